"""How far, how fast and how abruptly each joint may move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arrays import Array, read_only
from planner.errors import InvalidLimits


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
    """`Bounds` made of others that were checked before, of one motion (n,) or of many (c, n)."""

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array

    @classmethod
    def of_many(cls, bounds: Sequence[Bounds]) -> Allowance:
        """Return bounds (n,) each as rows."""
        return cls(*(np.array([getattr(one, name) for one in bounds]) for name in cls._fields))

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> Allowance:
        """Return some of the rows, by index or mask."""
        return Allowance(*(bound[rows] for bound in self))


# No arm comes near; far beyond, the corners' solver has been seen to take its process with it.
SMALLEST_RATE: Final = 1e-10
LARGEST_RATE: Final = 1e10


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Position range and largest rates of every joint, each (n,) and read-only.

    Attributes:
        lower: Smallest position [rad].
        upper: Largest position [rad].
        velocity: Largest |velocity| [rad/s].
        acceleration: Largest |acceleration| [rad/s²].
        jerk: Largest |jerk| [rad/s³].

    Raises:
        InvalidLimits: shapes differ, a value is not finite, lower >= upper, a rate outside
            1e-10..1e10.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array

    def __post_init__(self) -> None:
        for field in fields(self):
            values = read_only(getattr(self, field.name))
            object.__setattr__(self, field.name, values)
            if values.ndim != 1 or values.size == 0 or values.shape != self.lower.shape:
                raise InvalidLimits(
                    field.name, f"has shape {values.shape}; all five must share one (n_joints,)"
                )
            if not np.all(np.isfinite(values)):
                raise InvalidLimits(field.name, f"must be finite, got {values.tolist()}")
        if np.any(self.lower >= self.upper):
            joint = int(np.argmax(self.lower >= self.upper))
            raise InvalidLimits(
                "lower", f"must be below upper; joint {joint}: {self.lower[joint]} >= "
                f"{self.upper[joint]} rad",
            )  # fmt: skip
        for name in ("velocity", "acceleration", "jerk"):
            rates = getattr(self, name)
            if np.any(rates <= 0.0):
                raise InvalidLimits(name, f"must be positive, got {rates.tolist()}")
            if np.any((rates < SMALLEST_RATE) | (rates > LARGEST_RATE)):
                raise InvalidLimits(
                    name, f"must lie in {SMALLEST_RATE:g}..{LARGEST_RATE:g}, got {rates.tolist()}"
                )

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.lower.size)

    def scaled(
        self,
        *,
        velocity: ArrayLike = 1.0,
        acceleration: ArrayLike = 1.0,
        jerk: ArrayLike = 1.0,
    ) -> JointLimits:
        """Return the same range with rates multiplied by the factors, each a number or (n,)."""
        return replace(
            self,
            velocity=self.velocity * np.asarray(velocity),
            acceleration=self.acceleration * np.asarray(acceleration),
            jerk=self.jerk * np.asarray(jerk),
        )
