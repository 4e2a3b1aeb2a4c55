"""Panels of a page: pictures of its charts as SVG, in the font and colours of its style sheet."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import lru_cache
from typing import Final
from xml.etree import ElementTree

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import offset_copy

from hil.base.arrays import Array
from hil.base.terminal_text import one_line
from hil.report import picture_style as style
from hil.report.chart import (
    BAND,
    INK,
    MUTED,
    Boxes,
    Caption,
    Chart,
    Matrix,
    label,
)
from hil.report.chart_picture import draw_plot

TICK_SIZE: Final = 10.5  # px, as all lengths here: a picture has 72 of them per inch
TEXT_SIZE: Final = 11.0
LINE_BINS: Final = 300  # of a line over time, which has up to two points in each, some one per px
_PANEL_WIDTH: Final = 370.0
_LEFT_MARGIN: Final = 46.0
_RIGHT_MARGIN: Final = 10.0
_TOP_MARGIN: Final = 20.0
_BOTTOM_MARGIN: Final = 40.0
_PLOT_GAP: Final = 24.0  # between plots above each other
_MIN_TICKS: Final = 3  # of y: a printed chart has no pointer that reads it
_MIN_BOX_VALUES: Final = 5  # values
_BOX_HEIGHT: Final = 206.0
_LABEL_WIDTH: Final = 84.0
_MATRIX_SIDE: Final = 560.0
_MIN_CELL_SIDE: Final = 11.0
_MAX_CELL_SIDE: Final = 26.0
_POINTS_PER_INCH: Final = 72.0
_GRID_WIDTH: Final = 0.8
_NAME_GAP: Final = 4.0  # between a matrix and its names
_GRID_ORDER: Final = 0.5  # over shades, under curves
_GOLDEN_RATIO: Final = 0.6180339887498949
_FURTHER_DIGITS: Final = re.compile(r"(?<=\.\d)\d+")  # after the first decimal
_SVG: Final = "{http://www.w3.org/2000/svg}"
_LINK: Final = "{http://www.w3.org/1999/xlink}href"
_COORDINATES: Final = frozenset({"x", "y", "width", "height", "transform", "points"})


@dataclass(frozen=True)
class Panel:
    """One drawing with a title above it and a note next to the title."""

    title: str
    note: str
    svg: Markup
    key: str = ""  #: of its caption
    joint: int | None = None  #: number of the joint of a chart, from 0


def chart_panel(
    chart: Chart, bins: int = LINE_BINS, width: float = _PANEL_WIDTH, left: float = _LEFT_MARGIN
) -> Panel:
    """Draw a chart; a line has at most two points in each of the `bins` of its x.

    Args:
        chart: the chart.
        bins: intervals of its horizontal axis.
        width: of the panel [px].
        left: of this, for the texts of the vertical axis [px].
    """
    heights = tuple(plot.height for plot in chart.plots)
    height = _TOP_MARGIN + sum(heights) + _PLOT_GAP * (len(heights) - 1) + _BOTTOM_MARGIN
    has_names = bool(chart.ticks) or any(plot.names for plot in chart.plots)
    with _page(chart.caption.key):
        sheet = _new_sheet if has_names else _sheet
        figure, rows = sheet(width, left, height, heights, chart.log)
        for axes, plot in zip(rows, chart.plots, strict=True):
            for artist in (*axes.lines, *axes.patches, *axes.collections, *axes.texts):
                artist.remove()
            draw_plot(axes, plot, chart, 1.0, bins)
            _draw_grid(axes)
            _head(axes, plot.heading)
        _foot(rows[-1], chart.foot)
        return _panel(figure, chart.caption, width, height, chart.joint)


def _new_sheet(
    width: float, left: float, height: float, heights: Sequence[float], is_log: bool
) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes of these heights, one above the other."""
    figure = _figure(width, height)
    rows: list[Axes] = []
    top = _TOP_MARGIN
    for each in heights:
        axes = _axes(figure, left, top, width - left - _RIGHT_MARGIN, each)
        if not is_log:
            axes.xaxis.set_major_locator(_round_ticks(6))
            axes.yaxis.set_major_locator(_round_ticks(4, _MIN_TICKS))
        axes.tick_params(labelbottom=len(rows) == len(heights) - 1)
        axes.grid(visible=False)
        rows.append(axes)
        top += each + _PLOT_GAP
    return figure, rows


# Axes and their ticks take as long to build as to draw, and the charts of all joints have the same.
_sheet = lru_cache(maxsize=8)(_new_sheet)


def _draw_grid(axes: Axes) -> None:
    """Draw the lines of all ticks as one artist: one for each takes longer than the curves."""
    x_limits, y_limits = axes.get_xlim(), axes.get_ylim()
    columns = [x for x in axes.get_xticks() if x_limits[0] <= x <= x_limits[1]]
    rows = [y for y in axes.get_yticks() if y_limits[0] <= y <= y_limits[1]]
    x = [value for x in columns for value in (x, x, np.nan)]
    y = [value for _ in columns for value in (*y_limits, np.nan)]
    x += [value for _ in rows for value in (*x_limits, np.nan)]
    y += [value for y in rows for value in (y, y, np.nan)]
    colour = style.colour("grid")
    axes.add_artist(Line2D(x, y, linewidth=_GRID_WIDTH, color=colour, zorder=_GRID_ORDER))


def box_panel(boxes: Boxes) -> Panel:
    """Draw columns of values as dots, with boxes: quartiles, median, 1.5 box heights."""
    names = boxes.names
    bottom = 25.0
    width = 110.0 + 40.0 * len(boxes.columns)
    every = np.concatenate(boxes.columns)
    # A scale that shows every value and does not exaggerate small changes.
    middle = float(np.median(every))
    low = min(float(every.min()), 0.9 * middle)
    high = max(float(every.max()), 1.1 * middle)
    with _page(boxes.caption.key):
        figure = _figure(width, _BOX_HEIGHT + bottom)
        axes = _axes(
            figure,
            _LEFT_MARGIN,
            _TOP_MARGIN,
            width - _LEFT_MARGIN - _RIGHT_MARGIN,
            _BOX_HEIGHT - _TOP_MARGIN,
        )
        for k, (values, colour) in enumerate(zip(boxes.columns, boxes.colours, strict=True), 1):
            if values.size >= _MIN_BOX_VALUES:
                _box(axes, k, values)
            # Horizontal offsets by the golden ratio separate neighbouring values.
            rank = np.argsort(np.argsort(values, kind="stable"), kind="stable")
            side = k + 0.34 * ((rank * _GOLDEN_RATIO) % 1.0 - 0.5)
            axes.plot(
                side, values, "o", color=style.colour(colour), markersize=4.0, markeredgewidth=0.0
            )
        axes.set_xlim(0.4, len(names) + 0.6)
        axes.set_xticks(range(1, len(names) + 1), names)
        axes.xaxis.grid(visible=False)
        axes.set_ylim(max(0.0, low - 0.06 * (high - low)), high + 0.06 * (high - low) or 1.0)
        axes.yaxis.set_major_locator(_round_ticks(5, _MIN_TICKS))
        _head(axes, boxes.heading)
        return _panel(figure, boxes.caption, width, _BOX_HEIGHT + bottom)


def _box(axes: Axes, row: int, values: Array) -> None:
    """Draw quartiles and median, and whiskers to the last values within 1.5 box heights."""
    muted = style.colour(MUTED)
    line = {"color": muted, "linewidth": 1.0}
    parts = axes.boxplot(
        [values], positions=[row], widths=0.6, patch_artist=True, showfliers=False,
        manage_ticks=False, capprops=line, whiskerprops=line,
        boxprops={"facecolor": style.colour(BAND), "edgecolor": muted, "linewidth": 1.0},
        medianprops={"color": style.colour(INK), "linewidth": 2.2},
    )  # fmt: skip
    for artists in parts.values():
        for artist in artists:
            artist.set_zorder(1.5)


def matrix_panel(matrix: Matrix) -> Panel:
    """Draw a matrix of correlations with its names."""
    names = [label(name) for name in matrix.names]
    cell = min(max(_MATRIX_SIDE / len(names), _MIN_CELL_SIDE), _MAX_CELL_SIDE)
    side = cell * len(names)
    whole = _LABEL_WIDTH + side + 6.0
    with _page(matrix.caption.key):
        figure = _figure(whole, whole)
        axes = _axes(figure, _LABEL_WIDTH, _LABEL_WIDTH, side, side)
        axes.imshow(
            np.nan_to_num(matrix.values), cmap="gist_yarg", vmin=0.0, vmax=1.0, interpolation="none"
        )
        axes.grid(visible=False)
        axes.spines[:].set_visible(True)
        size = min(TICK_SIZE, 0.76 * cell)
        axes.set(xticks=[], yticks=[])
        # A text takes a fraction of the time of a tick.
        columns, rows = axes.get_xaxis_transform(), axes.get_yaxis_transform()
        above = offset_copy(columns, figure, 0.0, _NAME_GAP, units="points")
        before = offset_copy(rows, figure, -_NAME_GAP, 0.0, units="points")
        for k, name in enumerate(names):
            axes.text(
                k, 1.0, name, transform=above, fontsize=size, color=style.colour(INK),
                rotation=90.0, ha="center", va="bottom",
            )  # fmt: skip
            axes.text(
                0.0, k, name, transform=before, fontsize=size, color=style.colour(INK),
                ha="right", va="center_baseline",
            )  # fmt: skip
        return _panel(figure, matrix.caption, whole, whole)


def _page(key: str) -> AbstractContextManager[None]:
    """Return the settings of a picture; the key alone determines the ids in its SVG."""
    grid = style.colour("grid")
    muted = style.colour("muted")
    ink = style.colour("ink")
    return style.page(
        **{"svg.hashsalt": key, "xtick.labelsize": TICK_SIZE, "ytick.labelsize": TICK_SIZE},
        **{"xtick.labelcolor": ink, "ytick.labelcolor": ink},
        **{"xtick.color": muted, "ytick.color": muted, "axes.edgecolor": muted},
        **{"grid.color": grid, "grid.linewidth": _GRID_WIDTH, "axes.linewidth": 0.8},
        # Lines of the grid mark the ticks.
        **{"xtick.bottom": False, "ytick.left": False, "figure.dpi": _POINTS_PER_INCH},
        **{"xtick.major.pad": 6.0, "ytick.major.pad": 6.0},
    )


def _figure(width: float, height: float) -> Figure:
    return Figure((width / _POINTS_PER_INCH, height / _POINTS_PER_INCH), frameon=False)


def _axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Return axes with distances in px from the upper left corner."""
    whole = figure.get_size_inches() * _POINTS_PER_INCH
    bottom = whole[1] - top - height
    rectangle = (left / whole[0], bottom / whole[1], width / whole[0], height / whole[1])
    axes = figure.add_axes(rectangle)
    axes.patch.set_visible(False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_label_coords(0.0, 0.0)  # no label, whose place would take every text's extent
    # Before the quantity, which stands above the axis.
    axes.yaxis.get_offset_text().set_horizontalalignment("right")
    return axes


def _head(axes: Axes, text: str) -> None:
    """Write the quantity of the vertical axis above its upper end."""
    axes.annotate(
        one_line(text), (0.0, 1.0), (0.0, 5.0), "axes fraction", "offset points",
        color=style.colour(MUTED), fontsize=TEXT_SIZE,
    )  # fmt: skip


def _foot(axes: Axes, text: str) -> None:
    axes.annotate(
        one_line(text), (0.5, 0.0), (0.0, -32.0), "axes fraction", "offset points",
        color=style.colour(MUTED), fontsize=TEXT_SIZE, ha="center",
    )  # fmt: skip


def _round_ticks(most: int, fewest: int = 1) -> MaxNLocator:
    """Return a locator of round values, with at most this number of intervals."""
    return MaxNLocator(most, steps=[1.0, 2.0, 5.0, 10.0], min_n_ticks=fewest)


def _panel(
    figure: Figure, caption: Caption, width: float, height: float, joint: int | None = None
) -> Panel:
    """Return a figure as a panel with its text alternative."""
    note = f"; {caption.note}" if caption.note else ""
    content = io.BytesIO()
    without = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(content, format="svg", metadata=without)
    svg = _of_page(ElementTree.fromstring(content.getvalue()))
    svg.attrib.clear()
    svg.attrib |= {
        "viewBox": f"0 0 {width:g} {height:g}",
        "style": f"max-width: {1.3 * width:.0f}px",
        "role": "img",
        "aria-label": one_line(f"{caption.title}: {caption.what}{note}."),
    }
    text = ElementTree.tostring(svg, encoding="unicode")
    return Panel(caption.title, caption.note, Markup(text), caption.key, joint)


def _of_page(svg: ElementTree.Element) -> ElementTree.Element:
    """Return matplotlib's SVG with the colours and the font of the page, without what it repeats.

    Colours of the palette become its variables, so that a dark page uses the dark palette;
    groups lose their ids, which would not be unique in the page, and coordinates their further
    digits.
    """
    variables = {value: f"var(--{name})" for name, value in reversed([*style.palette().items()])}
    (cleaned,) = _cleaned(svg, variables)
    return cleaned


def _cleaned(
    element: ElementTree.Element, variables: Mapping[str, str]
) -> list[ElementTree.Element]:
    """Return what is left of an element, or of a group without attributes its children."""
    tag = element.tag.removeprefix(_SVG)
    if tag == "style":
        return []
    children = [left for child in element for left in _cleaned(child, variables)]
    cleaned = ElementTree.Element(tag)
    cleaned.text = element.text if tag == "text" else None
    for name, value in element.attrib.items():
        if (tag == "g" and name == "id") or value.startswith("rotate(-0 "):
            continue
        if name == "style":
            value = _style(value, variables)
        elif name == "d":
            value = _path(value)
        elif name in _COORDINATES:
            value = _FURTHER_DIGITS.sub("", value)
        cleaned.set("href" if name == _LINK else name, value)
    dots = [child for child in children if child.tag == "use"]
    styles = {dot.get("style", "") for dot in dots}
    if tag == "g" and len(dots) > 1 and len(styles) == 1:
        cleaned.set("style", *styles)
        for dot in dots:
            del dot.attrib["style"]
    if tag in ("g", "defs") and not children:
        return []
    if tag == "g" and not cleaned.attrib:
        return children
    cleaned.extend(children)
    return [cleaned]


def _path(data: str) -> str:
    """Return a path with one digit behind the point; lines after its start need no letter."""
    short = " ".join(_FURTHER_DIGITS.sub("", data).split()).replace(".0 ", " ")
    has_curves = "C" in short or "Q" in short
    return short if has_curves else short.replace(" L ", " ")


def _style(text: str, variables: Mapping[str, str]) -> str:
    """Return declarations of a style with the palette's variables, in the font of the page."""
    declarations = (part.partition(":") for part in text.split(";"))
    return ";".join(
        f"{name.strip()}:{variables.get(value.strip(), value.strip())}"
        for name, _, value in declarations
        if value and name.strip() != "font-family"
    )
