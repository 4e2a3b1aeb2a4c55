"""Numbers in messages, written as in tables and on pages."""

from __future__ import annotations

from string import Formatter
from typing import Final


def percentage(share: float, decimals: int = 0) -> str:
    """Format a share in per cent with a space before the sign (SI brochure, 5.4.7): 1.5 %."""
    return f"{100.0 * share:.{decimals}f} %"


def filled(template: str, **values: object) -> str:
    """Fill a template as `str.format` does, percentages as :func:`percentage` writes them."""
    return _MESSAGES.vformat(template, (), values)


def unit_text(unit: str) -> str:
    """Replace blanks of a unit, as files of earlier versions have: N·m for `N m`."""
    return unit.replace(" ", "·")


class _Messages(Formatter):
    """Writes the format type `%` with a space before the sign."""

    def format_field(self, value: object, format_spec: str) -> str:
        text = str(super().format_field(value, format_spec))
        return f"{text[:-1]} %" if format_spec.endswith("%") else text


_MESSAGES: Final = _Messages()
