"""A study from beginning to end: searches, campaigns, estimates, predictions, tables, page."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.design import preset
from hil.io import digest
from hil.progress import Reporter
from hil.simulation import planted_values, simulated_link, simulated_provenance
from sim_fixtures.ns16 import CELL_PATH

from .campaigns import (
    ABLATION,
    EFFECTS,
    NO_EFFECTS,
    Plans,
    Workers,
    execute_all,
    plan_study,
    workers_of,
)
from .page import write_outcome
from .records import PLANTED, FitRecord, Run, ScoreRecord, fit_all, score_all
from .results import ConditionResult, MotionRow, SearchResult, StudyResults, study_results
from .searches import AP, B0, LABELS, A, B, Found, run_searches, searches
from .settings import StudyFolder, StudySettings, stage
from .tables import (
    Condition,
    Evidence,
    ablations,
    condition_result,
    estimates_of,
    parameters_of,
    printed_rows,
)

Array = NDArray[np.float64]

_WORDS: Final = {
    NO_EFFECTS: "the arm is what the model says",
    EFFECTS: "the arm has the effects that the model leaves out",
}


def run_study(
    root: Path,
    settings: StudySettings,
    reporter: Reporter,
    *,
    workers: int = 2,
    cell: Cell | None = None,
) -> StudyResults:
    """Reproduce the paper on a simulated cell, and write results and page into a folder.

    What is complete in the folder is reused: a study that was interrupted resumes there, and of
    one that is done only the results are written again.

    Args:
        root: the folder; new, empty, or that of a study with the same settings.
        settings: what is searched and run.
        reporter: of the progress.
        workers: processes at work; no number in the results depends on them but the times.
        cell: a simulated cell; the NS 16 of the paper if left out.

    Raises:
        CellError: the cell is one of real hardware.
        InputError: the folder holds something else, or another study is running in it.
        StudyError: a part was not completed; starting again resumes there.
        NoExcitationError: a search found no motion.
        OutputError: the results cannot be written.
    """
    folder = StudyFolder(root)
    if cell is None:
        cell = Cell.load(CELL_PATH)
    else:
        simulated_link(cell)  # refuses real hardware before anything is searched
        settings = settings.model_copy(update={"cell": digest(cell.text + cell.urdf)})
    with folder.locked():
        folder.begin(settings)
        times: dict[str, float] = {}
        wanted = searches(settings, len(cell.joint_names))
        with stage("searches", times):
            found = run_searches(folder, cell, wanted, reporter, workers=workers)
        with stage("plans", times):
            plans = plan_study(folder, cell, settings, found)
        with stage("campaigns", times), workers_of(workers) as processes:
            plans = plans.without(execute_all(plans.all, reporter, processes))
        with stage("estimates and predictions", times), workers_of(workers) as processes:
            study = _Analysis(folder, cell, settings, plans, found, reporter, processes)
            results = study.results()
        results = results.model_copy(update={"times": times})
        write_outcome(root, results, reporter)
    return results


@dataclass(frozen=True, eq=False)
class _Analysis:
    """Estimates and predictions of all campaigns of a study, and their tables."""

    folder: StudyFolder
    cell: Cell
    settings: StudySettings
    plans: Plans
    found: Mapping[str, Found]
    reporter: Reporter
    workers: Workers
    fits: dict[str, dict[str, FitRecord]] = field(default_factory=dict)
    scores: dict[str, dict[str, ScoreRecord]] = field(default_factory=dict)

    def results(self) -> StudyResults:
        """Read all archives that were not read before, and make the tables."""
        cell, settings, truth = self.cell, self.settings, planted_values(self.cell)
        for condition, executions in self.plans.executions.items():
            runs = [Run(key, LABELS.get(key, key), one.root) for key, one in executions.items()]
            place = self.folder.fits / condition
            self.fits[condition] = fit_all(runs, place, self.reporter, self.workers)
        conditions = [
            self._condition(one, truth) for one in self.plans.executions if one != ABLATION
        ]
        evidence = Evidence(
            self.fits[ABLATION],
            self.fits[NO_EFFECTS],
            [self.scores[NO_EFFECTS]],
            truth,
            self.plans.sines,
        )
        sizes = preset("b").search
        return study_results(
            self.folder.root,
            cell,
            parameters_of(cell, truth),
            simulated=True,
            quick=settings.effort_b.tried < sizes.population * sizes.generations,
            settings=settings,
            searches=[
                SearchResult.of(one, chosen=key in (self.plans.sines, B, B0))
                for key, one in self.found.items()
            ],
            table1=self._table1() + printed_rows(cell),
            conditions=conditions,
            ablations=ablations(settings, evidence),
            missing=self.plans.missing
            + ([] if settings.effects else ["The unmodelled effects were not run."]),
            times={},
        )

    def _condition(self, condition: str, truth: Array) -> ConditionResult:
        executions, fits = self.plans.executions[condition], self.fits[condition]
        labels = {key: label for key, label in LABELS.items() if key in executions}
        methods = {key: fits[key] for key in labels}
        estimates = estimates_of(methods) | {PLANTED: truth}
        runs = [Run(key, label, executions[key].root) for key, label in labels.items()]
        fits_folder = self.folder.fits / condition
        scores = score_all(runs, fits_folder, estimates, (A, B), self.reporter, self.workers)
        self.scores[condition] = scores
        on = condition == EFFECTS
        effects = tuple(json.loads(simulated_provenance(self.cell, on)["effects"]))
        return condition_result(
            Condition(condition, _WORDS[condition], effects, drifts=on),
            labels,
            methods,
            scores,
            parameters_of(self.cell, truth),
            self.cell.joint_names,
            [PLANTED],
        )

    def _table1(self) -> list[MotionRow]:
        """Of the excitations that the arm bore."""
        plans, fits = self.plans, self.fits[NO_EFFECTS]
        searched = {A: plans.sines, AP: plans.printed or plans.sines}
        return [
            MotionRow(
                key=key,
                words=self.found[searched.get(key, key)].search.notes,
                n_samples=one.criteria.n_samples,
                log10_det=one.criteria.log10_det,
                coupling_index=one.criteria.coupling_index,
                executed_log10_det=fits[key].log10_det,
                executed_coupling_index=fits[key].coupling_index,
                duration=float(one.trajectory.duration),
            )
            for key, one in plans.excitations.items()
            if key in fits
        ]
