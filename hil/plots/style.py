"""Style of pictures; colours are distinguishable in print and for colour-blind readers."""

from __future__ import annotations

from contextlib import AbstractContextManager

from hil.report.drawing import drawing

INK, MUTED, RULE = "#1a1a1a", "#666666", "#dddddd"
LIMIT = "#b3261e"
POSITION, VELOCITY, ACCELERATION = "#0072b2", "#00795a", "#b0530b"
SMALL, TEXT, TITLE = 7.5, 9.0, 12.0
_STYLE = {
    "font.size": TEXT,
    "axes.axisbelow": True,
    "axes.edgecolor": MUTED,
    "axes.grid": True,
    "axes.linewidth": 0.7,
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": TEXT,
    "grid.color": RULE,
    "grid.linewidth": 0.5,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
}


def page() -> AbstractContextManager[None]:
    """Draw with these settings, one thread at a time."""
    return drawing(_STYLE)
