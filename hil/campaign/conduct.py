"""How a campaign was run, read from its folder: for a reader who was not there."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

from hil.archive import ArchiveName, ArchiveOutcome, open_archive
from hil.errors import ArchiveError, HilError
from hil.results import ConductResult, RecordedResult, StepResult, WarmUpResult
from hil.terminal_text import plural

from .dry_run import DryRun
from .folder import CampaignFolder, Entry
from .rehearsal import Rehearsal
from .warmup import WarmUp

T = TypeVar("T")


def conduct_of(folder: CampaignFolder) -> ConductResult:
    """What rehearsal, dry run, warm-up and archives of a folder say; nothing is changed.

    A file that cannot be read is reported in its step's words.

    Raises:
        CampaignFolderError: the manifest cannot be read.
    """
    recorded = [one for one in (_recorded(folder, entry) for entry in folder.manifest()) if one]
    warm = _tolerant(lambda: WarmUp.load(folder.warmup, folder.plan_hash))
    return ConductResult(
        steps=[
            _rehearsed(folder),
            _dry_run(folder),
            _warmed(warm),
            _motions(recorded, "excitation", "repetitions"),
            _motions(recorded, "validation", "validation"),
        ],
        warm_up=None if isinstance(warm, str) or warm is None else _warm_up(warm),
        recorded=recorded,
    )


def _rehearsed(folder: CampaignFolder) -> StepResult:
    found = _tolerant(lambda: Rehearsal.load(folder))
    name = "rehearsal"
    if isinstance(found, str):
        return StepResult(step=name, done=False, words=found, details=[])
    if found is None:
        words = "none on record"
        return StepResult(step=name, done=False, words=words, details=[])
    if found.plan_hash != folder.plan_hash:
        words = "of another cell, URDF or plan than was run"
        return StepResult(step=name, done=False, words=words, details=[])
    passed = sum(one.passed for one in found.criteria)
    words = f"{passed} of {len(found.criteria)} criteria passed on the simulated arm"
    details = [] if found.warning is None else [found.warning]
    details += [one.sentence for one in found.criteria]
    details += [f"not seen by it: {sentence}" for sentence in found.not_seen]
    return StepResult(step=name, done=found.passed, words=words, details=details)


def _dry_run(folder: CampaignFolder) -> StepResult:
    found = _tolerant(lambda: DryRun.load(folder))
    name = "dry run"
    if isinstance(found, str):
        return StepResult(step=name, done=False, words=found, details=[])
    if found is None:
        return StepResult(step=name, done=False, words="none of this plan on record", details=[])
    words = f"{plural(len(found.archives), 'motion')} at {found.override:.0%} of their speed"
    if found.accepted is None:
        return StepResult(step=name, done=False, words=f"{words}, not accepted", details=[])
    currents = ", ".join(
        f"{joint} {share:.0%}"
        for joint, share in zip(found.joint_names, found.current_share, strict=True)
    )
    return StepResult(
        step=name,
        done=True,
        words=f"{words}, accepted by {found.accepted.by} at {found.accepted.at}",
        details=[
            f"largest current, of its limit: {currents}",
            f"{plural(found.missed, 'packet')} missed, {plural(found.late, 'answer')} late",
            *(f"{warning}; it was accepted by name" for warning in found.warnings),
        ],
    )


def _warmed(found: WarmUp | str | None) -> StepResult:
    name = "warm-up"
    if found is None or isinstance(found, str):
        return StepResult(step=name, done=False, words=found or "none", details=[])
    details = [_lost(len(found.earlier))] if found.earlier else []
    if found.outcome == "not warm":
        details.append(_drifting(found))
    return StepResult(
        step=name,
        done=found.outcome == "warm",
        words=f"{found.outcome} after {plural(len(found.motions), 'motion')}",
        details=details,
    )


def _lost(motions: int) -> str:
    return f"{plural(motions, 'motion')} before {'was' if motions == 1 else 'were'} lost in a pause"


def _drifting(found: WarmUp) -> str:
    """What a reader of the results must know of an arm that was not warm."""
    change = float(found.curve.change[-1]) if found.motions else math.nan
    left = (
        f"friction still changed by {change:.2%} a motion"
        if math.isfinite(change)
        else ("no joint moved enough to tell its friction")
    )
    return (
        f"{left}; below {found.threshold:.2%} was wanted, so the repetitions were begun while it "
        "may have drifted, and what is estimated is its mean over them"
    )


def _motions(recorded: list[RecordedResult], kind: str, words: str) -> StepResult:
    own = [one for one in recorded if one.kind == kind]
    good = [one for one in own if one.outcome == "completed"]
    bad = len(own) - len(good)
    seconds = sum(one.seconds for one in good)
    text = f"{len(good)} whole, {seconds:.0f} s of motion"
    if bad:
        text += f"; {bad} rejected or ended early, and run again"
    return StepResult(step=words, done=bool(good), words=text, details=[])


def _warm_up(found: WarmUp) -> WarmUpResult:
    return WarmUpResult(
        verdict=found.outcome,
        threshold=found.threshold,
        friction=[list(one.friction) for one in found.motions],
        change=[float(c) if math.isfinite(c) else None for c in found.curve.change],
    )


def _recorded(folder: CampaignFolder, entry: Entry) -> RecordedResult | None:
    """What an archive says of its motion; None of one that is gone or cannot be read."""
    name = ArchiveName.parse(entry.name)
    try:
        archive = open_archive(folder.archives / entry.name, fields=())
    except ArchiveError:
        return None
    stamp, outcome = archive.columns["stamp"], archive.outcome or ArchiveOutcome()
    return RecordedResult(
        archive=entry.name,
        kind=archive.kind if name is None else name.kind,
        when=archive.header.recorded_at,
        seconds=float(stamp[-1] - stamp[0]) * 1e-9 if len(stamp) else 0.0,
        cycles=archive.n_samples,
        missed=outcome.lost_packets or 0,
        late=outcome.late_replies or 0,
        not_accepted=outcome.replies_not_accepted or 0,
        lost=outcome.records_lost or 0,
        outcome=entry.outcome,
        why=entry.reason or ("" if entry.outcome == "completed" else outcome.reason),
    )


def _tolerant(load: Callable[[], T]) -> T | str:
    """What is loaded, or in words why it cannot be."""
    try:
        return load()
    except HilError as error:
        return str(error)
