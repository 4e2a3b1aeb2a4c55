"""Colours by role, axes placed by the pixel, and lines thinned without losing their peaks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, Locator, MaxNLocator, NullLocator
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Figures draw with stand-ins, colours that no one would draw with: each becomes a CSS variable when
# the figure enters the page, so that light, dark and print need no second drawing.
INK = "#010201"
MUTED = "#010202"
GRID = "#010203"
BAND = "#010204"
PAPER = "#010205"
FIRST = "#010206"
SECOND = "#010207"
WIDE = "#010208"
"""A light, broad line that another one may lie upon."""
ROUTES = ("#010209", "#01020a", "#01020b", "#01020c")
INSIDE, OUTSIDE_2, OUTSIDE_3 = "#01020d", "#01020e", "#01020f"

CSS_VARIABLES = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    GRID: "var(--grid)",
    BAND: "var(--band)",
    PAPER: "var(--paper)",
    FIRST: "var(--first)",
    SECOND: "var(--second)",
    WIDE: "var(--wide)",
    ROUTES[0]: "var(--route-0)",
    ROUTES[1]: "var(--route-1)",
    ROUTES[2]: "var(--route-2)",
    ROUTES[3]: "var(--route-3)",
    INSIDE: "var(--inside)",
    OUTSIDE_2: "var(--outside-2)",
    OUTSIDE_3: "var(--outside-3)",
}

TICK_SIZE, TEXT_SIZE = 10.5, 11.0
PANEL_WIDTH = 370.0
"""Of most figures, px."""
_TOP = 20.0


def blank(width: float, height: float) -> Figure:
    """A transparent figure of `width` x `height` page pixels."""
    figure = Figure(figsize=(width / 72.0, height / 72.0))
    figure.patch.set_visible(False)
    return figure


def place(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Axes at (`left`, `top`) pixels from the upper left corner of the figure."""
    full_width, full_height = figure.get_size_inches() * 72.0
    bottom = full_height - top - height
    axes = figure.add_axes(
        (
            left / full_width,
            bottom / full_height,
            width / full_width,
            height / full_height,
        )
    )
    _style(axes)
    return axes


def plot_panel(
    height: float, *, left: float = 46.0, right: float = 10.0, bottom: float = 40.0
) -> tuple[Figure, Axes]:
    """A figure of the page's usual width with one plot, and the room for its labels [px]."""
    figure = blank(PANEL_WIDTH, height)
    return figure, place(figure, left, _TOP, PANEL_WIDTH - left - right, height - _TOP - bottom)


def log_ticks(axis: Axis, locator: Locator) -> None:
    """Ticks of a logarithmic axis as decimal numbers, and none between them."""
    axis.set_major_locator(locator)
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def _style(axes: Axes) -> None:
    axes.patch.set_visible(False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(MUTED)
        axes.spines[side].set_linewidth(0.8)
    axes.tick_params(
        colors=MUTED, labelcolor=INK, labelsize=TICK_SIZE, length=3.0, width=0.8, pad=3.0
    )
    axes.set_axisbelow(True)


def ruled(
    axes: Axes, axis: Literal["x", "y", "both"], *, x_ticks: int = 5, y_ticks: int = 4
) -> None:
    """Light rules at few, round ticks."""
    axes.grid(True, axis=axis, color=GRID, linewidth=0.8)
    axes.xaxis.set_major_locator(MaxNLocator(x_ticks, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_locator(MaxNLocator(y_ticks, steps=[1, 2, 5, 10]))


def headed(axes: Axes, text: str) -> None:
    """`text` (what the vertical axis is, and its unit) above the axes, to be read level."""
    axes.set_title(text, loc="left", fontsize=TEXT_SIZE, color=MUTED, pad=5.0)


def footed(axes: Axes, text: str) -> None:
    """`text` below the axes."""
    axes.set_xlabel(text, fontsize=TEXT_SIZE, color=MUTED, labelpad=3.0)


def dots(axes: Axes, x: Array, y: Array, color: str, size: float = 2.2) -> None:
    """Small dots at (c,) points as one path, a tenth of what c marks would take of the page."""
    gap = np.full(x.shape, np.nan)
    # A line without length, with round ends, is a dot.
    rows = [np.column_stack([v, v, gap]).ravel() for v in (x, y)]
    with mpl.rc_context({"path.simplify": False}):
        axes.plot(*rows, color=color, linewidth=size, solid_capstyle="round")


def boxed(axes: Axes, columns: Sequence[Array], width: float, **options: Any) -> None:
    """A box for each column, side by side from 1 on: quartiles, median and whiskers."""
    thin = {"color": MUTED, "linewidth": 1.1}
    axes.boxplot(
        columns,
        positions=range(1, len(columns) + 1),
        widths=width,
        patch_artist=True,
        boxprops={"facecolor": BAND, "edgecolor": MUTED, "linewidth": 1.1},
        medianprops={"color": INK, "linewidth": 2.2},
        whiskerprops=thin,
        capprops=thin,
        **options,
    )


def thinned(time: Array, values: Array, bins: int = 500) -> tuple[Array, Array]:
    """Lowest and highest sample of each of `bins` equal stretches, in order; (m,) -> (<= 2 bins,).

    Unlike taking every k-th sample this keeps every peak that a screen could show.
    """
    if time.size <= 2 * bins:
        return time, values
    edges = np.linspace(0, time.size, bins + 1).astype(np.intp)
    keep = {0, time.size - 1}
    for start, end in pairwise(edges):
        stretch = values[start:end]
        keep.add(int(start + np.argmin(stretch)))
        keep.add(int(start + np.argmax(stretch)))
    chosen = np.array(sorted(keep), dtype=np.intp)
    return time[chosen], values[chosen]
