"""Run of a study: searches, campaigns, estimates, predictions, tables, page."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

from hil.batch.workers import LocalWorkers
from hil.cell import Cell
from hil.design import preset
from hil.files import digest
from hil.progress import Reporter
from hil.simulation import planted_values, simulated_link, simulated_provenance
from hil.version import software
from identification.excitation import Excitation
from sim_fixtures.ns16 import CELL_PATH

from . import campaigns, tables
from .page import write_outcome
from .records import PLANTED, FitRecord, Reader, ScoreRecord
from .results import MotionRow, SearchResult, StudyResults, conclusions
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

    An interrupted study resumes; of a complete one only the results are written again. Results do
    not depend on the number of workers, except for the times.

    Raises:
        CellError: the cell is not simulated.
        InputError: the folder contains other files, or another study is running in it.
        StudyError: a part was not completed; a restart resumes.
        NoExcitationError: a search found no feasible motion.
        OutputError: the results cannot be written.
    """
    folder, times = StudyFolder(root), dict[str, float]()
    if cell is None:
        cell = Cell.load(CELL_PATH)
    else:
        simulated_link(cell)  # raises for real hardware
        settings = settings.model_copy(update={"cell": digest(cell.text + cell.urdf)})
    with folder.locked(), LocalWorkers(workers, timeout=campaigns.LONGEST) as processes:
        folder.begin(settings)
        wanted = campaigns.searches(settings, len(cell.joint_names))
        with _stage("searches", times):
            found = campaigns.run_searches(folder, cell, wanted, reporter, workers)
        with _stage("plans", times):
            plans = campaigns.plan_study(folder, cell, settings, found)
        with _stage("campaigns", times):
            plans = plans.without(campaigns.execute_all(plans.all, reporter, processes))
        with _stage("estimates and predictions", times):
            reader = Reader(folder.fits, reporter, processes)
            results = _simulated(root, cell, settings, plans, found, reader)
        results = results.model_copy(update={"times": times})
        write_outcome(root, results, reporter)
    return results


@contextmanager
def _stage(name: str, times: dict[str, float]) -> Iterator[None]:
    """Measure the time of a stage [s]."""
    begin = time.perf_counter()
    yield
    times[name] = round(time.perf_counter() - begin, 1)


def _simulated(
    root: Path,
    cell: Cell,
    settings: StudySettings,
    plans: campaigns.Plans,
    found: Mapping[str, campaigns.Search],
    reader: Reader,
) -> StudyResults:
    """Estimate, predict and tabulate."""
    truth = planted_values(cell)
    parameters, conditions = tables.parameters_of(cell, truth), []
    fits, scores = dict[str, dict[str, FitRecord]](), dict[str, dict[str, ScoreRecord]]()
    for name, some in plans.executions.items():
        roots = {key: one.root for key, one in some.items()}
        within = replace(reader, fits=reader.fits / name)
        fits[name] = within.fit(roots)
        if name == campaigns.ABLATION:
            continue
        scores[name] = within.score(roots, tables.estimates_of(fits[name]) | {PLANTED: truth})
        drifts = name == campaigns.EFFECTS
        effects = tuple(json.loads(simulated_provenance(cell, drifts)["effects"]))
        condition = tables.Condition(name, _WORDS[name], effects, drifts)
        conditions.append(tables.condition_result(condition, fits[name], scores[name], parameters))
    sines, sizes, main = plans.searched[campaigns.A], preset("b").search, fits[campaigns.NO_EFFECTS]
    evidence = tables.Evidence(
        fits[campaigns.ABLATION], main, scores[campaigns.NO_EFFECTS], truth, sines
    )
    varied, ranges = tables.ablations(settings, evidence)
    results = StudyResults(
        name=root.resolve().name,
        cell=cell.name,
        simulated=True,
        quick=settings.effort_b.tried < sizes.population * sizes.generations,
        settings=settings,
        software=software(),
        joint_names=list(cell.joint_names),
        n_base=len(cell.model.base.names),
        parameters=parameters,
        searches=[
            _search_result(one, chosen=key in (sines, campaigns.B, campaigns.B0))
            for key, one in found.items()
        ],
        table1=[
            _row(key, found[plans.searched[key]].notes, one.plan.excitation, main[key])
            for key, one in plans.executions[campaigns.NO_EFFECTS].items()
        ]
        + tables.printed_rows(cell),
        conditions=conditions,
        ablations=varied,
        ranges=ranges,
        missing=plans.missing
        + ([] if settings.effects else ["The unmodelled effects were not simulated."]),
        reading=[],
        times={},
    )
    return results.model_copy(update={"reading": conclusions(results)})


def _row(key: str, words: str, excitation: Excitation, record: FitRecord) -> MotionRow:
    """Return a row of Table 1."""
    return MotionRow.of(
        excitation.criteria,
        key=key,
        words=words,
        executed_log10_det=record.log10_det,
        executed_coupling_index=record.coupling_index,
        duration=excitation.trajectory.duration,
    )


def _search_result(search: campaigns.Search, *, chosen: bool) -> SearchResult:
    found, one = {"key": search.key, "words": search.words, "chosen": chosen}, search.excitation
    if one is None:
        return SearchResult.of(**found)
    rejected = {name: int(n) for name, n in one.rejected.items()}
    duration = float(one.trajectory.duration)
    return SearchResult.of(
        one.criteria, **found, tried=one.tried, infeasible=rejected, duration=duration
    )
