"""Straight joint-space moves between two via points, from rest to rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from planner.arrays import Array
from planner.limits import JointLimits
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
        ramp: Time spent accelerating, equal to that spent decelerating [s].
    """

    start: Array
    direction: Array
    law: PiecewiseCubic
    ramp: float

    @classmethod
    def between(cls, start: Array, end: Array, limits: JointLimits) -> Self:
        """Plan the fastest straight move that keeps the velocity, acceleration, jerk limits."""
        change = end - start
        length = float(np.max(np.abs(change)))
        if length == 0.0:
            nowhere = PiecewiseCubic((np.zeros(2),), (np.zeros((1, 4)),))
            return cls(start, change, nowhere, 0.0)
        direction = change / length
        with np.errstate(divide="ignore", over="ignore"):
            along = [
                float(np.min(bound / np.abs(direction)))
                for bound in (limits.velocity, limits.acceleration, limits.jerk)
            ]
        return cls(start, direction, *rest_to_rest(length, *along))

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        return self.law.duration

    def state(self, t: float) -> Array:
        """Return position, velocity and acceleration (n, 3) at time `t` [s]."""
        state = np.outer(self.direction, np.concatenate(self.law.sample_one(t)))
        state[:, 0] += self.start
        return state

    def pieces(self, start: float, stop: float) -> PiecewiseCubic:
        """Return the part between two times [s] as a table of all joints."""
        law = self.law.restricted(start, stop)
        table = self.direction[:, None, None] * law.coefficients[0]
        table[:, :, 0] += self.start[:, None]
        return PiecewiseCubic(law.knots * len(table), tuple(table))
