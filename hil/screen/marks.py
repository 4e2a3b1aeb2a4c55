"""Bars, curves and times in characters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from rich.text import Text

_EIGHTHS: Final = " ▏▎▍▌▋▊▉█"
_HEIGHTS: Final = "▁▂▃▄▅▆▇█"
WARNING: Final = 0.8
"""Share of a limit from which on it is coloured."""


def bar(share: float, width: int) -> Text:
    """A share of a limit; above `WARNING` it is marked by colour, above 1 by the last character."""
    if not math.isfinite(share):
        return Text("?".ljust(width), style="bold red")
    filled = round(8 * width * min(max(share, 0.0), 1.0))
    whole, rest = divmod(filled, 8)
    filled_blocks = "█" * whole + (_EIGHTHS[rest] if rest else "")
    text = Text(filled_blocks, style=colour(share))
    text.append("·" * (width - len(filled_blocks)), style="dim")
    if share > 1.0:
        text = Text("█" * (width - 1) + "▶", style=colour(share))
    return text


def colour(share: float) -> str:
    """Style of a share of a limit; the number beside it says the same without colours."""
    if share > 1.0:
        return "bold red"
    return "yellow" if share > WARNING else "green"


def percent(share: float) -> str:
    """A share in four characters."""
    if not math.isfinite(share):
        return "  ?%"
    value = min(100.0 * share, 999.0)
    return f"{value:3.1f}%" if value < 9.95 else f"{value:3.0f}%"


def curve(values: Sequence[float], width: int) -> str:
    """The last `width` values as a row of blocks, from 0 to the largest of them."""
    shown = [value for value in values if math.isfinite(value)][-width:]
    top = max(shown, default=0.0)
    if top <= 0.0:
        return _HEIGHTS[0] * len(shown)
    return "".join(
        _HEIGHTS[min(len(_HEIGHTS) - 1, int(len(_HEIGHTS) * max(value, 0.0) / top))]
        for value in shown
    )


def clock(seconds: float | None) -> str:
    """A time as h:mm:ss or m:ss."""
    if seconds is None or not math.isfinite(seconds):
        return "?"
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def duration(seconds: float) -> str:
    """A latency."""
    if not math.isfinite(seconds):
        return "> 5 ms"
    return f"{1e3 * seconds:.1f} ms" if seconds >= 1e-3 else f"{1e6 * seconds:.0f} µs"
