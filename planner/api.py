"""All public names of `planner`, imported when the first of them is used."""

from planner.errors import (
    InvalidLimits,
    InvalidPlanFile,
    InvalidSetting,
    InvalidTrajectory,
    InvalidViaPoints,
    LimitExceeded,
    NotSmooth,
    PlannerCrashed,
    PlannerError,
    PlannerNotStarted,
    PlanningError,
    PlanningTimedOut,
    StartMismatch,
    UnsupportedSolver,
)
from planner.fourier import FourierSeries, harmonic_bounds
from planner.interpolator import Interpolator
from planner.limits import JointLimits
from planner.moves import (
    MotionPlan,
    Move,
    Overrides,
    TargetPassage,
    plan,
    plan_chunk,
    plan_moves,
)
from planner.piecewise_cubic import Extrema, PiecewiseCubic, Trajectory, check_limits, check_rest
from planner.plan_file import PlanFile, to_csv
from planner.player import TrajectoryPlayer
from planner.worker import WorkerProcess, in_child, plan_in_child

__all__ = [
    "plan",
    "plan_moves",
    "Move",
    "Overrides",
    "MotionPlan",
    "TargetPassage",
    "plan_chunk",
    "plan_in_child",
    "in_child",
    "WorkerProcess",
    "check_limits",
    "check_rest",
    "JointLimits",
    "Trajectory",
    "PiecewiseCubic",
    "Extrema",
    "FourierSeries",
    "harmonic_bounds",
    "TrajectoryPlayer",
    "Interpolator",
    "PlanFile",
    "to_csv",
    "PlannerError",
    "InvalidLimits",
    "InvalidSetting",
    "InvalidTrajectory",
    "InvalidPlanFile",
    "InvalidViaPoints",
    "PlanningError",
    "LimitExceeded",
    "NotSmooth",
    "UnsupportedSolver",
    "PlannerCrashed",
    "PlannerNotStarted",
    "PlanningTimedOut",
    "StartMismatch",
]
