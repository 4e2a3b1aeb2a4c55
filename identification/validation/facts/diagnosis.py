"""Facts about what the recordings are: torque without bodies or gravity, zeros, another arm."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from identification.hypotheses.changes import COUPLED, IN_ORDER, SIGNS, Change, Meaning
from identification.hypotheses.diagnosis import RigidTorque, TorqueDiagnosis
from identification.hypotheses.search import Step
from identification.text import percentage
from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, Naming

NO_BODIES: Final = "bodies in the torque"
"""Name of the check whether the torque is that of an arm."""
ARM: Final = "arm of the URDF"
"""Name of the check whether the model is that of the described arm."""
_OTHER_SCALE: Final = 3.0  # of the torque to that of the masses; descriptions in use are closer
_SIGMAS: Final = 3.0
_CHECKS: Final[Mapping[Meaning, str]] = {
    **dict.fromkeys(SIGNS, "direction of axes"),
    **dict.fromkeys(IN_ORDER, "order of joints"),
    **dict.fromkeys(COUPLED, "coupled angles"),
}
_QUANTITIES: Final[Mapping[Meaning, str]] = {
    "torque sign": "torque",
    "position sign": "position",
    "axis sign": "position and torque",
    "torque order": "torques",
    "position order": "positions",
    "joint order": "positions and torques",
}


@dataclass(frozen=True, eq=False)
class MeaningFacts:
    """What the torque is: without bodies or gravity, of other zeros, or of open signs."""

    diagnosis: TorqueDiagnosis

    @classmethod
    def of(cls, evidence: Evidence) -> MeaningFacts | None:
        """Return what was found; None if nothing was asked."""
        return None if evidence.diagnosis is None else cls(evidence.diagnosis)

    @property
    def is_other(self) -> bool:
        """Whether it is other than stated."""
        found = self.diagnosis
        zeros = any(step.sure for step in found.zeros)
        return found.rigid.is_nothing or found.is_weightless or zeros

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield what the torque is other than stated."""
        found = self.diagnosis
        if found.rigid.is_nothing:
            words = without_bodies(found.rigid)
            yield Finding(NO_BODIES, "wrong", words, RECORD_ALL_TORQUE, "cause")
        elif found.is_weightless:
            assert found.weightless is not None
            yield Finding(
                "gravity",
                "wrong",
                "gravity was removed from the torque: without it, the fitted motion is predicted"
                f" with {found.weightless.ratio:.2f} times the error",
                "state it: `--gravity 0 0 0` where a log is read with its URDF, or gravity of"
                " [robot] in the cell file",
                "cause",
            )
        yield from self._zeros(naming)
        for step in self.diagnosis.discrete:
            if not step.sure:
                yield _open(step, naming)

    def _zeros(self, naming: Naming) -> Iterator[Finding]:
        steps = self.diagnosis.zeros
        if not steps:
            return
        offsets = np.zeros(len(naming.joints))
        for step in steps:
            offsets[list(step.change.joints)] += step.change.size
        named = naming.each(offsets != 0.0, lambda joint: f"{np.degrees(offsets[joint]):+.1f}°")
        error = percentage(steps[0].error / max(steps[0].before, 1e-300))
        if all(step.sure for step in steps):
            numbers = ", ".join(f"{offset:.4f}" for offset in offsets + 0.0)
            yield Finding(
                "zeros",
                "wrong",
                f"the zeros of joints are other than those of the URDF: {named} to be added; with"
                f" that, rows that did not choose it are predicted with {error} of the error",
                f"correct them: [position] offset = [{numbers}] (rad) in the column map; compare"
                " with a posture of the arm",
                "cause",
            )
        else:
            yield Finding(
                "zeros",
                "doubtful",
                f"none of the tested explanations fits the recording; the nearest is zeros of"
                f" joints other than those of the URDF ({named})",
                "compare a posture of the arm with that of the URDF at the same angles",
            )


def _open(step: Step, naming: Naming) -> Finding:
    """Return that a sign or an order is other than stated, or the nearest to an explanation."""
    change = step.change
    if step.is_explained and step.alike:
        alike = [change, *(other for other, _ in step.alike if other.is_discrete)]
        others = " or ".join(_words(each, naming) for each in alike)
        return Finding(
            _CHECKS[change.meaning],
            "wrong",
            f"several explanations fit alike: {others}; with each of them, rows that did not choose"
            f" it are predicted with {percentage(step.error / max(step.before, 1e-300))} of the"
            " error",
            f"jog {naming.all_of(change.joints)} and compare direction, order and torque with the"
            " column map",
            "cause",
        )
    return Finding(
        _CHECKS[change.meaning],
        "doubtful",
        "none of the tested explanations fits the recording; the nearest is"
        f" {_words(change, naming)}",
        f"compare direction and order of {naming.all_of(change.joints)} with the column map",
    )


def _words(change: Change, naming: Naming) -> str:
    joints = naming.all_of(change.joints)
    if change.meaning in _QUANTITIES:
        done = "negated" if change.meaning in SIGNS else "interchanged"
        return f"{_QUANTITIES[change.meaning]} of {joints} {done}"
    joint, other = (naming.joints[index] for index in change.joints)
    sign = "plus" if change.meaning == "angle sum" else "less"
    return f"an angle of {joint} {sign} that of {other}"


def without_bodies(rigid: RigidTorque) -> str:
    """Return in words that there is next to nothing of bodies in a torque."""
    share = percentage(float(rigid.over_friction.max()))
    return (
        f"there is next to nothing of bodies in the torque, at most {share} of its friction on any"
        f" axis, and {rigid.scale:.2g} times what the masses of the URDF need: a model of the arm"
        " was subtracted from it, as by a controller that reports external torque"
    )


RECORD_ALL_TORQUE: Final = (
    "record the torque of the motors or of joint sensors, before the controller's model is"
    " subtracted"
)
"""What to do about that."""


@dataclass(frozen=True)
class ArmFacts:
    """Whether the model is that of the described arm, however well it predicts."""

    scale: float  # measured torque over that of the masses

    @classmethod
    def of(cls, evidence: Evidence, meaning: MeaningFacts | None) -> ArmFacts | None:
        """Compare the torque with the masses; None where another finding says more."""
        if meaning is None or meaning.is_other:
            return None
        rigid = meaning.diagnosis.rigid
        if not np.isfinite(rigid.scale) or evidence.context.nominal_scale is None:
            return None
        far = _SIGMAS * rigid.std
        is_near = rigid.scale - far < _OTHER_SCALE and rigid.scale + far > 1.0 / _OTHER_SCALE
        return None if is_near else cls(rigid.scale)

    def findings(self, _: Naming) -> Iterator[Finding]:
        """Yield that it is not."""
        yield Finding(
            ARM,
            "wrong",
            f"its masses would be {self.scale:.2g} times those described",
            "check unit and side (motor or joint) of the torque, gear ratios and torque constants,"
            " and the units of the masses of the URDF",
            "cause",
        )
