"""Limits of position, velocity, acceleration and jerk of each joint."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arrays import Array, read_only
from planner.errors import InvalidLimits

# Far beyond what any arm does; with larger numbers ruckig has crashed its process.
MIN_RATE: Final = 1e-10
MAX_RATE: Final = 1e10
# Tolerances for rounding: of a position beyond its range, relative to its largest magnitude, and of
# a jump between two pieces, relative to the limit of the quantity.
POSITION_ROUNDING: Final = 1e-12
RATE_ROUNDING: Final = 1e-9


class Allowance(NamedTuple):
    """Limits computed from checked ones, of one motion (n,) or of many (c, n)."""

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> Allowance:
        """Return rows by index or mask."""
        return Allowance(*(bound[rows] for bound in self))


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Limits of every joint, each (n,), read-only, in SI units; rates are magnitudes.

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
                reason = f"has shape {values.shape}; all five must share one (n_joints,)"
                raise InvalidLimits(field.name, reason)
            if not np.all(np.isfinite(values)):
                raise InvalidLimits(field.name, f"must be finite, got {values.tolist()}")
        if np.any(self.lower >= self.upper):
            joint = int(np.argmax(self.lower >= self.upper))
            ends = f"{self.lower[joint]} >= {self.upper[joint]} rad"
            raise InvalidLimits("lower", f"must be below upper; joint {joint}: {ends}")
        for name in ("velocity", "acceleration", "jerk"):
            rates = getattr(self, name)
            if np.any((rates < MIN_RATE) | (rates > MAX_RATE)):
                reason = f"must lie in {MIN_RATE:g}..{MAX_RATE:g}, got {rates.tolist()}"
                raise InvalidLimits(name, reason)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.lower.size)

    def scaled(
        self, *, velocity: ArrayLike = 1.0, acceleration: ArrayLike = 1.0, jerk: ArrayLike = 1.0
    ) -> JointLimits:
        """Return the same range with rates multiplied by the factors, each a number or (n,)."""
        return replace(
            self,
            velocity=self.velocity * np.asarray(velocity),
            acceleration=self.acceleration * np.asarray(acceleration),
            jerk=self.jerk * np.asarray(jerk),
        )


Bounds: TypeAlias = JointLimits | Allowance


def position_rounding(limits: Bounds) -> Array:
    """Return the tolerance on positions beyond their range (..., n) [rad]."""
    return POSITION_ROUNDING * np.maximum(np.abs(limits.lower), np.abs(limits.upper))


def jump_rounding(limits: Bounds, duration: float | Array) -> Array:
    """Return the tolerances on jumps of position, velocity, acceleration, (..., n, 3)."""
    # Times of knots are rounded in proportion to the duration.
    tick = 4.0 * np.spacing(np.asarray(duration, dtype=np.float64))[..., None]
    return np.stack(
        (
            position_rounding(limits) + tick * limits.velocity,
            RATE_ROUNDING * limits.velocity + tick * limits.acceleration,
            RATE_ROUNDING * limits.acceleration + tick * limits.jerk,
        ),
        axis=-1,
    )
