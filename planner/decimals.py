"""Values of a TOML text whose numbers were read as `Decimal`, which keeps angles exact."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Context, Decimal, localcontext
from math import degrees, pi
from typing import Any

_EXACT = Context(prec=60)
_PI = Decimal("3.14159265358979323846264338327950288419716939937510")
_SHORT_DIGITS = 15
_MOST_DIGITS = 20


def radians_of(angle: Decimal | int) -> float:
    """Return an angle in rad from one in degrees, as it was written."""
    angle = Decimal(angle)
    if len(angle.as_tuple().digits) <= _SHORT_DIGITS or not angle.is_finite():
        return float(angle) * (pi / 180.0)
    with localcontext(_EXACT):
        return float(angle * _PI / 180)


def degrees_text(angle: float) -> str:
    """Return the shortest degrees that `radians_of` turns into this angle [rad], to the bit."""
    rounded = repr(float(f"{degrees(angle):.{_SHORT_DIGITS}g}"))
    if _same(radians_of(Decimal(rounded)), angle):
        return rounded
    with localcontext(_EXACT):
        exact = Decimal(angle) * 180 / _PI
    for digits in range(_SHORT_DIGITS + 1, _MOST_DIGITS):
        text = f"{exact:.{digits - 1}e}"
        if _same(radians_of(Decimal(text)), angle):
            return f"{Decimal(text):f}" if 1e-4 < abs(exact) < 1e15 else text
    raise AssertionError(f"{angle!r} rad has no degrees")  # 18 digits tell any two floats apart


def _same(a: float, b: float) -> bool:
    return a == b and str(a) == str(b)  # the latter tells -0.0 from 0.0


def radians_in(name: str, value: Any) -> Any:
    """Return degrees, one number or nested lists of them, in rad.

    Args:
        name: of the field, for the error.
        value: as read.

    Raises:
        ValueError: an entry is not a number.
    """
    if isinstance(value, list):
        return [radians_in(name, entry) for entry in value]
    if isinstance(value, bool) or not isinstance(value, Decimal | int):
        raise ValueError(f"{name}: {value!r} is not a number of degrees")
    return radians_of(value)


def without_decimals(value: Any) -> Any:
    """Return a value, whatever it is nested in, with a float for each `Decimal`."""
    if isinstance(value, Decimal):
        return float(value)
    if isinstance(value, list):
        return [without_decimals(entry) for entry in value]
    if isinstance(value, Mapping):
        return {name: without_decimals(entry) for name, entry in value.items()}
    return value
