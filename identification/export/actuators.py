"""Servo and friction of joints as fields of simulators, with ranges for domain randomisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

Quantity = Literal[
    "stiffness", "limit", "friction", "static", "viscous", "armature", "delay", "offset"
]
"""Stiffness of the position servo, limit of its torque, dynamic and static dry friction, viscous
friction, armature, delay of commands, and what the servo adds to a command."""


class FieldUnit(NamedTuple):
    """Units of a quantity, of a joint that turns and of one that slides."""

    turning: str
    sliding: str


UNITS: Final[Mapping[Quantity, FieldUnit]] = {
    "stiffness": FieldUnit("N·m/rad", "N/m"),
    "limit": FieldUnit("N·m", "N"),
    "friction": FieldUnit("N·m", "N"),
    "static": FieldUnit("N·m", "N"),
    "viscous": FieldUnit("N·m·s/rad", "N·s/m"),
    "armature": FieldUnit("kg·m²", "kg"),
    "delay": FieldUnit("s", "s"),
    "offset": FieldUnit("rad", "m"),
}


@dataclass(frozen=True, eq=False)
class FieldRange:
    """Values of a quantity of n joints, with the ends of their 95 % intervals.

    Attributes:
        value, lower, upper: (n,).
        from_data: whether the data decide the value, else what was assumed before (n,).
    """

    value: Array
    lower: Array
    upper: Array
    from_data: NDArray[np.bool_]

    @classmethod
    def exact(cls, value: Array, *, from_data: bool = False) -> FieldRange:
        """Return values without a range."""
        return cls(value, value, value, np.full(value.shape, from_data))


@dataclass(frozen=True, eq=False)
class Actuators:
    """Servo and friction of n joints.

    Attributes:
        joint_names: (n,).
        turning: whether a joint turns (n,).
        fields: by quantity; a joint driven by torque has no stiffness, delay and offset.
        draws: correlated draws from the posterior by quantity (N, n), empty for none.
    """

    joint_names: tuple[str, ...]
    turning: NDArray[np.bool_]
    fields: Mapping[Quantity, FieldRange]
    draws: Mapping[Quantity, Array]

    @property
    def is_servo(self) -> bool:
        """Whether position servos drive the joints."""
        return "stiffness" in self.fields

    def value(self, quantity: Quantity) -> Array:
        """Return the values of a quantity (n,)."""
        return self.fields[quantity].value

    def units(self, quantity: Quantity) -> list[str]:
        """Return the unit of a quantity for each joint."""
        unit = UNITS[quantity]
        return [unit.turning if turns else unit.sliding for turns in self.turning]

    def sample(self, index: int) -> Actuators:
        """Return the actuators of a draw, without ranges."""
        fields = {
            quantity: FieldRange.exact(self.draws[quantity][index])
            if quantity in self.draws
            else field
            for quantity, field in self.fields.items()
        }
        return Actuators(self.joint_names, self.turning, fields, {})


def ranges_of(
    actuators: Actuators, names: Mapping[str, Quantity], remarks: Sequence[str]
) -> dict[str, object]:
    """Return ranges for domain randomisation, and draws, for JSON.

    Args:
        actuators: of all joints.
        names: quantity of each field of the simulator.
        remarks: what the file says of itself.
    """
    present = {name: quantity for name, quantity in names.items() if quantity in actuators.fields}
    by_field = {
        name: {
            joint: {
                "low": finite(field.lower[j]),
                "value": finite(field.value[j]),
                "high": finite(field.upper[j]),
                "unit": unit,
                "from": "data" if field.from_data[j] else "prior",
            }
            for j, (joint, unit) in enumerate(
                zip(actuators.joint_names, actuators.units(quantity), strict=True)
            )
        }
        for name, quantity in present.items()
        for field in [actuators.fields[quantity]]
    }
    document: dict[str, object] = {
        "remarks": list(remarks),
        "interval": 0.95,
        "joints": list(actuators.joint_names),
        "ranges": by_field,
    }
    if actuators.draws:
        document["draws"] = {
            name: [[finite(number) for number in row] for row in actuators.draws[quantity]]
            for name, quantity in present.items()
            if quantity in actuators.draws
        }
    return document


def finite(number: float) -> float | None:
    """Return a number for JSON and Python files, None if it is infinite: there is no limit."""
    return float(f"{number:.6g}") if np.isfinite(number) else None
