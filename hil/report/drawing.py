"""Panels of the pages: matplotlib figures as SVG, in the font and colours of the style sheet."""

from __future__ import annotations

import io
import re
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Figures have placeholder colours, which become variables of the style sheet (light, dark, print).
CSS_VARIABLES: Final = {
    f"#0102{k:02x}": f"var(--{name})"
    for k, name in enumerate(("ink", "muted", "grid", "band", "first", "second", "wide"))
}
INK, MUTED, GRID, BAND, FIRST, SECOND, WIDE = CSS_VARIABLES
"""`WIDE` is a light colour for a broad line below another one."""

TICK_SIZE, TEXT_SIZE = 10.5, 11.0
DASHED: Final = (0, (4, 3))
_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 370.0, 46.0, 10.0, 20.0, 40.0  # of a panel, px
_GAP: Final = 24.0  # between plots above each other, px
_LABEL_LENGTH: Final = 28
_FEWEST_FOR_A_BOX: Final = 5  # values
_PAGE: Final = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": MUTED,
    "axes.axisbelow": True,
    "axes.titlelocation": "left",
    "axes.titlesize": TEXT_SIZE,
    "axes.titlecolor": MUTED,
    "axes.titlepad": 5.0,
    "axes.labelsize": TEXT_SIZE,
    "axes.labelcolor": MUTED,
    "axes.labelpad": 3.0,
    "grid.color": GRID,
    "lines.solid_joinstyle": "round",
    "savefig.transparent": True,
    **{
        f"{axis}tick.{name}": value
        for axis in "xy"
        for name, value in (
            ("color", MUTED), ("labelcolor", INK), ("labelsize", TICK_SIZE), ("major.size", 3.0),
        )
    },
}  # fmt: skip
_settings = threading.RLock()


class Caption(NamedTuple):
    """Texts of a panel: `key` makes its ids unique in the page, `what` is the description."""

    key: str
    title: str
    note: str
    what: str


@dataclass(frozen=True)
class Panel:
    """One drawing with the title above it and a note beside the title."""

    title: str
    note: str
    svg: Markup


@contextmanager
def drawing(style: Mapping[str, Any] = _PAGE) -> Iterator[None]:
    """Draw with fixed settings of matplotlib, one thread at a time (settings are global)."""
    with _settings, warnings.catch_warnings(), mpl.rc_context():
        # Text is shown in the fonts of the page; glyphs missing in DejaVu do not matter.
        warnings.filterwarnings("ignore", message=r"Glyph \d+")
        mpl.rcdefaults()
        settings: Any = {"svg.fonttype": "none", "svg.hashsalt": "hil", "text.parse_math": False}
        mpl.rcParams.update(settings | dict(style))
        yield


def one_line(text: str) -> str:
    """Replace unprintable characters by blanks."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def label(text: str) -> str:
    """Shorten a name to one printable line."""
    line = one_line(text)
    return line if len(line) <= _LABEL_LENGTH else line[: _LABEL_LENGTH - 1] + "…"


def to_panel(figure: Figure, caption: Caption) -> Panel:
    """Return a figure as SVG for inclusion in a page."""
    out = io.StringIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(out, format="svg", metadata=metadata)
    svg = out.getvalue().partition("<svg")[2].partition(">")[2]
    svg = re.sub(r"<style.*?</style>|<metadata>.*?</metadata>", "", svg, flags=re.S)
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{caption.key}-", svg).replace("xlink:", "")
    svg = re.sub(r" font-family: [^;\"]*;?", "", svg)
    svg = re.sub(r"(?<=\.\d\d)\d+", "", svg)
    for placeholder, variable in CSS_VARIABLES.items():
        svg = svg.replace(placeholder, variable)
    width, height = figure.get_size_inches() * 72.0
    note = f"; {caption.note}" if caption.note else ""
    alt = escape(one_line(f"{caption.title}: {caption.what}{note}."))
    size = f'viewBox="0 0 {width:g} {height:g}" style="max-width: {1.3 * width:.0f}px"'
    head = f'<svg {size} role="img" aria-label="{alt}">'
    return Panel(caption.title, caption.note, Markup(head + svg))


@contextmanager
def panel(
    panels: list[Panel],
    height: float,
    caption: Caption,
    heading: str = "",
    foot: str = "",
    *,
    left: float = _LEFT,
    right: float = _RIGHT,
    bottom: float = _BOTTOM,
    top: float = _TOP,
    width: float = _WIDTH,
) -> Iterator[Axes]:
    """Yield axes, and append the drawing to `panels`; size and margins in px.

    `heading` is the quantity and unit of the vertical axis, `foot` those of the horizontal one.
    """
    with drawing():
        figure = Figure(figsize=(width / 72.0, height / 72.0))
        figure.subplots_adjust(
            left / width, bottom / height, 1.0 - right / width, 1.0 - top / height
        )
        axes = figure.subplots()
        axes.set_title(heading)
        axes.set_xlabel(foot)
        yield axes
        panels.append(to_panel(figure, caption))


def ruled(
    axes: Axes, axis: Literal["x", "y", "both"], *, x_ticks: int = 5, y_ticks: int = 4
) -> None:
    """Draw a light grid at few, round ticks."""
    axes.grid(True, axis=axis)
    axes.xaxis.set_major_locator(MaxNLocator(x_ticks, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_locator(MaxNLocator(y_ticks, steps=[1, 2, 5, 10]))


def thinned(time: Array, values: Array, bins: int = 500) -> tuple[Array, Array]:
    """Return minimum and maximum of each of `bins` equal intervals, (m,) -> (<= 2 bins,)."""
    if time.size <= 2 * bins:
        return time, values
    edges = np.linspace(0, time.size, bins + 1).astype(np.intp)
    parts = [(start, values[start:end]) for start, end in pairwise(edges)]
    ends = [start + end(part) for start, part in parts for end in (np.argmin, np.argmax)]
    chosen = np.unique([0, *ends, time.size - 1])
    return time[chosen], values[chosen]


@dataclass(frozen=True, eq=False)
class Trace:
    """One line over time."""

    values: Array  #: (m,)
    colour: str  #: of the palette
    width: float  #: of the line [px]
    dashed: bool = False


@dataclass(frozen=True, eq=False)
class Plot:
    """Axes of a panel with time to the right."""

    height: float  #: [px]
    heading: str  #: quantity and unit
    traces: Sequence[Trace]  #: its lines, the lowest first
    #: shaded intervals of time [s]
    shaded: Sequence[tuple[float, float]] = ()
    #: largest value of a range about zero; the range of the lines if None
    reach: float | None = None


def time_panel(time: Array, plots: Sequence[Plot], caption: Caption) -> Panel:
    """Draw plots over the same time (m,) [s], one above the other."""
    inner = [plot.height for plot in plots]
    height = _TOP + sum(inner) + _GAP * (len(plots) - 1) + _BOTTOM
    with drawing():
        figure = Figure(figsize=(_WIDTH / 72.0, height / 72.0))
        rows = figure.subplots(
            len(plots), 1, sharex=True, squeeze=False, height_ratios=inner,
            gridspec_kw={
                "left": _LEFT / _WIDTH, "right": 1.0 - _RIGHT / _WIDTH, "top": 1.0 - _TOP / height,
                "bottom": _BOTTOM / height, "hspace": _GAP / float(np.mean(inner)),
            },
        )[:, 0]  # fmt: skip
        for axes, plot in zip(rows, plots, strict=True):
            for interval in plot.shaded:
                axes.axvspan(*interval, color=BAND, linewidth=0.0, zorder=0.5)
            for trace in plot.traces:
                line = DASHED if trace.dashed else "-"
                axes.plot(
                    *thinned(time, trace.values), color=trace.colour, linewidth=trace.width,
                    linestyle=line,
                )  # fmt: skip
            if plot.reach is not None:
                axes.set_ylim(-plot.reach, plot.reach)
            axes.set_title(plot.heading)
            ruled(axes, "both", x_ticks=6)
        rows[-1].set_xlabel("time [s]")
        rows[-1].set_xlim(float(time[0]), max(float(time[-1]), float(time[0]) + 1e-9))
        return to_panel(figure, caption)


def box_panel(
    caption: Caption,
    columns: Sequence[Array],
    colours: Sequence[str],
    heading: str,
    labels: Sequence[str],
) -> Panel:
    """Draw columns of values (m,) as dots with a box."""
    lines = 1 + max(label.count("\n") for label in labels)
    panels, grey = list[Panel](), {"color": MUTED}
    width, bottom = 110.0 + 40.0 * len(columns), 12.0 + 13.0 * lines
    with panel(panels, 206.0 + bottom, caption, heading, width=width, bottom=bottom) as axes:
        for k, (values, colour) in enumerate(zip(columns, colours, strict=True), 1):
            if values.size >= _FEWEST_FOR_A_BOX:
                axes.boxplot(
                    [values], positions=[k], widths=0.6, patch_artist=True, showfliers=False,
                    boxprops={"facecolor": BAND, "edgecolor": MUTED}, whiskerprops=grey,
                    capprops=grey, medianprops={"color": INK, "linewidth": 2.2},
                )  # fmt: skip
            # Horizontal offsets by the golden ratio separate neighbouring values.
            rank = np.argsort(np.argsort(values, kind="stable"), kind="stable")
            side = k + 0.34 * ((rank * 0.6180339887498949) % 1.0 - 0.5)
            axes.scatter(side, values, s=14.0, color=colour, alpha=0.85, linewidths=0.0, zorder=3)
        ruled(axes, "y", y_ticks=5)
        axes.set_xticks(range(1, len(columns) + 1), labels)
        axes.set_xlim(0.4, len(columns) + 0.6)
        axes.tick_params(axis="x", length=0.0)
        # A scale that shows every value and does not exaggerate small changes.
        every = np.concatenate(columns)
        middle = float(np.median(every))
        low, high = min(float(every.min()), 0.9 * middle), max(float(every.max()), 1.1 * middle)
        axes.set_ylim(max(0.0, low - 0.06 * (high - low)), high + 0.06 * (high - low) or 1.0)
    return panels[0]


_LABELS: Final = 84.0  # px
_SIDE: Final = 560.0  # px
_SMALLEST_CELL, _LARGEST_CELL = 11.0, 26.0  # px


def matrix_panel(matrix: Array, labels: Sequence[str], key: str, title: str) -> Panel:
    """Draw |ρ| of a normalised matrix (n, n), 0 white, 1 black, one label for each row."""
    n, matrix = len(labels), np.abs(matrix)
    names = [label(text) for text in labels]
    note = f"{int(np.sum(np.triu(matrix, 1) > 0.9))} of {n * (n - 1) // 2} pairs above 0.9"
    what = f"absolute correlation between {n} base parameters, white for 0 and black for 1"
    cell = min(max(_SIDE / n, _SMALLEST_CELL), _LARGEST_CELL)
    side, size = n * cell, min(TICK_SIZE, 0.76 * cell)
    panels, caption = list[Panel](), Caption(key, title, note, what)
    with panel(
        panels, _LABELS + side + 6.0, caption, left=_LABELS, top=_LABELS, right=6.0, bottom=6.0,
        width=_LABELS + side + 6.0,
    ) as axes:  # fmt: skip
        axes.imshow(matrix, cmap="gray_r", vmin=0.0, vmax=1.0, interpolation="none", aspect="auto")
        axes.xaxis.tick_top()
        axes.set_xticks(range(n), names, rotation=90, fontsize=size)
        axes.set_yticks(range(n), names, fontsize=size)
        axes.tick_params(length=0.0, pad=4.0)
        axes.spines[:].set_visible(True)
    return panels[0]
