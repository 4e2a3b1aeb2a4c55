"""Whether a motion keeps the joint limits between its samples too, and rests at both ends.

A table of cubics tells its extremes from its roots. A sum of sines does so only at a price that a
search over thousands cannot pay, so its samples decide first: a limit that a sample exceeds is
broken, and one that is farther from all samples than the sum can swing between two of them
(f <= max + M h²/8, M the sum's largest second derivative) is satisfied. Only what lies between is
looked at exactly. Either answer is rigorous.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.excitation.violation import Violation
from identification.model.motion import Motion
from planner import (
    FourierSeries,
    JointLimits,
    NotSmooth,
    PiecewiseCubic,
    check_rest,
)
from planner.limits import position_rounding
from planner.piecewise_cubic import Extrema

Array = NDArray[np.float64]

# Samples within a ramp that is shorter than the motion's own.
_IN_RAMP = 17
_RATES = ("velocity", "acceleration", "jerk")


class RateBounds(NamedTuple):
    """Bounds of the magnitudes of each joint's rates in g parts of a motion, (n, g) each."""

    velocity: Array
    acceleration: Array
    jerk: Array


class _Swing(NamedTuple):
    """By how much a series may exceed what its samples show, (n,) each."""

    position: Array
    velocity: Array
    acceleration: Array
    jerk: Array


def limit_violations(
    trajectory: PiecewiseCubic | FourierSeries, limits: JointLimits, motion: Motion
) -> list[Violation]:
    """Return for each quantity and joint the largest excess over its limit, if there is any.

    Args:
        trajectory: the motion.
        limits: what it must keep.
        motion: samples of it, both ends included; they say when the excess is.
    """
    if isinstance(trajectory, PiecewiseCubic):
        return _beyond(trajectory.extrema(), limits, motion)
    attained = _attained(motion)
    found = _beyond(attained, limits, motion)
    for ramp in _short_ramps(trajectory, motion):
        found = found or _beyond(_attained(ramp), limits, ramp)
    if found or _within(attained, _swing(trajectory, motion), limits):
        return found
    return _beyond(trajectory.extrema(), limits, motion)


def rest_violations(
    trajectory: PiecewiseCubic | FourierSeries, limits: JointLimits
) -> list[Violation]:
    """Return what is left of a rate where the motion begins or ends, if anything is."""
    try:
        check_rest(trajectory, limits)
    except NotSmooth as jump:
        end = "end" if jump.time > 0.0 else "start"
        bare = isinstance(trajectory, FourierSeries) and trajectory.ramp == 0.0
        return [
            Violation(
                "joint limit",
                f"{jump.quantity} of joint {jump.joint} at the {end}",
                jump.jump,
                0.0,
                jump.time,
                scale=float(getattr(limits, jump.quantity)[jump.joint]),
                remedy="a bare series of sines starts and ends at speed; give it a ramp over "
                "which the sines grow and fade"
                if bare
                else "a motion must start and end at rest",
            )
        ]
    return []


def _beyond(extrema: Extrema, limits: JointLimits, motion: Motion) -> list[Violation]:
    slack = position_rounding(limits)
    room = limits.upper - limits.lower
    found = [
        *_low(extrema.lower, limits.lower - slack, limits.lower, room, motion),
        *_high("position", extrema.upper, limits.upper + slack, limits.upper, room, motion),
    ]
    for quantity in _RATES:
        bound = getattr(limits, quantity)
        found += _high(quantity, getattr(extrema, quantity), bound, bound, bound, motion)
    return found


def _low(
    value: Array, least: Array, bound: Array, scale: Array, motion: Motion
) -> Iterable[Violation]:
    for joint in np.flatnonzero(~(value >= least)).tolist():  # NaN is beyond every bound
        k = int(np.argmin(motion.position[:, joint]))
        yield _violation("position", joint, value, bound, scale, motion, k)


def _high(
    quantity: str, value: Array, most: Array, bound: Array, scale: Array, motion: Motion
) -> Iterable[Violation]:
    for joint in np.flatnonzero(~(value <= most)).tolist():
        size = motion.position if quantity == "position" else np.abs(_sampled(quantity, motion))
        k = int(np.argmax(size[:, joint]))
        yield _violation(quantity, joint, value, bound, scale, motion, k)


def _violation(
    quantity: str, joint: int, value: Array, bound: Array, scale: Array, motion: Motion, k: int
) -> Violation:
    return Violation(
        "joint limit",
        f"{quantity} of joint {joint}",
        float(value[joint]),
        float(bound[joint]),
        float(motion.time[k]),
        tuple(motion.position[k].tolist()),
        scale=float(scale[joint]),
    )


def _sampled(quantity: str, motion: Motion) -> Array:
    if quantity == "velocity":
        return motion.velocity
    if quantity == "acceleration":
        return motion.acceleration
    return _jerk(motion)


def _jerk(motion: Motion) -> Array:
    """Return the mean jerk between samples (m - 1, n), which the true one attains there."""
    steps = np.diff(motion.time)
    change: Array = np.diff(motion.acceleration, axis=0) / steps[:, None]
    return change


def _attained(motion: Motion) -> Extrema:
    return Extrema(
        motion.position.min(axis=0),
        motion.position.max(axis=0),
        *(np.abs(_sampled(quantity, motion)).max(axis=0) for quantity in _RATES),
    )


def _short_ramps(series: FourierSeries, motion: Motion) -> list[Motion]:
    """Return samples within ramps that are too short for the motion's own samples to show them.

    What such ramps break is seen there at once; looking at it exactly would cost seconds.
    """
    step = float(np.max(np.diff(motion.time)))
    if not 0.0 < series.ramp < 3.0 * step:
        return []
    shares = np.linspace(0.0, series.ramp, _IN_RAMP)
    parts = (shares, series.length - shares[::-1])
    return [
        Motion(time, *series.sample(time)) for time in parts if bool(np.all(np.diff(time) > 0.0))
    ]


def _within(attained: Extrema, swing: _Swing, limits: JointLimits) -> bool:
    return bool(
        np.all(attained.lower - swing.position >= limits.lower)
        and np.all(attained.upper + swing.position <= limits.upper)
        and np.all(attained.velocity + swing.velocity <= limits.velocity)
        and np.all(attained.acceleration + swing.acceleration <= limits.acceleration)
        and np.all(attained.jerk + swing.jerk <= limits.jerk)
    )


def _swing(series: FourierSeries, motion: Motion) -> _Swing:
    step = float(np.max(np.diff(motion.time)))
    second, third, fourth = (series.derivative_bound(order) for order in (2, 3, 4))
    # Where sines stop growing or begin to fade the jerk jumps. A neighbouring pair of samples on
    # the same side of that knows it to two steps' time, if each part lasts three.
    parts = [series.ramp, series.length - 2.0 * series.ramp]
    long_enough = all(part == 0.0 or part >= 3.0 * step for part in parts)
    jerk = 2.0 * step * fourth if long_enough else np.full_like(fourth, np.inf)
    acceleration = fourth * step**2 / 8.0 if series.ramp == 0.0 else third * step / 2.0
    return _Swing(second * step**2 / 8.0, third * step**2 / 8.0, acceleration, jerk)


def rate_bounds(
    trajectory: PiecewiseCubic | FourierSeries, start: Array, stop: Array
) -> RateBounds:
    """Return bounds of the rates in parts of a motion, sound and quick rather than tight.

    Args:
        trajectory: a table, or a series: short ramps count only in the parts they reach into.
        start: of each part (g,) [s].
        stop: of each part (g,) [s].
    """
    if isinstance(trajectory, FourierSeries):
        ramp, length = trajectory.ramp, trajectory.length
        between = (start >= ramp) & (stop <= length - ramp)
        return RateBounds(
            *(
                np.where(
                    between,
                    trajectory.derivative_bound(order, ramps=False)[:, None],
                    trajectory.derivative_bound(order)[:, None],
                )
                for order in (1, 2, 3)
            )
        )
    extrema = trajectory.extrema()
    everywhere = np.ones(len(start))
    return RateBounds(
        *(
            rate[:, None] * everywhere
            for rate in (extrema.velocity, extrema.acceleration, extrema.jerk)
        )
    )
