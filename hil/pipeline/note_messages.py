"""Notes of the results about recordings, settings and estimate, in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, assert_never

from hil.pipeline.notes import (
    AssumedPayload,
    AssumedTorqueConstants,
    CompensatedDelay,
    CostlyBodies,
    DelayNotApplied,
    ElasticGears,
    EndedEarly,
    EstimatedDelay,
    FittedRows,
    IntervalUnits,
    LastHeldOut,
    LoadNotConverged,
    ManyOutliers,
    MergedSamples,
    NoEssentialParameters,
    NoOtherDelay,
    NotConsistent,
    Note,
    NotEssential,
    NotJudged,
    OtherMeaning,
    PoorlySeparated,
    PositionNoise,
    PriorContradicted,
    RejectedArchive,
    RepairedArchive,
    RestPredicted,
    ReweightingNotConverged,
    StatedText,
    TimesUsed,
    UnevenClock,
    UnrestrictedBodies,
    WeakInstruments,
    WhyNotApplied,
)
from hil.pipeline.torque_scale import ScaleSource, TorqueScale
from identification.estimators.delay_messages import delay_line
from identification.estimators.torque_scale import described
from identification.signals.messages import ROW_REASONS, clock_lines, time_lines
from identification.text import joined, number, percentage
from identification.validation.finding import Finding, TestedOn
from identification.validation.finding_messages import Naming, consistency_words, worded

SCALE_SOURCES: Final = {
    ScaleSource.COLUMN_MAP: "torque_uncertainty of the column map",
    ScaleSource.ROBOT_TABLE: "torque_uncertainty of [robot] in the cell file",
    ScaleSource.DRIVE_TRAIN_TABLE: "torque_uncertainty of [drive_train] in the cell file",
    ScaleSource.SIMULATED: "a simulated arm",
    ScaleSource.DATA_SHEET: "of a data sheet, as no torque_uncertainty is stated",
}
_WHY_NOT_APPLIED: Final = {
    WhyNotApplied.UNDETERMINED: "it is not determined",
    WhyNotApplied.PREDICTS_WORSE: "it predicts worse",
    WhyNotApplied.PREDICTS_NO_BETTER: "it predicts no better",
}


def note_lines(notes: Iterable[Note]) -> list[str]:
    """Return sentences without their full stops, one for most notes."""
    return [line for note in notes for line in _lines(note)]


def finding_lines(findings: Iterable[Finding], joints: Sequence[str]) -> list[str]:
    """Return how recordings of these joints differ from their description, with a remedy."""
    naming = Naming(tuple(joints), TestedOn.RECORDINGS)
    return [
        f"{each.words}: {each.next_step}" for each in (worded(found, naming) for found in findings)
    ]


def _lines(note: Note) -> list[str]:
    if isinstance(note, TimesUsed):
        return [f"{note.recording}: {line}" for line in time_lines(note.times)]
    return [_line(note)]


def _line(note: Note) -> str:
    match note:
        case (
            StatedText()
            | RejectedArchive()
            | EndedEarly()
            | NotJudged()
            | RepairedArchive()
            | OtherMeaning()
            | RestPredicted()
            | LastHeldOut()
        ):
            return _of_recordings(note)
        case MergedSamples() | UnevenClock() | PositionNoise() | FittedRows():
            return _of_rows(note)
        case AssumedTorqueConstants() | AssumedPayload():
            return _of_cell(note)
        case EstimatedDelay() | NoOtherDelay() | CompensatedDelay() | DelayNotApplied():
            return _of_delay(note)
        case NotConsistent() | CostlyBodies() | NotEssential():
            return _of_validation(note)
    return _of_estimate(note)


def _of_recordings(
    note: StatedText
    | RejectedArchive
    | EndedEarly
    | NotJudged
    | RepairedArchive
    | OtherMeaning
    | RestPredicted
    | LastHeldOut,
) -> str:
    match note:
        case StatedText(text, recording):
            return f"{recording}: {text}" if recording else text
        case RejectedArchive(recording, reason):
            return f"{recording} was rejected and is not used: {reason}"
        case EndedEarly(recording, outcome):
            return f"{recording} ended {outcome}"
        case NotJudged(recording):
            return (
                f"{recording} is not in its campaign's manifest.json: the run was killed before the"
                " quality of the recording was checked"
            )
        case RepairedArchive():
            return "data were lost when it was repaired"
        case OtherMeaning(finding, joints):
            said = worded(finding, Naming(joints, TestedOn.RECORDINGS))
            return f"{said.words}: {said.next_step}"
        case RestPredicted(fitted):
            return (
                f"the first {percentage(fitted)} of one recording were fitted and the rest was"
                " predicted; another motion would be a stronger test"
            )
        case LastHeldOut(recording):
            return f"no validation run: the last recording, {recording}, was held out"
    assert_never(note)


def _of_rows(note: MergedSamples | UnevenClock | PositionNoise | FittedRows) -> str:
    match note:
        case MergedSamples(count, recording):
            text = (
                f"{count} samples had the time stamp of the previous sample and were averaged with"
                " it"
            )
            return f"{recording}: {text}" if recording else text
        case UnevenClock(recording, base):
            return f"{recording}: {'; '.join(clock_lines(base))}"
        case PositionNoise(at_standstill=True):
            return "position noise was measured at standstill"
        case PositionNoise():
            return "position noise was estimated from the high frequencies of the positions"
        case FittedRows(rows, excluded):
            fitted = percentage(1.0 - sum(excluded.values()), 1)
            parts = ", ".join(
                f"{percentage(share, 2)} {ROW_REASONS[reason]}"
                for reason, share in excluded.items()
            )
            return (
                f"{fitted} of {rows} rows (one joint at one sample) were fitted; excluded: {parts}"
            )
    assert_never(note)


def _of_cell(note: AssumedTorqueConstants | AssumedPayload) -> str:
    match note:
        case AssumedTorqueConstants(can_be_weighed):
            weigh = "; weigh a known payload with `hil torque-constants`"
            return (
                "the torque constants are assumed: predictions of current are not affected, but all"
                f" parameters are in units of the assumed constants{weigh * can_be_weighed}"
            )
        case AssumedPayload():
            return (
                "mass and centre of the payload are assumed ([robot.payload]); their errors are in"
                " the parameters of the last link (weigh it with `hil payload`)"
            )
    assert_never(note)


def _of_delay(note: EstimatedDelay | NoOtherDelay | CompensatedDelay | DelayNotApplied) -> str:
    match note:
        case EstimatedDelay(estimate):
            return delay_line(estimate)
        case NoOtherDelay(assumed, beside_low_pass):
            low_pass = " in addition to the low-pass of the torque" * beside_low_pass
            return f"no delay other than the assumed {1e3 * assumed:.3g} ms was applied{low_pass}"
        case CompensatedDelay(delay, stated):
            combined = (
                ""
                if stated is None
                else f", the estimate combined with the stated {1e3 * stated:.3g} ms"
            )
            return f"a delay of {1e3 * delay:.3g} ms of all axes was compensated{combined}"
        case DelayNotApplied(estimate, reason):
            return f"{delay_line(estimate)}; not applied, as {_WHY_NOT_APPLIED[reason]}"
    assert_never(note)


def _of_estimate(note: Note) -> str:
    match note:
        case LoadNotConverged(change, passes):
            return (
                f"load-dependent friction still changed the torque by {percentage(change, 1)} in"
                f" pass {passes}"
            )
        case IntervalUnits(scale):
            return (
                "parameter intervals are in units of this arm's torque; absolute intervals are"
                f" computed {scale_words(scale)}"
            )
        case ElasticGears():
            return "the intervals allow for elastic gears between motors and links"
        case PoorlySeparated(condition, from_sums):
            how = (
                ", and sums of squares lose digits there; `hil identify` on these archives uses QR"
                if from_sums
                else " (solved by QR)"
            )
            return (
                f"the scaled condition number is {number(condition, 2)}: the motion separates some"
                f" parameters poorly{how}"
            )
        case UnrestrictedBodies(reason):
            return f"physically impossible bodies were allowed because {reason}"
        case ManyOutliers(joint, share):
            return (
                f"{percentage(share)} of the rows of {joint} deviate by more than four standard"
                " deviations: an unmodelled effect rather than outliers, which a robust loss would"
                " hide; use --estimator wls"
            )
        case ReweightingNotConverged(iterations):
            return f"the reweighting did not converge in {iterations} iterations"
        case PriorContradicted(parameters, deviations):
            return (
                f"data and prior of {joined(parameters)} differ by more than {deviations:g}"
                " standard deviations: correct the CAD values, or their uncertainty in [nominal]"
            )
        case WeakInstruments(parameters):
            return f"the instruments are too weak for {joined(parameters)}"
    raise TypeError(type(note))


def _of_validation(note: NotConsistent | CostlyBodies | NotEssential) -> str:
    match note:
        case NotConsistent(reason):
            return f"no physically consistent parameters were found: {reason}"
        case CostlyBodies(check):
            return consistency_words(check)
        case NotEssential(NoEssentialParameters.NOTHING_HELD_OUT):
            return "no essential parameters: they are chosen on held-out data, and there is none"
        case NotEssential(reason):
            return f"no essential parameters: {reason}"
    assert_never(note)


def scale_words(scale: TorqueScale) -> str:
    """Return what intervals assume, such as "assuming torque constants to 3 %"."""
    source = SCALE_SOURCES[scale.source]
    if not scale.std.any():
        return f"assuming exact torques ({source})"
    return f"assuming {described(scale.std, scaled_words(scale))} (standard deviation; {source})"


def scaled_words(scale: TorqueScale) -> str:
    """Return which torques have an uncertain scale."""
    return "torque constants" if scale.by_currents else "the scale of the recorded torques"
