"""The page of a study: results in, one self-contained HTML file with the figures out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.files import write_together
from hil.progress import Reporter
from hil.report import numbers
from hil.report.drawing import (
    FIRST,
    MOST_POINTS,
    MUTED,
    ROUTES,
    SECOND,
    TICK_SIZE,
    WIDE,
    Panel,
    Plot,
    Trace,
    blank,
    boxed,
    drawing,
    footed,
    headed,
    place,
    ruled,
    to_panel,
)
from hil.report.figures import matrix_panel, time_panel
from hil.report.rendering import environment, page_bytes

from .records import ExampleRecord
from .results import ConditionResult, StudyResults

Array = NDArray[np.float64]

COLOURS: Final = (FIRST, SECOND, ROUTES[3], ROUTES[0])
MARKERS: Final = ("o", "D", "^", "s")
_LEGEND: Final = tuple(zip(("--first", "--second", "--route-3", "--route-0"), "●◆▲■", strict=True))
_WIDTH, _LEFT, _RIGHT = 370.0, 46.0, 10.0


def write_outcome(root: Path, results: StudyResults, reporter: Reporter) -> None:
    """Write `results.json` and `report.html` together, and say where they are.

    Raises:
        OutputError: they cannot be written.
    """
    write_together(root, {"results.json": results.to_json(), "report.html": study_page(results)})
    reporter.say(f"report: {root / 'report.html'}")


def study_page(results: StudyResults) -> bytes:
    """The page as one HTML file; the same results give the same bytes."""
    first, joints = results.conditions[0], results.joint_names
    template = environment().get_template("study.html.j2")
    text = template.render(
        results=results,
        labels=first.labels,
        paragraphs={one.key: one for one in results.reading},
        legend=[(one.label, *_LEGEND[k % 4]) for k, one in enumerate(first.methods)],
        parameters=sorted(
            enumerate(results.parameters), key=lambda one: one[1].printed_id or math.inf
        ),
        trajectories=[_trajectory(first, j, name) for j, name in enumerate(joints)],
        correlations=_correlations(results, first),
        boxes={one.key: _error_panels(one, joints) for one in results.conditions},
        examples={one.key: _example_panels(one, joints) for one in results.conditions},
    )
    return page_bytes(text)


def _trajectory(condition: ConditionResult, j: int, name: str) -> Panel:
    """Position of a joint in each excitation, on scales of time and angle in common (Fig. 1)."""
    methods = condition.methods
    every = np.concatenate([one.position[j] for one in methods])
    margin = 0.06 * float(np.ptp(every)) or 0.1
    with drawing():
        figure = blank(_WIDTH, 40.0 + len(methods) * 84.0)
        for k, one in enumerate(methods):
            axes = place(figure, _LEFT, 20.0 + 84.0 * k, _WIDTH - _LEFT - _RIGHT, 58.0)
            axes.plot(one.time, one.position[j], color=COLOURS[k % 4], linewidth=1.5)
            axes.set_xlim(0.0, max(method.time[-1] for method in methods))
            axes.set_ylim(float(every.min()) - margin, float(every.max()) + margin)
            ruled(axes, "both", x_ticks=6, y_ticks=3)
            headed(axes, f"{one.label}: position [rad]")
            axes.tick_params(labelbottom=k == len(methods) - 1)
        footed(axes, "time [s]")
        spans = [
            f"{one.label} {math.degrees(min(one.position[j])):.0f}° to"
            f" {math.degrees(max(one.position[j])):.0f}°"
            for one in methods
        ]
        alt = f"{name}: position in the excitations; {'; '.join(spans)}."
        return to_panel(figure, key=f"x{j}", title=name, note="", alt=alt)


def _correlations(results: StudyResults, condition: ConditionResult) -> list[Panel]:
    """|ρ| of the base parameters for each excitation, friction left out (Fig. 2)."""
    n = results.n_base
    labels = [f"{one.printed_id or ''} {one.name}".strip() for one in results.parameters[:n]]
    return [
        matrix_panel(np.array(one.correlation)[:n, :n], labels, key=f"c{k}", title=one.label)
        for k, one in enumerate(condition.methods)
    ]


def _error_panels(condition: ConditionResult, joint_names: Sequence[str]) -> list[Panel]:
    """Mean |e| on fly-by motions, a box for each estimate and a panel for each joint (Fig. 3)."""
    found = next((one for one in condition.classes if one.motion_class == "fly-by"), None)
    if found is None:
        return []
    errors = [np.array(found.mean_abs[one.key]) for one in condition.methods]
    return [
        _boxes(condition, j, name, [one[:, j] for one in errors])
        for j, name in enumerate(joint_names)
    ]


def _boxes(condition: ConditionResult, j: int, name: str, columns: Sequence[Array]) -> Panel:
    labels = [one.label.replace(" ", "\n") for one in condition.methods]
    medians = [float(np.median(column)) for column in columns]
    with drawing():
        figure = blank(220.0, 226.0 + 11.0 * max(label.count("\n") for label in labels))
        axes = place(figure, 46.0, 24.0, 164.0, 172.0)
        fliers = {"marker": "+", "markeredgecolor": MUTED, "markersize": 6.0}
        boxed(axes, columns, 0.6, flierprops=fliers)
        for k, middle in enumerate(medians):
            colour, marker = COLOURS[k % 4], MARKERS[k % 4]
            axes.scatter([k + 1], [middle], s=34.0, marker=marker, color=colour, zorder=4)
        ruled(axes, "y", y_ticks=5)
        axes.set_xticks(range(1, len(columns) + 1), labels, fontsize=TICK_SIZE)
        axes.tick_params(axis="x", length=0.0)
        # A scale that shows every motion, and never makes a small change look large.
        every = np.concatenate(columns)
        low = min(float(every.min()), 0.9 * float(np.median(every)))
        high = max(float(every.max()), 1.1 * float(np.median(every)))
        axes.set_ylim(max(0.0, low - 0.06 * (high - low)), high + 0.06 * (high - low))
        headed(axes, "mean |e| [N·m]")
        shown = ", ".join(
            f"{one.label} {numbers.significant(value)}"
            for one, value in zip(condition.methods, medians, strict=True)
        )
        alt = f"{name}: mean absolute error on {len(columns[0])} motions; medians {shown} N·m."
        return to_panel(figure, key=f"b{condition.key}{j}", title=name, note="", alt=alt)


def _example_panels(condition: ConditionResult, joint_names: Sequence[str]) -> list[Panel]:
    """One held-out motion in time: measured, predicted by each, and the errors (Fig. 4)."""
    return [
        _example(condition, example, j, name)
        for example in condition.examples[:1]
        for j, name in enumerate(joint_names)
    ]


def _example(condition: ConditionResult, example: ExampleRecord, j: int, name: str) -> Panel:
    labels, time = condition.labels, np.array(example.time)
    measured = np.array(example.measured[j])
    predicted = {k: np.array(series[j]) for k, series in example.predicted.items()}
    errors = {k: measured - series for k, series in predicted.items()}
    colours = {k: COLOURS[list(labels).index(k) % 4] for k in predicted}
    width = _WIDTH - _LEFT - _RIGHT
    reach = 1.05 * max(float(np.abs(error).max()) for error in errors.values()) or 1.0
    # A row for each error: where there is noise, one line over another would hide it.
    traces = [Trace(measured, WIDE, 4.0, "measured")]
    traces += [
        Trace(series, colours[k], 1.1, labels[k], dashed=colours[k] == COLOURS[1])
        for k, series in predicted.items()
    ]
    plots = [Plot((_LEFT, 20.0, width, 128.0), "torque [N·m]", traces)] + [
        Plot(
            (_LEFT, 172.0 + 72.0 * row, width, 48.0),
            f"measured − {labels[k]} [N·m]",
            [Trace(error, colours[k], 1.0, labels[k])],
            reach=reach,
        )
        for row, (k, error) in enumerate(errors.items())
    ]
    rms = ", ".join(
        f"{labels[k]} {numbers.significant(float(np.sqrt(np.mean(error**2))))}"
        for k, error in errors.items()
    )
    note = f"RMS error {rms} N·m"
    words = {
        "key": f"e{condition.key}{j}",
        "title": name,
        "note": note,
        "alt": f"{name}: measured and predicted torque over {time[-1]:.1f} s; {note}.",
    }
    return time_panel(188.0 + 72.0 * len(errors), time, plots, MOST_POINTS, **words)
