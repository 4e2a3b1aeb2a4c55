"""How the errors and the worst known parameter change as parameters are removed."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

from hil.report.figures.canvas import TICK_SIZE, blank, footed, headed, log_ticks, place, ruled
from hil.report.figures.palette import FIRST, GRID, INK, MUTED, PAPER, SECOND
from hil.report.figures.svg import Panel, drawing, to_panel
from hil.results import EliminationStepResult, EssentialResult

_WIDTH, _HEIGHT = 370.0, 250.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 12.0, 22.0, 42.0
# The last few parameters leave errors of 100 %, beside which nothing else could be distinguished.
_HIGHEST_ERROR = 4.0  # times the lowest


def elimination_panels(essential: EssentialResult) -> list[Panel]:
    """Torque error, and largest relative standard deviation, over the number of parameters."""
    steps = essential.steps
    if len(steps) < 2:
        return []
    return [_errors(essential, steps), _deviations(essential, steps)]


def _errors(essential: EssentialResult, steps: list[EliminationStepResult]) -> Panel:
    left = np.array([step.left for step in steps])
    held_out = 100.0 * np.array([step.held_out for step in steps])
    in_sample = 100.0 * np.array([step.in_sample for step in steps])
    chosen = steps[essential.cut]
    top = _HIGHEST_ERROR * max(float(np.nanmin(held_out)), 1e-9)
    top = max(top, 1.15 * float(held_out[0]), 1.15 * 100.0 * essential.by_spread_held_out)
    alt = (
        f"Torque error over the number of parameters: on held-out motion {held_out[0]:.2f} % with"
        f" all {left[0]}, {100.0 * chosen.held_out:.2f} % with the {chosen.left} at the cut,"
        f" {100.0 * essential.by_spread_held_out:.2f} % with the {essential.by_spread_left} that"
        " relative standard deviations alone leave."
    )
    with drawing():
        figure = blank(_WIDTH, _HEIGHT)
        axes = _axes(figure, left)
        axes.plot(left, in_sample, color=SECOND, linewidth=1.4, linestyle=(0, (5, 3)))
        axes.plot(left, held_out, color=FIRST, linewidth=1.8)
        axes.set_ylim(0.0, top)
        ruled(axes, "y", x_ticks=6, y_ticks=5)
        _cut(axes, chosen.left, 100.0 * chosen.held_out, top)
        axes.scatter(
            [essential.by_spread_left],
            [100.0 * essential.by_spread_held_out],
            s=40.0,
            marker="D",
            facecolor=PAPER,
            edgecolor=FIRST,
            linewidths=1.5,
            zorder=5,
        )
        headed(axes, "torque error [%]")
        note = f"cut at {chosen.left} of {left[0]}"
        return to_panel(figure, key="el0", title="Torque error", note=note, alt=alt)


def _deviations(essential: EssentialResult, steps: list[EliminationStepResult]) -> Panel:
    left = np.array([step.left for step in steps])
    largest = 100.0 * np.array([step.largest_relative_std for step in steps])
    usable = np.isfinite(largest) & (largest > 0.0)
    chosen = steps[essential.cut]
    worst = 100.0 * chosen.largest_relative_std
    alt = (
        "Largest relative standard deviation over the number of parameters,"
        f" {worst:.3g} % with the {chosen.left} at the cut."
    )
    with drawing():
        figure = blank(_WIDTH, _HEIGHT)
        axes = _axes(figure, left)
        axes.set_yscale("log")
        axes.plot(left[usable], largest[usable], color=FIRST, linewidth=1.8)
        low = float(largest[usable].min(initial=1.0)) / 2.0
        high = 2.0 * min(float(largest[usable].max(initial=1.0)), 1e5)
        axes.set_ylim(low, high)
        decades = range(math.ceil(math.log10(low)), math.floor(math.log10(high)) + 1)
        log_ticks(axes.yaxis, FixedLocator([10.0**k for k in decades]))
        axes.grid(True, axis="y", color=GRID, linewidth=0.8)
        _cut(axes, chosen.left, worst if math.isfinite(worst) else high, high)
        headed(axes, "largest std / |estimate| [%]")
        note = f"{worst:.3g} % at the cut" if math.isfinite(worst) else ""
        return to_panel(figure, key="el1", title="Worst known parameter", note=note, alt=alt)


def _axes(figure: Figure, left: NDArray[np.intp]) -> Axes:
    """Axes on which parameters go from all of them on the left to one on the right."""
    axes = place(figure, _LEFT, _TOP, _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM)
    axes.set_xlim(float(left[0]) + 0.5, 0.0)
    footed(axes, "parameters left")
    return axes


def _cut(axes: Axes, left: int, value: float, top: float) -> None:
    """A line at the cut, and the point on the curve there."""
    axes.axvline(left, color=MUTED, linewidth=1.0, linestyle=(0, (3, 3)))
    axes.scatter([left], [min(value, top)], s=44.0, color=FIRST, linewidths=0.0, zorder=5)
    axes.annotate(
        "cut",
        (left, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(4.0, -9.0),
        textcoords="offset points",
        fontsize=TICK_SIZE,
        color=INK,
    )
