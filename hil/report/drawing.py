"""Drawings of the pages: matplotlib figures as SVG for inclusion in a page.

The size of a drawing comes from the layout of the page, its font and colours from the style sheet
(light, dark, print), and its ids are unique in the page.
"""

from __future__ import annotations

import base64
import io
import json
import math
import re
import threading
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, Locator, MaxNLocator, NullLocator
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Figures are drawn with placeholder colours, which become variables of the style sheet.
CSS_VARIABLES: Final = {
    f"#0102{k:02x}": f"var(--{name})"
    for k, name in enumerate(
        (
            *("ink", "muted", "grid", "band", "paper", "first", "second", "wide"),
            *("route-0", "route-1", "route-2", "route-3", "outside-3"),
        )
    )
}
INK, MUTED, GRID, BAND, PAPER, FIRST, SECOND, WIDE, *ROUTES, OUTSIDE_3 = CSS_VARIABLES
"""`WIDE` is a light colour for a broad line below another one."""

TICK_SIZE, TEXT_SIZE = 10.5, 11.0
PANEL_WIDTH: Final = 370.0  #: Of most figures, px
DASHED: Final = (0, (4, 3))
_TOP: Final = 20.0
_SVG: Final = "http://www.w3.org/2000/svg"
_XLINK: Final = "http://www.w3.org/1999/xlink"
_LONG_DECIMAL: Final = re.compile(r"-?\d+\.\d{3,}")
_FONT_FAMILY: Final = re.compile(r"font-family:[^;]*;?\s*")
_REFERENCE: Final = re.compile(r"url\(#([^)]+)\)")
_LABEL_LENGTH: Final = 28
FEWEST_FOR_A_BOX: Final = 5  #: Fewest values that a box summarises
_settings = threading.RLock()


class Caption(NamedTuple):
    """Texts of a panel: `key` makes its ids unique in the page, `what` is the description."""

    key: str
    title: str
    note: str
    what: str

    @property
    def alt(self) -> str:
        """Alternative text."""
        parts = [f"{self.title}: {self.what}", self.note]
        return (
            "; ".join("".join(c if c.isprintable() else " " for c in p) for p in parts if p) + "."
        )


@dataclass(frozen=True)
class Panel:
    """One drawing with the title above it and a note beside the title."""

    title: str
    note: str
    svg: Markup
    width: float  #: Nominal width [px]


def blank(width: float, height: float) -> Figure:
    """Return a transparent figure of `width` x `height` page pixels."""
    figure = Figure(figsize=(width / 72.0, height / 72.0))
    figure.patch.set_visible(False)
    return figure


def place(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Return axes at (`left`, `top`) pixels from the upper left corner of the figure."""
    full_width, full_height = figure.get_size_inches() * 72.0
    bottom = (full_height - top - height) / full_height
    axes = figure.add_axes(
        (left / full_width, bottom, width / full_width, height / full_height),
    )
    axes.patch.set_visible(False)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set(color=MUTED, linewidth=0.8)
    axes.tick_params(
        colors=MUTED, labelcolor=INK, labelsize=TICK_SIZE, length=3.0, width=0.8, pad=3.0
    )
    axes.set_axisbelow(True)
    return axes


def log_ticks(axis: Axis, locator: Locator) -> None:
    """Set decimal ticks on a logarithmic axis, without minor ticks."""
    axis.set_major_locator(locator)
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def ruled(
    axes: Axes, axis: Literal["x", "y", "both"], *, x_ticks: int = 5, y_ticks: int = 4
) -> None:
    """Draw a light grid at few, round ticks."""
    axes.grid(True, axis=axis, color=GRID, linewidth=0.8)
    axes.xaxis.set_major_locator(MaxNLocator(x_ticks, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_locator(MaxNLocator(y_ticks, steps=[1, 2, 5, 10]))


def headed(axes: Axes, text: str) -> None:
    """Write quantity and unit of the vertical axis above the axes."""
    axes.set_title(text, loc="left", fontsize=TEXT_SIZE, color=MUTED, pad=5.0)


def footed(axes: Axes, text: str) -> None:
    """Write `text` below the axes."""
    axes.set_xlabel(text, fontsize=TEXT_SIZE, color=MUTED, labelpad=3.0)


def dots(axes: Axes, x: Array, y: Array, color: str, size: float = 2.2) -> None:
    """Draw small dots at (c,) points as one path, a tenth of the size of c markers."""
    gap = np.full(x.shape, np.nan)
    # A line of zero length with round caps is a dot.
    rows = [np.column_stack([v, v, gap]).ravel() for v in (x, y)]
    with mpl.rc_context({"path.simplify": False}):
        axes.plot(*rows, color=color, linewidth=size, solid_capstyle="round")


def thinned(time: Array, values: Array, bins: int = 500) -> tuple[Array, Array]:
    """Return minimum and maximum of each of `bins` equal intervals, (m,) -> (<= 2 bins,)."""
    if time.size <= 2 * bins:
        return time, values
    edges = np.linspace(0, time.size, bins + 1).astype(np.intp)
    stretches = [(start, values[start:end]) for start, end in pairwise(edges)]
    ends = [start + end(part) for start, part in stretches for end in (np.argmin, np.argmax)]
    chosen = np.unique([0, *ends, time.size - 1])
    return time[chosen], values[chosen]


def runs(time: Array, values: Array, bins: int = 500) -> Iterator[tuple[Array, Array]]:
    """Yield intervals of finite values (m,), each :func:`thinned`, with `bins` bins in total."""
    edges = np.flatnonzero(np.diff(np.isfinite(values), prepend=False, append=False))
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        yield thinned(time[a:b], values[a:b], max(2, round(bins * (b - a) / len(values))))


@contextmanager
def drawing() -> Iterator[None]:
    """Draw with the default settings of matplotlib, one thread at a time (settings are global)."""
    with _settings, warnings.catch_warnings(), mpl.rc_context():
        # Text is drawn with the fonts of the page; glyphs missing in DejaVu do not matter.
        warnings.filterwarnings("ignore", message=r"Glyph \d+")
        mpl.rcdefaults()
        mpl.rcParams.update(
            {"svg.fonttype": "none", "svg.hashsalt": "hil", "text.parse_math": False}
        )
        yield


def label(text: str) -> str:
    """Shorten a name to one printable line."""
    line = "".join(c if c.isprintable() else " " for c in text).strip()
    return line if len(line) <= _LABEL_LENGTH else line[: _LABEL_LENGTH - 1] + "…"


def to_panel(figure: Figure, caption: Caption, traces: str = "") -> Panel:
    """Return a figure as SVG; `traces` (see :func:`traces_text`) make it zoomable."""
    out = io.BytesIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(out, format="svg", metadata=metadata)
    root = ET.fromstring(out.getvalue())
    _drop_document_parts(root)
    _rename_ids(root, caption.key)
    for element in root.iter():
        _restyle(element)
    width, height = figure.get_size_inches() * 72.0
    root.attrib.clear()
    root.set("viewBox", f"0 0 {width:g} {height:g}")
    root.set("role", "img")
    root.set("aria-label", " ".join(caption.alt.split()))
    if traces:
        root.set("data-traces", traces)
    ET.register_namespace("", _SVG)
    ET.register_namespace("xlink", _XLINK)
    svg = Markup(ET.tostring(root, encoding="unicode"))
    return Panel(caption.title, caption.note, svg, width)


def _drop_document_parts(root: ET.Element) -> None:
    """Remove style rules (they would hold for the whole page) and layout white space."""
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in (f"{{{_SVG}}}style", f"{{{_SVG}}}metadata"):
                parent.remove(child)
        if parent.tag != f"{{{_SVG}}}text" and not (parent.text or "").strip():
            parent.text = None
        parent.tail = None


def _rename_ids(root: ET.Element, key: str) -> None:
    """Keep only ids that something refers to, numbered in order of appearance."""
    references: set[str] = set()
    for element in root.iter():
        references.add(element.get(f"{{{_XLINK}}}href", "").removeprefix("#"))
        for value in element.attrib.values():
            references.update(_REFERENCE.findall(value))
    present = [i for e in root.iter() if (i := e.get("id")) is not None and i in references]
    names = {old: f"{key}-{k}" for k, old in enumerate(present)}
    for element in root.iter():
        name, target = element.attrib.pop("id", None), element.get(f"{{{_XLINK}}}href", "")
        if name in names:
            element.set("id", names[name])
        if target.startswith("#"):
            del element.attrib[f"{{{_XLINK}}}href"]
            element.set("href", f"#{names[target[1:]]}")
        for attribute, value in element.attrib.items():
            if "url(#" in value:
                element.set(attribute, _REFERENCE.sub(lambda m: f"url(#{names[m[1]]})", value))


def _restyle(element: ET.Element) -> None:
    """Apply fonts and colours of the page, and round coordinates."""
    style = element.get("style")
    if style:
        style = _FONT_FAMILY.sub("", style)
        for sentinel, variable in CSS_VARIABLES.items():
            style = style.replace(sentinel, variable)
        element.set("style", style)
    for attribute in ("d", "x", "y"):
        value = element.get(attribute)
        if value:
            short = _LONG_DECIMAL.sub(lambda m: f"{float(m[0]):.2f}", value)
            element.set(attribute, " ".join(short.split()))
    if re.fullmatch(r"rotate\(-?0 .*\)", element.get("transform", "")):
        del element.attrib["transform"]


MOST_POINTS: Final = 3000  #: Samples of a line; for a zoom of more than three
_STEPS: Final = 65534
_NOTHING: Final = 65535  # Code of a missing sample


@dataclass(frozen=True, eq=False)
class Trace:
    """One line."""

    values: Array  #: (m,); NaN where nothing was recorded
    colour: str  #: of the palette
    width: float  #: of the line [px]
    name: str  #: label
    dashed: bool = False  #: for print


@dataclass(frozen=True, eq=False)
class Plot:
    """Axes of a panel with time to the right."""

    box: tuple[float, float, float, float]  #: left, top, width and height in the panel [px]
    heading: str  #: quantity and unit
    traces: Sequence[Trace]  #: its lines, the lowest first
    limits: Sequence[float] = ()  #: values at which dashed lines are drawn
    #: shaded intervals of time, from the first sample [s]
    shaded: Sequence[tuple[float, float]] = ()
    #: largest value of a range about zero; the range of the lines if None
    reach: float | None = None


def traces_text(
    time: Array, plots: Sequence[Plot], *, points: int = MOST_POINTS, marks: Sequence[float] = ()
) -> str:
    """Return plots over time (m,) [s] as JSON for the page's script; "" for under two samples.

    Lines are resampled evenly to at most `points`; vertical lines are drawn at `marks` [s].
    """
    if time.size < 2 or not time[-1] > time[0]:
        return ""
    begin, grid = float(time[0]), np.linspace(time[0], time[-1], min(points, time.size))
    content = {
        "begin": round(begin, 6),
        "end": round(float(time[-1]) - begin, 6),
        "marks": [round(mark - begin, 6) for mark in marks],
        "plots": [
            {
                "box": plot.box,
                "heading": plot.heading,
                "limits": [float(f"{limit:.7g}") for limit in plot.limits],
                "shaded": [[round(start, 4), round(stop, 4)] for start, stop in plot.shaded],
                "lines": [_line(np.interp(grid, time, one.values), one) for one in plot.traces],
            }
            for plot in plots
        ],
    }
    return json.dumps(content, separators=(",", ":"), ensure_ascii=False)


def _line(values: Array, trace: Trace) -> dict[str, str | float]:
    there = np.isfinite(values)
    known = values[there]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    step = (high - low) / _STEPS or 1.0
    counts = np.full(values.shape, _NOTHING, dtype="<u2")
    counts[there] = np.rint((known - low) / step)
    return {
        "name": trace.name,
        "colour": CSS_VARIABLES[trace.colour],
        "width": trace.width,
        "low": float(f"{low:.7g}"),
        "step": float(f"{step:.7g}"),
        "data": base64.b64encode(counts.tobytes()).decode("ascii"),
    }


@contextmanager
def panel(
    panels: list[Panel],
    height: float,
    caption: Caption,
    heading: str = "",
    foot: str = "",
    *,
    left: float = 46.0,
    right: float = 10.0,
    bottom: float = 40.0,
) -> Iterator[Axes]:
    """Yield axes of the usual width, and append the drawing to `panels`; margins in px."""
    with drawing():
        figure = blank(PANEL_WIDTH, height)
        axes = place(figure, left, _TOP, PANEL_WIDTH - left - right, height - _TOP - bottom)
        yield axes
        if heading:
            headed(axes, heading)
        if foot:
            footed(axes, foot)
        panels.append(to_panel(figure, caption))


def marked(
    axes: Axes, limits: Sequence[float], colour: str, marks: Sequence[tuple[float, str]]
) -> None:
    """Draw dashed lines at limits inside the range of the axis, dotted ones at instants."""
    low, high = axes.get_ylim()
    if (least := 1e-3 * max(-low, high, 1e-6)) > high - low:  # noise at standstill is not magnified
        low, high = 0.5 * (low + high - least), 0.5 * (low + high + least)
    for limit in limits:
        if low <= limit <= high:
            axes.axhline(limit, color=colour, linewidth=0.9, linestyle=(0, (5, 2)))
    for mark, own in marks:
        axes.axvline(mark, color=own, linewidth=0.8, linestyle=(0, (1, 2)))
    axes.set_ylim(low, high)
    axes.ticklabel_format(axis="y", useOffset=False)


def time_panel(
    height: float,
    time: Array,
    plots: Sequence[Plot],
    caption: Caption,
    points: int = MOST_POINTS,
    *,
    width: float = PANEL_WIDTH,
    foot: str = "time [s]",
    marks: Sequence[tuple[float, str]] = (),
) -> Panel:
    """Draw plots over the same time, one above the other, zoomable; `marks` are time and colour."""
    with drawing():
        figure = blank(width, height)
        for k, plot in enumerate(plots):
            axes = place(figure, *plot.box)
            for stretch in plot.shaded:
                axes.axvspan(*stretch, color=BAND, linewidth=0.0, zorder=0.5)
            for trace in plot.traces:
                for part in runs(time, trace.values):
                    axes.plot(
                        *part,
                        color=trace.colour,
                        linewidth=trace.width,
                        linestyle=(0, (4, 2)) if trace.dashed else "-",
                        solid_joinstyle="round",
                    )
            if plot.reach is not None:
                axes.set_ylim(-plot.reach, plot.reach)
            headed(axes, plot.heading)
            marked(axes, plot.limits, OUTSIDE_3, marks)
            values = np.concatenate([one.values for one in plot.traces])
            if np.nanmin(values, initial=0.0) < 0.0 < np.nanmax(values, initial=0.0):
                axes.axhline(0.0, color=MUTED, linewidth=0.8, zorder=1.5)
            ruled(axes, "both", x_ticks=6, y_ticks=3 if k else 4)
            axes.set_xlim(float(time[0]), max(float(time[-1]), float(time[0]) + 1e-9))
            axes.tick_params(labelbottom=plot is plots[-1])
            if plot is plots[-1]:
                footed(axes, foot)
        at = [mark for mark, _ in marks]
        return to_panel(figure, caption, traces_text(time, plots, points=points, marks=at))


def box_panel(
    caption: Caption,
    columns: Sequence[Array],
    colours: Sequence[str],
    heading: str,
    labels: Sequence[str] = (),
    level: float = math.nan,
) -> Panel:
    """Draw columns of values (m,) as dots with a box, and a dashed line at `level`."""
    lines = max([label.count("\n") for label in labels], default=-1) + 1
    thin = {"color": MUTED, "linewidth": 1.1}
    with drawing():
        width = 110.0 + 40.0 * len(columns)
        figure = blank(width, 216.0 + 13.0 * lines)
        axes = place(figure, 46.0, 24.0, width - 54.0, 182.0)
        for k, (values, colour) in enumerate(zip(columns, colours, strict=True), 1):
            if values.size >= FEWEST_FOR_A_BOX:
                axes.boxplot(
                    [values],
                    positions=[k],
                    widths=0.6,
                    patch_artist=True,
                    showfliers=False,
                    boxprops={"facecolor": BAND, "edgecolor": MUTED, "linewidth": 1.1},
                    medianprops={"color": INK, "linewidth": 2.2},
                    whiskerprops=thin,
                    capprops=thin,
                )
            # Horizontal offsets by the golden ratio separate neighbouring values.
            rank = np.argsort(np.argsort(values, kind="stable"), kind="stable")
            side = k + 0.34 * ((rank * 0.6180339887498949) % 1.0 - 0.5)
            axes.scatter(side, values, s=14.0, color=colour, alpha=0.85, linewidths=0.0, zorder=3)
        if math.isfinite(level):
            axes.axhline(level, color=SECOND, linewidth=1.3, linestyle=DASHED, zorder=4)
        ruled(axes, "y", y_ticks=5)
        axes.set_xticks(range(1, len(columns) + 1) if labels else [], labels, fontsize=TICK_SIZE)
        axes.set_xlim(0.4, len(columns) + 0.6)
        axes.tick_params(axis="x", length=0.0)
        # A scale that shows every value and does not exaggerate small changes.
        every = np.concatenate([*columns, [level] if math.isfinite(level) else []])
        middle = float(np.median(every))
        low, high = min(float(every.min()), 0.9 * middle), max(float(every.max()), 1.1 * middle)
        axes.set_ylim(max(0.0, low - 0.06 * (high - low)), high + 0.06 * (high - low) or 1.0)
        headed(axes, heading)
        return to_panel(figure, caption)
