"""Units of logs as people and programs write them, and quantities as they name them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, Literal, get_args

from hil.importers.unit_products import DEGREE, product_of

Kind = Literal["time", "position", "velocity", "torque", "motor_current", "commanded_position"]
JOINT_KINDS: Final[tuple[Kind, ...]] = (
    "position", "velocity", "torque", "motor_current", "commanded_position",
)  # fmt: skip
"""Quantities of a joint."""

_TURN: Final = 2.0 * math.pi
_ANGLES: Final = {"rad": 1.0, "mrad": 1e-3, "deg": DEGREE, "rev": _TURN, "m": 1.0, "mm": 1e-3}
UNITS: Final[Mapping[str, Mapping[str, float]]] = {
    "position": _ANGLES,
    "velocity": {
        "rad/s": 1.0, "deg/s": DEGREE, "rev/s": _TURN, "rpm": _TURN / 60.0, "m/s": 1.0,
        "mm/s": 1e-3,
    },
    "torque": {"N.m": 1.0, "mN.m": 1e-3, "kN.m": 1e3, "N": 1.0, "%": 0.01, "‰": 0.001},
    "motor_current": {"A": 1.0, "mA": 1e-3, "%": 0.01, "‰": 0.001},
    "commanded_position": _ANGLES,
}  # fmt: skip
"""Factors to SI units of the usual units of a quantity, the SI one first; of rated ones to 1."""
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
    "‰": ("permille", "per mille", "per mil", "0.1%", "0.1 %", "1/1000"),
    "s": ("sec", "secs", "second", "seconds"),
    "ms": ("msec", "millisecond", "milliseconds"),
    "us": ("usec", "µs", "μs", "microsecond", "microseconds"),
    "ns": ("nsec", "nanosecond", "nanoseconds"),
}
RATED: Final = ("%", "‰")
"""Of a rated torque or current, which the column map states."""
TIMES: Final[Mapping[str, int]] = {"s": 0, "ms": 3, "us": 6, "ns": 9}
"""Decimal places between a unit of time and the second."""

SUFFIXES: Final = (
    *("deg", "rad", "mrad", "gon", "mdeg", "rpm", "ms", "us", "ns", "sec", "mA", "permille"),
    *("Nm", "mNm", "kNm", "Ncm", "Nmm", "kgcm", "kgfcm", "ozin", "ozfin", "lbft", "lbfft", "lbin"),
    *("ticks", "counts", "increments"),
)
"""Units that end the name of a column, behind an underscore."""
_BY_SPELLING: Final = {
    spelled.lower(): unit
    for unit in dict.fromkeys([*TIMES, *(unit for table in UNITS.values() for unit in table)])
    for spelled in (unit, *_SPELLED.get(unit, ()))
}


def kind_named(name: str) -> Kind:
    """Return the quantity of this name."""
    return next(kind for kind in get_args(Kind) if kind == name)


def names_of_units(kind: str) -> str:
    """Return the usual units of a quantity, each in one spelling, for a message."""
    return ", ".join(UNITS[kind])


def unit_of(text: str, kind: str | None = None) -> str | None:
    """Return the unit that a text spells, of a quantity or of any; None if it spells none.

    A product such as ``kgf cm`` is returned as it is spelled. Units of different size differ in
    more than case: mN.m and MN.m would not, and the latter is none of them.
    """
    text = text.strip()
    unit = _BY_SPELLING.get(text.lower())
    if unit is not None and (kind is None or unit in (TIMES if kind == "time" else UNITS[kind])):
        return unit
    product = product_of(text)
    if product is None or kind == "time":  # times are read as decimals
        return None
    return text if kind is None or kind in product.kinds else None


def factor_of(unit: str, kind: str) -> float:
    """Return the factor of a unit of a quantity to SI units, of a rated one to 1."""
    if unit in UNITS[kind]:
        return UNITS[kind][unit]
    product = product_of(unit)
    assert product is not None, unit  # `unit_of` returned it
    return product.factor
