"""Formats of numbers in tables.

Minus is the ASCII hyphen, so that tables can be pasted into a spreadsheet.
"""

from __future__ import annotations

import math
import re

from identification.text import LARGEST_DECIMAL

MISSING = "–"
_SMALLEST_DECIMAL = 1e-4
_MAX_DECIMALS = 6
_MOMENT = re.compile(r"(\d{4}-\d\d-\d\d)T(\d\d:\d\d)(?::[\d.]+)?(Z|[+-]\d\d:\d\d|)")


def significant(value: float | None, digits: int = 3) -> str:
    """Format with `digits` significant digits; with an exponent below 1e-4 and from 1e6."""
    if value is None or not math.isfinite(value) or value == 0.0:
        return fixed(value, 0)
    if not _SMALLEST_DECIMAL <= abs(value) < LARGEST_DECIMAL:
        return _short_exponent(f"{value:.{digits - 1}e}")
    # Round first: 9.996 to three digits is 10.0.
    exponent = int(f"{abs(value):.{digits - 1}e}".split("e")[1])
    return fixed(value, max(0, digits - 1 - exponent))


def fixed(value: float | None, decimals: int, *, sign: bool = False) -> str:
    """Format with `decimals` decimals; never "-0.00"."""
    if value is None or math.isnan(value):
        return MISSING
    if math.isinf(value):
        return str(value)
    text = f"{value:+.{decimals}f}" if sign else f"{value:.{decimals}f}"
    return text if float(text) else text.replace("-", "+" if sign else "")


def beside(value: float | None, std: float) -> str:
    """Round `value` at the second significant digit of `std`."""
    if value is None or value == 0.0:
        return significant(value)
    if not (math.isfinite(value) and math.isfinite(std) and std > 0.0):
        return significant(value, 4)
    exponent = int(f"{std:.1e}".split("e")[1]) - 1
    if exponent > 0:
        return fixed(value, 0)
    if -exponent <= _MAX_DECIMALS:
        return fixed(value, -exponent)
    digits = max(1, math.floor(math.log10(abs(value))) - exponent)
    return _short_exponent(f"{value:.{digits}e}")


def percent(fraction: float | None, decimals: int | None = None) -> str:
    """Format a fraction in per cent, without the % sign."""
    if fraction is None or math.isnan(fraction) or decimals is not None:
        return fixed(None if fraction is None else 100.0 * fraction, decimals or 0)
    magnitude = abs(100.0 * fraction)
    if magnitude >= 1000.0:
        return ">999"
    return fixed(100.0 * fraction, 0 if magnitude >= 99.5 else 1 if magnitude >= 9.95 else 2)


def with_std(value: float | None, std: float | None) -> str:
    """Format `value ± std`; the value alone if it is exact, a dash if either is missing."""
    if value is None or std is None or not math.isfinite(value) or not math.isfinite(std):
        return MISSING
    return f"{beside(value, std)} ± {significant(std, 2)}" if std > 0.0 else significant(value)


def prose(text: str) -> str:
    """Keep the per cent signs of a message on the line of their numbers."""
    return re.sub(r"(?<=\d) ?%", "\u00a0%", text)


def moments(text: str) -> str:
    """Write times of ISO 8601 in a text to the minute: 2026-11-26 12:30 UTC."""

    def readable(match: re.Match[str]) -> str:
        zone = {"": "", "Z": " UTC", "+00:00": " UTC"}.get(match[3], f" {match[3]}")
        return f"{match[1]} {match[2]}{zone}"

    return _MOMENT.sub(readable, text)


def capitalised(text: str) -> str:
    """Capitalise the first letter only."""
    return text[:1].upper() + text[1:]


def _short_exponent(text: str) -> str:
    return re.sub(r"e([+-])0*(\d)", lambda m: f"e{m[1].replace('+', '')}{m[2]}", text)
