"""Panels of a page: pictures of its charts as SVG, in the font and colours of its style sheet."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

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
from hil.report.svg_renderer import SvgRenderer

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
_TICK_GAP: Final = 9.5  # between the vertical axis and its numbers
_HEAD_RISE: Final = 5.0  # of the base line of the quantity above its axis
_TICK_DROP: Final = 17.4  # of the base line of the numbers below the horizontal axis
_FOOT_DROP: Final = 32.0
_TICK_ROUNDING: Final = 1e-10  # of the length of an axis
_GRID_ORDER: Final = 0.5  # over shades, under curves
_GOLDEN_RATIO: Final = 0.6180339887498949


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
    renderer = SvgRenderer(width, height, chart.caption.key)
    with _page():
        sheet = _new_sheet if has_names else _sheet
        figure, rows = sheet(width, left, height, heights, chart.log)
        for axes, plot in zip(rows, chart.plots, strict=True):
            for artist in (*axes.lines, *axes.patches, *axes.collections):
                artist.remove()
            draw_plot(axes, plot, chart, 1.0, bins)
            x_ticks, y_ticks = _Ticks.of(axes.xaxis), _Ticks.of(axes.yaxis)
            _draw_grid(axes, x_ticks.major, y_ticks.major)
            _write_y_ticks(renderer, axes, y_ticks)
            _write_head(renderer, axes, plot.heading)
            if axes is rows[-1]:
                _write_x_ticks(renderer, axes, x_ticks)
                _write_foot(renderer, axes, chart.foot)
        figure.draw(renderer)
    return _panel(renderer, chart.caption, chart.joint)


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
        rows.append(axes)
        top += each + _PLOT_GAP
    return figure, rows


# Axes take as long to build as to draw, and the charts of all joints have the same.
_sheet = lru_cache(maxsize=8)(_new_sheet)


class _Ticks(NamedTuple):
    """Ticks of an axis within its limits."""

    major: list[float]
    texts: list[tuple[float, str]]  # of these and the minor ones, by their share of the axis
    factor: str  # of all numbers, or what is added to them

    @classmethod
    def of(cls, axis: Axis) -> _Ticks:
        """Return the ticks of an axis."""
        formatter = axis.get_major_formatter()
        major, minor = axis.get_majorticklocs().tolist(), axis.get_minorticklocs().tolist()
        names = [*formatter.format_ticks(major), *axis.get_minor_formatter().format_ticks(minor)]
        values = np.array([*major, *minor])
        low, high = axis.get_transform().transform(np.sort(axis.get_view_interval()))
        shares = (axis.get_transform().transform(values) - low) / (high - low)
        inside = (shares >= -_TICK_ROUNDING) & (shares <= 1.0 + _TICK_ROUNDING)
        return cls(
            [value for value, is_inside in zip(major, inside, strict=False) if is_inside],
            [(shares[k], names[k]) for k in np.flatnonzero(inside).tolist() if names[k]],
            formatter.get_offset(),
        )


def _draw_grid(axes: Axes, columns: Sequence[float], rows: Sequence[float]) -> None:
    """Draw the lines of ticks as one artist: one for each takes longer than the curves."""
    x_limits, y_limits = axes.get_xlim(), axes.get_ylim()
    x = [value for x in columns for value in (x, x, np.nan)]
    y = [value for _ in columns for value in (*y_limits, np.nan)]
    x += [value for _ in rows for value in (*x_limits, np.nan)]
    y += [value for y in rows for value in (y, y, np.nan)]
    colour = style.colour("grid")
    axes.add_artist(Line2D(x, y, linewidth=_GRID_WIDTH, color=colour, zorder=_GRID_ORDER))


def _write_x_ticks(renderer: SvgRenderer, axes: Axes, ticks: _Ticks) -> None:
    """Write the numbers or names below the horizontal axis."""
    frame = _frame(axes)
    for share, name in ticks.texts:
        renderer.write(
            name, frame.left + share * (frame.right - frame.left), frame.bottom + _TICK_DROP,
            size=TICK_SIZE, colour=INK, anchor="middle",
        )  # fmt: skip
    if ticks.factor:
        renderer.write(
            ticks.factor, frame.right, frame.bottom + _FOOT_DROP,
            size=TICK_SIZE, colour=INK, anchor="end",
        )  # fmt: skip


def _write_y_ticks(renderer: SvgRenderer, axes: Axes, ticks: _Ticks) -> None:
    """Write the numbers or names to the left of the vertical axis."""
    frame = _frame(axes)
    right = frame.left - _TICK_GAP
    for share, name in ticks.texts:
        renderer.write(
            name, right, frame.bottom - share * (frame.bottom - frame.top),
            size=TICK_SIZE, colour=INK, anchor="end", centred=True,
        )  # fmt: skip
    if ticks.factor:
        renderer.write(
            ticks.factor, right, frame.top - _HEAD_RISE, size=TICK_SIZE, colour=INK, anchor="end"
        )


def _write_head(renderer: SvgRenderer, axes: Axes, text: str) -> None:
    """Write the quantity of the vertical axis above its upper end."""
    frame = _frame(axes)
    renderer.write(one_line(text), frame.left, frame.top - _HEAD_RISE, size=TEXT_SIZE, colour=MUTED)


def _write_foot(renderer: SvgRenderer, axes: Axes, text: str) -> None:
    """Write the quantity of the horizontal axis below its numbers."""
    frame = _frame(axes)
    renderer.write(
        one_line(text), 0.5 * (frame.left + frame.right), frame.bottom + _FOOT_DROP,
        size=TEXT_SIZE, colour=MUTED, anchor="middle",
    )  # fmt: skip


class _Frame(NamedTuple):
    """Sides of axes [px], from the upper left corner of their figure."""

    left: float
    right: float
    top: float
    bottom: float


def _frame(axes: Axes) -> _Frame:
    box = axes.bbox
    height = float(axes.figure.bbox.height)
    return _Frame(box.x0, box.x1, height - box.y1, height - box.y0)


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
    renderer = SvgRenderer(width, _BOX_HEIGHT + bottom, boxes.caption.key)
    with _page():
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
        axes.set_ylim(max(0.0, low - 0.06 * (high - low)), high + 0.06 * (high - low) or 1.0)
        axes.yaxis.set_major_locator(_round_ticks(5, _MIN_TICKS))
        y_ticks = _Ticks.of(axes.yaxis)
        _draw_grid(axes, (), y_ticks.major)
        _write_y_ticks(renderer, axes, y_ticks)
        _write_x_ticks(renderer, axes, _Ticks.of(axes.xaxis))
        _write_head(renderer, axes, boxes.heading)
        figure.draw(renderer)
    return _panel(renderer, boxes.caption)


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
    renderer = SvgRenderer(whole, whole, matrix.caption.key)
    with _page():
        figure = _figure(whole, whole)
        axes = _axes(figure, _LABEL_WIDTH, _LABEL_WIDTH, side, side)
        axes.imshow(
            np.nan_to_num(matrix.values), cmap="gist_yarg", vmin=0.0, vmax=1.0, interpolation="none"
        )
        axes.spines[:].set_visible(True)
        figure.draw(renderer)
    size = min(TICK_SIZE, 0.76 * cell)
    edge = _LABEL_WIDTH - _NAME_GAP
    for k, name in enumerate(names):
        place = _LABEL_WIDTH + (k + 0.5) * cell
        renderer.write(name, place, edge, size=size, colour=INK, centred=True, upwards=True)
        renderer.write(name, edge, place, size=size, colour=INK, anchor="end", centred=True)
    return _panel(renderer, matrix.caption)


def _page() -> AbstractContextManager[None]:
    """Return the settings of a panel."""
    return style.page(**{"axes.edgecolor": style.colour("muted"), "axes.linewidth": 0.8})


def _figure(width: float, height: float) -> Figure:
    size = width / _POINTS_PER_INCH, height / _POINTS_PER_INCH
    return Figure(size, _POINTS_PER_INCH, frameon=False)


def _axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Return axes with distances in px from the upper left corner."""
    whole = figure.get_size_inches() * _POINTS_PER_INCH
    bottom = whole[1] - top - height
    rectangle = (left / whole[0], bottom / whole[1], width / whole[0], height / whole[1])
    axes = figure.add_axes(rectangle)
    axes.patch.set_visible(False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_visible(False)  # the text of a tick takes longer than a curve
    return axes


def _round_ticks(most: int, fewest: int = 1) -> MaxNLocator:
    """Return a locator of round values, with at most this number of intervals."""
    return MaxNLocator(most, steps=[1.0, 2.0, 5.0, 10.0], min_n_ticks=fewest)


def _panel(renderer: SvgRenderer, caption: Caption, joint: int | None = None) -> Panel:
    """Return a drawing as a panel with its text alternative."""
    note = f"; {caption.note}" if caption.note else ""
    svg = renderer.svg(one_line(f"{caption.title}: {caption.what}{note}."))
    return Panel(caption.title, caption.note, svg, caption.key, joint)
