"""The largest value of a smooth function, bounded without a gap between its samples.

A function stays below the straight line between two of its values plus M h²/8, if M bounds its
second derivative and h is how far they are apart. So where the samples say that no maximum can be,
there is none; the rest is divided again.
"""

from __future__ import annotations

from collections.abc import Callable
from math import ceil, sqrt

import numpy as np

from planner.arrays import Array

# The result may exceed the truth by this share of `largest`; some 1e4 times what rounding does.
_RESOLUTION = 1e-10
# At first the function is told to this share; each division tells _PARTS² times more.
_FIRST = 1e-3
_PARTS = 8
# Below this, quotients of bounds lose their digits; no motion is so small.
_TINY = 1e-290
# A function that needs more samples than this is bounded by `largest` alone.
_MOST_SAMPLES = 400_000


def supremum(
    function: Callable[[Array], Array],
    start: float,
    stop: float,
    *,
    largest: float,
    curvature: float,
) -> float:
    """Return an upper bound, tight to 1e-10 of `largest`, of a function on [start, stop].

    Args:
        function: Values at times (m,): what has a continuous second derivative between the ends,
            or the magnitude of that.
        start: Where to begin.
        stop: Where to end, above `start`.
        largest: A bound of the function's magnitude, known beforehand.
        curvature: A bound of the magnitude of its second derivative.
    """
    if largest < _TINY:
        return largest
    pieces = (stop - start) * sqrt(curvature / (8.0 * _FIRST * largest))
    if not pieces <= _MOST_SAMPLES:  # written so that an infinite bound ends here
        return largest
    knots = np.linspace(start, stop, 1 + max(1, ceil(pieces)))
    left, right = knots[:-1], knots[1:]
    values = function(knots)
    higher = np.maximum(values[:-1], values[1:])
    while True:
        step = float(np.max(right - left))
        excess = curvature * step * step / 8.0
        best = float(np.max(higher))
        if excess <= _RESOLUTION * largest or len(left) * _PARTS > _MOST_SAMPLES:
            return min(best + excess, largest)
        possible = higher + excess > best
        left, right = _divided(left[possible], right[possible])
        higher = np.maximum(function(left), function(right))


def _divided(left: Array, right: Array) -> tuple[Array, Array]:
    shares = np.linspace(0.0, 1.0, 1 + _PARTS)
    knots = left[:, None] + (right - left)[:, None] * shares
    knots[:, -1] = right
    return knots[:, :-1].ravel(), knots[:, 1:].ravel()
