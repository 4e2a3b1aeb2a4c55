"""Where a campaign stands and what to type next; how it was run, for a reader who was not there."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar

from hil.archive import ArchiveName, ArchiveOutcome, open_archive
from hil.errors import ArchiveError, HilError
from hil.reading import lies_there
from hil.results import ConductResult, RecordedResult, Results, StepResult, WarmUpResult
from hil.terminal_text import plural

from .dry_run import DryRun
from .folder import CampaignFolder, Entry
from .intervals import wanted
from .rehearsal import Rehearsal
from .warmup import WarmUp, drift_wanted

if TYPE_CHECKING:
    from .campaign import Campaign

T = TypeVar("T")
State = Literal["done", "next", "blocked"]

_WANTED: Final = ("standstill", "excitation", "validation", "dryrun")
"""Kinds of motion that a campaign cannot do without."""


@dataclass(frozen=True)
class Step:
    """One step of a campaign.

    Attributes:
        name: "design", "rehearse", "dry run", "warm-up", "repetitions", "validation", "identify"
            or "report".
        state: whether it is done, is to be done next, or waits for one before it.
        sentence: what is known of it.
        command: what to type for it; "" for what is done, and where no command helps (the
            sentence then says what does).
    """

    name: str
    state: State
    sentence: str
    command: str = ""


@dataclass(frozen=True)
class CampaignStatus:
    """Where a campaign stands.

    Attributes:
        root: its folder.
        plan_hash: of cell, URDF and plan as they lie there.
        steps: in the order in which they are done.
        notes: archives that are torn, damaged or rejected, and why, in sentences.
    """

    root: str
    plan_hash: str
    steps: tuple[Step, ...]
    notes: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether every step is done."""
        return all(step.state == "done" for step in self.steps)

    @property
    def next_command(self) -> str:
        """What to type next; "" where nothing is left to do, or where no command helps."""
        return next((step.command for step in self.steps if step.state == "next"), "")

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self) | {"complete": self.complete, "next_command": self.next_command}


@dataclass(frozen=True)
class _Found:
    """What is known of a step by itself: whether it is done, in words, and how to do it."""

    done: bool
    sentence: str
    command: str


_LEFT_OUT = _Found(True, "left out, as a simulated arm allows", "")


def status_of(campaign: Campaign) -> CampaignStatus:
    """Look at what lies in a campaign's folder; nothing is changed.

    Raises:
        CampaignFolderError: its manifest cannot be read.
    """
    folder = campaign.folder
    at = _quoted(folder)
    # With what makes the file of a step anew, should it be damaged: nothing makes up for the cell
    # or the plan of recordings, nor for what a person saw.
    looks: list[tuple[str, Callable[[], _Found], str]] = [
        ("design", lambda: _design(campaign), ""),
        ("rehearse", lambda: _rehearsal(campaign), f"hil rehearse {at} --again"),
        ("dry run", lambda: _dry_run(campaign), ""),
        ("warm-up", lambda: _warm_up(campaign), ""),
        ("repetitions", lambda: _motions(campaign, "excitation", "repetitions"), ""),
        ("validation", lambda: _motions(campaign, "validation", "validation motions"), ""),
        ("identify", lambda: _identified(folder), f"hil identify {at}"),
        ("report", lambda: _reported(folder), f"hil report {at}"),
    ]
    steps: list[Step] = []
    waits_for = ""
    for name, look, mend in looks:
        found = _looked(look, mend)
        if found.done:
            steps.append(Step(name, "done", found.sentence))
        elif not waits_for:
            waits_for = name
            steps.append(Step(name, "next", found.sentence, found.command))
        else:
            sentence = f"{found.sentence}; waits for: {waits_for}"
            steps.append(Step(name, "blocked", sentence, found.command))
    return CampaignStatus(str(folder.root), folder.plan_hash, tuple(steps), _notes(folder))


def _looked(look: Callable[[], _Found], mend: str) -> _Found:
    try:
        return look()
    except HilError as error:  # a file of one step says nothing of the others
        return _Found(False, str(error).rstrip("."), mend)


def _design(campaign: Campaign) -> _Found:
    excitation, folder = campaign.plan.excitation, campaign.folder
    sentence = (
        f"an excitation of {excitation.trajectory.duration:.1f} s and "
        f"{plural(len(campaign.plan.validation), 'validation motion')}"
    )
    if folder.manifest():  # until something is recorded, a rehearsal takes changes in
        folder.require_unchanged()
    return _Found(True, sentence, "")


def _rehearsal(campaign: Campaign) -> _Found:
    folder = campaign.folder
    command = f"hil rehearse {_quoted(folder)}"
    found = Rehearsal.load(folder)
    if found is None and _left_out(campaign):
        return _LEFT_OUT
    if found is None:
        return _Found(False, "not rehearsed on the simulated arm yet", command)
    if not found.covers(folder, folder.plan_hash):
        sentence = "rehearsed with another cell, URDF or plan than it has now"
        return _Found(False, sentence, command)
    if not found.passed:
        return _Found(False, found.line, command)
    but = "" if found.warning is None else f"; {found.warning}"
    return _Found(True, f"passed all {len(found.criteria)} criteria{but}", "")


def _dry_run(campaign: Campaign) -> _Found:
    folder, simulated = campaign.folder, campaign.cell.only_simulated
    found = DryRun.that_counts(
        folder,
        plan_hash=folder.plan_hash,
        motions=1 + len(campaign.plan.validation),
        simulated=simulated,
    )
    command = f"hil run {_quoted(folder)} --dry-run"
    if found is None:
        if folder.dry_run.exists():
            was = "of another plan, of another kind of arm, or its archives are gone"
            return _Found(False, f"the one on record does not count: it is {was}", command)
        if _left_out(campaign):
            return _LEFT_OUT
        return _Found(False, "not done: every motion at a fifth of its speed", command)
    if found.accepted is None:
        accept = f"hil run {_quoted(folder)} --accept-dry-run"
        names = "".join(f" --accept-torque {joint}" for joint in found.against_gravity)
        but = "".join(f"; {warning}" for warning in found.warnings)
        words = f"done ({found.duration:.0f} s), but not accepted{but}"
        return _Found(False, words, accept + names)
    return _Found(True, f"accepted by {found.accepted.by}, {found.accepted.at}", "")


def _left_out(campaign: Campaign) -> bool:
    """Whether a simulated arm has done all at full speed, so that no gate is left to pass."""
    kinds = ("excitation", "validation")
    return campaign.cell.only_simulated and all(_motions(campaign, k, k).done for k in kinds)


def _warm_up(campaign: Campaign) -> _Found:
    folder = campaign.folder
    if not drift_wanted(campaign.cell):
        return _Found(True, "none wanted (warmup_drift)", "")
    found = WarmUp.load(folder.warmup, folder.plan_hash)
    if found is None:
        if _motions(campaign, "excitation", "repetitions").done:
            return _Found(True, "left out", "")
        return _Found(False, "not done", f"hil run {_quoted(folder)}")
    done = found.outcome != "going on"
    words = f"{found.outcome} after {plural(len(found.motions), 'motion')}"
    return _Found(done, words, f"hil run {_quoted(folder)}")


def _motions(campaign: Campaign, kind: str, words: str) -> _Found:
    folder = campaign.folder
    total = sum(one.kind == kind for one in wanted(campaign.cell, campaign.plan))
    whole = len(folder.completed(kind))
    return _Found(whole >= total, f"{whole} of {total} {words} whole", f"hil run {_quoted(folder)}")


def _identified(folder: CampaignFolder) -> _Found:
    command = f"hil identify {_quoted(folder)}"
    if not lies_there(folder.results):
        return _Found(False, "not identified yet", command)
    results = Results.load(folder.results)
    used = {*results.repetitions, *(one.archive for one in results.validation)}
    kinds = ("excitation", "validation")
    new = [path.name for kind in kinds for path in folder.completed(kind) if path.name not in used]
    if new:
        return _Found(False, f"identified without {len(new)} of the archives ({new[0]})", command)
    return _Found(True, results.verdict.line, "")


def _reported(folder: CampaignFolder) -> _Found:
    command = f"hil report {_quoted(folder)}"
    if not folder.report.exists():
        return _Found(False, "no report yet", command)
    if (
        folder.results.exists()
        and folder.results.stat().st_mtime > folder.report.stat().st_mtime + 1.0
    ):
        return _Found(False, "older than the results", command)
    return _Found(True, str(folder.report), "")


def _quoted(folder: CampaignFolder) -> str:
    """The folder as a shell takes it."""
    return shlex.quote(str(folder.root))


def _notes(folder: CampaignFolder) -> tuple[str, ...]:
    """Archives that are of no use, and why."""
    entries = folder.manifest()
    known = {entry.name for entry in entries}
    there = sorted(path.name for path in folder.archives.glob("*.mcap"))
    torn = [_left_behind(folder, name) for name in there if name not in known]
    busy = ("a run or a rehearsal is at work on it now",) if folder.busy else ()
    return (*busy, *folder.damaged(), *torn, *filter(None, map(_of_no_use, entries)))


def _left_behind(folder: CampaignFolder, name: str) -> str:
    """What becomes of an archive that its run had no time to enter."""
    left = f"{name} was left by a run that was killed"
    parsed = ArchiveName.parse(name)
    if (
        parsed is None
        or parsed.kind not in _WANTED
        or folder.whole(parsed.kind, parsed.index) is not None
    ):
        return f"{left}; nothing is missing without it"
    return f"{left}: used if it is whole, its motion run again if not"


def _of_no_use(entry: Entry) -> str:
    if entry.outcome == "completed":
        return ""
    return f"{entry.name} is {entry.outcome}" + (f": {entry.reason}" if entry.reason else "")


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
            _dry_run_of(folder),
            _warmed(warm),
            _recorded_motions(recorded, "excitation", "repetitions"),
            _recorded_motions(recorded, "validation", "validation"),
        ],
        warm_up=None if isinstance(warm, str) or warm is None else _warm_up_of(warm),
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


def _dry_run_of(folder: CampaignFolder) -> StepResult:
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


def _recorded_motions(recorded: list[RecordedResult], kind: str, words: str) -> StepResult:
    own = [one for one in recorded if one.kind == kind]
    good = [one for one in own if one.outcome == "completed"]
    bad = len(own) - len(good)
    seconds = sum(one.seconds for one in good)
    text = f"{len(good)} whole, {seconds:.0f} s of motion"
    if bad:
        text += f"; {bad} rejected or ended early, and run again"
    return StepResult(step=words, done=bool(good), words=text, details=[])


def _warm_up_of(found: WarmUp) -> WarmUpResult:
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
