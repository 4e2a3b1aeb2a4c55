"""A motion that was drawn at random: what it was planned from, and the motion itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner import FlyPercent, Move, PiecewiseCubic

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """A motion, and what it was planned from.

    Attributes:
        via_points: (n_points, n) [rad], home at both ends included.
        speed: (n,) share of each joint's velocity limit.
        fly: how far corners are rounded, 0 to 1.
        trajectory: the motion planned from these.
    """

    via_points: Array
    speed: Array
    fly: float
    trajectory: PiecewiseCubic

    @property
    def moves(self) -> tuple[Move, ...]:
        """The moves from the first via point on; they plan to the trajectory, bit for bit."""
        return moves_through(self.via_points, self.speed, self.fly)


def moves_through(via_points: Array, speed: Array, fly: float) -> tuple[Move, ...]:
    """Return one move to each via point but the first, as `planner.plan` makes them."""
    passing = FlyPercent(100.0 * fly)
    return tuple(Move(point, joint_speed=speed, fly=passing) for point in via_points[1:])
