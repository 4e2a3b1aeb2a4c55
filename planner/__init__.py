"""Via points to motion, as an industrial controller's joint interpolator runs it.

`plan` turns via points into a `PiecewiseCubic`; `TrajectoryPlayer` gives it out one set-point
per controller cycle and stops it on its path.
"""

from __future__ import annotations

from planner.errors import (
    InvalidLimits,
    InvalidSetting,
    InvalidTrajectory,
    InvalidViaPoints,
    LimitExceeded,
    NonFiniteViaPoint,
    NotBegun,
    NotSmooth,
    PlannerError,
    PlanningError,
    StartMismatch,
    TooFewViaPoints,
    ViaPointOutOfLimits,
    WrongShape,
)
from planner.limits import JointLimits
from planner.piecewise_cubic import Extrema, PiecewiseCubic
from planner.plan import plan
from planner.player import TrajectoryPlayer
from planner.trajectory import Trajectory
from planner.verify import check_limits

__all__ = [
    "plan",
    "check_limits",
    "JointLimits",
    "Trajectory",
    "PiecewiseCubic",
    "Extrema",
    "TrajectoryPlayer",
    "PlannerError",
    "InvalidLimits",
    "InvalidSetting",
    "InvalidTrajectory",
    "InvalidViaPoints",
    "WrongShape",
    "TooFewViaPoints",
    "NonFiniteViaPoint",
    "ViaPointOutOfLimits",
    "PlanningError",
    "LimitExceeded",
    "NotSmooth",
    "StartMismatch",
    "NotBegun",
]
