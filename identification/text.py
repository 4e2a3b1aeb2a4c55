"""Numbers in messages, written as in tables and on pages."""

from __future__ import annotations


def percentage(share: float, decimals: int = 0, *, signed: bool = False) -> str:
    """Format a share in per cent with a space before the sign (SI brochure, 5.4.7): 1.5 %.

    A `signed` one has a plus if it is not negative.
    """
    sign = "+" if signed else "-"
    return f"{100.0 * share:{sign}.{decimals}f} %"


def unit_text(unit: str) -> str:
    """Replace blanks of a unit, as files of earlier versions have: N·m for `N m`."""
    return unit.replace(" ", "·")
