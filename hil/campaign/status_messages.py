"""Steps of a campaign in words: the state of each, and details for the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, assert_never

from hil.base.terminal_text import plural
from identification.text import percentage

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
from .record_messages import gravity_lines, precision_line, rehearsal_line, warm_up_line

_MOTIONS: Final[Mapping[RepeatedKind, str]] = {
    "excitation": "repetitions",
    "validation": "validation motions",
}


def step_line(found: StepOutcome) -> str:
    """Return the result of a step, or what is missing, without full stop."""
    match found:
        case UnreadableStep(problem):
            return problem.rstrip(".")
        case DesignedPlan(duration, validation):
            return (
                f"an excitation of {duration:.1f} s and {plural(validation, 'validation motion')}"
            )
        case NotRehearsed(is_of_another_plan):
            if is_of_another_plan:
                return "rehearsed with another cell, URDF or plan than the campaign has now"
            return "not rehearsed on the simulated arm"
        case Rehearsed(rehearsal):
            return rehearsal_line(rehearsal)
        case NoDryRun(is_invalid):
            if is_invalid:
                return (
                    "the recorded dry run is not valid: it belongs to another plan or kind of arm,"
                    " or its archives are missing"
                )
            return "not done: every motion at 20 % of its speed"
        case DryRunDone(record):
            if record.accepted is not None:
                return f"accepted by {record.accepted.by} at {record.accepted.at}"
            but = "".join(f"; {line}" for line in gravity_lines(record))
            return f"done ({record.duration:.0f} s), but not accepted{but}"
        case SkippedStep(as_simulated):
            return "skipped, as the arm is simulated" if as_simulated else "left out"
        case NoWarmUp(is_required):
            return "not done" if is_required else "not required (warmup_drift)"
        case WarmUpDone(record):
            return f"{record.outcome} after {plural(len(record.motions), 'motion')}"
        case PlannedRecordings() | MadeRecordings():
            return _recordings_line(found)
        case NotIdentified() | Identified() | NoReport() | Reported():
            return _result_line(found)
        case never:
            assert_never(never)


def step_details(found: StepOutcome) -> list[str]:
    """Return more lines on a step, for the report."""
    match found:
        case Rehearsed(rehearsal):
            return [
                *(criterion.sentence for criterion in rehearsal.criteria),
                *(f"not detectable by it: {sentence}" for sentence in rehearsal.not_seen),
            ]
        case DryRunDone(record) if record.accepted is not None:
            shares = zip(record.joint_names, record.current_share, strict=True)
            currents = ", ".join(f"{joint} {percentage(share)}" for joint, share in shares)
            return [
                f"largest current, of its limit: {currents}",
                f"{plural(len(record.archives), 'motion')} at {percentage(record.override)} of"
                " their speed",
                f"{plural(record.missed, 'packet')} missed, {plural(record.late, 'reply')} late",
                *(f"{line}; it was accepted by name" for line in gravity_lines(record)),
            ]
        case WarmUpDone(record) if record.outcome == "not warm" and record.motions:
            return [warm_up_line(record)]
        case PlannedRecordings(precision=precision) if precision is not None:
            return [precision_line(precision)]
        case MadeRecordings(_, ended, precision):
            reached = [] if precision is None else [precision_line(precision)]
            return [*map(_ended_line, ended), *reached]
    return []


def _recordings_line(found: PlannedRecordings | MadeRecordings) -> str:
    match found:
        case PlannedRecordings(kind, complete, planned):
            return f"{complete} of {planned} {_MOTIONS[kind]} complete"
        case MadeRecordings(complete, ended):
            rejected = f"; {len(ended)} rejected or ended early" if ended else ""
            return f"{complete} complete{rejected}"


def _result_line(found: NotIdentified | Identified | NoReport | Reported) -> str:
    match found:
        case NotIdentified(missing):
            if missing:
                return f"identified without {len(missing)} of the archives ({missing[0]})"
            return "not identified yet"
        case Identified(verdict):
            return verdict
        case NoReport(is_outdated):
            return "older than the results" if is_outdated else "no report yet"
        case Reported(path):
            return str(path)


def _ended_line(ended: EndedRecording) -> str:
    reason = ended.reason
    if ended.archived_outcome:
        reason = (
            "the program ended before it checked the motion"
            f" ({ended.archived_outcome}: {ended.reason})"
        )
    elif ended.outcome == "killed":
        reason = "it was never closed: the program or the computer stopped"
    return f"{ended.archive} {ended.outcome}: {reason}"
