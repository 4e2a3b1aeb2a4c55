"""A study from beginning to end: searches, campaigns, estimates, predictions, tables, page."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, open_archive
from hil.batch.cache import arm_digest
from hil.batch.workers import LocalWorkers
from hil.campaign import CampaignFolderError
from hil.cell import Cell
from hil.compare.comparison import apart
from hil.compare.trend import short_names
from hil.design import preset
from hil.errors import InputError
from hil.identify.sources import cell_of
from hil.identify.summary import planted_in
from hil.io import digest
from hil.progress import Reporter
from hil.simulation import planted_values, simulated_link, simulated_provenance
from identification.excitation import Excitation
from sim_fixtures.ns16 import CELL_PATH

from .campaigns import (
    ABLATION,
    AP,
    B0,
    EFFECTS,
    LABELS,
    LONGEST,
    NO_EFFECTS,
    A,
    B,
    Plans,
    Search,
    execute_all,
    plan_study,
    run_searches,
    searches,
)
from .page import write_outcome
from .records import CLASSES, PLANTED, FitRecord, Reader, Run, ScoreRecord, class_in, plan_in
from .results import MotionRow, SearchResult, StudyResults
from .settings import StudyFolder, StudySettings
from .tables import (
    Condition,
    Evidence,
    ablations,
    condition_result,
    estimates_of,
    parameters_of,
    printed_rows,
    repetition_ablation,
    study_results,
)

_WORDS: Final = {
    NO_EFFECTS: "without unmodelled effects",
    EFFECTS: "with unmodelled effects",
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
    folder, times = StudyFolder(root), dict[str, float]()
    if cell is None:
        cell = Cell.load(CELL_PATH)
    else:
        simulated_link(cell)  # refuses real hardware before anything is searched
        settings = settings.model_copy(update={"cell": digest(cell.text + cell.urdf)})
    with folder.locked(), LocalWorkers(workers, timeout=LONGEST) as processes:
        folder.begin(settings)
        wanted = searches(settings, len(cell.joint_names))
        with _stage("searches", times):
            found = run_searches(folder, cell, wanted, reporter, workers)
        with _stage("plans", times):
            plans = plan_study(folder, cell, settings, found)
        with _stage("campaigns", times):
            plans = plans.without(execute_all(plans.all, reporter, processes))
        with _stage("estimates and predictions", times):
            reader = Reader(folder.fits, reporter, processes)
            results = _results(root, cell, settings, plans, found, reader)
        results = results.model_copy(update={"times": times})
        write_outcome(root, results, reporter)
    return results


@contextmanager
def _stage(name: str, times: dict[str, float]) -> Iterator[None]:
    """Note in `times` how long a stage takes [s]."""
    begin = time.perf_counter()
    yield
    times[name] = round(time.perf_counter() - begin, 1)


def _results(
    root: Path,
    cell: Cell,
    settings: StudySettings,
    plans: Plans,
    found: Mapping[str, Search],
    reader: Reader,
) -> StudyResults:
    """Read all archives that were not read before, and make the tables."""
    truth, executions = planted_values(cell), plans.executions
    parameters = parameters_of(cell, truth)
    fits: dict[str, dict[str, FitRecord]] = {}
    scores: dict[str, dict[str, ScoreRecord]] = {}
    conditions = []
    for name, some in executions.items():
        runs = [Run(key, LABELS.get(key, key), one.root) for key, one in some.items()]
        within = Reader(reader.fits / name, reader.reporter, reader.workers)
        fits[name] = within.fit(runs)
        if name == ABLATION:
            continue
        estimates = estimates_of(fits[name]) | {PLANTED: truth}
        scores[name] = within.score(runs, estimates, (A, B))
        on = name == EFFECTS
        effects = tuple(json.loads(simulated_provenance(cell, on)["effects"]))
        condition = Condition(name, _WORDS[name], effects, drifts=on)
        labels = {run.key: run.label for run in runs}
        conditions.append(condition_result(condition, labels, fits[name], scores[name], parameters))
    sines, sizes = plans.searched[A], preset("b").search
    main = fits[NO_EFFECTS]
    varied, ranges = ablations(
        settings, Evidence(fits[ABLATION], main, [scores[NO_EFFECTS]], truth, sines)
    )
    return study_results(
        root,
        cell,
        truth,
        simulated=True,
        quick=settings.effort_b.tried < sizes.population * sizes.generations,
        settings=settings,
        searches=[_search_result(one, chosen=key in (sines, B, B0)) for key, one in found.items()],
        table1=[
            _row(key, found[plans.searched[key]].notes, one.plan.excitation, main[key])
            for key, one in executions[NO_EFFECTS].items()
        ]
        + printed_rows(cell),
        conditions=conditions,
        ablations=varied,
        ranges=ranges,
        missing=plans.missing
        + ([] if settings.effects else ["The unmodelled effects were not run."]),
        times={},
    )


def _row(key: str, words: str, excitation: Excitation | None, record: FitRecord) -> MotionRow:
    """Row of Table 1, as planned where that is known, and as executed."""
    planned = record if excitation is None else excitation.criteria
    return MotionRow(
        key=key,
        words=words,
        n_samples=record.n_samples if excitation is None else excitation.criteria.n_samples,
        log10_det=planned.log10_det,
        coupling_index=planned.coupling_index,
        executed_log10_det=record.log10_det,
        executed_coupling_index=record.coupling_index,
        duration=record.duration if excitation is None else excitation.trajectory.duration,
    )


def _search_result(search: Search, *, chosen: bool) -> SearchResult:
    one = search.excitation
    return SearchResult(
        key=search.key,
        words=search.words,
        chosen=chosen,
        tried=0 if one is None else one.tried,
        infeasible={} if one is None else {name: int(n) for name, n in one.rejected.items()},
        log10_det=None if one is None else one.criteria.log10_det,
        coupling_index=None if one is None else one.criteria.coupling_index,
        duration=None if one is None else float(one.trajectory.duration),
    )


Array = NDArray[np.float64]

SUBSETS: Final = (1, 2, 5, 10, 20, 30, 50, 100)


@dataclass(frozen=True, eq=False)
class Recorded:
    """One campaign by its first excitation.

    Attributes:
        run: its folder under a key, which is "a", "b" or "b0" where no other one holds an
            excitation of that method, and never otherwise.
        archive: the first excitation.
    """

    run: Run
    archive: Archive

    @cached_property
    def cell(self) -> Cell:
        """As it travels in the archive."""
        return cell_of(self.archive)

    @property
    def planted(self) -> Array | None:
        """Parameters (p,) of its simulated arm; None of a real one."""
        header = self.archive.header
        return planted_in(self.cell, header) if header.only_simulated else None

    @cached_property
    def excitation(self) -> Excitation | None:
        """As it was planned, if that is known."""
        try:
            return Excitation.from_dict(plan_in(self.archive)["excitation"])
        except (KeyError, TypeError, ValueError):
            return None

    @property
    def words(self) -> str:
        """How the excitation was found."""
        return "not known" if self.excitation is None else f"method {self.excitation.method}"

    @property
    def method(self) -> str:
        """Which of the paper's three excitations it is; "" if that is not known."""
        if self.excitation is None or self.excitation.method not in (A, B):
            return ""
        stops = self.excitation.method == B and class_in(self.archive) == "stop-to-stop"
        return B0 if stops else self.excitation.method


def study_campaigns(
    root: Path, campaigns: Sequence[Path], reporter: Reporter, *, workers: int = 2
) -> StudyResults:
    """Study recorded campaigns of one arm, simulated or real, from their archives alone.

    Args:
        root: folder for results and page; what was read before is not read again.
        campaigns: their folders; the first two are compared as the paper compares A and B, or
            those that hold the excitations of these methods, where there is one of each.
        reporter: of the progress.
        workers: processes at work.

    Raises:
        InputError: see :func:`recorded_runs`.
    """
    begin = time.perf_counter()
    folder, recorded = StudyFolder(root), recorded_runs(campaigns)
    header, cell = recorded[0].archive.header, recorded[0].cell
    runs = [one.run for one in recorded]
    keys, labels = [run.key for run in runs], {run.key: run.label for run in runs}
    every = [values for one in recorded if (values := one.planted) is not None]
    same = len(every) == len(recorded) and all(np.array_equal(one, every[0]) for one in every)
    truth = every[0] if same else None
    # Where campaigns ran the same held-out motions, each predicts them by itself.
    parts = [
        (Condition(f"recorded-{one.key}", f"on the motions of {one.label}", header.effects), [one])
        for one in homes(runs)
    ] or [(Condition("recorded", "as recorded", header.effects), runs)]
    with folder.locked(), LocalWorkers(workers, timeout=LONGEST) as processes:
        reader = Reader(folder.fits, reporter, processes)
        fits = reader.fit(runs)
        estimates = estimates_of(fits)
        scores = [reader.score(some, estimates, keys[:2]) for _, some in parts]
        parameters = parameters_of(cell, truth)
        results = study_results(
            root,
            cell,
            truth,
            simulated=header.only_simulated,
            quick=False,
            settings=None,
            searches=[],
            table1=[
                _row(one.run.key, one.words, one.excitation, fits[one.run.key]) for one in recorded
            ]
            + printed_rows(cell),
            conditions=[
                condition_result(one, labels, fits, some, parameters)
                for (one, _), some in zip(parts, scores, strict=True)
            ],
            ablations=[repetition_ablation(Evidence({}, fits, scores, truth), SUBSETS, keys)],
            ranges=[],
            missing=_missing(recorded, truth, {name for some in scores for name in some}),
            times={"estimates and predictions": round(time.perf_counter() - begin, 1)},
        )
        write_outcome(root, results, reporter)
    return results


def recorded_runs(campaigns: Sequence[Path]) -> list[Recorded]:
    """The campaigns; those of method A, B, and B with fly 0 first, where there is just one of each.

    Raises:
        InputError: a folder is no campaign, is named twice, holds no whole excitation, or is of
            another arm than the first, or of one that behaves otherwise.
    """
    folders = [path.resolve() for path in campaigns]
    found: list[Recorded] = []
    for path, label in zip(folders, short_names([str(one) for one in folders]), strict=True):
        if not (path / "manifest.json").exists():
            raise CampaignFolderError(
                path, "is not a campaign folder", "name one that has a manifest.json"
            )
        if folders.count(path) > 1:
            raise InputError(path, "is named twice", remedy="name each campaign once")
        key = label.replace("/", "-")  # those of the methods mean how an excitation was found
        run = Run(f"campaign-{key}" if key in (A, B, B0, AP, PLANTED) else key, label, path)
        first = next(iter(run.archives("excitation")), None)
        if first is None:
            problem, remedy = "holds no whole excitation", "run the campaign first (hil run)"
            raise InputError(path, problem, remedy=remedy)
        found.append(Recorded(run, open_archive(run.folder.archives / first)))
        _require_alike(found[-1], found[0])
    every = [one.method for one in found]
    methods = {one.method: one for one in found if one.method and every.count(one.method) == 1}
    if not {A, B} <= methods.keys():
        return found
    named = [
        replace(one, run=replace(one.run, key=key, label=f"{LABELS[key]} ({one.run.label})"))
        for key, one in ((key, methods[key]) for key in (A, B, B0) if key in methods)
    ]
    return named + [one for one in found if methods.get(one.method) is not one]


def _require_alike(one: Recorded, first: Recorded) -> None:
    """One arm, as `hil compare` requires it, and one behaviour of a simulated arm."""
    arms, effects = [], []
    for each in (one, first):
        header, drives = each.archive.header, each.archive.attachments.get("drive_train.json")
        arms.append(arm_digest(each.cell, drives, simulated=header.only_simulated))
        effects.append(header.effects)
    if arms[0] != arms[1]:
        problem = f"is of another arm than {first.run.root}: {apart(one.cell, first.cell)}"
        raise InputError(one.run.root, problem, remedy="name campaigns of one arm")
    if effects[0] != effects[1]:
        own, other = ("; ".join(some) or "none" for some in effects)
        raise InputError(
            one.run.root,
            f"was simulated with other unmodelled effects ({own}) than {first.run.root}"
            f" ({other}): the arms differ, and not only the excitations",
            remedy="name campaigns that were simulated alike",
        )


def homes(runs: Sequence[Run]) -> list[Run]:
    """Campaigns that ran the same held-out motions as another one; none where each has its own.

    Two campaigns of one cell predict the same motions: one estimate was made in the state of the
    arm on that day, and the other in another state.
    """
    plans: dict[str, set[str]] = {}
    for run in runs:
        paths = [run.folder.archives / name for name in run.archives("validation")]
        texts = [open_archive(one, fields=()).attachments.get("plan.json") for one in paths]
        plans[run.key] = {digest(text) for text in texts if text is not None}
    every = [motion for own in plans.values() for motion in own]
    return [run for run in runs if plans[run.key]] if len(every) > len(set(every)) else []


def _missing(
    recorded: Sequence[Recorded], truth: Array | None, classes: Collection[str]
) -> list[str]:
    """What the recordings do not allow, in sentences."""
    absent = [name for name in CLASSES if name not in classes]
    sentences = {
        "Searches, fly-by share, K, λ and noise cannot be varied with recorded campaigns.": True,
        "One campaign was given, so that nothing is compared: give another one of the same arm,"
        " with the other method's excitation (--campaign again).": len(recorded) < 2,
        "The simulated arms were planted with different values: distances from them are left"
        " out.": recorded[0].planted is not None and truth is None,
        f"No held-out motion is {' or '.join(absent)}: these columns are missing.": bool(absent),
    }
    return [sentence for sentence, applies in sentences.items() if applies]
