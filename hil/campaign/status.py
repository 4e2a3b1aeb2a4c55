"""Progress of a campaign with the next command, and its execution log for the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

from hil.archive import ArchiveName, open_archive
from hil.base.errors import HilError
from hil.base.safe_input import path_exists
from hil.base.terminal_text import plural, typed
from hil.cell import Cell
from hil.design.result import RESULT, DesignResult
from hil.results.results import ExecutionLogResult, PrecisionResult, Results, StepResult
from identification.text import percentage

from .dry_run_record import DryRunRecord
from .folder import PAYLOAD_RESULT, PAYLOADS, SIDES, CampaignFolder
from .joint_warm_up import WarmUpRecord, drift_wanted
from .precision_record import PrecisionRecord
from .rehearsal_messages import rehearsal_line
from .rehearsal_record import Rehearsal
from .state import CampaignState

State = Literal["done", "next", "blocked"]
NOT_REQUIRED: Final = "not required (warmup_drift)"


@dataclass(frozen=True)
class CampaignStep:
    """One step of a campaign.

    Attributes:
        state: done, next, or blocked by an earlier step.
        sentence: its result, or what is missing.
        command: to do it; "" for a step that is done, or for which there is no command.
        details: more sentences, for the report.
        warning: whether what follows was recorded in spite of it.
        name: of the step.
    """

    state: State
    sentence: str
    command: str = ""
    details: tuple[str, ...] = ()
    warning: bool = False
    name: str = ""

    @property
    def done(self) -> bool:
        """Whether it is done."""
        return self.state == "done"


@dataclass(frozen=True)
class CampaignStatus:
    """Progress of a campaign: its steps in order.

    Attributes:
        weighed: names of the payloads that it weighed.
        weighing: of those that it has begun to weigh, the last one first, each with the command
            that goes on.
        only_weighs: whether it has recordings of payloads and none of its own.
    """

    root: str
    plan_hash: str
    steps: tuple[CampaignStep, ...]
    weighed: tuple[str, ...] = ()
    weighing: tuple[tuple[str, str], ...] = ()
    only_weighs: bool = False

    @property
    def complete(self) -> bool:
        """Whether every step is done."""
        return all(step.done for step in self.steps)

    @property
    def next_command(self) -> str:
        """Command of the next step, or of a weighing that goes on; "" where there is none."""
        if self.only_weighs:
            return next((command for _, command in self.weighing), "")
        return next((step.command for step in self.steps if step.state == "next"), "")

    def to_dict(self) -> dict[str, Any]:
        """Return the status for JSON."""
        return asdict(self) | {"complete": self.complete, "next_command": self.next_command}


def status_of(campaign: CampaignState) -> CampaignStatus:
    """Return the progress of a campaign from the files in its folder; nothing is changed."""
    folder = replace(campaign.folder, digests={})
    again = "rehearse {} --again"
    campaign = replace(campaign, folder=folder)
    folder.manifest()  # one that cannot be read is an error of all steps
    at = typed(folder.root)
    # With the command that recreates the file of a step, should it be damaged: none does for the
    # cell or the plan of recordings, nor for an acceptance.
    evaluations: list[tuple[str, Callable[[], CampaignStep], str]] = [
        ("design", lambda: _design(campaign), ""),
        ("rehearse", lambda: _gate(campaign, _rehearsal(folder), folder.rehearsal), again),
        ("dry run", lambda: _gate(campaign, _dry_run(campaign), folder.dry_run), ""),
        ("warm-up", lambda: _warmed(campaign), ""),
        ("repetitions", lambda: _motions(campaign, "excitation", "repetitions"), ""),
        ("validation", lambda: _motions(campaign, "validation", "validation motions"), ""),
        ("identify", lambda: _identified(folder), "identify {}"),
        ("report", lambda: _reported(folder), "report {}"),
    ]
    steps: list[CampaignStep] = []
    first = ""
    for name, evaluate, repair in evaluations:
        step = replace(_step(evaluate, repair), name=name)
        if step.done:
            step = replace(step, command="")
        elif first:
            step = replace(step, state="blocked", sentence=f"{step.sentence}; waits for: {first}")
        first = first or ("" if step.done else name)
        command = f"hil {step.command.replace('{}', at)}" if step.command else ""
        steps.append(replace(step, command=command))
    weighed, weighing = _weighings(folder)
    return CampaignStatus(
        str(folder.root),
        folder.plan_hash,
        tuple(steps),
        weighed,
        weighing,
        only_weighs=bool(weighed or weighing) and not folder.manifest(),
    )


def _weighings(
    folder: CampaignFolder,
) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Return the payloads that were weighed, and the unfinished ones with their commands."""
    weighed = []
    weighing = []
    for payload in sorted((folder.root / PAYLOADS).glob("*"), key=lambda path: path.name):
        sides = [CampaignFolder(payload / side) for side in SIDES]
        if path_exists(payload / PAYLOAD_RESULT):
            weighed.append(payload.name)
        elif any(side.sealed for side in sides):
            weighing.append((payload.name, sides[1].run_command))
    return tuple(weighed), tuple(weighing)


def _step(evaluate: Callable[[], CampaignStep], repair: str = "") -> CampaignStep:
    try:
        return evaluate()
    except HilError as error:  # a damaged file of one step does not affect the others
        return CampaignStep("next", str(error).rstrip("."), repair)


def _design(campaign: CampaignState) -> CampaignStep:
    excitation = campaign.plan.excitation
    folder = campaign.folder
    if folder.manifest():  # before the first recording a rehearsal accepts changes
        folder.require_unchanged()
    motions = plural(len(campaign.plan.validation), "validation motion")
    return CampaignStep(
        "done", f"an excitation of {excitation.trajectory.duration:.1f} s and {motions}"
    )


def _rehearsal(folder: CampaignFolder) -> CampaignStep:
    rehearsal = Rehearsal.load(folder)
    if rehearsal is None:
        return CampaignStep("next", "not rehearsed on the simulated arm", "rehearse {}")
    if rehearsal.plan_hash != folder.plan_hash:
        message = "rehearsed with another cell, URDF or plan than it has now"
        return CampaignStep("next", message, "rehearse {}")
    return CampaignStep(
        "done" if rehearsal.passed else "next",
        rehearsal_line(rehearsal),
        "rehearse {}",
        (
            *(criterion.sentence for criterion in rehearsal.criteria),
            *(f"not detectable by it: {sentence}" for sentence in rehearsal.not_seen),
        ),
    )


def _dry_run(campaign: CampaignState) -> CampaignStep:
    folder = campaign.folder
    record = DryRunRecord.load_valid(
        folder,
        plan_hash=folder.plan_hash,
        motions=1 + len(campaign.plan.validation),
        simulated=campaign.cell.only_simulated,
    )
    if record is None and folder.dry_run.exists():
        problem = "of another plan or kind of arm, or its archives are missing"
        return CampaignStep("next", f"the recorded one is not valid: {problem}", "run {} --dry-run")
    return _accepted(record)


def _accepted(record: DryRunRecord | None) -> CampaignStep:
    if record is None:
        return CampaignStep(
            "next", "not done: every motion at 20 % of its speed", "run {} --dry-run"
        )
    if record.accepted is None:
        names = "".join(f" --accept-torque {joint}" for joint in record.against_gravity)
        but = "".join(f"; {warning}" for warning in record.warnings)
        message = f"done ({record.duration:.0f} s), but not accepted{but}"
        return CampaignStep("next", message, f"run {{}} --accept-dry-run{names}")
    shares = zip(record.joint_names, record.current_share, strict=True)
    currents = ", ".join(f"{joint} {percentage(share)}" for joint, share in shares)
    return CampaignStep(
        "done",
        f"accepted by {record.accepted.by} at {record.accepted.at}",
        details=(
            f"largest current, of its limit: {currents}",
            f"{plural(len(record.archives), 'motion')} at {percentage(record.override)} of their "
            "speed",
            f"{plural(record.missed, 'packet')} missed, {plural(record.late, 'reply')} late",
            *(f"{warning}; it was accepted by name" for warning in record.warnings),
        ),
    )


def _gate(campaign: CampaignState, step: CampaignStep, record: Path) -> CampaignStep:
    """Return a step, done if a simulated arm has left it out and run everything at full speed."""
    if step.done or record.exists() or not campaign.cell.only_simulated:
        return step
    if all(_motions(campaign, kind, kind).done for kind in ("excitation", "validation")):
        return CampaignStep("done", "skipped, as the arm is simulated")
    return step


def _warmed(campaign: CampaignState) -> CampaignStep:
    if not drift_wanted(campaign.cell):
        return CampaignStep("done", NOT_REQUIRED)
    warm = WarmUpRecord.load(campaign.folder.warmup, campaign.folder.plan_hash)
    if warm is None and _motions(campaign, "excitation", "repetitions").done:
        return CampaignStep("done", "left out")
    over = warm is not None and warm.outcome != "going on"
    return replace(_warm_up(warm), state="done" if over else "next")


def _warm_up(record: WarmUpRecord | None) -> CampaignStep:
    """Return the step for the report: done if the arm was warm."""
    if record is None:
        return CampaignStep("next", "not done", "run {}")
    message = f"{record.outcome} after {plural(len(record.motions), 'motion')}"
    cold = record.outcome == "not warm" and bool(record.motions)
    state: State = "done" if record.outcome == "warm" else "next"
    details = (record.sentence,) if cold else ()
    return CampaignStep(state, message, "run {}", details, warning=record.outcome == "not warm")


def _conducted_warm_up(folder: CampaignFolder) -> CampaignStep:
    """Return the step for the report: done if the arm was warm, or no warm-up was wanted."""
    warm = WarmUpRecord.load(folder.warmup, folder.plan_hash)
    if warm is None and not drift_wanted(Cell.load(folder.cell)):
        return CampaignStep("done", NOT_REQUIRED)
    return _warm_up(warm)


def _motions(campaign: CampaignState, kind: str, plural_kind: str) -> CampaignStep:
    whole, total = campaign.progress(kind)
    state: State = "done" if whole >= total else "next"
    precision = campaign.precision if kind == "excitation" else None
    details = () if precision is None else (precision.message,)
    return CampaignStep(state, f"{whole} of {total} {plural_kind} complete", "run {}", details)


def _identified(folder: CampaignFolder) -> CampaignStep:
    if not path_exists(folder.results):
        return CampaignStep("next", "not identified yet", "identify {}")
    results = Results.load(folder.results)
    used = {*results.repetitions, *(prediction.archive for prediction in results.validation)}
    kinds = ("excitation", "validation")
    new = [path.name for kind in kinds for path in folder.completed(kind) if path.name not in used]
    if new:
        message = f"identified without {len(new)} of the archives ({new[0]})"
        return CampaignStep("next", message, "identify {}")
    return CampaignStep("done", results.verdict.line)


def _reported(folder: CampaignFolder) -> CampaignStep:
    if not folder.report.exists():
        return CampaignStep("next", "no report yet", "report {}")
    written = folder.report.stat().st_mtime
    if folder.results.exists() and folder.results.stat().st_mtime > written + 1.0:
        return CampaignStep("next", "older than the results", "report {}")
    return CampaignStep("done", str(folder.report))


def execution_log_of(folder: CampaignFolder) -> ExecutionLogResult:
    """Return the execution log of a campaign by its files; an unreadable one is in its step.

    Raises:
        CampaignFolderError: the manifest cannot be read.
    """
    steps = {
        "rehearsal": _step(lambda: _rehearsal(folder)),
        "dry run": _step(lambda: _accepted(DryRunRecord.load(folder))),
        "warm-up": _step(lambda: _conducted_warm_up(folder)),
        "repetitions": _recorded(folder, "excitation"),
        "validation": _recorded(folder, "validation"),
    }
    record = _precision(folder)
    if record is not None:
        repeated = steps["repetitions"]
        details = (*repeated.details, record.message)
        steps["repetitions"] = replace(repeated, details=details)
    return ExecutionLogResult(
        steps=[
            StepResult(
                step=name,
                done=step.done,
                words=step.sentence,
                details=[*step.details],
                warning=step.warning,
            )
            for name, step in steps.items()
        ],
        precision=[] if record is None else _over_repetitions(folder, record),
    )


def _precision(folder: CampaignFolder) -> PrecisionRecord | None:
    if not path_exists(folder.precision):
        return None
    record = PrecisionRecord.load(folder.precision, folder.plan_hash)
    return record if record is not None and record.looks else None


def _over_repetitions(folder: CampaignFolder, record: PrecisionRecord) -> list[PrecisionResult]:
    """Return each requirement over the repetitions, with what the design in the folder promised."""
    promised: dict[str, float] = {}
    if path_exists(folder.root / RESULT):
        for forecast in DesignResult.load(folder.root).data.get("precision", ()):
            promised[forecast["requirement"]] = forecast["half"] / forecast["wanted"]
    return [
        PrecisionResult(
            requirement=text,
            repetitions=[look.repetitions for look in record.looks],
            ratio=[look.reached[k].ratio for look in record.looks],
            worst=record.looks[-1].reached[k].worst,
            promised=promised.get(text),
        )
        for k, text in enumerate(record.requirements)
    ]


def _end_of_killed(path: Path) -> str:
    """Return how an archive ended that no program entered into the manifest."""
    try:
        outcome = open_archive(path).outcome
    except HilError:
        outcome = None
    if outcome is None:
        return "it was never closed: the program or the computer stopped"
    return f"the program ended before it checked the motion ({outcome.outcome}: {outcome.reason})"


def _recorded(folder: CampaignFolder, kind: str) -> CampaignStep:
    """Return how many motions of a kind are complete, with the reasons of the others."""
    entries = [entry for entry in folder.manifest() if entry.kind == kind]
    bad = [f"{e.name} {e.outcome}: {e.reason}" for e in entries if e.outcome != "completed"]
    good = len(entries) - len(bad)
    entered = {entry.name for entry in entries}
    names = sorted(path.name for path in folder.archives.glob("*.mcap") if path.name not in entered)
    for name in names:
        parsed = ArchiveName.parse(name)
        if parsed is not None and parsed.kind == kind:
            bad.append(f"{name} killed: {_end_of_killed(folder.archives / name)}")
    rejected = f"; {len(bad)} rejected or ended early" if bad else ""
    return CampaignStep(
        "done" if good else "next", f"{good} complete{rejected}", details=(*sorted(bad),)
    )
