"""Angles as people write them, in degrees, without the loss of a bit.

Not every float64 in radians is reached by multiplying one in degrees by pi / 180. So a number of
up to 15 digits is converted as everywhere else, and one of more digits, which people do not type,
exactly: as a decimal, by pi to 50 digits, rounded once.
"""

from __future__ import annotations

from decimal import Context, Decimal, localcontext
from math import degrees, pi

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
