"""Progress of a campaign with the next command, and its execution log for the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from hil.archive import ArchiveName, open_archive
from hil.base.errors import HilError
from hil.base.safe_input import path_exists
from hil.base.terminal_text import typed
from hil.cell import Cell
from hil.design.result import RESULT, DesignResult
from hil.results.results import ExecutionLogResult, PrecisionResult, Results, StepResult

from .campaign_steps import (
    DesignedPlan,
    DryRunDone,
    EndedRecording,
    Identified,
    MadeRecordings,
    NoDryRun,
    NoReport,
    NotIdentified,
    NotRehearsed,
    NoWarmUp,
    PlannedRecordings,
    Rehearsed,
    RepeatedKind,
    Reported,
    SkippedStep,
    StepOutcome,
    UnreadableStep,
    WarmUpDone,
)
from .dry_run_record import DryRunRecord
from .folder import PAYLOAD_RESULT, PAYLOADS, SIDES, CampaignFolder
from .joint_warm_up import WarmUpRecord, drift_wanted
from .precision_record import PrecisionRecord
from .rehearsal_record import Rehearsal
from .state import CampaignState
from .status_messages import step_details, step_line

State = Literal["done", "next", "blocked"]


@dataclass(frozen=True)
class CampaignStep:
    """One step of a campaign.

    Attributes:
        state: done, next, or blocked by an earlier step.
        found: its result, or what is missing.
        command: to do it; "" for a step that is done, or for which there is no command.
        warning: whether what follows was recorded in spite of it.
        name: of the step.
        waits_for: the step that blocks it; "" if none does.
    """

    state: State
    found: StepOutcome
    command: str = ""
    warning: bool = False
    name: str = ""
    waits_for: str = ""

    @property
    def done(self) -> bool:
        """Whether it is done."""
        return self.state == "done"

    @property
    def sentence(self) -> str:
        """Its result, or what is missing, in words."""
        waits = f"; waits for: {self.waits_for}" if self.waits_for else ""
        return f"{step_line(self.found)}{waits}"

    @property
    def details(self) -> tuple[str, ...]:
        """More sentences, for the report."""
        return tuple(step_details(self.found))

    def to_dict(self) -> dict[str, Any]:
        """Return the step for JSON."""
        return {
            "state": self.state,
            "sentence": self.sentence,
            "command": self.command,
            "details": self.details,
            "warning": self.warning,
            "name": self.name,
        }


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
        return {
            "root": self.root,
            "plan_hash": self.plan_hash,
            "steps": [step.to_dict() for step in self.steps],
            "weighed": self.weighed,
            "weighing": self.weighing,
            "only_weighs": self.only_weighs,
            "complete": self.complete,
            "next_command": self.next_command,
        }


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
        ("repetitions", lambda: _motions(campaign, "excitation"), ""),
        ("validation", lambda: _motions(campaign, "validation"), ""),
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
            step = replace(step, state="blocked", waits_for=first)
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
        return CampaignStep("next", UnreadableStep(str(error)), repair)


def _design(campaign: CampaignState) -> CampaignStep:
    excitation = campaign.plan.excitation
    folder = campaign.folder
    if folder.manifest():  # before the first recording a rehearsal accepts changes
        folder.require_unchanged()
    found = DesignedPlan(excitation.trajectory.duration, len(campaign.plan.validation))
    return CampaignStep("done", found)


def _rehearsal(folder: CampaignFolder) -> CampaignStep:
    rehearsal = Rehearsal.load(folder)
    if rehearsal is None:
        return CampaignStep("next", NotRehearsed(is_of_another_plan=False), "rehearse {}")
    if rehearsal.plan_hash != folder.plan_hash:
        return CampaignStep("next", NotRehearsed(is_of_another_plan=True), "rehearse {}")
    state: State = "done" if rehearsal.passed else "next"
    return CampaignStep(state, Rehearsed(rehearsal), "rehearse {}")


def _dry_run(campaign: CampaignState) -> CampaignStep:
    folder = campaign.folder
    record = DryRunRecord.load_valid(
        folder,
        plan_hash=folder.plan_hash,
        motions=1 + len(campaign.plan.validation),
        simulated=campaign.cell.only_simulated,
    )
    if record is None and folder.dry_run.exists():
        return CampaignStep("next", NoDryRun(is_invalid=True), "run {} --dry-run")
    return _accepted(record)


def _accepted(record: DryRunRecord | None) -> CampaignStep:
    if record is None:
        return CampaignStep("next", NoDryRun(), "run {} --dry-run")
    if record.accepted is None:
        names = "".join(f" --accept-torque {joint}" for joint in record.against_gravity)
        return CampaignStep("next", DryRunDone(record), f"run {{}} --accept-dry-run{names}")
    return CampaignStep("done", DryRunDone(record))


def _gate(campaign: CampaignState, step: CampaignStep, record: Path) -> CampaignStep:
    """Return a step, done if a simulated arm has left it out and run everything at full speed."""
    if step.done or record.exists() or not campaign.cell.only_simulated:
        return step
    if all(_motions(campaign, kind).done for kind in get_args(RepeatedKind)):
        return CampaignStep("done", SkippedStep(as_simulated=True))
    return step


def _warmed(campaign: CampaignState) -> CampaignStep:
    if not drift_wanted(campaign.cell):
        return CampaignStep("done", NoWarmUp(is_required=False))
    warm = WarmUpRecord.load(campaign.folder.warmup, campaign.folder.plan_hash)
    if warm is None and _motions(campaign, "excitation").done:
        return CampaignStep("done", SkippedStep(as_simulated=False))
    over = warm is not None and warm.outcome != "going on"
    return replace(_warm_up(warm), state="done" if over else "next")


def _warm_up(record: WarmUpRecord | None) -> CampaignStep:
    """Return the step for the report: done if the arm was warm."""
    if record is None:
        return CampaignStep("next", NoWarmUp(is_required=True), "run {}")
    state: State = "done" if record.outcome == "warm" else "next"
    is_cold = record.outcome == "not warm"
    return CampaignStep(state, WarmUpDone(record), "run {}", warning=is_cold)


def _conducted_warm_up(folder: CampaignFolder) -> CampaignStep:
    """Return the step for the report: done if the arm was warm, or no warm-up was wanted."""
    warm = WarmUpRecord.load(folder.warmup, folder.plan_hash)
    if warm is None and not drift_wanted(Cell.load(folder.cell)):
        return CampaignStep("done", NoWarmUp(is_required=False))
    return _warm_up(warm)


def _motions(campaign: CampaignState, kind: RepeatedKind) -> CampaignStep:
    whole, total = campaign.progress(kind)
    state: State = "done" if whole >= total else "next"
    precision = campaign.precision if kind == "excitation" else None
    return CampaignStep(state, PlannedRecordings(kind, whole, total, precision), "run {}")


def _identified(folder: CampaignFolder) -> CampaignStep:
    if not path_exists(folder.results):
        return CampaignStep("next", NotIdentified(), "identify {}")
    results = Results.load(folder.results)
    used = {*results.repetitions, *(prediction.archive for prediction in results.validation)}
    kinds = ("excitation", "validation")
    names = [path.name for kind in kinds for path in folder.completed(kind)]
    if new := tuple(name for name in names if name not in used):
        return CampaignStep("next", NotIdentified(new), "identify {}")
    return CampaignStep("done", Identified(results.verdict.line))


def _reported(folder: CampaignFolder) -> CampaignStep:
    if not folder.report.exists():
        return CampaignStep("next", NoReport(is_outdated=False), "report {}")
    written = folder.report.stat().st_mtime
    if folder.results.exists() and folder.results.stat().st_mtime > written + 1.0:
        return CampaignStep("next", NoReport(is_outdated=True), "report {}")
    return CampaignStep("done", Reported(folder.report))


def execution_log_of(folder: CampaignFolder) -> ExecutionLogResult:
    """Return the execution log of a campaign by its files; an unreadable one is in its step.

    Raises:
        CampaignFolderError: the manifest cannot be read.
    """
    record = _precision(folder)
    steps = {
        "rehearsal": _step(lambda: _rehearsal(folder)),
        "dry run": _step(lambda: _accepted(DryRunRecord.load(folder))),
        "warm-up": _step(lambda: _conducted_warm_up(folder)),
        "repetitions": _recorded(folder, "excitation", record),
        "validation": _recorded(folder, "validation"),
    }
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


def _killed(path: Path) -> EndedRecording:
    """Return a recording that no program entered into the manifest."""
    try:
        outcome = open_archive(path).outcome
    except HilError:
        outcome = None
    if outcome is None:
        return EndedRecording(path.name, "killed", "")
    return EndedRecording(path.name, "killed", outcome.reason, outcome.outcome)


def _recorded(
    folder: CampaignFolder, kind: RepeatedKind, precision: PrecisionRecord | None = None
) -> CampaignStep:
    """Return how many motions of a kind are complete, with the reasons of the others."""
    entries = [entry for entry in folder.manifest() if entry.kind == kind]
    ended = [
        EndedRecording(entry.name, entry.outcome, entry.reason)
        for entry in entries
        if entry.outcome != "completed"
    ]
    good = len(entries) - len(ended)
    entered = {entry.name for entry in entries}
    for path in folder.archives.glob("*.mcap"):
        parsed = None if path.name in entered else ArchiveName.parse(path.name)
        if parsed is not None and parsed.kind == kind:
            ended.append(_killed(path))
    found = MadeRecordings(good, tuple(sorted(ended, key=lambda each: each.archive)), precision)
    return CampaignStep("done" if good else "next", found)
