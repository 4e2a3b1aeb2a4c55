"""Units of logs as people and programs write them, and quantities as they name them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Final, Literal, get_args

Kind = Literal["time", "position", "velocity", "torque", "motor_current", "commanded_position"]

_TURN: Final = 2.0 * math.pi
_DEGREE: Final = math.pi / 180.0
_ANGLES: Final = {"rad": 1.0, "mrad": 1e-3, "deg": _DEGREE, "rev": _TURN, "m": 1.0, "mm": 1e-3}
_SI: Final[Mapping[str, Mapping[str, float]]] = {
    "position": _ANGLES,
    "velocity": {
        "rad/s": 1.0, "deg/s": _DEGREE, "rev/s": _TURN, "rpm": _TURN / 60.0, "m/s": 1.0,
        "mm/s": 1e-3,
    },
    "torque": {"N.m": 1.0, "mN.m": 1e-3, "kN.m": 1e3, "N": 1.0, "%": 0.01},
    "motor_current": {"A": 1.0, "mA": 1e-3, "%": 0.01},
    "commanded_position": _ANGLES,
}  # fmt: skip
_SPELLED: Final[Mapping[str, tuple[str, ...]]] = {
    "rad": ("radian", "radians"),
    "deg": ("degree", "degrees", "°", "grad"),
    "rev": ("revolution", "revolutions", "turns"),
    "m": ("meter", "metre", "meters", "metres"),
    "rad/s": ("rad/sec", "radians/s", "rad s^-1", "rad·s⁻¹", "rps"),
    "deg/s": ("deg/sec", "degrees/s", "degree/s", "°/s", "deg s^-1", "grad/s"),
    "rpm": ("1/min", "U/min", "r/min", "rev/min", "min^-1"),
    "N.m": ("Nm", "N·m", "N*m", "N m", "N-m", "newton meter", "newton metre"),
    "mN.m": ("mNm", "mN·m", "mN m"),
    "kN.m": ("kNm", "kN·m", "kN m"),
    "A": ("amp", "amps", "ampere", "amperes"),
    "%": ("percent", "per cent"),
    "s": ("sec", "secs", "second", "seconds"),
    "ms": ("msec", "millisecond", "milliseconds"),
    "us": ("usec", "µs", "μs", "microsecond", "microseconds"),
    "ns": ("nsec", "nanosecond", "nanoseconds"),
}
PER_CENT: Final = "%"
"""Of a rated torque or current, which the column map states."""
TIMES: Final[Mapping[str, int]] = {"s": 0, "ms": 3, "us": 6, "ns": 9}
"""Decimal places between a unit of time and the second."""
UNITS: Final[Mapping[str, Mapping[str, float]]] = {
    kind: {
        spelled: factor
        for unit, factor in table.items()
        for spelled in (unit, *_SPELLED.get(unit, ()))
    }
    for kind, table in _SI.items()
}
"""Factors to SI units by quantity and unit, in every spelling; of "%" to a share."""

_BY_SPELLING: Final = {
    spelled.lower(): unit
    for unit in dict.fromkeys([*TIMES, *(unit for table in _SI.values() for unit in table)])
    for spelled in (unit, *_SPELLED.get(unit, ()))
}
_BRACKETED: Final = re.compile(r"(.*?)[\s_]*(?:\[([^\[\]]*)\]|\(([^()]*)\))")
_SUFFIXES: Final = ("deg", "rad", "mrad", "rpm", "Nm", "ms", "us", "ns", "sec", "mA")


def kind_named(name: str) -> Kind:
    """Return the quantity of this name."""
    return next(kind for kind in get_args(Kind) if kind == name)


def names_of_units(kind: str) -> str:
    """Return the units of a quantity, each in one spelling, for a message."""
    return ", ".join(_SI[kind])


def unit_of(text: str, kind: str | None = None) -> str | None:
    """Return the unit that a text spells, of a quantity or of any; None if it spells none.

    Units of different size differ in more than case: mN.m and MN.m would not, and the latter is
    none of them.
    """
    unit = _BY_SPELLING.get(text.strip().lower())
    if unit is None or kind is None:
        return unit
    return unit if unit in (TIMES if kind == "time" else _SI[kind]) else None


def without_unit(name: str) -> tuple[str, str | None]:
    """Return the name of a column without its unit, and that unit or None.

    A unit is in brackets, as in ``q1 [deg]`` or ``M1 (Nm)``, or a few are at the end, ``q1_deg``.
    """
    match = _BRACKETED.fullmatch(name.strip())
    if match is not None:
        unit = unit_of(match[2] if match[2] is not None else match[3])
        if unit is not None:
            return match[1], unit
    bare, _, end = name.rpartition("_")
    if bare and end in _SUFFIXES:
        return bare, unit_of(end)
    return name, None
