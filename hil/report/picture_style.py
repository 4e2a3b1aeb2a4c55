"""Style of pictures; colours are distinguishable in print and for colour-blind readers."""

from __future__ import annotations

import re
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any

import matplotlib as mpl

from hil.report.rendering import template_text

INK = "#1a1a1a"
MUTED = "#666666"
RULE = "#dddddd"
LIMIT = "#b3261e"
POSITION = "#0072b2"
VELOCITY = "#00795a"
ACCELERATION = "#b0530b"
"""Colours that only pictures have; charts use the colours of the pages, see :func:`colour`."""
SMALL_FONT_SIZE = 7.5
FONT_SIZE = 9.0
TITLE_FONT_SIZE = 12.0
_STYLE = {
    "font.size": FONT_SIZE,
    "axes.axisbelow": True,
    "axes.edgecolor": MUTED,
    "axes.grid": True,
    "axes.linewidth": 0.7,
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": FONT_SIZE,
    "grid.color": RULE,
    "grid.linewidth": 0.5,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": SMALL_FONT_SIZE,
    "ytick.labelsize": SMALL_FONT_SIZE,
}


@cache
def palette() -> Mapping[str, str]:
    """Return the colours of the pages on paper, by variable of their style sheet."""
    root = template_text("report.css").partition("}")[0]
    return dict(re.findall(r"--([\w-]+): (#[0-9a-f]+);", root))


def colour(variable: str) -> str:
    """Return the colour of a variable of the style sheet: ``ink``, ``--ink`` or ``var(--ink)``."""
    return palette()[variable.removeprefix("var(").removesuffix(")").removeprefix("--")]


_settings = threading.RLock()


@contextmanager
def page(**changes: Any) -> Iterator[None]:
    """Draw with fixed settings of matplotlib and these changes, one thread at a time.

    The settings of matplotlib are global.
    """
    settings: Any = mpl.rcParams
    with _settings, warnings.catch_warnings():
        # A name may have glyphs that are missing in DejaVu.
        warnings.filterwarnings("ignore", message=r"Glyph \d+")
        before = _settings_now()
        try:
            dict.update(settings, _checked_settings())
            settings.update(changes)
            yield
        finally:  # as `rc_context`, which copies one by one
            dict.update(settings, before)


@cache
def _checked_settings() -> dict[str, Any]:
    """Return the settings of all pictures, which matplotlib checks one by one: here, once."""
    settings: Any = mpl.rcParams
    with mpl.rc_context():
        dict.update(settings, mpl.rcParamsDefault)
        settings.update({"svg.fonttype": "none", "svg.hashsalt": "hil", "text.parse_math": False})
        settings.update(_STYLE)
        checked = _settings_now()
    del checked["backend"]  # the user's, of which pictures have no need
    return checked


def _settings_now() -> dict[str, Any]:
    """Return the settings of matplotlib; `rcParams["backend"]` would load pyplot."""
    settings: Any = mpl.rcParams
    return dict(dict.items(settings))
