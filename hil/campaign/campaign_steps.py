"""State of the steps of a campaign, as values; `status_messages` words them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from .dry_run_record import DryRunRecord
from .joint_warm_up import WarmUpRecord
from .precision_record import PrecisionRecord
from .rehearsal_record import Rehearsal

RepeatedKind = Literal["excitation", "validation"]
"""Kinds of motions of which a campaign needs several recordings."""


@dataclass(frozen=True)
class UnreadableStep:
    """A step whose files cannot be read."""

    problem: str  #: as its error states it


@dataclass(frozen=True)
class DesignedPlan:
    """The plan of the campaign."""

    duration: float  #: of the excitation [s]
    validation: int  #: motions


@dataclass(frozen=True)
class NotRehearsed:
    """No rehearsal of this plan."""

    is_of_another_plan: bool  #: whether there is one of another


@dataclass(frozen=True)
class Rehearsed:
    """A rehearsal of this plan."""

    rehearsal: Rehearsal


@dataclass(frozen=True)
class NoDryRun:
    """No dry run of this plan on this kind of arm."""

    is_invalid: bool = False  #: whether a record of another one is there


@dataclass(frozen=True)
class DryRunDone:
    """A dry run, accepted or not."""

    record: DryRunRecord


@dataclass(frozen=True)
class SkippedStep:
    """A gate that a simulated arm does not need, or a warm-up that was not done."""

    as_simulated: bool


@dataclass(frozen=True)
class NoWarmUp:
    """No warm-up."""

    is_required: bool


@dataclass(frozen=True)
class WarmUpDone:
    """Motions of a warm-up, which may go on."""

    record: WarmUpRecord


@dataclass(frozen=True)
class PlannedRecordings:
    """Recordings of a kind of motion."""

    kind: RepeatedKind
    complete: int
    planned: int
    precision: PrecisionRecord | None = None


@dataclass(frozen=True)
class EndedRecording:
    """A recording that is not complete."""

    archive: str
    outcome: str  #: "killed" for one that no program entered into the manifest
    reason: str  #: as archive or manifest state it; "" if the archive was never closed
    #: outcome of a "killed" one in its archive, which no program checked; "" without one
    archived_outcome: str = ""


@dataclass(frozen=True)
class MadeRecordings:
    """Recordings of a kind of motion that were made, for the execution log."""

    complete: int
    ended: tuple[EndedRecording, ...]
    precision: PrecisionRecord | None = None


@dataclass(frozen=True)
class NotIdentified:
    """No results, or results without some of the recordings."""

    missing: tuple[str, ...] = ()  #: recordings that the results do not have


@dataclass(frozen=True)
class Identified:
    """Results from all recordings."""

    verdict: str  #: as the results state it


@dataclass(frozen=True)
class NoReport:
    """No report of the results."""

    is_outdated: bool  #: whether there is an older one


@dataclass(frozen=True)
class Reported:
    """A report of the results."""

    path: Path


StepOutcome = (
    UnreadableStep
    | DesignedPlan
    | NotRehearsed
    | Rehearsed
    | NoDryRun
    | DryRunDone
    | SkippedStep
    | NoWarmUp
    | WarmUpDone
    | PlannedRecordings
    | MadeRecordings
    | NotIdentified
    | Identified
    | NoReport
    | Reported
)
