"""Rows about what explains the torque error: constant, drift, spring, or a change in a part."""

from __future__ import annotations

from collections.abc import Iterator

from hil.base.arrays import Array
from hil.importers.conclusions import Certainty
from hil.look.physics import TorqueFindings
from hil.look.readings import (
    CorrectedError,
    Evidence,
    FoundChange,
    NextStep,
    PartError,
    RivalChanges,
)
from hil.look.result import Aspect, Row
from identification.hypotheses.column_scores import SEPARATE_ERROR_RATIO
from identification.hypotheses.diagnosis import explain_errors
from identification.hypotheses.explanation import Explanation
from identification.hypotheses.joint_changes import Change
from identification.hypotheses.scores import EXPLAINED_ERROR

# A delay has its own row, and friction that grows with the load is no fault of a recording.
_NO_FAULTS = ("delay", "load friction")


def explained_rows(finding: TorqueFindings, scale_std: Array) -> Iterator[Row]:
    """Yield a row for each change that explains the error of a torque that follows the arm.

    None is certain: only a motion that was not fitted can confirm it, as `hil identify` asks. Where
    the changes found before leave more than a free fit does, none is likely either.

    Args:
        finding: of the torque, with the changes of signs, zeros and units that were found.
        scale_std: relative standard deviation of each joint's torque scale (n,).
    """
    readings = finding.readings
    if finding.torque.is_otherwise or readings.score.overall > EXPLAINED_ERROR:
        return
    names = finding.cell.joint_names
    if finding.explained is not None and (springs := finding.explained.how.springs):
        change = Change("spring", tuple(names.index(name) for name in springs))
        ratio = finding.explained.error / finding.torque.error
        yield _row(Explanation(change, ratio), names, is_likely=True)
        return
    for found in explain_errors(readings.model, readings.samples, scale_std):
        change = found.change
        if change.meaning not in _NO_FAULTS and not found.is_assumed(scale_std):
            is_likely = found.is_certain and not finding.fits_badly
            yield _row(found, names, is_likely)


def _row(found: Explanation, joints: tuple[str, ...], is_likely: bool) -> Row:
    evidence: list[Evidence] = [CorrectedError(found.ratio)]
    if found.rivals:
        evidence.insert(0, RivalChanges(found.rivals, joints))
    if found.excess > SEPARATE_ERROR_RATIO:
        evidence.append(PartError(found.excess))
    aspect, step = _decided_by(found.change)
    certainty = Certainty.LIKELY if is_likely else Certainty.UNDETERMINED
    reading = FoundChange(found, joints)
    return Row(aspect, reading, certainty, tuple(evidence), step, is_fault=True)


def _decided_by(change: Change) -> tuple[Aspect, NextStep]:
    if change.part is not None:
        return "changed part", NextStep.CUT_THE_RECORDING
    if change.meaning == "drift":
        return "zero", NextStep.CHECK_ENCODER_MOUNTING
    if change.meaning == "spring":
        return "spring", NextStep.DESCRIBE_SPRING
    return "scale", NextStep.WEIGH_A_LOAD
