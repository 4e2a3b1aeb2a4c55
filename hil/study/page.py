"""The page of a study: results in, one self-contained HTML file with the figures out."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from hil.report import drawing
from hil.report.numbers import significant
from hil.report.rendering import environment, page_bytes

from .results import ConditionResult, StudyResults

COLOURS: Final = (drawing.FIRST, drawing.SECOND)


def study_page(results: StudyResults) -> bytes:
    """Return the page as one HTML file; the same results give the same bytes."""
    first, n = results.conditions[0], results.n_base
    names = [f"{one.printed_id or ''} {one.name}".strip() for one in results.parameters[:n]]
    template = environment().get_template("study.html.j2")
    text = template.render(
        results=results,
        labels={one.key: one.label for one in first.methods},
        legend=[*zip((one.label for one in first.methods), ("--first", "--second"), strict=True)],
        parameters=sorted(
            enumerate(results.parameters), key=lambda one: one[1].printed_id or math.inf
        ),
        trajectories=_trajectories(first, results.joint_names),
        correlations=[
            drawing.matrix_panel(np.array(one.correlation)[:n, :n], names, f"c{k}", one.label)
            for k, one in enumerate(first.methods)
        ],
        boxes={one.key: _boxes(one, results.joint_names) for one in results.conditions},
        examples={one.key: _examples(one, results.joint_names) for one in results.conditions},
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
            for one, colour in zip(condition.methods, COLOURS, strict=True):
                axes.plot(one.time, one.position[j], color=colour, linewidth=1.3)
            drawing.ruled(axes, "both", x_ticks=6)
    return panels


def _boxes(condition: ConditionResult, joint_names: list[str]) -> list[drawing.Panel]:
    """Draw mean |e| on the held-out motions, a box per estimate and a panel per joint (Fig. 3)."""
    labels = [one.label for one in condition.methods]
    errors = [np.array(condition.held_out.mean_abs[one.key]) for one in condition.methods]
    panels = []
    for j, name in enumerate(joint_names):
        columns = [own[:, j] for own in errors]
        medians = ", ".join(
            f"{label} {significant(float(np.median(own)))}"
            for label, own in zip(labels, columns, strict=True)
        )
        key, what = f"b{condition.key}{j}", "mean |e| in N·m"
        caption = drawing.Caption(key, name, f"medians {medians}", what)
        panels.append(drawing.box_panel(caption, columns, COLOURS, "mean |e| [N·m]", labels))
    return panels


def _examples(condition: ConditionResult, joint_names: list[str]) -> list[drawing.Panel]:
    """Draw one held-out motion in time: measured, predicted by each, and the errors (Fig. 4)."""
    found = condition.held_out
    time, panels = np.array(found.time), []
    for j, name in enumerate(joint_names):
        measured = np.array(found.measured[j])
        names = [one.label for one in condition.methods]
        lines = [
            drawing.Trace(np.array(found.predicted[one.key][j]), COLOURS[k], 1.1, dashed=k == 1)
            for k, one in enumerate(condition.methods)
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
