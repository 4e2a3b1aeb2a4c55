"""Figures of a study: the paper's four."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.report import numbers
from hil.report.figures.canvas import TICK_SIZE, blank, footed, headed, place, ruled
from hil.report.figures.correlation import matrix_panel
from hil.report.figures.palette import BAND, FIRST, INK, MUTED, ROUTES, SECOND, WIDE
from hil.report.figures.svg import Panel, drawing, to_panel
from hil.report.figures.traces import Plot, Trace, traces_text

from .records import ExampleRecord
from .results import ConditionResult, StudyResults

Array = NDArray[np.float64]

COLOURS: Final = (FIRST, SECOND, ROUTES[3], ROUTES[0])
MARKERS: Final = ("o", "D", "^", "s")

_WIDTH, _LEFT, _RIGHT = 370.0, 46.0, 10.0


def trajectory_panels(condition: ConditionResult, joint_names: Sequence[str]) -> list[Panel]:
    """Position of each joint in each excitation, on scales of time and angle in common (Fig. 1)."""
    longest = max(method.time[-1] for method in condition.methods)
    return [_trajectory(condition, j, name, longest) for j, name in enumerate(joint_names)]


def _trajectory(condition: ConditionResult, j: int, name: str, longest: float) -> Panel:
    methods = condition.methods
    spans = [
        f"{one.label} {math.degrees(min(one.position[j])):.0f}° to"
        f" {math.degrees(max(one.position[j])):.0f}°"
        for one in methods
    ]
    every = np.concatenate([one.position[j] for one in methods])
    margin = 0.06 * float(np.ptp(every)) or 0.1
    with drawing():
        figure = blank(_WIDTH, 40.0 + len(methods) * 84.0)
        for k, one in enumerate(methods):
            axes = place(figure, _LEFT, 20.0 + 84.0 * k, _WIDTH - _LEFT - _RIGHT, 58.0)
            axes.plot(one.time, one.position[j], color=colour_of(k), linewidth=1.5)
            axes.set_xlim(0.0, longest)
            axes.set_ylim(float(every.min()) - margin, float(every.max()) + margin)
            ruled(axes, "both", x_ticks=6, y_ticks=3)
            headed(axes, f"{one.label}: position [rad]")
            if k < len(methods) - 1:
                axes.tick_params(labelbottom=False)
            else:
                footed(axes, "time [s]")
        alt = f"{name}: position in the excitations; {'; '.join(spans)}."
        return to_panel(figure, key=f"x{j}", title=name, note="", alt=alt)


def correlation_panels(results: StudyResults, condition: ConditionResult) -> list[Panel]:
    """|ρ| of the base parameters for each excitation, friction left out (the paper's Fig. 2)."""
    n = results.n_base
    labels = [
        one.name if one.printed_id is None else f"{one.printed_id} {one.name}"
        for one in results.parameters[:n]
    ]
    return [
        matrix_panel(np.array(one.correlation)[:n, :n], labels, key=f"c{k}", title=one.label)
        for k, one in enumerate(condition.methods)
    ]


def error_panels(condition: ConditionResult, joint_names: Sequence[str]) -> list[Panel]:
    """Mean |e| on fly-by motions, a box for each estimate and a panel for each joint (Fig. 3)."""
    found = next((one for one in condition.classes if one.motion_class == "fly-by"), None)
    if found is None:
        return []
    labels = [one.label for one in condition.methods]
    panels = []
    for j, name in enumerate(joint_names):
        columns = [
            np.array([row[j] for row in found.mean_abs[one.key]]) for one in condition.methods
        ]
        panels.append(_boxes(condition.key, j, name, labels, columns))
    return panels


def _boxes(key: str, j: int, name: str, labels: Sequence[str], columns: Sequence[Array]) -> Panel:
    medians = [float(np.median(column)) for column in columns]
    told = ", ".join(
        f"{label} {numbers.significant(value)}"
        for label, value in zip(labels, medians, strict=True)
    )
    thin = {"color": MUTED, "linewidth": 1.1}
    with drawing():
        figure = blank(220.0, 226.0 + 11.0 * max(_broken(label).count("\n") for label in labels))
        axes = place(figure, 46.0, 24.0, 164.0, 172.0)
        axes.boxplot(
            columns,
            positions=range(1, len(columns) + 1),
            widths=0.6,
            patch_artist=True,
            boxprops={"facecolor": BAND, "edgecolor": MUTED, "linewidth": 1.1},
            medianprops={"color": INK, "linewidth": 2.2},
            whiskerprops=thin,
            capprops=thin,
            flierprops={"marker": "+", "markeredgecolor": MUTED, "markersize": 6.0},
        )
        for k, middle in enumerate(medians):
            axes.scatter(
                [k + 1], [middle], s=34.0, marker=marker_of(k), color=colour_of(k), zorder=4
            )
        ruled(axes, "y", y_ticks=5)
        axes.set_xticks(range(1, len(columns) + 1))
        axes.set_xticklabels([_broken(label) for label in labels], fontsize=TICK_SIZE)
        axes.tick_params(axis="x", length=0.0)
        axes.set_ylim(*_reach(columns))
        headed(axes, "mean |e| [N·m]")
        alt = f"{name}: mean absolute error on {len(columns[0])} motions; medians {told} N·m."
        return to_panel(figure, key=f"b{key}{j}", title=name, note="", alt=alt)


def _broken(label: str) -> str:
    """A label in lines short enough to stand beside others."""
    return label.replace(" ", "\n")


def _reach(columns: Sequence[Array]) -> tuple[float, float]:
    """A scale that shows every motion, and never makes a change of nothing look like much."""
    low = min(float(column.min()) for column in columns)
    high = max(float(column.max()) for column in columns)
    middle = float(np.median(np.concatenate(columns)))
    low, high = min(low, 0.9 * middle), max(high, 1.1 * middle)
    return max(0.0, low - 0.06 * (high - low)), high + 0.06 * (high - low)


def example_panels(
    condition: ConditionResult, example: ExampleRecord, joint_names: Sequence[str]
) -> list[Panel]:
    """One held-out motion in time: measured, predicted by each, and the errors (Fig. 4)."""
    labels = {one.key: one.label for one in condition.methods}
    return [_example(condition.key, example, labels, j, name) for j, name in enumerate(joint_names)]


def _example(key: str, example: ExampleRecord, labels: dict[str, str], j: int, name: str) -> Panel:
    time, measured = np.array(example.time), np.array(example.measured[j])
    errors = {k: measured - np.array(series[j]) for k, series in example.predicted.items()}
    note = ", ".join(
        f"{labels[k]} {numbers.significant(float(np.sqrt(np.mean(error**2))))}"
        for k, error in errors.items()
    )
    width = _WIDTH - _LEFT - _RIGHT
    colours = {k: colour_of(list(labels).index(k)) for k in example.predicted}
    # A row for each error: where there is noise, one drawn over another would hide it.
    plots = [
        Plot(
            (_LEFT, 20.0, width, 128.0),
            "torque [N·m]",
            [Trace(measured, WIDE, 4.0, "measured")]
            + [
                Trace(np.array(series[j]), colours[k], 1.1, labels[k])
                for k, series in example.predicted.items()
            ],
        ),
        *(
            Plot(
                (_LEFT, 172.0 + 72.0 * row, width, 48.0),
                f"measured − {labels[k]} [N·m]",
                [Trace(error, colours[k], 1.0, labels[k])],
            )
            for row, (k, error) in enumerate(errors.items())
        ),
    ]
    reach = 1.05 * max(float(np.abs(error).max()) for error in errors.values()) or 1.0
    with drawing():
        figure = blank(_WIDTH, 188.0 + 72.0 * len(errors))
        upper, *lower = (place(figure, *plot.box) for plot in plots)
        for axes, plot in zip((upper, *lower), plots, strict=True):
            for one in plot.traces:
                dashed = axes is upper and one.colour == COLOURS[1]
                style = (0, (4, 2)) if dashed else "-"
                axes.plot(time, one.values, color=one.colour, linewidth=one.width, linestyle=style)
            axes.set_xlim(0.0, float(time[-1]))
            headed(axes, plot.heading)
        ruled(upper, "both", x_ticks=6)
        for axes in lower:
            axes.axhline(0.0, color=MUTED, linewidth=0.8)
            axes.set_ylim(-reach, reach)
            ruled(axes, "both", x_ticks=6, y_ticks=3)
        for axes in (upper, *lower[:-1]):
            axes.tick_params(labelbottom=False)
        footed(lower[-1], "time [s]")
        alt = f"{name}: measured and predicted torque over {time[-1]:.1f} s; RMS error {note} N·m."
        return to_panel(
            figure,
            key=f"e{key}{j}",
            title=name,
            note=f"RMS error {note} N·m",
            alt=alt,
            traces=traces_text(time, plots),
        )


def colour_of(k: int) -> str:
    """Colour of the method in this place of the tables."""
    return COLOURS[k % len(COLOURS)]


def marker_of(k: int) -> str:
    """Its mark, which tells it without colour."""
    return MARKERS[k % len(MARKERS)]
