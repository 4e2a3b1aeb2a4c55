"""Numbers and names in messages, written as in tables and on pages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

LARGEST_DECIMAL: Final = 1e6
_LONGEST_IN_SECONDS: Final = 300.0
_LONGEST_IN_MINUTES: Final = 180.0


def percentage(share: float, decimals: int = 0, *, signed: bool = False) -> str:
    """Format a share in per cent with a space before the sign (SI brochure, 5.4.7): 1.5 %.

    A `signed` one has a plus if it is not negative.
    """
    sign = "+" if signed else "-"
    return f"{100.0 * share:{sign}.{decimals}f} %"


def unit_text(unit: str) -> str:
    """Replace blanks of a unit, as files of earlier versions have: N·m for `N m`."""
    return unit.replace(" ", "·")


def joined(names: Sequence[str], most: int = 6) -> str:
    """Return names separated by commas, the first few of many."""
    omitted = len(names) - most
    return ", ".join(names[:most]) + (f" and {omitted} more" if omitted > 0 else "")


def enumerated(parts: Sequence[str]) -> str:
    """Return one or more parts as in a sentence: a, b and c."""
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def number(value: float, digits: int = 3) -> str:
    """Format with `digits` significant digits, without an exponent from 1e-4 to 1e6: 1324."""
    is_whole = 10.0**digits <= abs(float(f"{value:.{digits}g}")) < LARGEST_DECIMAL
    return f"{value:.0f}" if is_whole else f"{value:.{digits}g}"


def interval_text(low: float, high: float) -> str:
    """Format an interval that may have no upper end: 0.3 to 1.2, above 0.3."""
    return f"above {number(low)}" if high == math.inf else f"{number(low)} to {number(high)}"


def duration_text(seconds: float) -> str:
    """Format a duration in seconds, minutes or hours: 27.5 s, 22 min, 3.4 h."""
    if seconds < _LONGEST_IN_SECONDS:
        return f"{number(seconds)} s"
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes < _LONGEST_IN_MINUTES else f"{minutes / 60.0:.1f} h"
