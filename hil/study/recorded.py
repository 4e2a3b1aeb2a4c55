"""A study of campaigns that were recorded: what of the paper's figures they allow."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from hil.archive import open_archive
from hil.campaign import CampaignFolder, CampaignFolderError
from hil.cell import Cell
from hil.errors import InputError
from hil.identify.sources import cell_of
from hil.progress import Reporter
from hil.version import software
from identification.excitation import Excitation

from .ablations import Evidence, repetition_ablation, subsets_of
from .analysis import Run, fit_all, score_all
from .designs import A, B
from .equal_data import EqualData
from .folder import StudyFolder
from .outcome import parameters_of, printed_rows, write_outcome
from .reading import reading_of
from .records import FitRecord
from .results import MotionRow, StudyResults
from .summary import Named, condition_result, estimates_of
from .workers import workers_of

SUBSETS: Final = (1, 2, 5, 10, 20, 30, 50, 100)
_RECORDED: Final = Named("recorded", "as recorded", ())


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
        InputError: a folder is no campaign, holds no whole excitation, or is of another arm.
    """
    begin = time.perf_counter()
    folder = StudyFolder(root)
    runs = _runs(campaigns)
    cells = [_cell(run) for run in runs]
    cell = cells[0]
    for run, other in zip(runs, cells, strict=True):
        if other.urdf != cell.urdf or other.model.parameter_names != cell.model.parameter_names:
            raise InputError(
                run.root, f"is of another arm than {runs[0].root}", remedy="name one arm's"
            )
    with folder.held(), workers_of(workers) as processes:
        fits = fit_all(runs, folder.fits, reporter, processes)
        keys = [run.key for run in runs]
        estimates = estimates_of(fits) | subsets_of(fits, SUBSETS, keys)
        equal = EqualData.of(fits, keys)
        estimates |= {} if equal is None else equal.estimate(fits)
        scores = score_all(runs, folder.fits, estimates, keys[:2], reporter, processes)
        simulated = all(_simulated(run) for run in runs)
        parameters = parameters_of(cell, planted=simulated and cell.file.simulation is not None)
        truth = (
            None
            if any(one.truth is None for one in parameters)
            else np.array([one.truth for one in parameters], dtype=np.float64)
        )
        labels = {run.key: run.label for run in runs}
        condition = condition_result(_RECORDED, labels, fits, scores, parameters, cell.joint_names)
        evidence = Evidence({}, fits, estimates, scores, truth)
        results = StudyResults(
            name=root.resolve().name,
            cell=cell.name,
            simulated=simulated,
            quick=False,
            settings=None,
            software=software(),
            joint_names=list(cell.joint_names),
            n_base=len(cell.model.base.names),
            parameters=parameters,
            searches=[],
            table1=[_row(run, fits[run.key]) for run in runs] + printed_rows(cell),
            conditions=[condition],
            ablations=[repetition_ablation(evidence, SUBSETS, keys)],
            reading=[],
            missing=_missing(runs, list(scores)),
            times={"estimates and predictions": round(time.perf_counter() - begin, 1)},
        )
        results = results.model_copy(update={"reading": reading_of(results)})
        write_outcome(root, results, reporter)
    return results


def _runs(campaigns: Sequence[Path]) -> list[Run]:
    runs: list[Run] = []
    for path in campaigns:
        if not (path / "manifest.json").exists():
            raise CampaignFolderError(
                path, "is not a campaign folder", "name one that has a manifest.json"
            )
        name = path.resolve().name
        key = name if name not in [run.key for run in runs] else f"{name}-{len(runs) + 1}"
        run = Run(key, key, path)
        if not run.archives("excitation"):
            raise InputError(
                path, "holds no whole excitation", remedy="run the campaign first (hil run)"
            )
        runs.append(run)
    return _as_in_the_paper(runs)


def _as_in_the_paper(runs: list[Run]) -> list[Run]:
    """A and B first and so named, where just one campaign is of each method's excitation."""
    methods = [None if (e := _excitation(run)) is None else e.method for run in runs]
    if methods.count(A) != 1 or methods.count(B) != 1:
        return runs
    first = [
        Run(method, method.upper() + ("" if run.key == method else f" ({run.label})"), run.root)
        for method in (A, B)
        for run in [runs[methods.index(method)]]
    ]
    others = [run for run, method in zip(runs, methods, strict=True) if method not in (A, B)]
    return first + [
        Run(f"{run.key}-3", run.label, run.root) if run.key in (A, B) else run for run in others
    ]


def _first(run: Run) -> Path:
    return CampaignFolder(run.root).archives / run.archives("excitation")[0][0]


def _cell(run: Run) -> Cell:
    return cell_of(open_archive(_first(run)))


def _simulated(run: Run) -> bool:
    return open_archive(_first(run)).metadata.get("simulated") == "yes"


def _excitation(run: Run) -> Excitation | None:
    plan = json.loads(open_archive(_first(run)).attachments.get("plan.json", b"{}"))
    try:
        return Excitation.from_dict(plan["excitation"])
    except (KeyError, TypeError, ValueError):
        return None


def _row(run: Run, record: FitRecord) -> MotionRow:
    planned = _excitation(run)
    words = "not known" if planned is None else f"found by method {planned.method}"
    return MotionRow(
        key=run.key,
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


def _missing(runs: Sequence[Run], classes: Sequence[str]) -> list[str]:
    """What the recordings do not allow, in sentences."""
    found = [
        "Searches, fly-by share, K, λ and noise cannot be varied with recorded campaigns; only the "
        "number of repetitions is."
    ]
    if len(runs) < 2:
        found.append(
            "One campaign was given, so that nothing is compared: give another one of the same "
            "arm, with the other method's excitation (--campaign again)."
        )
    absent = [name for name in ("fly-by", "stop-to-stop", "sinusoid") if name not in classes]
    if absent:
        found.append(
            f"No held-out motion is {' or '.join(absent)}: these columns of the cross table are "
            "missing."
        )
    return found
