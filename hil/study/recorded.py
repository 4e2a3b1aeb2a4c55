"""A study of campaigns that were recorded: what of the paper's figures they allow."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.progress import Reporter
from hil.version import software

from .ablations import Evidence, repetition_ablation
from .analysis import Run, fit_all, score_all
from .equal_data import EqualData
from .folder import StudyFolder
from .outcome import parameters_of, printed_rows, write_outcome
from .reading import reading_of
from .recorded_runs import Recorded, homes, recorded_runs
from .records import FitRecord, ScoreRecord
from .results import MotionRow, StudyResults
from .summary import Named, condition_result, estimates_of
from .workers import workers_of

Array = NDArray[np.float64]

SUBSETS: Final = (1, 2, 5, 10, 20, 30, 50, 100)
_RECORDED: Final = "recorded"


def study_campaigns(
    root: Path, campaigns: Sequence[Path], reporter: Reporter, *, workers: int = 2
) -> StudyResults:
    """Study recorded campaigns of one arm, simulated or real, from their archives alone.

    Args:
        root: folder for results and page; what it read before is not read again.
        campaigns: their folders; the first two are compared as the paper compares A and B, or
            those that hold the excitations of these methods, where there is one of each.
        reporter: told of the progress.
        workers: processes at work.

    Raises:
        InputError: a folder is no campaign, holds no whole excitation, or is of another arm, or
            of one that was simulated otherwise.
    """
    begin = time.perf_counter()
    folder = StudyFolder(root)
    recorded = recorded_runs(campaigns)
    runs, cell = [one.run for one in recorded], recorded[0].cell
    keys, labels = [run.key for run in runs], {run.key: run.label for run in runs}
    truth, effects = _planted(recorded), recorded[0].effects
    with folder.held(), workers_of(workers) as processes:
        fits = fit_all(runs, folder.fits, reporter, processes)
        estimates = estimates_of(fits)
        equal = EqualData.of(fits, keys)
        estimates |= {} if equal is None else equal.estimate(fits)

        def scored(some: Sequence[Run]) -> dict[str, ScoreRecord]:
            return score_all(some, folder.fits, estimates, keys[:2], reporter, processes)

        scores, parameters = scored(runs), parameters_of(cell, truth)
        by_home = {_at_home(run, effects): scored([run]) for run in homes(runs)}
        by_home = by_home or {Named(_RECORDED, "as recorded", effects): scores}
        conditions = [
            condition_result(named, labels, fits, some, parameters, cell.joint_names)
            for named, some in by_home.items()
        ]
        evidence = Evidence({}, fits, scores, truth)
        results = StudyResults(
            name=root.resolve().name,
            cell=cell.name,
            simulated=recorded[0].simulated,
            quick=False,
            settings=None,
            software=software(),
            joint_names=list(cell.joint_names),
            n_base=len(cell.model.base.names),
            parameters=parameters,
            searches=[],
            table1=[_row(one, fits[one.run.key]) for one in recorded] + printed_rows(cell),
            conditions=conditions,
            ablations=[repetition_ablation(evidence, SUBSETS, keys)],
            reading=[],
            missing=_missing(recorded, list(scores)),
            times={"estimates and predictions": round(time.perf_counter() - begin, 1)},
        )
        results = results.model_copy(update={"reading": reading_of(results)})
        write_outcome(root, results, reporter)
    return results


def _at_home(run: Run, effects: tuple[str, ...]) -> Named:
    return Named(f"{_RECORDED}-{run.key}", f"on the motions of {run.label}", effects)


def _planted(recorded: Sequence[Recorded]) -> Array | None:
    """What is planted in the arm of all of them (p,), if they agree on it."""
    first = recorded[0].planted
    if first is None or any(
        one.planted is None or not np.array_equal(one.planted, first) for one in recorded
    ):
        return None
    return first


def _row(one: Recorded, record: FitRecord) -> MotionRow:
    planned = one.excitation
    words = "not known" if planned is None else f"found by method {planned.method}"
    return MotionRow(
        key=one.run.key,
        words=words,
        n_samples=record.n_samples,
        log10_det=record.log10_det if planned is None else planned.criteria.log10_det,
        coupling_index=(
            record.coupling_index if planned is None else planned.criteria.coupling_index
        ),
        executed_log10_det=record.log10_det,
        executed_coupling_index=record.coupling_index,
        duration=record.duration,
    )


def _missing(recorded: Sequence[Recorded], classes: Sequence[str]) -> list[str]:
    """What the recordings do not allow, in sentences."""
    found = [
        "Searches, fly-by share, K, λ and noise cannot be varied with recorded campaigns; only the "
        "number of repetitions is."
    ]
    if len(recorded) < 2:
        found.append(
            "One campaign was given, so that nothing is compared: give another one of the same "
            "arm, with the other method's excitation (--campaign again)."
        )
    if recorded[0].planted is not None and _planted(recorded) is None:
        found.append(
            "The simulated arms were not planted with the same values: distances from them are "
            "left out."
        )
    absent = [name for name in ("fly-by", "stop-to-stop", "sinusoid") if name not in classes]
    if absent:
        found.append(
            f"No held-out motion is {' or '.join(absent)}: these columns of the cross table are "
            "missing."
        )
    return found
