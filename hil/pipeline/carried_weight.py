"""Whether the torque of recordings shows the weight of what the arm carries."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hil.base.errors import InputError
from identification.hypotheses.diagnosis import diagnose
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.validation.facts.diagnosis import RECORD_ALL_TORQUE, without_bodies


def require_weight(model: RobotModel, recordings: Sequence[Samples], path: Path | None) -> None:
    """Raise InputError if gravity, or all of the bodies, was removed from the torque.

    A controller that removes the weight of its arm may remove that of the load it knows as well,
    so that the torque does not say how heavy one is.

    Args:
        model: of the arm.
        recordings: prepared, of the bare arm.
        path: of the first of them.
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
