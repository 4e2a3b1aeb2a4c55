from __future__ import annotations

import numpy as np

from planner import JointLimits, PiecewiseCubic
from planner.corners import finish_many, solve_many
from planner.limits import Allowance
from planner.moves import Legs

DEG = np.pi / 180.0


_VELOCITY = DEG * np.array([155.0, 155.0, 170.0, 360.0, 350.0, 550.0])
SIX_AXES = JointLimits(
    lower=DEG * np.array([-180.0, -60.0, -170.0, -720.0, -120.0, -720.0]),
    upper=DEG * np.array([180.0, 155.0, 110.0, 720.0, 120.0, 720.0]),
    velocity=_VELOCITY,
    acceleration=_VELOCITY / 0.3,
    jerk=_VELOCITY / 0.3 / 0.1,
)
"""Limits like those of a 16 kg industrial arm: full speed in 0.3 s, acceleration in 0.1 s."""


def random_points(seed: int, count: int = 6) -> np.ndarray:
    """So many via points uniformly within the limits."""
    shares = np.random.default_rng(seed).random((count, SIX_AXES.n_joints))
    return SIX_AXES.lower + shares * (SIX_AXES.upper - SIX_AXES.lower)


def rows_of(*limits: JointLimits) -> Allowance:
    """Limits as the rows of one table."""
    return Allowance(
        *(
            np.array([getattr(joint_limits, name) for joint_limits in limits])
            for name in Allowance._fields
        )
    )


def legs_between(points: np.ndarray, limits: JointLimits) -> Legs:
    """The moves from each point to the next, at full limits."""
    bounds = rows_of(*[limits] * (len(points) - 1))
    return Legs.between(points[:-1], points[1:], bounds, bounds.acceleration)


def join(start, end, limits: JointLimits, time: float) -> PiecewiseCubic | None:
    """Join two states (n, 3) within limits in about a time [s], as a corner does."""
    bounds = rows_of(limits)
    solutions = solve_many(start[None], end[None], np.array([time]), bounds)
    return finish_many(solutions, bounds)[0] if solutions.trajectories[0] is not None else None
