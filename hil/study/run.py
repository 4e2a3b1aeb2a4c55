"""Run of a study: searches, campaigns, estimates, predictions; its page."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.base.arrays import Array
from hil.base.files import digest, write_files
from hil.base.progress import Reporter
from hil.base.threads import one_thread
from hil.base.version import software
from hil.batch.cluster import Cluster
from hil.cell import Cell
from hil.control.simulation import planted_values, simulated_link, simulated_provenance
from hil.design import preset
from hil.report import drawing
from hil.report.chart import Caption, Chart, Plot, Trace
from hil.report.numbers import significant
from hil.report.rendering import environment, page_bytes
from sim_fixtures.ns16 import CELL_PATH

from . import campaigns, results
from .campaigns import Search
from .results import ConditionResult, MotionRow, StudyResults
from .settings import StudyFolder, StudySettings

_CONDITIONS: Final = {
    campaigns.NO_EFFECTS: "without unmodelled effects",
    campaigns.EFFECTS: "with unmodelled effects",
}


@one_thread()
def run_study(
    root: Path,
    settings: StudySettings,
    reporter: Reporter,
    *,
    workers: int = 2,
    cell: Cell | None = None,
) -> StudyResults:
    """Reproduce the paper on a simulated cell (default: the NS 16), and write results and page.

    An interrupted study resumes with the searches and campaigns that are not complete. Results do
    not depend on the number of workers.

    Raises:
        CellError: the cell is not simulated.
        InputError: the folder contains other files, or another study is running in it.
        StudyError: a part was not completed; a restart resumes.
        NoExcitationError: a search found no feasible motion.
        OutputError: the results cannot be written.
    """
    folder = StudyFolder(root)
    if cell is None:
        cell = Cell.load(CELL_PATH)
    else:
        simulated_link(cell)  # raises for real hardware
        settings = settings.model_copy(update={"cell": digest(cell.text + cell.urdf)})
    truth = planted_values(cell)
    with folder.locked(), Cluster(workers, reporter=reporter) as processes:
        folder.begin(settings)
        wanted = campaigns.searches(settings, len(cell.joint_names))
        searches = campaigns.run_searches(folder, cell, wanted, reporter, workers)
        best = campaigns.chosen(searches)
        plans = campaigns.plan_study(folder, cell, settings, best)
        executions = chain.from_iterable(methods.values() for methods in plans.values())
        runs = [(execution.root, (execution,)) for execution in executions]
        campaigns.in_children(campaigns.execute, runs, "running campaigns", reporter, processes)
        calls = [
            (folder.campaign(key, ""), _condition(cell, key, methods, truth))
            for key, methods in plans.items()
        ]
        conditions = campaigns.in_children(
            results.condition_result, calls, "estimating and predicting", reporter, processes
        )
        quick = _is_quick(settings)
        study = StudyResults(
            name=root.resolve().name,
            cell=cell.name,
            quick=quick,
            settings=settings,
            software=software(),
            joint_names=list(cell.joint_names),
            n_base=len(cell.model.base.names),
            parameters=results.parameters_of(cell, truth),
            table1=[*_rows(searches, best, conditions), *results.printed_rows(cell)],
            conditions=conditions,
            conclusion=results.conclusion_of(conditions, quick=quick),
        )
        write_files(root, {"results.json": study.to_json(), "report.html": study_page(study)})
        reporter.say(f"report: {root / 'report.html'}")
    return study


def _is_quick(settings: StudySettings) -> bool:
    """Return whether less is searched than by the preset of method B."""
    sizes = preset("b").search
    return settings.effort_b.tried < sizes.population * sizes.generations


def _condition(
    cell: Cell, key: str, executions: Mapping[str, campaigns.StudyExecution], truth: Array
) -> tuple[str, str, Any, dict[str, Path], Array]:
    """Return the arguments of `results.condition_result`."""
    effects = json.loads(simulated_provenance(cell, key == campaigns.EFFECTS)["effects"])
    roots = {name: execution.root for name, execution in executions.items()}
    return key, _CONDITIONS[key], effects, roots, truth


def _rows(
    searches: Sequence[Search], best: Mapping[str, Search], conditions: Sequence[ConditionResult]
) -> list[MotionRow]:
    """Return a row of Table 1 for each search, with what was executed of the best of a method."""
    executed = {best[method.key].key: method for method in conditions[0].methods}
    rows = []
    for search in searches:
        excitation = search.excitation
        method = executed.get(search.key)
        row = MotionRow(key=search.key, words=search.description, executed=method is not None)
        if excitation is not None:
            row = MotionRow.of(
                excitation.criteria,
                **row.model_dump(exclude_defaults=True),
                tried=excitation.tried,
                duration=float(excitation.trajectory.duration),
                executed_log10_det=None if method is None else method.log10_det,
                executed_coupling_index=None if method is None else method.coupling_index,
            )
        rows.append(row)
    return rows


COLOURS: Final = (drawing.FIRST, drawing.SECOND)


def study_page(results: StudyResults) -> bytes:
    """Return the page as one HTML file; the same results give the same bytes."""
    first = results.conditions[0]
    n = results.n_base
    names = [
        f"{parameter.printed_id or ''} {parameter.name}".strip()
        for parameter in results.parameters[:n]
    ]
    template = environment().get_template("study.html.j2")
    text = template.render(
        results=results,
        labels={method.key: method.label for method in first.methods},
        legend=[
            *zip((method.label for method in first.methods), ("--first", "--second"), strict=True)
        ],
        parameters=sorted(
            enumerate(results.parameters), key=lambda numbered: numbered[1].printed_id or math.inf
        ),
        trajectories=_trajectories(first, results.joint_names),
        correlations=[
            drawing.matrix_panel(np.array(method.correlation)[:n, :n], names, f"c{k}", method.label)
            for k, method in enumerate(first.methods)
        ],
        boxes={
            condition.key: _boxes(condition, results.joint_names)
            for condition in results.conditions
        },
        examples={
            condition.key: _examples(condition, results.joint_names)
            for condition in results.conditions
        },
        quartiles=lambda values: 100.0 * np.percentile(values, (50.0, 25.0, 75.0)),
    )
    return page_bytes(text)


def _trajectories(condition: ConditionResult, joint_names: list[str]) -> list[drawing.Panel]:
    """Draw the position of each joint in each excitation, on common scales (Fig. 1)."""
    panels: list[drawing.Panel] = []
    for j, name in enumerate(joint_names):
        spans = [
            f"{method.label} {math.degrees(min(method.position[j])):.0f}° to"
            f" {math.degrees(max(method.position[j])):.0f}°"
            for method in condition.methods
        ]
        caption = Caption(f"x{j}", name, "; ".join(spans), "position in each excitation")
        axes = drawing.single(170.0, "position [rad]", "time [s]", x_ticks=6)
        for method, colour in zip(condition.methods, COLOURS, strict=True):
            axes.line(np.array(method.time), np.array(method.position[j]), colour, 1.3)
        panels.append(drawing.panel([axes], caption))
    return panels


def _boxes(condition: ConditionResult, joint_names: list[str]) -> list[drawing.Panel]:
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
        key = f"b{condition.key}{j}"
        what = "mean |e| in N·m"
        caption = Caption(key, name, f"medians {medians}", what)
        panels.append(drawing.box_panel(caption, columns, COLOURS, "mean |e| [N·m]", labels))
    return panels


def _examples(condition: ConditionResult, joint_names: list[str]) -> list[drawing.Panel]:
    """Draw one held-out motion in time: measured, predicted by each, and the errors (Fig. 4)."""
    held_out = condition.held_out
    time = np.array(held_out.time)
    panels = []
    for j, name in enumerate(joint_names):
        measured = np.array(held_out.measured[j])
        names = [method.label for method in condition.methods]
        lines = [
            Trace(np.array(held_out.predicted[method.key][j]), COLOURS[k], 1.1, dashed=k == 1)
            for k, method in enumerate(condition.methods)
        ]
        errors = [measured - line.values for line in lines]
        reach = 1.05 * max(float(np.abs(error).max()) for error in errors) or 1.0
        both = [Trace(measured, drawing.WIDE, 4.0), *lines]
        plots = [Plot(128.0, "torque [N·m]", both)]
        rms = []
        # A row for each error: where there is noise, one line over another would hide it.
        for which, line, error in zip(names, lines, errors, strict=True):
            trace = Trace(error, line.colour, 1.0)
            plots.append(Plot(48.0, f"measured − {which} [N·m]", [trace], reach=reach))
            rms.append(f"{which} {significant(float(np.sqrt(np.mean(error**2))))}")
        note = f"RMS error {', '.join(rms)} N·m"
        what = "measured and predicted torque"
        caption = Caption(f"e{condition.key}{j}", name, note, what)
        panels.append(drawing.chart_panel(Chart(caption, time, plots)))
    return panels
