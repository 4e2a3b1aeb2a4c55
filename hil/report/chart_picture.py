"""Charts as pictures, by matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator, StrMethodFormatter

from hil.base.arrays import Array
from hil.report import picture_style as style
from hil.report.chart import Chart, Legend, Plot, thinned

_FIGURE_WIDTH: Final = 9.0  # inch
_PIXELS_PER_INCH: Final = 110.0  # of a page, per inch of height
_FRAME_PIXELS: Final = 34.0  # above and below a plot, pixels of a page
_POINTS_PER_PIXEL: Final = 0.75  # per pixel


def draw_charts(
    columns: Sequence[Sequence[Chart]],
    legends: Sequence[Legend] = (),
    *,
    enlarged: float = 1.0,
    size: tuple[float, float] | None = None,
) -> Figure:
    """Draw columns of charts side by side, with the legends of the lines that they contain.

    A single column has its legend above it, several columns have legends in their charts.

    Args:
        columns: of charts.
        legends: of all lines.
        enlarged: height of plots over that on a page, unless the size is given.
        size: of the figure [inch].
    """
    heights = [[plot.height for chart in column for plot in chart.plots] for column in columns]
    rows = max(map(len, heights))
    height = (
        enlarged * max(map(sum, heights)) + rows * _FRAME_PIXELS + _FRAME_PIXELS
    ) / _PIXELS_PER_INCH
    with style.page():
        figure = Figure(size or (_FIGURE_WIDTH, height), layout="constrained")
        grid = figure.add_gridspec(1, len(columns))
        for k, (column, ratios) in enumerate(zip(columns, heights, strict=True)):
            cells = grid[k].subgridspec(len(ratios), 1, height_ratios=ratios)
            places = iter(range(len(ratios)))
            for chart in column:
                axes = [figure.add_subplot(cells[next(places)]) for _ in chart.plots]
                _draw(chart, axes, is_last=chart is column[-1])
                if len(columns) > 1:
                    axes[0].legend(*_entries([chart], legends), fontsize=style.SMALL_FONT_SIZE)
        if len(columns) == 1:
            figure.legend(
                *_entries(columns[0], legends),
                loc="outside upper center",
                ncols=5,
                fontsize=style.SMALL_FONT_SIZE,
            )
    return figure


def draw_torque(axes: Axes, chart: Chart, legends: Sequence[Legend]) -> None:
    """Draw the first plot of a chart into given axes."""
    plot = chart.plots[0]
    draw_plot(axes, plot, chart, _POINTS_PER_PIXEL)
    axes.set_title(chart.caption.title)
    axes.set_xlabel(chart.foot)
    axes.set_ylabel(plot.heading)
    axes.legend(*_entries([replace(chart, plots=[plot])], legends))


def _entries(charts: Sequence[Chart], legends: Sequence[Legend]) -> tuple[list[Artist], list[str]]:
    """Return symbols and texts of the legends of what charts contain."""
    plots = [plot for chart in charts for plot in chart.plots]
    names = {trace.name for plot in plots for trace in plot.traces}
    shown = [legend for legend in legends if legend.key in names]
    lines: list[Artist] = [
        Line2D(
            [],
            [],
            color=style.colour(legend.colour),
            linewidth=legend.width * _POINTS_PER_PIXEL,
            linestyle="--" if legend.dashed else "-",
        )
        for legend in shown
    ]
    texts = [legend.text for legend in shown]
    if shades := dict.fromkeys(plot.shade for plot in plots if plot.shaded):
        lines += [Patch(color=style.colour("band")) for _ in shades]
        texts += shades
    return lines, texts


def _draw(chart: Chart, rows: Sequence[Axes], *, is_last: bool) -> None:
    """Draw the plots of a chart one above the other; the last of a column has the ticks of x."""
    rows[0].set_title(chart.caption.title)
    rows[0].set_title(
        chart.caption.note, loc="right", fontsize=style.SMALL_FONT_SIZE, color=style.MUTED
    )
    for axes, plot in zip(rows, chart.plots, strict=True):
        draw_plot(axes, plot, chart, _POINTS_PER_PIXEL)
        axes.set_title(plot.heading, loc="left", fontsize=style.SMALL_FONT_SIZE, color=style.MUTED)
        axes.tick_params(labelbottom=is_last and axes is rows[-1])
    if is_last:
        rows[-1].set_xlabel(chart.foot)


def draw_plot(axes: Axes, plot: Plot, chart: Chart, scale: float, bins: int | None = None) -> None:
    """Draw a plot of a chart into axes, without its texts.

    Args:
        axes: of matplotlib.
        plot: one of the chart's.
        chart: its horizontal axis.
        scale: points of a pixel.
        bins: intervals of x, in each of which a line has at most two points; None: all.
    """
    if plot.shaded:  # one artist, as a call for each would take longer than all else
        corners = [[(a, 0.0), (a, 1.0), (b, 1.0), (b, 0.0), (a, 0.0)] for a, b in plot.shaded]
        shades = PathPatch(
            Path.make_compound_path_from_polys(np.array(corners)),
            transform=axes.get_xaxis_transform(), color=style.colour("band"), linewidth=0.0,
            zorder=0.2,
        )  # fmt: skip
        axes.add_artist(shades)
    if plot.band is not None:
        axes.axhspan(*plot.band, color=style.colour("band"), linewidth=0.0, zorder=0.2)
    if plot.origin:
        axes.axhline(0.0, color=style.colour("muted"), linewidth=scale)
        axes.axvline(0.0, color=style.colour("muted"), linewidth=scale)
    for trace in plot.traces:
        x = chart.x if trace.x is None else trace.x
        values = trace.values
        size = trace.width * scale
        colour = style.colour(trace.colour)
        # Not by `plot`, which takes as long again for limits that are set below.
        line: Artist
        if trace.dots and bins is not None:
            line = _dots_of_page(x, values, colour, size)
        elif trace.dots:
            line = Line2D(
                x, values, linestyle="none", marker="o", color=colour, markersize=size,
                markeredgewidth=0.0,
            )  # fmt: skip
        else:
            if bins is not None and trace.x is None:
                x, values = thinned(x, values, bins)
            dashes: Literal["--", "-"] = "--" if trace.dashed else "-"
            line = Line2D(x, values, linestyle=dashes, color=colour, linewidth=size)
        axes.add_artist(line)
    if chart.log:
        if axes.get_yscale() != "log":
            axes.loglog()
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        few = plot.y_limits[1] < 20.0 * plot.y_limits[0]
        axes.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}") if few else NullFormatter())
        if bins is not None:  # a page shows no ticks but their numbers
            axes.xaxis.set_minor_locator(NullLocator())
            axes.yaxis.set_minor_locator(LogLocator(subs="auto") if few else NullLocator())
    axes.set_xlim(*chart.x_limits)
    axes.set_ylim(*plot.y_limits)
    if chart.ticks:
        names = chart.tick_names or [f"{tick:g}" for tick in chart.ticks]
        axes.set_xticks(chart.ticks, names)
        axes.xaxis.set_minor_locator(NullLocator())
    if plot.names:
        axes.set_yticks([at for at, _ in plot.names], [text for _, text in plot.names])


def _dots_of_page(x: Array, values: Array, colour: str, size: float) -> PathPatch:
    """Return dots as one path of lines without length, with round ends.

    As markers each is an element of its own: they take several times as long, and as much space.
    """
    places = np.column_stack([x, values])
    places = places[np.isfinite(places).all(axis=1)]
    path = Path(np.repeat(places, 2, axis=0), [Path.MOVETO, Path.LINETO] * len(places))
    path.should_simplify = False  # which leaves out lines without length
    return PathPatch(
        path, fill=False, edgecolor=colour, linewidth=size, capstyle="round", zorder=2.0
    )
