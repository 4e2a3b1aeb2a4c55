"""A study from beginning to end: searches, campaigns, estimates, predictions, tables, page."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
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

from .ablations import Evidence, ablations
from .analysis import Run, fit_all, score_all
from .designs import AP, B0, A, B, Found, notes_of, run_searches, searches
from .equal_data import EqualData
from .execution import execute_all
from .folder import StudyFolder
from .forms import ClassForms
from .one_effect import ALL, NONE, EffectSetting, effect_ablation, effect_key, effects_of
from .outcome import parameters_of, printed_rows, write_outcome
from .plans import ABLATION, EFFECTS, PLAIN, Plans, plan_study, with_single_effects
from .reading import reading_of
from .records import PLANTED, FitRecord, ScoreRecord
from .results import (
    ConditionResult,
    MotionRow,
    SearchResult,
    StudyResults,
)
from .settings import StudySettings
from .stages import Stages
from .summary import Named, condition_result, estimates_of
from .workers import Workers, workers_of

Array = NDArray[np.float64]

LABELS: Final = {A: "A", B: "B", B0: "B, fly 0", AP: "A as printed"}
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
    folder = StudyFolder(root)
    if cell is None:
        cell = Cell.load(CELL_PATH)
    else:
        simulated_link(cell)  # refuses real hardware before anything is searched
        settings = settings.model_copy(update={"cell": _digest(cell)})
    with folder.held(), workers_of(workers) as processes:
        begun = folder.settings.exists()
        folder.begin(settings)
        stages = Stages(root, begun=begun)
        wanted = searches(settings, len(cell.joint_names))
        with stages.stage("searches"):
            found = run_searches(folder, cell, wanted, reporter, workers=workers)
        with stages.stage("plans"):
            plans = plan_study(folder, cell, settings, found)
        with stages.stage("campaigns"):
            plans = plans.without(execute_all(plans.all, reporter, processes))
        with stages.stage("estimates and predictions"):
            results = _analysed(folder, cell, settings, plans, found, reporter, processes)
        times = stages.times
        results = results.model_copy(
            update={
                "times": times.wall,
                "processor_times": times.processor,
                "times_whole": times.whole,
            }
        )
        with stages.stage("page"):
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
    truth = planted_values(cell)
    parameters = parameters_of(cell, truth)
    conditions: list[ConditionResult] = []
    fits: dict[str, dict[str, FitRecord]] = {}
    for condition, executions in plans.executions.items():
        runs = [Run(key, LABELS.get(key, key), one.root) for key, one in executions.items()]
        fits[condition] = fit_all(runs, folder.fits / condition, reporter, workers)
    scores: dict[str, dict[str, ScoreRecord]] = {}
    for condition in plans.executions:
        if condition == ABLATION:
            continue
        labels = {key: name for key, name in LABELS.items() if key in plans.executions[condition]}
        runs = [Run(key, label, folder.campaign(condition, key)) for key, label in labels.items()]
        methods = {key: fits[condition][key] for key in labels}
        estimates = estimates_of(methods) | {PLANTED: truth}
        equal = EqualData.of(methods, list(labels))
        estimates |= {} if equal is None else equal.estimate(methods)
        scores[condition] = score_all(
            runs, folder.fits / condition, estimates, (A, B), reporter, workers
        )
        on = condition == EFFECTS
        named = Named(condition, _CONDITION_WORDS[condition], _effects(cell, on), drifts=on)
        conditions.append(
            condition_result(
                named, labels, methods, scores[condition], parameters, cell.joint_names, [PLANTED]
            )
        )
    evidence = Evidence(
        fits[ABLATION], fits[PLAIN], scores[PLAIN], truth, plans.missing, plans.sines
    )
    varied = ablations(settings, evidence)
    if with_single_effects(settings):
        one_effect = _effect_settings(
            folder, cell, settings, plans, fits, scores, reporter, workers
        )
        varied.append(effect_ablation(one_effect, fits[PLAIN], evidence.forms, truth))
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
        missing=_missing(settings),
        times={},
    )
    return results.model_copy(update={"reading": reading_of(results)})


def _effect_settings(
    folder: StudyFolder,
    cell: Cell,
    settings: StudySettings,
    plans: Plans,
    fits: Mapping[str, Mapping[str, FitRecord]],
    scores: Mapping[str, Mapping[str, ScoreRecord]],
    reporter: Reporter,
    workers: Workers,
) -> list[EffectSetting]:
    """What A and B gave without effects, with each by itself, and with all."""
    few, forms = settings.ablation_repetitions, "fly-by"
    plain, every = (ClassForms.of(scores[one][forms].forms) for one in (PLAIN, EFFECTS))
    bases = {A: fits[PLAIN][A], B: fits[PLAIN][B]}, {A: fits[EFFECTS][A], B: fits[EFFECTS][B]}
    found = [EffectSetting(NONE, bases[0], plain, few, base=True)]
    for effect in effects_of(cell):
        keys = {method: effect_key(method, effect) for method in (A, B)}
        if not fits[ABLATION].keys() >= set(keys.values()):
            continue  # the arm did not bear one of them, which is told
        own = {method: fits[ABLATION][key] for method, key in keys.items()}
        root = plans.executions[ABLATION][keys[B]].root
        scored = score_all(
            [Run(keys[B], keys[B], root)],
            folder.fits / ABLATION,
            estimates_of(own),
            (),
            reporter,
            workers,
        )
        found.append(EffectSetting(effect, own, ClassForms.of(scored[forms].forms), few))
    return [*found, EffectSetting(ALL, bases[1], every, few, base=True)]


def _digest(cell: Cell) -> str:
    return hashlib.sha256((cell.text + cell.urdf).encode()).hexdigest()


def _missing(settings: StudySettings) -> list[str]:
    if not settings.effects:
        return ["The effects that the model leaves out were not run."]
    if not with_single_effects(settings):
        return [
            "The effects that the model leaves out were not tried one at a time: each setting is"
            f" run too few times here ({settings.ablation_repetitions}) to tell anything."
        ]
    return []


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
    rows, searched = [], {A: plans.sines, AP: plans.printed or plans.sines}
    for key, excitation in plans.excitations.items():
        if key not in fits:
            continue  # the arm did not bear it, which is told
        rows.append(
            MotionRow(
                key=key,
                words=notes_of(found[searched.get(key, key)].search),
                n_samples=excitation.criteria.n_samples,
                log10_det=excitation.criteria.log10_det,
                coupling_index=excitation.criteria.coupling_index,
                executed_log10_det=fits[key].log10_det,
                executed_coupling_index=fits[key].coupling_index,
                duration=float(excitation.trajectory.duration),
            )
        )
    return rows
