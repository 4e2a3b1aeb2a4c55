"""Straight joint-space moves between two via points, from rest to rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from planner.arrays import Array
from planner.bounds import Bounds
from planner.piecewise_cubic import PiecewiseCubic
from planner.scurve import rest_to_rest


@dataclass(frozen=True, eq=False)
class StraightSegment:
    """A straight line that all joints run in phase, ruled by the slowest of them.

    One scalar profile moves along the line, so the line is straight for any ratio between the
    joints' limits. (A general planner asked for phase synchronisation leaves the line where
    the joint that is slowest overall is not the one that is slowest to build up acceleration.)

    Attributes:
        start: Where it begins (n,) [rad].
        direction: Change of the joints per unit of path, largest entry 1, (n,).
        law: Path covered as a function of time, one joint.
        speeding_up: Time from rest to the fastest [s].
        slowing_down: Time from the fastest to rest [s].
    """

    start: Array
    direction: Array
    law: PiecewiseCubic
    speeding_up: float
    slowing_down: float

    @classmethod
    def between(
        cls, start: Array, end: Array, limits: Bounds, deceleration: Array | None = None
    ) -> Self:
        """Plan the fastest straight move that keeps the velocity, acceleration, jerk limits.

        `deceleration` (n,) [rad/s²] bounds the slowing down where it differs.
        """
        change = end - start
        size = np.abs(change)
        length = float(size.max())
        if length == 0.0:
            nowhere = PiecewiseCubic((np.zeros(2),), (np.zeros((1, 4)),))
            return cls(start, change, nowhere, 0.0, 0.0)
        slowing = limits.acceleration if deceleration is None else deceleration
        bounds = np.array((limits.velocity, limits.acceleration, limits.jerk, slowing))
        with np.errstate(divide="ignore", over="ignore"):
            along = (bounds / (size / length)).min(axis=1).tolist()
        return cls(start, change / length, *rest_to_rest(length, *along))

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        return self.law.duration

    def state(self, t: float) -> Array:
        """Return position, velocity and acceleration (n, 3) at time `t` [s]."""
        state: Array = self.states(np.array([t]))[0]
        return state

    def states(self, times: Array) -> Array:
        """Return position, velocity and acceleration (m, n, 3) at times (m,) [s] within it."""
        knots, pieces = self.law.knots[0], self.law.coefficients[0]
        index = knots[1:-1].searchsorted(times, side="right")
        p, v, a, j = pieces[index].T
        x = times - knots[index]
        along = np.empty((len(times), 1, 3))
        along[:, 0, 0] = p + x * (v + x * (a * 0.5 + x * j * (1.0 / 6.0)))
        along[:, 0, 1] = v + x * (a + x * j * 0.5)
        along[:, 0, 2] = a + x * j
        states: Array = self.direction[:, None] * along
        states[:, :, 0] += self.start
        return states

    def pieces(self, start: float, stop: float) -> PiecewiseCubic:
        """Return the part between two times [s] as a table of all joints."""
        law = self.law.restricted(start, stop)
        table = self.direction[:, None, None] * law.coefficients[0]
        table[:, :, 0] += self.start[:, None]
        return PiecewiseCubic(law.knots * len(table), tuple(table))
