"""Numbers and names in messages, written as in tables and on pages."""

from __future__ import annotations

from collections.abc import Sequence


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
