"""What lost answers left an arm behind by, made up little by little.

A controller that is without an answer holds its target. The set-point that it takes next would be
two steps or more from that target in one cycle. Instead the arm goes on from there with its own
step, behind its path in time, and catches up at no more than `SHARE` of full speed: planners leave
at least that of speed, acceleration and jerk (:mod:`planner.profiles`).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHARE: Final = 0.005
"""Of full speed, for what was lost at one time."""
_FEWEST: Final = 200
"""Cycles."""
_STEEPEST: Final = 1.875
"""Largest slope of the curve from 1 to 0 with no speed and acceleration at its ends."""


class CatchUp:
    """How far an arm is behind its path, and how fast it catches up.

    Args:
        velocity: (n,) rad/s, full speed.
        period: s.
    """

    def __init__(self, velocity: Array, period: float) -> None:
        self._velocity = velocity
        self._period = period
        self._lost: list[tuple[Array, int, int]] = []  # way, cycles, cycles since
        self._none = np.zeros(len(velocity))

    @property
    def active(self) -> bool:
        """Whether it is behind."""
        return bool(self._lost)

    def begin(self) -> None:
        """Nothing was lost."""
        self._lost.clear()

    def add(self, way: Array) -> None:
        """It fell behind by a way (n,) rad."""
        slowest = float(np.max(np.abs(way) / (SHARE * self._velocity * self._period)))
        self._lost.append((way, max(_FEWEST, math.ceil(_STEEPEST * slowest)), 0))

    def advance(self) -> tuple[Array, Array]:
        """One period on: how far it is behind (n,) rad, and the rate of that (n,) rad/s."""
        behind, rate = self._none, self._none
        for way, cycles, since in self._lost:
            left, slope = _curve((since + 1) / cycles)
            behind = behind + left * way
            rate = rate + slope / (cycles * self._period) * way
        self._lost = [(way, n, since + 1) for way, n, since in self._lost if since + 1 < n]
        return behind, rate


def _curve(x: float) -> tuple[float, float]:
    """From 1 at x = 0 to 0 at x = 1, and its slope: the quintic at rest at both ends."""
    return 1.0 - x**3 * (10.0 - 15.0 * x + 6.0 * x**2), -30.0 * x**2 * (1.0 - x) ** 2
