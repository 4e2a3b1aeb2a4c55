"""What recordings are other than their description, for commands that judge no model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from hil.base.errors import InputError
from identification.hypotheses.column_search import Explanation
from identification.hypotheses.diagnosis import TorqueDiagnosis, diagnose
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.validation.facts.diagnosis import (
    RECORD_ALL_TORQUE,
    MeaningFacts,
    without_bodies,
)
from identification.validation.facts.faults import text_of
from identification.validation.finding import Naming

_MOTION: Final = "the recordings"


def other_meanings(model: RobotModel, found: TorqueDiagnosis) -> tuple[str, ...]:
    """Return what recordings are other than described, as sentences with what to do about each."""
    naming = Naming(tuple(model.joint_names), _MOTION)
    certain = [Explanation(step.change, step.ratio) for step in found.discrete if step.sure]
    texts = [text_of(each, naming) for each in certain]
    pairs = [(text.message, text.step) for text in texts]
    pairs += [(each.words, each.next_step) for each in MeaningFacts(found).findings(naming)]
    return tuple(f"{words}: {step}" for words, step in pairs)


def require_weight(
    model: RobotModel, recordings: Sequence[Samples], path: Path | None
) -> tuple[str, ...]:
    """Return what bare recordings are other than described; gravity must be in their torque.

    A controller that removes the weight of its arm may remove that of the load it knows as well,
    so that the torque does not say how heavy one is.

    Args:
        model: of the arm.
        recordings: prepared, of the bare arm.
        path: of the first of them.

    Raises:
        InputError: gravity, or all of the bodies, was removed from the torque.
    """
    found = diagnose(model, recordings)
    if found.rigid.is_nothing:
        problem = without_bodies(found.rigid)
        raise InputError(path, problem, field="torque", remedy=RECORD_ALL_TORQUE)
    if found.is_weightless:
        assert found.weightless is not None
        problem = (
            "gravity was removed from the torque: without it, the bare recordings are predicted"
            f" with {found.weightless.ratio:.2f} times the error; of a load that the controller"
            " knows, the weight is missing as well"
        )
        remedy = "record the torque before gravity is removed from it"
        raise InputError(path, problem, field="torque", remedy=remedy)
    return other_meanings(model, found)
