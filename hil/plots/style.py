"""Style of pictures; colours are distinguishable in print and for colour-blind readers."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl

INK, MUTED, RULE = "#1a1a1a", "#666666", "#dddddd"
LIMIT = "#b3261e"
POSITION, VELOCITY, ACCELERATION = "#0072b2", "#00795a", "#b0530b"
SMALL = 7.5
TEXT = 9.0
TITLE = 12.0
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


_settings = threading.RLock()


@contextmanager
def page() -> Iterator[None]:
    """Draw with fixed settings of matplotlib, one thread at a time (settings are global)."""
    with _settings, warnings.catch_warnings(), mpl.rc_context():
        # A name may have glyphs that are missing in DejaVu.
        warnings.filterwarnings("ignore", message=r"Glyph \d+")
        mpl.rcdefaults()
        settings: Any = {"svg.fonttype": "none", "svg.hashsalt": "hil", "text.parse_math": False}
        mpl.rcParams.update(settings | _STYLE)
        yield
