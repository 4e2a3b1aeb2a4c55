"""The page of a study: results in, one self-contained HTML file with the figures out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np

from hil.files import write_files
from hil.progress import Reporter
from hil.report import drawing
from hil.report.numbers import significant
from hil.report.rendering import environment, page_bytes

from .results import ConditionResult, StudyResults

COLOURS: Final = (drawing.FIRST, drawing.SECOND, drawing.ROUTES[3], drawing.ROUTES[0])
_VARIABLES: Final = ("--first", "--second", "--route-3", "--route-0")


def write_outcome(root: Path, results: StudyResults, reporter: Reporter) -> None:
    """Write `results.json` and `report.html` together, or raise OutputError."""
    write_files(root, {"results.json": results.to_json(), "report.html": study_page(results)})
    reporter.say(f"report: {root / 'report.html'}")


def study_page(results: StudyResults) -> bytes:
    """Return the page as one HTML file; the same results give the same bytes."""
    first, n = results.conditions[0], results.n_base
    labels = [f"{one.printed_id or ''} {one.name}".strip() for one in results.parameters[:n]]
    template = environment().get_template("study.html.j2")
    text = template.render(
        results=results,
        labels=first.labels,
        legend=[(one.label, _VARIABLES[k % 4]) for k, one in enumerate(first.methods)],
        parameters=sorted(
            enumerate(results.parameters), key=lambda one: one[1].printed_id or math.inf
        ),
        trajectories=_trajectories(first, results.joint_names),
        correlations=[
            drawing.matrix_panel(np.array(one.correlation)[:n, :n], labels, f"c{k}", one.label)
            for k, one in enumerate(first.methods)
        ],
        boxes={one.key: _boxes(one, results.joint_names) for one in results.conditions},
        examples={one.key: _examples(one, results.joint_names) for one in results.conditions},
        median=np.median,
        quartiles=lambda values: 100.0 * np.percentile(values, (50.0, 25.0, 75.0)),
    )
    return page_bytes(text)


def _trajectories(condition: ConditionResult, joint_names: list[str]) -> list[drawing.Panel]:
    """Draw the position of each joint in each excitation, on common scales (Fig. 1)."""
    panels: list[drawing.Panel] = []
    for j, name in enumerate(joint_names):
        spans = [
            f"{one.label} {math.degrees(min(one.position[j])):.0f}° to"
            f" {math.degrees(max(one.position[j])):.0f}°"
            for one in condition.methods
        ]
        caption = drawing.Caption(f"x{j}", name, "; ".join(spans), "position in each excitation")
        with drawing.panel(panels, 170.0, caption, "position [rad]", "time [s]") as axes:
            for k, one in enumerate(condition.methods):
                axes.plot(one.time, one.position[j], color=COLOURS[k % 4], linewidth=1.3)
            drawing.ruled(axes, "both", x_ticks=6)
    return panels


def _boxes(condition: ConditionResult, joint_names: list[str]) -> list[drawing.Panel]:
    """Draw mean |e| on fly-by motions, a box per estimate and a panel per joint (Fig. 3)."""
    found = next(one for one in condition.classes if one.motion_class == "fly-by")
    errors = [np.array(found.mean_abs[one.key]) for one in condition.methods]
    labels = [one.label.replace(" ", "\n") for one in condition.methods]
    panels = []
    for j, name in enumerate(joint_names):
        medians = ", ".join(
            f"{one.label} {significant(float(np.median(own[:, j])))}"
            for one, own in zip(condition.methods, errors, strict=True)
        )
        caption = drawing.Caption(
            f"b{condition.key}{j}", name, f"medians {medians}", "mean |e| in N·m"
        )
        columns, colours = [own[:, j] for own in errors], COLOURS[: len(errors)]
        panels.append(drawing.box_panel(caption, columns, colours, "mean |e| [N·m]", labels))
    return panels


def _examples(condition: ConditionResult, joint_names: list[str]) -> list[drawing.Panel]:
    """Draw one held-out motion in time: measured, predicted by each, and the errors (Fig. 4)."""
    (example,) = condition.examples
    time, panels = np.array(example.time), []
    for j, name in enumerate(joint_names):
        measured = np.array(example.measured[j])
        names = [condition.labels[key] for key in example.predicted]
        lines = [
            drawing.Trace(np.array(series[j]), COLOURS[k], 1.1, dashed=k == 1)
            for k, series in enumerate(example.predicted.values())
        ]
        errors = [measured - one.values for one in lines]
        reach = 1.05 * max(float(np.abs(error).max()) for error in errors) or 1.0
        both = [drawing.Trace(measured, drawing.WIDE, 4.0), *lines]
        plots, rms = [drawing.Plot(128.0, "torque [N·m]", both)], []
        # A row for each error: where there is noise, one line over another would hide it.
        for which, one, error in zip(names, lines, errors, strict=True):
            trace = drawing.Trace(error, one.colour, 1.0)
            plots.append(drawing.Plot(48.0, f"measured − {which} [N·m]", [trace], reach=reach))
            rms.append(f"{which} {significant(float(np.sqrt(np.mean(error**2))))}")
        note, what = f"RMS error {', '.join(rms)} N·m", "measured and predicted torque"
        caption = drawing.Caption(f"e{condition.key}{j}", name, note, what)
        panels.append(drawing.time_panel(time, plots, caption))
    return panels
