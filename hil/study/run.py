"""Run of a study: searches, campaigns, estimates, predictions, page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from hil.batch.workers import Workers
from hil.cell import Cell
from hil.design import preset
from hil.files import digest, write_files
from hil.progress import Reporter
from hil.simulation import planted_values, simulated_link, simulated_provenance
from hil.version import software
from sim_fixtures.ns16 import CELL_PATH

from . import campaigns, results
from .campaigns import Search
from .page import study_page
from .results import ConditionResult, MotionRow, StudyResults
from .settings import StudyFolder, StudySettings

_WORDS: Final = {
    campaigns.NO_EFFECTS: "without unmodelled effects",
    campaigns.EFFECTS: "with unmodelled effects",
}


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
    with folder.locked(), Workers(workers, timeout=campaigns.LONGEST) as processes:
        folder.begin(settings)
        wanted = campaigns.searches(settings, len(cell.joint_names))
        found = campaigns.run_searches(folder, cell, wanted, reporter, workers)
        best = campaigns.chosen(found)
        plans = campaigns.plan_study(folder, cell, settings, best)
        runs = [(one.root, (one,)) for some in plans.values() for one in some.values()]
        campaigns.in_children(campaigns.execute, runs, "running campaigns", reporter, processes)
        calls = []
        for key, some in plans.items():
            provenance = simulated_provenance(cell, key == campaigns.EFFECTS)
            roots = {name: one.root for name, one in some.items()}
            effects = json.loads(provenance["effects"])
            calls.append((folder.campaign(key, ""), (key, _WORDS[key], effects, roots, truth)))
        conditions = campaigns.in_children(
            results.condition_result, calls, "estimating and predicting", reporter, processes
        )
        sizes = preset("b").search
        quick = settings.effort_b.tried < sizes.population * sizes.generations
        study = StudyResults(
            name=root.resolve().name,
            cell=cell.name,
            quick=quick,
            settings=settings,
            software=software(),
            joint_names=list(cell.joint_names),
            n_base=len(cell.model.base.names),
            parameters=results.parameters_of(cell, truth),
            table1=[*_rows(found, best, conditions), *results.printed_rows(cell)],
            conditions=conditions,
            conclusion=results.conclusion_of(conditions, quick=quick),
        )
        write_files(root, {"results.json": study.to_json(), "report.html": study_page(study)})
        reporter.say(f"report: {root / 'report.html'}")
    return study


def _rows(
    found: Sequence[Search], best: Mapping[str, Search], conditions: Sequence[ConditionResult]
) -> list[MotionRow]:
    """Return a row of Table 1 for each search, with what was executed of the best of a method."""
    executed = {best[one.key].key: one for one in conditions[0].methods}
    rows = []
    for search in found:
        one, method = search.excitation, executed.get(search.key)
        row = MotionRow(key=search.key, words=search.words, executed=method is not None)
        if one is not None:
            row = MotionRow.of(
                one.criteria,
                **row.model_dump(exclude_defaults=True),
                tried=one.tried,
                duration=float(one.trajectory.duration),
                executed_log10_det=None if method is None else method.log10_det,
                executed_coupling_index=None if method is None else method.coupling_index,
            )
        rows.append(row)
    return rows
