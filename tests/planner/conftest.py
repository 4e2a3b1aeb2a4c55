from __future__ import annotations

import numpy as np
import pytest

from planner import JointLimits, PiecewiseCubic
from planner.corners import finish_many, solve_many
from planner.limits import Allowance
from planner.moves import Legs

DEG = np.pi / 180.0


@pytest.fixture(scope="session")
def six_axis_limits() -> JointLimits:
    """Limits like those of a 16 kg industrial arm: full speed in 0.3 s, full acceleration in 0.1 s."""  # noqa: E501
    velocity = DEG * np.array([155.0, 155.0, 170.0, 360.0, 350.0, 550.0])
    return JointLimits(
        lower=DEG * np.array([-180.0, -60.0, -170.0, -720.0, -120.0, -720.0]),
        upper=DEG * np.array([180.0, 155.0, 110.0, 720.0, 120.0, 720.0]),
        velocity=velocity,
        acceleration=velocity / 0.3,
        jerk=velocity / 0.3 / 0.1,
    )


@pytest.fixture(scope="session")
def random_points(six_axis_limits: JointLimits):
    """Make `count` via points uniformly within the limits from a seed."""

    def points(seed: int, count: int = 6) -> np.ndarray:
        span = six_axis_limits.upper - six_axis_limits.lower
        shares = np.random.default_rng(seed).random((count, six_axis_limits.n_joints))
        return six_axis_limits.lower + shares * span

    return points


def rows_of(*limits: JointLimits) -> Allowance:
    """Limits as the rows of one table."""
    return Allowance(
        *(np.array([getattr(one, name) for one in limits]) for name in Allowance._fields)
    )


def legs_between(points: np.ndarray, limits: JointLimits) -> Legs:
    """The moves from each point to the next, at full limits."""
    bounds = rows_of(*[limits] * (len(points) - 1))
    return Legs.between(points[:-1], points[1:], bounds, bounds.acceleration)


@pytest.fixture(scope="session")
def join():
    """Join two states (n, 3) within limits in about a time [s], as a corner does."""

    def joined(start, end, limits: JointLimits, time: float) -> PiecewiseCubic | None:
        bounds = rows_of(limits)
        found = solve_many(start[None], end[None], np.array([time]), bounds)
        return finish_many(found, bounds)[0] if found.found[0] is not None else None

    return joined
