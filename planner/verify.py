"""The promise of a plan, checked on its finished table."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from planner.arrays import Array
from planner.errors import LimitExceeded, NotSmooth
from planner.limits import Bounds
from planner.piecewise_cubic import Extrema, PiecewiseCubic, Trajectory

# Rounding, not licence: a position may leave its range by this share of the range's size, and
# neighbouring pieces may differ by this share of the limit of the quantity.
POSITION_ROUNDING = 1e-12
RATE_ROUNDING = 1e-9


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
    for quantity, value, bound, excess in (
        ("position", extrema.lower, limits.lower, limits.lower - extrema.lower - slack),
        ("position", extrema.upper, limits.upper, extrema.upper - limits.upper - slack),
        ("velocity", extrema.velocity, limits.velocity, extrema.velocity - limits.velocity),
        (
            "acceleration",
            extrema.acceleration,
            limits.acceleration,
            extrema.acceleration - limits.acceleration,
        ),
        ("jerk", extrema.jerk, limits.jerk, extrema.jerk - limits.jerk),
    ):
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


def position_rounding(limits: Bounds) -> Array:
    """Return by how much a position may leave its range, which counts as rounding, (..., n)."""
    return POSITION_ROUNDING * np.maximum(np.abs(limits.lower), np.abs(limits.upper))


def jump_rounding(limits: Bounds, duration: float | Array) -> Array:
    """Return the jumps of position, velocity, acceleration that count as rounding, (..., n, 3).

    Durations (...) [s] and limits (..., n) are of one motion or of many.
    """
    # A knot is reported no finer than the clock allows: late in a long motion that shows.
    tick = 4.0 * np.spacing(np.asarray(duration, dtype=np.float64))[..., None]
    return np.stack(
        (
            position_rounding(limits) + tick * limits.velocity,
            RATE_ROUNDING * limits.velocity + tick * limits.acceleration,
            RATE_ROUNDING * limits.acceleration + tick * limits.jerk,
        ),
        axis=-1,
    )
