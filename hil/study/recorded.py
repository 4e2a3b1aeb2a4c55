"""A study of recorded campaigns of one arm: what of the paper's figures they allow."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, open_archive
from hil.batch.cache import arm_digest
from hil.campaign import CampaignFolderError
from hil.cell import Cell
from hil.compare.gather import apart
from hil.compare.trend import short_names
from hil.errors import InputError
from hil.identify.sources import cell_of
from hil.identify.summary import planted_in
from hil.io import digest
from hil.progress import Reporter
from identification.excitation import Excitation

from .campaigns import workers_of
from .page import write_outcome
from .records import (
    CLASSES,
    PLANTED,
    FitRecord,
    Run,
    ScoreRecord,
    class_in,
    fit_all,
    plan_in,
    score_all,
)
from .results import MotionRow, StudyResults, study_results
from .searches import AP, B0, LABELS, A, B
from .settings import StudyFolder
from .tables import (
    Condition,
    Evidence,
    condition_result,
    estimates_of,
    parameters_of,
    printed_rows,
    repetition_ablation,
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
    def method(self) -> str:
        """Which of the paper's three excitations it is; "" if that is not known."""
        if self.excitation is None or self.excitation.method not in (A, B):
            return ""
        stops = self.excitation.method == B and class_in(self.archive) == "stop-to-stop"
        return B0 if stops else self.excitation.method

    @property
    def arm(self) -> str:
        """Digest of the arm: another drive train is another arm, and so is a simulated one."""
        drive_train = self.archive.attachments.get("drive_train.json")
        return arm_digest(self.cell, drive_train, simulated=self.archive.header.only_simulated)

    def row(self, record: FitRecord) -> MotionRow:
        """Row of Table 1."""
        one = self.excitation
        planned = record if one is None else one.criteria
        return MotionRow(
            key=self.run.key,
            words="not known" if one is None else f"found by method {one.method}",
            n_samples=record.n_samples,
            log10_det=planned.log10_det,
            coupling_index=planned.coupling_index,
            executed_log10_det=record.log10_det,
            executed_coupling_index=record.coupling_index,
            duration=record.duration,
        )


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
        InputError: a folder is no campaign, holds no whole excitation, or is of another arm, or
            of one that was simulated otherwise.
    """
    begin = time.perf_counter()
    folder, recorded = StudyFolder(root), recorded_runs(campaigns)
    header = recorded[0].archive.header
    runs, first = [one.run for one in recorded], recorded[0]
    keys, labels, cell = [run.key for run in runs], {run.key: run.label for run in runs}, first.cell
    planted = [values for one in recorded if (values := one.planted) is not None]
    same = len(planted) == len(recorded) and all(np.array_equal(p, planted[0]) for p in planted)
    truth = planted[0] if same else None
    with folder.locked(), workers_of(workers) as processes:
        fits = fit_all(runs, folder.fits, reporter, processes)
        estimates = estimates_of(fits)

        def scored(some: Sequence[Run]) -> dict[str, ScoreRecord]:
            return score_all(some, folder.fits, estimates, keys[:2], reporter, processes)

        parameters, effects = parameters_of(cell, truth), header.effects
        conditions = [
            (
                Condition(f"recorded-{one.key}", f"on the motions of {one.label}", effects),
                scored([one]),
            )
            for one in homes(runs)
        ] or [(Condition("recorded", "as recorded", effects), scored(runs))]
        scores = [some for _, some in conditions]
        results = study_results(
            root,
            cell,
            parameters,
            simulated=header.only_simulated,
            quick=False,
            settings=None,
            searches=[],
            table1=[one.row(fits[one.run.key]) for one in recorded] + printed_rows(cell),
            conditions=[
                condition_result(one, labels, fits, some, parameters, cell.joint_names)
                for one, some in conditions
            ],
            ablations=[repetition_ablation(Evidence({}, fits, scores, truth), SUBSETS, keys)],
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
        if not run.archives("excitation"):
            raise InputError(
                path, "holds no whole excitation", remedy="run the campaign first (hil run)"
            )
        name, _ = run.archives("excitation")[0]
        found.append(Recorded(run, open_archive(run.folder.archives / name)))
    for one in found[1:]:
        _require_alike(one, found[0])
    methods = {
        one.method: one
        for one in found
        if one.method and [each.method for each in found].count(one.method) == 1
    }
    if not {A, B} <= methods.keys():
        return found
    named = [
        replace(one, run=replace(one.run, key=key, label=f"{LABELS[key]} ({one.run.label})"))
        for key, one in ((key, methods[key]) for key in (A, B, B0) if key in methods)
    ]
    return named + [one for one in found if methods.get(one.method) is not one]


def _require_alike(one: Recorded, first: Recorded) -> None:
    """One arm, as `hil compare` requires it, and one behaviour of a simulated arm."""
    if one.arm != first.arm:
        problem = f"is of another arm than {first.run.root}: {apart(one.cell, first.cell)}"
        raise InputError(one.run.root, problem, remedy="name campaigns of one arm")
    effects = [each.archive.header.effects for each in (one, first)]
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
        paths = [run.folder.archives / name for name, _ in run.archives("validation")]
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
