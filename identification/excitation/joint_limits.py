"""Joint limits over all time, and rest at both ends."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from identification.excitation.violation import Violation
from identification.model.motion import Motion
from planner import FourierSeries, JointLimits, NotSmooth, PiecewiseCubic, check_rest
from planner.limits import position_rounding
from planner.piecewise_cubic import Extrema

Array = NDArray[np.float64]

_IN_RAMP = 17  # samples within a short ramp
_RATES = ("velocity", "acceleration", "jerk")


def limit_violations(
    trajectory: PiecewiseCubic | FourierSeries, limits: JointLimits, motion: Motion
) -> list[Violation]:
    """Return the largest violation of each quantity and joint.

    Its time is that of one of the samples of the motion, which include both ends.
    """
    if isinstance(trajectory, FourierSeries):
        for samples in (motion, *_short_ramps(trajectory, motion)):
            if found := _beyond(_attained(samples), limits, samples):
                return found
        if _certain(trajectory, limits, motion):
            return []
    return _beyond(trajectory.extrema(), limits, motion)


def rest_violations(
    trajectory: PiecewiseCubic | FourierSeries, limits: JointLimits
) -> list[Violation]:
    """Return the largest rate at the start or end of a motion, if it is not zero."""
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
                remedy="a sum of sines without a ramp starts and ends at speed; set a ramp"
                if bare
                else "a motion must start and end at rest",
            )
        ]
    return []


def _beyond(extrema: Extrema, limits: JointLimits, motion: Motion) -> list[Violation]:
    rounding, span = position_rounding(limits), limits.upper - limits.lower
    # Quantity, extremum, bound, sign of an excess, tolerance, scale.
    rows = [
        ("position", extrema.lower, limits.lower, -1.0, rounding, span),
        ("position", extrema.upper, limits.upper, 1.0, rounding, span),
    ]
    for name in _RATES:
        bound = getattr(limits, name)
        rows.append((name, getattr(extrema, name), bound, 1.0, 0.0 * bound, bound))
    found = []
    for quantity, value, bound, sign, tolerance, scale in rows:
        broken = np.flatnonzero(~(sign * value <= sign * bound + tolerance)).tolist()  # NaN as well
        for joint in broken:
            if quantity == "position":
                size = sign * motion.position
            else:
                size = _rates(motion)[_RATES.index(quantity)]
            k = int(np.argmax(size[:, joint]))
            found.append(
                Violation(
                    "joint limit",
                    f"{quantity} of joint {joint}",
                    float(value[joint]),
                    float(bound[joint]),
                    float(motion.time[k]),
                    tuple(motion.position[k].tolist()),
                    scale=float(scale[joint]),
                )
            )
    return found


def _rates(motion: Motion) -> tuple[Array, Array, Array]:
    """Return |qd|, |qdd| at the samples and the mean |jerk| between them."""
    jerk = np.diff(motion.acceleration, axis=0) / np.diff(motion.time)[:, None]
    return np.abs(motion.velocity), np.abs(motion.acceleration), np.abs(jerk)


def _attained(motion: Motion) -> Extrema:
    ends = motion.position.min(axis=0), motion.position.max(axis=0)
    return Extrema(*ends, *(rate.max(axis=0) for rate in _rates(motion)))


def _short_ramps(series: FourierSeries, motion: Motion) -> list[Motion]:
    """Return samples within the ramps if these are shorter than three sample periods."""
    step = float(np.max(np.diff(motion.time)))
    if not 0.0 < series.ramp < 3.0 * step:
        return []
    shares = np.linspace(0.0, series.ramp, _IN_RAMP)
    parts = (shares, series.length - shares[::-1])
    return [
        Motion(time, *series.sample(time)) for time in parts if bool(np.all(np.diff(time) > 0.0))
    ]


def _certain(series: FourierSeries, limits: JointLimits, motion: Motion) -> bool:
    """Whether the samples are farther from all limits than the series deviates between them.

    That is at most M h²/8 (M: largest second derivative); else exact extrema are computed.
    """
    step = float(np.max(np.diff(motion.time)))
    second, third, fourth = (series.derivative_bound(order) for order in (2, 3, 4))
    # The jerk jumps at the ends of the ramps. If each part of the motion lasts three steps, a pair
    # of samples on the same side gives the jerk with an error of two steps.
    parts = [series.ramp, series.length - 2.0 * series.ramp]
    long_enough = all(part == 0.0 or part >= 3.0 * step for part in parts)
    reached = _attained(motion)
    position = second * step**2 / 8.0
    velocity = third * step**2 / 8.0
    acceleration = fourth * step**2 / 8.0 if series.ramp == 0.0 else third * step / 2.0
    jerk = 2.0 * step * fourth if long_enough else np.full_like(fourth, np.inf)
    return bool(
        np.all(reached.lower - position >= limits.lower)
        and np.all(reached.upper + position <= limits.upper)
        and np.all(reached.velocity + velocity <= limits.velocity)
        and np.all(reached.acceleration + acceleration <= limits.acceleration)
        and np.all(reached.jerk + jerk <= limits.jerk)
    )


def acceleration_bound(
    trajectory: PiecewiseCubic | FourierSeries, start: Array, stop: Array
) -> Array:
    """Return an upper bound of |qdd| in parts of a motion from `start` to `stop` [s], (n, g)."""
    if isinstance(trajectory, FourierSeries):
        ramp, length = trajectory.ramp, trajectory.length
        between_ramps = (start >= ramp) & (stop <= length - ramp)
        without = trajectory.derivative_bound(2, ramps=False)[:, None]
        return np.where(between_ramps, without, trajectory.derivative_bound(2)[:, None])
    largest = trajectory.extrema().acceleration
    return np.broadcast_to(largest[:, None], (len(largest), len(start)))
