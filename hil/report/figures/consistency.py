"""How far physical consistency moves each parameter, in its standard deviations."""

from __future__ import annotations

import math

from matplotlib.axes import Axes

from hil.report import numbers
from hil.report.figures.canvas import TICK_SIZE, footed
from hil.report.figures.palette import BAND, FIRST, INK, MUTED, OUTSIDE_3
from hil.report.figures.parameters import groups, parameter_rows
from hil.report.figures.svg import Panel, drawing, to_panel
from hil.results import ConsistencyResult, Results

_SMALLEST_REACH, _LARGEST_REACH = 4.0, 12.0
_MOVED = 3.0


def shift_panels(results: Results, consistency: ConsistencyResult) -> list[Panel]:
    """(consistent - estimate) / std of every parameter."""
    largest = max((abs(z) for z in consistency.shift), default=0.0)
    reach = min(_LARGEST_REACH, max(_SMALLEST_REACH, 1.1 * largest))
    return [
        _panel(results, consistency, k, title, members, reach)
        for k, (title, members) in enumerate(groups(results))
    ]


def _panel(
    results: Results,
    consistency: ConsistencyResult,
    k: int,
    title: str,
    members: list[int],
    reach: float,
) -> Panel:
    values = [consistency.shift[i] for i in members]
    moved = sum(abs(z) > _MOVED for z in values)
    alt = (
        f"{title}: how far consistency moves {len(members)} parameters, in standard deviations;"
        f" {moved} by more than {_MOVED:g}."
    )
    with drawing():
        figure, axes = parameter_rows(results, members)
        axes.axvspan(-_MOVED, _MOVED, color=BAND, linewidth=0.0)
        axes.axvline(0.0, color=MUTED, linewidth=0.9)
        for row, z in enumerate(values):
            far = abs(z) > _MOVED
            color = OUTSIDE_3 if far else FIRST
            end = math.copysign(min(abs(z), reach - 0.2), z)
            axes.plot([0.0, end], [row, row], color=color, linewidth=2.2 if far else 1.6)
            axes.scatter(
                [end], [row], s=30.0, marker="s" if far else "o", color=color, linewidths=0.0
            )
            if far:
                _figure(axes, end, row, z)
        axes.set_xlim(-reach, reach)
        footed(axes, "(consistent − estimate) / std")
        return to_panel(figure, key=f"co{k}", title=title, note="", alt=alt)


def _figure(axes: Axes, end: float, row: int, z: float) -> None:
    """The number beside a bar, towards the middle, where there is room."""
    axes.annotate(
        numbers.fixed(z, 1, sign=True).replace("-", "−"),
        (0.0, row),
        xytext=(-5.0 if end > 0.0 else 5.0, 0.0),
        textcoords="offset points",
        ha="right" if end > 0.0 else "left",
        va="center",
        fontsize=TICK_SIZE,
        color=INK,
    )
