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

_RATES = ("velocity", "acceleration", "jerk")


def limit_violations(
    trajectory: PiecewiseCubic | FourierSeries, limits: JointLimits, motion: Motion
) -> list[Violation]:
    """Return the largest violation of each quantity and joint.

    Its time is that of one of the samples of the motion, which include both ends.
    """
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
