"""Ratios of the errors of two estimates, with their intervals."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from hil.report.figures.canvas import blank, footed, place
from hil.report.figures.palette import BAND, INK, MUTED
from hil.report.figures.svg import Panel, drawing, to_panel

from .results import ComparisonResult, ConditionResult


def ratio_panels(conditions: Sequence[ConditionResult]) -> list[Panel]:
    """Ratio of errors with its interval, every pair of estimates on every class."""
    every = [one for condition in conditions for one in condition.comparisons]
    if not every:
        return []
    ends = [end for one in every for end in (one.ratio, one.low, one.high) if end is not None]
    low, high = min(0.9, *ends) / 1.03, max(1.1, *ends) * 1.03
    return [_ratios(condition, (low, high)) for condition in conditions]


def _ratios(condition: ConditionResult, limits: tuple[float, float]) -> Panel:
    labels = {one.key: one.label for one in condition.methods}
    rows = condition.comparisons
    height = 17.0 * len(rows)
    with drawing():
        figure = blank(520.0, 10.0 + height + 42.0)
        axes = place(figure, 220.0, 8.0, 286.0, height)
        axes.set_xscale("log")
        axes.axvline(1.0, color=MUTED, linewidth=1.0)
        for row, one in enumerate(rows):
            _ratio(axes, row, one)
        axes.set_xlim(*limits)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_yticks(range(len(rows)))
        axes.set_yticklabels(
            [f"{one.motion_class}: {labels[one.second]} over {labels[one.first]}" for one in rows]
        )
        axes.tick_params(axis="y", length=0.0)
        axes.spines["left"].set_visible(False)
        ticks = _round_ticks(*limits)
        axes.xaxis.set_major_locator(FixedLocator(ticks))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.grid(True, axis="x", color=BAND, linewidth=0.8)
        footed(axes, "ratio of errors, geometric mean over the motions")
        alt = f"{condition.words}: " + "; ".join(
            f"{one.motion_class}, {labels[one.second]} over {labels[one.first]} {one.ratio:.3f}"
            for one in rows
        )
        return to_panel(
            figure, key=f"r{condition.key}", title=condition.words, note="", alt=f"{alt}."
        )


def _ratio(axes: Axes, row: int, one: ComparisonResult) -> None:
    sure = one.differs
    if one.low is not None and one.high is not None:
        axes.plot([one.low, one.high], [row, row], color=INK if sure else MUTED, linewidth=1.6)
    axes.scatter(
        [one.ratio],
        [row],
        s=38.0,
        marker="o" if sure else "s",
        facecolor=INK if sure else BAND,
        edgecolor=INK if sure else MUTED,
        zorder=3,
    )


def _round_ticks(low: float, high: float) -> list[float]:
    steps = [0.1, 0.2, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0, 100.0]
    if high / low < 1.5:
        steps = [round(0.5 + 0.05 * k, 2) for k in range(31)]
    if high / low < 1.12:
        steps = [round(0.9 + 0.01 * k, 2) for k in range(21)]
    found = [step for step in steps if low <= step <= high]
    return (
        found
        if len(found) < 9
        else [step for step in found if step == 1.0 or found.index(step) % 2 == 0]
    )
