"""How recordings differ from their description, for commands that do not judge a model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hil.base.errors import RefusedRecordingError
from hil.pipeline.recorded_rows import row_findings
from hil.pipeline.sources import Source
from identification.hypotheses.diagnosis import TorqueDiagnosis, diagnose
from identification.hypotheses.joint_changes import Change
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.validation.finding import Finding
from identification.validation.finding_messages import Naming, worded
from identification.validation.findings.diagnosis import of_diagnosis, without_bodies
from identification.validation.findings.faults import fault_keys


def other_meanings(found: TorqueDiagnosis, sources: Sequence[Source]) -> tuple[Finding, ...]:
    """Return how recordings differ from their description, each with a remedy."""
    certain = [_certain(step.change) for step in found.discrete if step.sure]
    return (*row_findings(sources), *certain, *of_diagnosis(found))


def _certain(change: Change) -> Finding:
    """Return a sign, an order or a coupled angle that is other than described."""
    key, remedy = fault_keys(change)
    return Finding(key, "wrong", remedy, "cause", joints=change.joints)


def require_weight(
    model: RobotModel, recordings: Sequence[Samples], sources: Sequence[Source], path: Path | None
) -> tuple[Finding, ...]:
    """Return how bare recordings differ from their description; their torque must include gravity.

    A controller that removes the weight of its arm may also remove the weight of a load it knows,
    so that the torque does not say how heavy one is.

    Args:
        model: of the arm.
        recordings: prepared, of the bare arm.
        sources: bare and loaded, as recorded.
        path: of the first of them.

    Raises:
        RefusedRecordingError: gravity, or all of the bodies, was removed from the torque.
    """
    found = diagnose(model, recordings)
    if found.rigid.is_nothing:
        finding = worded(without_bodies(found.rigid), Naming())
        raise RefusedRecordingError(path, finding.words, field="torque", remedy=finding.next_step)
    if found.is_weightless or found.is_partly_weightless:
        assert found.weightless is not None
        problem = (
            "gravity was removed from the torque: a model without gravity predicts the bare"
            f" recordings with {found.weightless.ratio:.2f} times the error; the weight of a load"
            " that the controller knows is missing as well"
        )
        remedy = "record the torque before gravity is removed from it"
        raise RefusedRecordingError(path, problem, field="torque", remedy=remedy)
    return other_meanings(found, sources)
