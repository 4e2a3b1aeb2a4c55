"""The page of a study, and its figures."""

from __future__ import annotations

import math
from typing import Final, get_args

import numpy as np

from hil.report.chart import (
    FIRST,
    INK,
    MUTED,
    SECOND,
    WIDE,
    Boxes,
    Caption,
    Chart,
    Plot,
    Trace,
    correlations,
    joined,
)  # fmt: skip
from hil.report.numbers import fixed, significant
from hil.report.panels import Panel, box_panel, chart_panel, matrix_panel
from hil.report.rendering import environment, page_bytes
from identification.excitation import Method

from .campaigns import MOTION_CLASSES
from .messages import CRITERION_WORDS, condition_words
from .model_errors import ALL, NONE
from .results import Criterion, DesignPoint, Quantity, ShownCondition, StudyResults
from .searches import LABELS

COLOURS: Final = (FIRST, SECOND, INK)
_VARIABLES: Final = ("--first", "--second", "--ink")
_RATIO_TICKS: Final = (
    (0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3),
    (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.6, 2.0, 2.5),
    (0.01, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 100.0),
)
"""Of ratios of errors, the first that reach far enough."""
_NAME_WIDTH: Final = 150.0  # width of the names of conditions, px
_POINTS_HEIGHT: Final = 180.0  # of a plot, px
_POSITION_HEIGHT: Final = 110.0


def study_page(results: StudyResults) -> bytes:
    """Return the page as one HTML file; the same results give the same bytes."""
    first = results.shown[0]
    n = results.n_base
    names = [
        f"{parameter.printed_id or ''} {parameter.name}".strip()
        for parameter in results.parameters[:n]
    ]
    template = environment().get_template("study.html.j2")
    text = template.render(
        results=results,
        labels={method.key: method.label for method in first.methods},
        legend=[*zip((method.label for method in first.methods), _VARIABLES, strict=True)],
        parameters=sorted(
            enumerate(results.parameters), key=lambda numbered: numbered[1].printed_id or math.inf
        ),
        trajectories=_trajectories(first, results.joint_names),
        correlations=[
            matrix_panel(
                correlations(np.array(method.correlation)[:n, :n], names, f"c{k}", method.label)
            )
            for k, method in enumerate(first.methods)
        ],
        boxes={shown.condition: _boxes(shown, results.joint_names) for shown in results.shown},
        examples={
            shown.condition: _examples(shown, results.joint_names) for shown in results.shown
        },
        words={condition.key: condition_words(condition) for condition in results.conditions},
        ratios=[_ratios(results, motions) for motions in MOTION_CLASSES],
        ratio_legend=[(label, variable) for _, label, variable, _ in _RATIOS],
        classes=MOTION_CLASSES,
        criteria=[
            (words, [_points(results, criterion, *quantity) for quantity in _quantities(results)])
            for criterion, words in CRITERION_WORDS.items()
        ],
        relation_rows=_relation_rows(results),
        quartiles=lambda values: 100.0 * np.percentile(values, (50.0, 25.0, 75.0)),
    )
    return page_bytes(text)


_RATIOS: Final[tuple[tuple[tuple[Method, Method], str, str, float], ...]] = (
    (("a", "b"), "B / A", "--second", 0.15),
    (("a", "gradient"), "gradient / A", "--ink", -0.15),
)
"""First and second method, label, colour, and place in the row of a condition."""


def _ratios(results: StudyResults, motions: str) -> Panel:
    """Draw the ratio of errors under each condition, with intervals, on one class of motions."""
    rows = [(float(-k), condition_words(one)) for k, one in enumerate(results.conditions)]
    y_limits = 0.6 - len(rows), 0.6
    traces = [Trace(np.array(y_limits), MUTED, 1.2, x=np.zeros(2))]
    for (first, second), _, variable, side in _RATIOS:
        found = [one.comparison(first, second, motions) for one in results.conditions]
        colour = f"var({variable})"
        places = np.array([place + side for place, _ in rows])
        ends = np.log10([(row.low or row.ratio, row.high or row.ratio) for row in found])
        gap = np.full(len(rows), np.nan)
        bars = np.column_stack([ends, gap]).ravel()
        traces.append(Trace(np.column_stack([places, places, gap]).ravel(), colour, 1.6, x=bars))
        ratios = np.log10([row.ratio for row in found])
        traces.append(Trace(places, colour, 6.0, x=ratios, dots=True))
    reached = joined(trace.x for trace in traces[1:] if trace.x is not None)
    low, high = float(np.nanmin(reached)), float(np.nanmax(reached))
    margin = 0.04 * (high - low) or 0.1
    low, high = low - margin, high + margin
    ticks = [tick for tick in _ticks(low, high) if low <= math.log10(tick) <= high]
    what = "torque error with B and with the gradient relative to A, by model error"
    chart = Chart(
        Caption(f"r{motions}", motions, "", what), np.empty(0),
        [Plot(22.0 * len(rows), "", traces, limits=y_limits, names=rows)],
        f"error relative to A, {motions}", x_range=(low, high),
        ticks=[math.log10(tick) for tick in ticks], tick_names=[f"{tick:g}" for tick in ticks],
    )  # fmt: skip
    return chart_panel(chart, width=560.0, left=_NAME_WIDTH)


def _ticks(low: float, high: float) -> tuple[float, ...]:
    """Return ticks for a range of logarithms."""
    for ticks in _RATIO_TICKS:
        if math.log10(ticks[0]) < low and high < math.log10(ticks[-1]):
            return ticks
    return _RATIO_TICKS[-1]


def _quantities(results: StudyResults) -> list[tuple[Quantity, str, str]]:
    """Return what the pictures of criteria show: quantity, condition, heading."""
    worst = results.conditions[-1].key
    rows: list[tuple[Quantity, str, str]] = [("variance", NONE.key, "scatter, in units of its RMS")]
    if worst == ALL.key:
        rows.append(("bias", worst, "bias, all errors, in the same units"))
    return [*rows, ("error", worst, "error on unseen motion [%]")]


def _figure(point: DesignPoint, quantity: Quantity, condition: str) -> float:
    if quantity == "variance":
        return point.variance
    return point.bias[condition] if quantity == "bias" else 100.0 * point.error[condition]


def _points(
    results: StudyResults, criterion: Criterion, quantity: Quantity, condition: str, heading: str
) -> Panel:
    """Draw a point for each design: a criterion and what it is meant to foretell."""
    traces = []
    for method, colour in zip(LABELS, COLOURS, strict=True):
        points = [point for point in results.designs if point.method == method]
        x = np.array([point.criteria[criterion] for point in points])
        y = np.array([_figure(point, quantity, condition) for point in points])
        traces.append(Trace(y, colour, 6.0, x=x, dots=True))
    relation = results.relation(criterion, quantity, condition)
    note = (
        f"rank correlation {fixed(relation.correlation, 2)}"
        f" ({fixed(relation.low, 2)} to {fixed(relation.high, 2)})"
    )
    key = f"q{criterion}{quantity}"
    caption = Caption(key, "", note, f"{heading} against criterion")
    plot = Plot(_POINTS_HEIGHT, heading, traces)
    return chart_panel(Chart(caption, np.empty(0), [plot], CRITERION_WORDS[criterion]))


def _relation_rows(
    results: StudyResults,
) -> list[tuple[Quantity, str, list[tuple[float, float, float, float]]]]:
    """Return rank correlations by quantity and condition, one column per criterion."""
    words = {condition.key: condition_words(condition) for condition in results.conditions}
    rows = dict.fromkeys((row.quantity, row.condition) for row in results.relations)
    table = []
    for quantity, condition in rows:
        cells = []
        for criterion in get_args(Criterion):
            row = results.relation(criterion, quantity, condition)
            cells.append((row.correlation, row.low, row.high, row.within))
        table.append((quantity, words[condition], cells))
    return table


def _trajectories(condition: ShownCondition, joint_names: list[str]) -> list[Panel]:
    """Draw the position of each joint in each excitation, on common scales (Fig. 1)."""
    panels: list[Panel] = []
    for j, name in enumerate(joint_names):
        spans = [
            f"{method.label} {math.degrees(min(method.position[j])):.0f}° to"
            f" {math.degrees(max(method.position[j])):.0f}°"
            for method in condition.methods
        ]
        caption = Caption(f"x{j}", name, "; ".join(spans), "position in each excitation")
        traces = [
            Trace(np.array(method.position[j]), colour, 1.3, x=np.array(method.time))
            for method, colour in zip(condition.methods, COLOURS, strict=True)
        ]
        plot = Plot(_POSITION_HEIGHT, "position [rad]", traces)
        panels.append(chart_panel(Chart(caption, np.empty(0), [plot])))
    return panels


def _boxes(condition: ShownCondition, joint_names: list[str]) -> list[Panel]:
    """Draw mean |e| on the held-out motions, a box per estimate and a panel per joint (Fig. 3)."""
    labels = [method.label for method in condition.methods]
    errors = [np.array(condition.held_out.mean_abs[method.key]) for method in condition.methods]
    panels = []
    for j, name in enumerate(joint_names):
        columns = [estimate_errors[:, j] for estimate_errors in errors]
        medians = ", ".join(
            f"{label} {significant(float(np.median(column)))}"
            for label, column in zip(labels, columns, strict=True)
        )
        key = f"b{condition.condition}{j}"
        what = "mean |e| in N·m"
        caption = Caption(key, name, f"medians {medians}", what)
        panels.append(box_panel(Boxes(caption, columns, COLOURS, "mean |e| [N·m]", labels)))
    return panels


def _examples(condition: ShownCondition, joint_names: list[str]) -> list[Panel]:
    """Draw one held-out motion in time: measured, predicted by each, and the errors (Fig. 4)."""
    held_out = condition.held_out
    time = np.array(held_out.time)
    panels = []
    for j, name in enumerate(joint_names):
        measured = np.array(held_out.measured[j])
        names = [method.label for method in condition.methods]
        lines = [
            Trace(np.array(held_out.predicted[method.key][j]), COLOURS[k], 1.1, dashed=k > 0)
            for k, method in enumerate(condition.methods)
        ]
        errors = [measured - line.values for line in lines]
        reach = 1.05 * max(float(np.abs(error).max()) for error in errors) or 1.0
        both = [Trace(measured, WIDE, 4.0), *lines]
        plots = [Plot(128.0, "torque [N·m]", both)]
        rms = []
        # A row for each error: where there is noise, one line over another would hide it.
        for which, line, error in zip(names, lines, errors, strict=True):
            trace = Trace(error, line.colour, 1.0)
            plots.append(Plot(48.0, f"measured − {which} [N·m]", [trace], reach=reach))
            rms.append(f"{which} {significant(float(np.sqrt(np.mean(error**2))))}")
        note = f"RMS error {', '.join(rms)} N·m"
        what = "measured and predicted torque"
        caption = Caption(f"e{condition.condition}{j}", name, note, what)
        panels.append(chart_panel(Chart(caption, time, plots)))
    return panels
