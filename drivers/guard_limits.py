"""What the guard enforces, and which of the three sets of bounds is in force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.motion_source import BoundsName

Array = NDArray[np.float64]

DEFAULT_STANDSTILL: Final = 5e-4
"""Motor revolutions per cycle below which an axis stands still.

An encoder at rest toggles between two increments, so a velocity formed over one cycle shows one
increment per cycle at worst and two with a little servo dither. Two increments of a coarse 12-bit
encoder are 4.9e-4; at 2 ms this is some 0.5 % of a drive's full speed.
"""

RANK: Final[Mapping[BoundsName, int]] = {"plan": 0, "override": 1, "stop": 2}
CARRIED_ON: Final = 3
"""Rank of the bounds of a stop without one on jerk: the steps that a controller made by itself have
none of the motion's acceleration, so that returning to it is a jump of acceleration."""
MEMORY: Final = 2
"""Cycles for which wider bounds stay: a third difference reaches over three cycles."""


@dataclass(frozen=True, eq=False)
class GuardLimits:
    """What the guard enforces; arrays (n,).

    Attributes:
        lower: rad, smallest joint position.
        upper: rad, largest.
        velocity: rad/s, magnitude, in all three sets of bounds.
        acceleration: rad/s², of the set "plan".
        jerk: rad/s³, of the set "plan".
        following_error: motor revolutions, as the controller states its thresholds.
        current: A.
        override_acceleration: factor on acceleration while an override changes.
        override_jerk: factor on jerk while an override changes.
        stop_acceleration: factor on acceleration during hold and stop.
        stop_jerk: factor on jerk during hold and stop.
        standstill: motor revolutions per cycle, see `DEFAULT_STANDSTILL`.
        current_rise: s that a commanded current takes, at least, from zero to its limit.

    Raises:
        ValueError: a shape, sign or order is wrong; names the field.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    following_error: Array
    current: Array
    override_acceleration: float = 1.3
    override_jerk: float = 1.7
    stop_acceleration: float = 2.0
    stop_jerk: float = 3.0
    standstill: float = DEFAULT_STANDSTILL
    current_rise: float = 0.01

    def __post_init__(self) -> None:
        n = np.size(self.lower)
        for name in ("lower", "upper", "velocity", "acceleration", "jerk"):
            self._check(name, n, positive=name not in ("lower", "upper"))
        self._check("following_error", n, positive=True)
        self._check("current", n, positive=True)
        if not np.all(self.lower < self.upper):
            raise ValueError(f"guard limits: lower {self.lower} is not below upper {self.upper}")
        for plan, override, stop in (
            (1.0, self.override_acceleration, self.stop_acceleration),
            (1.0, self.override_jerk, self.stop_jerk),
        ):
            if not plan <= override <= stop:
                raise ValueError(f"guard limits: factors 1 <= {override} <= {stop} do not hold")
        for name in ("standstill", "current_rise"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"guard limits: {name} {getattr(self, name)} is not positive")

    def _check(self, name: str, n: int, *, positive: bool) -> None:
        array = np.array(getattr(self, name), dtype=np.float64)
        if array.shape != (n,) or not np.all(np.isfinite(array)):
            raise ValueError(f"guard limits: {name} must be {n} finite numbers, got {array}")
        if positive and not np.all(array > 0.0):
            raise ValueError(f"guard limits: {name} must be positive, got {array}")
        object.__setattr__(self, name, array)

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.lower)

    def factors(self, rank: int) -> tuple[float, float]:
        """Factors on acceleration and jerk of a set of bounds, by its `RANK` or `CARRIED_ON`."""
        stop = self.stop_acceleration
        return (
            (1.0, self.override_acceleration, stop, stop)[rank],
            (1.0, self.override_jerk, self.stop_jerk, np.inf)[rank],
        )


class BoundsInForce:
    """Wider bounds stay in force until no difference reaches back to them.

    Attributes:
        rank: of the set in force.
    """

    def __init__(self) -> None:
        self.rank = 0
        self._age = 0

    def reset(self, rank: int = 0, cycles: int = 0) -> None:
        """Nothing was sent yet; or a set comes into force that applies for so many cycles more."""
        self.rank, self._age = rank, -cycles

    def take(self, bounds: BoundsName) -> int:
        """The set that the next set-point belongs to; returns the rank of the one in force."""
        rank = RANK[bounds]
        if rank >= self.rank:
            self.rank, self._age = rank, 0
        elif self._age < MEMORY:
            self._age += 1
        else:
            self.rank = rank
        return self.rank
