"""What limits look like to those who only read them; `JointLimits` are such."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from planner.arrays import Array


class Bounds(Protocol):
    """Range and largest rates of every joint, each (n,)."""

    @property
    def lower(self) -> Array:
        """Smallest position [rad]."""
        ...

    @property
    def upper(self) -> Array:
        """Largest position [rad]."""
        ...

    @property
    def velocity(self) -> Array:
        """Largest |velocity| [rad/s]."""
        ...

    @property
    def acceleration(self) -> Array:
        """Largest |acceleration| [rad/s²]."""
        ...

    @property
    def jerk(self) -> Array:
        """Largest |jerk| [rad/s³]."""
        ...


class Allowance(NamedTuple):
    """`Bounds` made of others that were checked before, each (n,), SI units."""

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
