"""A study from beginning to end: searches, campaigns, estimates, predictions, tables, page."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.design import preset
from hil.progress import Reporter
from hil.simulation import planted_values, simulated_link, simulated_provenance
from hil.version import software
from sim_fixtures.ns16 import CELL_PATH

from .ablations import ABLATED, Evidence, ablations, subsets_of
from .analysis import Run, fit_all, score_all
from .designs import B0, A, B, Found, notes_of, run_searches, searches
from .equal_data import EqualData
from .execution import execute_all
from .folder import StudyFolder
from .outcome import parameters_of, printed_rows, write_outcome
from .plans import ABLATION, EFFECTS, PLAIN, Plans, plan_study
from .reading import reading_of
from .records import PLANTED, FitRecord
from .results import (
    AblationResult,
    ConditionResult,
    MotionRow,
    SearchResult,
    StudyResults,
)
from .settings import StudySettings
from .summary import Named, condition_result, estimates_of
from .workers import Workers, workers_of

Array = NDArray[np.float64]

LABELS: Final = {A: "A", B: "B", B0: "B, fly 0"}
_CONDITION_WORDS: Final = {
    PLAIN: "the arm is what the model says",
    EFFECTS: "the arm does what the model leaves out",
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

    What is whole in the folder is kept: a study that was ended goes on where it was, and one that
    is done is only written again.

    Args:
        root: the folder; new, empty, or that of a study with the same settings.
        settings: what is searched and run.
        reporter: told of the progress.
        workers: processes at work; no number in the results depends on them but the times.
        cell: a simulated cell; the NS 16 of the paper if left out.

    Raises:
        CellError: the cell is one of real hardware.
        InputError: the folder holds something else, or another study is at work in it.
        StudyError: a part did not come to its end; starting again goes on there.
        NoExcitationError: a search found no motion.
        OutputError: the results cannot be written.
    """
    folder, times = StudyFolder(root), dict[str, float]()
    if cell is None:
        cell = Cell.load(CELL_PATH)
    else:
        simulated_link(cell)  # refuses real hardware before anything is searched
        settings = settings.model_copy(update={"cell": _digest(cell)})
    with folder.held(), workers_of(workers) as processes:
        folder.begin(settings)
        wanted = searches(settings, len(cell.joint_names))
        with _timed(times, "searches"):
            found = run_searches(folder, cell, wanted, reporter, workers=workers)
        with _timed(times, "plans"):
            plans = plan_study(folder, cell, settings, found)
        with _timed(times, "campaigns"):
            plans = plans.without(execute_all(plans.all, reporter, processes))
        with _timed(times, "estimates and predictions"):
            results = _analysed(folder, cell, settings, plans, found, reporter, processes)
        results = results.model_copy(update={"times": times})
        write_outcome(root, results, reporter)
    return results


def _analysed(
    folder: StudyFolder,
    cell: Cell,
    settings: StudySettings,
    plans: Plans,
    found: Mapping[str, Found],
    reporter: Reporter,
    workers: Workers,
) -> StudyResults:
    parameters = parameters_of(cell, planted=True)
    truth = planted_values(cell)
    conditions: list[ConditionResult] = []
    varied: list[AblationResult] = []
    fits: dict[str, dict[str, FitRecord]] = {}
    for condition, executions in plans.executions.items():
        runs = [Run(key, LABELS.get(key, key), one.root) for key, one in executions.items()]
        fits[condition] = fit_all(runs, folder.fits / condition, reporter, workers)
    for condition in plans.executions:
        if condition == ABLATION:
            continue
        runs = [
            Run(key, LABELS[key], folder.campaign(condition, key))
            for key in plans.executions[condition]
        ]
        estimates = estimates_of(fits[condition]) | {PLANTED: truth}
        equal = EqualData.of(fits[condition], list(LABELS))
        estimates |= {} if equal is None else equal.estimate(fits[condition])
        if condition == PLAIN:
            estimates |= subsets_of(fits[PLAIN], settings.subsets, (A, B))
            estimates |= {ABLATED + key: one for key, one in estimates_of(fits[ABLATION]).items()}
        scores = score_all(runs, folder.fits / condition, estimates, (A, B), reporter, workers)
        named = Named(condition, _CONDITION_WORDS[condition], _effects(cell, condition == EFFECTS))
        conditions.append(
            condition_result(
                named, LABELS, fits[condition], scores, parameters, cell.joint_names, [PLANTED]
            )
        )
        if condition == PLAIN:
            evidence = Evidence(
                fits[ABLATION],
                fits[PLAIN],
                estimates,
                scores,
                truth,
                plans.missing,
                plans.sines,
            )
            varied = ablations(settings, evidence)
    results = StudyResults(
        name=folder.root.resolve().name,
        cell=cell.name,
        simulated=True,
        quick=settings.effort_b.tried < _printed_effort(),
        settings=settings,
        software=software(),
        joint_names=list(cell.joint_names),
        n_base=len(cell.model.base.names),
        parameters=parameters,
        searches=[_search(one, plans.sines) for one in found.values()],
        table1=_table1(plans, found, fits[PLAIN]) + printed_rows(cell),
        conditions=conditions,
        ablations=varied,
        reading=[],
        missing=[] if settings.effects else ["The effects that the model leaves out were not run."],
        times={},
    )
    return results.model_copy(update={"reading": reading_of(results)})


def _digest(cell: Cell) -> str:
    return hashlib.sha256((cell.text + cell.urdf).encode()).hexdigest()


def _printed_effort() -> int:
    """Motions that the paper's method B looks at."""
    search = preset("b").search
    return search.population * search.generations


def _effects(cell: Cell, on: bool) -> tuple[str, ...]:
    return tuple(json.loads(simulated_provenance(cell, on)["effects"]))


def _search(found: Found, sines: str) -> SearchResult:
    one, search = found.excitation, found.search
    return SearchResult(
        key=search.key,
        words=search.words,
        chosen=search.key in (sines, B, B0),
        tried=0 if one is None else one.tried,
        infeasible={} if one is None else {name: int(n) for name, n in one.rejected.items()},
        log10_det=None if one is None else one.criteria.log10_det,
        coupling_index=None if one is None else one.criteria.coupling_index,
        duration=None if one is None else float(one.trajectory.duration),
    )


def _table1(
    plans: Plans, found: Mapping[str, Found], fits: Mapping[str, FitRecord]
) -> list[MotionRow]:
    rows = []
    for key, excitation in plans.excitations.items():
        rows.append(
            MotionRow(
                key=key,
                words=notes_of(found[plans.sines if key == A else key].search),
                n_samples=excitation.criteria.n_samples,
                log10_det=excitation.criteria.log10_det,
                coupling_index=excitation.criteria.coupling_index,
                executed_log10_det=fits[key].log10_det,
                executed_coupling_index=fits[key].coupling_index,
                duration=float(excitation.trajectory.duration),
            )
        )
    return rows


@contextmanager
def _timed(times: dict[str, float], name: str) -> Iterator[None]:
    begin = time.perf_counter()
    yield
    times[name] = round(time.perf_counter() - begin, 1)
