"""Recorded campaigns as a study takes them: whose excitation each holds, and that they compare."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, foreign_json, open_archive
from hil.batch.keys import arm_digest
from hil.batch.trend_words import short_names
from hil.campaign import CampaignFolder, CampaignFolderError
from hil.cell import Cell
from hil.compare.gather import apart
from hil.errors import InputError
from hil.identify.sources import cell_of
from hil.identify.summary import planted_in
from identification.excitation import Excitation

from .analysis import Run, class_in, plan_in
from .designs import AP, B0, A, B
from .records import PLANTED

Array = NDArray[np.float64]

_METHODS: Final = (A, B, B0)
_RESERVED: Final = (*_METHODS, AP, PLANTED)
"""Keys that mean what an excitation was found by; no folder's name does."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """One campaign.

    Attributes:
        run: its folder under a key, which is "a", "b" or "b0" where no other one holds an
            excitation of that method, and never otherwise.
        cell: as it travels in its archives.
        excitation: as it was planned, if that is known.
        simulated: whether no robot moved.
        effects: what its simulated arm did that the model leaves out, in words.
        planted: parameters (p,) of its simulated arm; None of a real one.
    """

    run: Run
    cell: Cell
    excitation: Excitation | None
    simulated: bool
    effects: tuple[str, ...]
    planted: Array | None


def recorded_runs(campaigns: Sequence[Path]) -> list[Recorded]:
    """The campaigns; those of method A, B, and B with fly 0 first, where there is just one of each.

    Raises:
        InputError: a folder is no campaign, is named twice, holds no whole excitation, or is of
            another arm than the first, or of one that behaves otherwise.
    """
    folders = [path.resolve() for path in campaigns]
    runs = []
    for path, label in zip(folders, short_names([str(one) for one in folders]), strict=True):
        if not (path / "manifest.json").exists():
            raise CampaignFolderError(
                path, "is not a campaign folder", "name one that has a manifest.json"
            )
        if folders.count(path) > 1:
            raise InputError(path, "is named twice", remedy="name each campaign once")
        key = label.replace("/", "-")
        run = Run(f"campaign-{key}" if key in _RESERVED else key, label, path)
        if not run.archives("excitation"):
            raise InputError(
                path, "holds no whole excitation", remedy="run the campaign first (hil run)"
            )
        runs.append(run)
    archives = [_first(run, "excitation") for run in runs]
    _require_one_arm(runs, archives)
    found = [_recorded(run, archive) for run, archive in zip(runs, archives, strict=True)]
    _require_one_behaviour(found)
    return _as_in_the_paper(found, [_method(archive) for archive in archives])


def homes(runs: Sequence[Run]) -> list[Run]:
    """Campaigns that ran the same held-out motions as another one; none where each has its own.

    Two campaigns of one cell are asked to predict the same motions. An estimate is then at home on
    one run of them, in the state that the arm was in, and a guest on the other.
    """
    plans = {run.key: _motions(run) for run in runs}
    every = [motion for own in plans.values() for motion in own]
    shared = len(every) > len(set(every))
    return [run for run in runs if plans[run.key]] if shared else []


def _motions(run: Run) -> set[str]:
    """Digests of the planned motions that a campaign holds out."""
    folder = CampaignFolder(run.root)
    plans = (
        open_archive(folder.archives / name, fields=()).attachments.get("plan.json")
        for name, _ in run.archives("validation")
    )
    return {hashlib.sha256(plan).hexdigest() for plan in plans if plan is not None}


def _first(run: Run, kind: str) -> Archive:
    return open_archive(CampaignFolder(run.root).archives / run.archives(kind)[0][0])


def _recorded(run: Run, archive: Archive) -> Recorded:
    cell, simulated = cell_of(archive), archive.metadata.get("simulated") == "yes"
    return Recorded(
        run=run,
        cell=cell,
        excitation=_excitation(archive),
        simulated=simulated,
        effects=foreign_json.names(archive.metadata.get("effects", "[]")) or (),
        planted=planted_in(cell, archive.metadata) if simulated else None,
    )


def _excitation(archive: Archive) -> Excitation | None:
    try:
        return Excitation.from_dict(plan_in(archive)["excitation"])
    except (KeyError, TypeError, ValueError):
        return None


def _method(archive: Archive) -> str:
    """Which of the paper's three excitations it is; "" if that is not known."""
    excitation = _excitation(archive)
    if excitation is None or excitation.method not in (A, B):
        return ""
    stops = excitation.method == B and class_in(archive) == "stop-to-stop"
    return B0 if stops else excitation.method


def _as_in_the_paper(found: list[Recorded], methods: list[str]) -> list[Recorded]:
    """A, B, and B with fly 0 first and so named, where just one campaign is of each."""
    single = [method for method in _METHODS if methods.count(method) == 1]
    named = {method: found[methods.index(method)] for method in single}
    if not {A, B} <= named.keys():
        return found
    words = {A: "A", B: "B", B0: "B, fly 0"}
    first = [
        replace(one, run=replace(one.run, key=method, label=f"{words[method]} ({one.run.label})"))
        for method, one in named.items()
    ]
    return first + [one for one in found if all(one is not taken for taken in named.values())]


def _require_one_arm(runs: Sequence[Run], archives: Sequence[Archive]) -> None:
    """As `hil compare` does: another drive train is another arm, and so is a simulated one."""
    digests = [
        arm_digest(
            cell_of(one),
            one.attachments.get("drive_train.json"),
            simulated=one.metadata.get("simulated") == "yes",
        )
        for one in archives
    ]
    for run, archive, digest in zip(runs, archives, digests, strict=True):
        if digest != digests[0]:
            differ = apart(cell_of(archive), cell_of(archives[0]))
            problem = f"is of another arm than {runs[0].root}: {differ}"
            raise InputError(run.root, problem, remedy="name campaigns of one arm")


def _require_one_behaviour(found: Sequence[Recorded]) -> None:
    first = found[0]
    for one in found[1:]:
        if one.effects != first.effects:
            told, other = ("; ".join(each.effects) or "none" for each in (one, first))
            raise InputError(
                one.run.root,
                f"was simulated with other unmodelled effects ({told}) than {first.run.root}"
                f" ({other}): what differs would be the arm, and not the excitation",
                remedy="name campaigns that were simulated alike",
            )
