"""How near a motion comes to a point, and when."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.arrays import Array
from planner.piecewise_cubic import PiecewiseCubic

_SAMPLES = 65  # a join has one bend; its distance to the corner has one dip, now and then two
_STEPS = 60  # of Newton's method, four or five as a rule; halving alone would need about fifty
_RESOLUTION = 1e-15  # share of the duration that a time is told to


class Passing(NamedTuple):
    """Where a motion is nearest to a point.

    Attributes:
        time: When, from the beginning of the motion [s].
        distance: Euclidean distance in joint space [rad].
    """

    time: float
    distance: float


def passing(motion: PiecewiseCubic, point: Array) -> Passing:
    """Return where `motion` comes nearest to `point` (n,) [rad].

    The distance is that of a point of the path, so that the true one is never larger: what is
    found to be within a tolerance is.
    """
    times = np.linspace(0.0, motion.duration, _SAMPLES)
    apart = motion.sample(times)[0] - point
    square = np.einsum("ij,ij->i", apart, apart)
    index = int(square.argmin())
    time, best = float(times[index]), float(square[index])
    low, high = float(times[max(index - 1, 0)]), float(times[min(index + 1, _SAMPLES - 1)])
    # At its ends a motion may rest, where the slope tells nothing.
    t = time if low < time < high else 0.5 * (low + high)
    for _ in range(_STEPS):
        q, qd, qdd = motion.sample_one(t)
        gap = q - point
        apart_here, slope = float(gap @ gap), float(gap @ qd)
        if apart_here < best:
            time, best = t, apart_here
        low, high = (t, high) if slope < 0.0 else (low, t)
        bend = float(qd @ qd + gap @ qdd)
        closer = t - slope / bend if bend > 0.0 else high
        if not low < closer < high:  # Newton's step is none: halve what is left
            closer = 0.5 * (low + high)
        if abs(closer - t) <= _RESOLUTION * motion.duration:
            break
        t = closer
    return Passing(time, float(np.sqrt(best)))
