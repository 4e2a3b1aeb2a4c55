"""The promise of a plan, checked on its finished table."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from planner.errors import LimitExceeded, NotSmooth
from planner.limits import Bounds, jump_rounding, position_rounding
from planner.piecewise_cubic import Extrema, PiecewiseCubic, Trajectory


class Bounded(Protocol):
    """A motion that knows how far it goes."""

    def extrema(self) -> Extrema:
        """Return bounds of its extremes over all time, rigorous ones."""
        ...


def check_limits(trajectory: Bounded, limits: Bounds) -> None:
    """Refuse a trajectory that breaks a limit anywhere, analytically.

    Raises:
        LimitExceeded: naming the first offending quantity, its worst joint, value and bound.
    """
    extrema = trajectory.extrema()
    slack = position_rounding(limits)
    for quantity, end, sign in (
        ("position", "lower", -1.0),
        ("position", "upper", 1.0),
        *((rate, rate, 1.0) for rate in ("velocity", "acceleration", "jerk")),
    ):
        value, bound = getattr(extrema, end), getattr(limits, end)
        excess = sign * (value - bound) - (slack if quantity == "position" else 0.0)
        if not np.all(excess <= 0.0):  # written so that NaN is refused too
            joint = int(np.argmax(excess))
            raise LimitExceeded(quantity, joint, float(value[joint]), float(bound[joint]))


def check_smooth(trajectory: PiecewiseCubic, limits: Bounds) -> None:
    """Refuse a trajectory that is not C2, or not at rest at both ends.

    Raises:
        NotSmooth: naming the quantity, joint, time and jump.
    """
    scale = jump_rounding(limits, trajectory.duration)
    for joint, ends in enumerate(trajectory.ends()):
        starts = trajectory.coefficients[joint][:, :3]
        rest_before = [[starts[0, 0], 0.0, 0.0]]
        rest_after = [[ends[-1, 0], 0.0, 0.0]]
        jumps = np.abs(np.concatenate((starts, rest_after)) - np.concatenate((rest_before, ends)))
        if not np.all(jumps <= scale[joint]):
            knot, which = np.unravel_index(int(np.argmax(jumps / scale[joint])), jumps.shape)
            raise NotSmooth(
                ("position", "velocity", "acceleration")[which],
                joint,
                float(trajectory.knots[joint][knot]),
                float(jumps[knot, which]),
            )


def check_rest(trajectory: Trajectory, limits: Bounds) -> None:
    """Refuse a trajectory of any kind that is not at rest at both ends.

    Raises:
        NotSmooth: naming the quantity, joint, time and what is left of velocity or acceleration.
    """
    scale = jump_rounding(limits, trajectory.duration)[:, 1:]
    times = np.array([0.0, trajectory.duration])
    _, *rates = trajectory.sample(times)
    left = np.abs(np.stack(rates, axis=2))  # (2, n, 2)
    if not np.all(left <= scale):  # written so that NaN is refused too
        end, joint, which = np.unravel_index(int(np.argmax(left / scale)), left.shape)
        raise NotSmooth(
            ("velocity", "acceleration")[which],
            int(joint),
            float(times[end]),
            float(left[end, joint, which]),
        )
