"""Figures of a study: the paper's four, the comparisons, and the ablations as small multiples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from hil.report import numbers
from hil.report.figures.canvas import TICK_SIZE, blank, footed, headed, place, ruled
from hil.report.figures.correlation import matrix_panel
from hil.report.figures.palette import BAND, FIRST, INK, MUTED, ROUTES, SECOND, WIDE
from hil.report.figures.svg import Panel, drawing, to_panel
from hil.report.figures.traces import Plot, Trace, traces_text

from .records import ExampleRecord
from .results import AblationResult, ComparisonResult, ConditionResult, StudyResults
from .wording import differs

Array = NDArray[np.float64]

COLOURS: Final = (FIRST, SECOND, ROUTES[3], ROUTES[0])
MARKERS: Final = ("o", "D", "^", "s")
CLASS_COLOURS: Final = {"fly-by": SECOND, "stop-to-stop": ROUTES[3], "sinusoid": FIRST}
CLASS_MARKERS: Final = {"fly-by": "D", "stop-to-stop": "^", "sinusoid": "o"}

LOG_DET: Final = "log det"
_DECADES: Final = 20.0  # between smallest and largest: beyond that a scale from zero hides most

_WIDTH, _LEFT, _RIGHT = 370.0, 46.0, 10.0


def trajectory_panels(condition: ConditionResult, joint_names: Sequence[str]) -> list[Panel]:
    """Position of each joint in each excitation, on one scale of time (the paper's Fig. 1)."""
    longest = max(method.time[-1] for method in condition.methods)
    return [_trajectory(condition, j, name, longest) for j, name in enumerate(joint_names)]


def _trajectory(condition: ConditionResult, j: int, name: str, longest: float) -> Panel:
    methods = condition.methods
    spans = [
        f"{one.label} {math.degrees(min(one.position[j])):.0f}° to"
        f" {math.degrees(max(one.position[j])):.0f}°"
        for one in methods
    ]
    with drawing():
        figure = blank(_WIDTH, 40.0 + len(methods) * 84.0)
        for k, one in enumerate(methods):
            axes = place(figure, _LEFT, 20.0 + 84.0 * k, _WIDTH - _LEFT - _RIGHT, 58.0)
            axes.plot(one.time, one.position[j], color=_colour(k), linewidth=1.5)
            axes.set_xlim(0.0, longest)
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
        figure = blank(220.0, 226.0)
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
            axes.scatter([k + 1], [middle], s=34.0, marker=_marker(k), color=_colour(k), zorder=4)
        ruled(axes, "y", y_ticks=5)
        axes.set_xticks(range(1, len(columns) + 1))
        axes.set_xticklabels(labels, fontsize=TICK_SIZE)
        axes.tick_params(axis="x", length=0.0)
        axes.set_ylim(*_reach(columns))
        headed(axes, "mean |e| [N·m]")
        alt = f"{name}: mean absolute error on {len(columns[0])} motions; medians {told} N·m."
        return to_panel(figure, key=f"b{key}{j}", title=name, note="", alt=alt)


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
    colours = {k: _colour(list(labels).index(k)) for k in example.predicted}
    plots = (
        Plot(
            (_LEFT, 20.0, width, 128.0),
            "torque [N·m]",
            [Trace(measured, WIDE, 4.0, "measured")]
            + [
                Trace(np.array(series[j]), colours[k], 1.1, labels[k])
                for k, series in example.predicted.items()
            ],
        ),
        Plot(
            (_LEFT, 172.0, width, 72.0),
            "measured − predicted [N·m]",
            [Trace(error, colours[k], 1.0, labels[k]) for k, error in errors.items()],
        ),
    )
    with drawing():
        figure = blank(_WIDTH, 284.0)
        upper, lower = (place(figure, *plot.box) for plot in plots)
        lower.axhline(0.0, color=MUTED, linewidth=0.8)
        for axes, plot in zip((upper, lower), plots, strict=True):
            for one in plot.traces:
                style = (0, (4, 2)) if one.colour == COLOURS[1] else "-"
                axes.plot(time, one.values, color=one.colour, linewidth=one.width, linestyle=style)
            axes.set_xlim(0.0, float(time[-1]))
            headed(axes, plot.heading)
        ruled(upper, "both", x_ticks=6)
        ruled(lower, "both", x_ticks=6, y_ticks=3)
        upper.tick_params(labelbottom=False)
        footed(lower, "time [s]")
        alt = f"{name}: measured and predicted torque over {time[-1]:.1f} s; RMS error {note} N·m."
        return to_panel(
            figure,
            key=f"e{key}{j}",
            title=name,
            note=f"RMS error {note} N·m",
            alt=alt,
            traces=traces_text(time, plots),
        )


def ratio_panels(conditions: Sequence[ConditionResult]) -> list[Panel]:
    """Ratio of errors with its interval, every pair of estimates on every class."""
    every = [one for condition in conditions for one in condition.comparisons]
    if not every:
        return []
    low = min(0.9, *(one.low for one in every)) / 1.03
    high = max(1.1, *(one.high for one in every)) * 1.03
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
    sure = differs(one)
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


def ablation_panels(ablation: AblationResult) -> list[Panel]:
    """Criteria, distance to the planted values, and prediction errors over one setting."""
    methods = list(dict.fromkeys(point.method for point in ablation.points))
    panels = []
    if len(ablation.points) > 1 and ablation.key not in ("repetitions", "noise"):
        panels.append(
            _lines(ablation, "coupling index I_c", _by_method(ablation, "coupling_index"))
        )
        panels.append(_lines(ablation, LOG_DET, _by_method(ablation, "log10_det")))
    known = _by_method(ablation, "parameter_error")
    if any(y is not None for _, points in known for _, y in points):
        panels.append(_lines(ablation, "distance to planted values, B = 1", known))
    for method in methods:
        points = [point for point in ablation.points if point.method == method]
        # The noise that every estimate leaves would cover what differs, where it can be told apart.
        own = all(point.own for point in points)
        series = [
            (name, [(p.value, 100.0 * (p.own if own else p.error)[name]) for p in points])
            for name in CLASS_COLOURS
            if all(name in (point.own if own else point.error) for point in points)
        ]
        title = f"{'own' if own else 'torque'} error [%]"
        title = title if len(methods) == 1 else f"{method.upper()}: {title}"
        panels.append(_lines(ablation, title, series, suffix=f"-{method}"))
    return panels


Series = Sequence[tuple[str, Sequence[tuple[float, float | None]]]]


def _by_method(ablation: AblationResult, field: str) -> Series:
    return [
        (method, [(p.value, getattr(p, field)) for p in ablation.points if p.method == method])
        for method in dict.fromkeys(point.method for point in ablation.points)
    ]


def _lines(ablation: AblationResult, title: str, series: Series, *, suffix: str = "") -> Panel:
    told, labelled = [], any(point.label for point in ablation.points)
    with drawing():
        figure = blank(270.0, 196.0)
        axes = place(figure, 46.0, 22.0, 212.0, 130.0)
        values = sorted({point.value for point in ablation.points})
        at = {value: k for k, value in enumerate(values)}
        for name, points in series:
            known = [(at[x], y) for x, y in points if y is not None and math.isfinite(y)]
            if not known:
                continue
            axes.plot(
                *zip(*known, strict=True),
                color=_named_colour(name),
                marker=_named_marker(name),
                markersize=5.0,
                linewidth=0.0 if labelled else 1.2,  # what is no number has nothing in between
            )
            told.append(f"{name} {known[0][1]:.3g} to {known[-1][1]:.3g}")
        _base(axes, ablation, at)
        axes.set_xlim(-0.4, len(values) - 0.6)
        ruled(axes, "y", y_ticks=4)
        # Settings are few and unevenly spaced: each has a place of its own.
        axes.set_xticks(range(len(values)))
        names = {point.value: point.name for point in ablation.points}
        axes.set_xticklabels([names[value].replace(", ", "\n") for value in values])
        shown = [y for _, points in series for _, y in points if y is not None and y > 0.0]
        if shown and max(shown) > _DECADES * min(shown):
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_locator(NullLocator())
        elif shown and title != LOG_DET:  # a logarithm has no zero to begin at
            axes.set_ylim(0.0, 1.12 * max(shown))
        headed(axes, title)
        if not labelled:
            footed(axes, ablation.variable)
        key = f"a{ablation.key}-{title[:3].strip().replace(' ', '')}{suffix}"
        alt = f"{ablation.title}, {title}: {'; '.join(told)}."
        return to_panel(figure, key=key, title="", note="", alt=alt)


def _base(axes: Axes, ablation: AblationResult, at: dict[float, int]) -> None:
    """A band about the setting of the study itself."""
    for value in {point.value for point in ablation.points if point.base}:
        axes.axvspan(at[value] - 0.3, at[value] + 0.3, color=BAND, linewidth=0.0)


def _named_colour(name: str) -> str:
    return CLASS_COLOURS.get(name, FIRST if name == "a" else SECOND)


def _named_marker(name: str) -> str:
    return CLASS_MARKERS.get(name, "o" if name == "a" else "D")


def _colour(k: int) -> str:
    return COLOURS[k % len(COLOURS)]


def _marker(k: int) -> str:
    return MARKERS[k % len(MARKERS)]
