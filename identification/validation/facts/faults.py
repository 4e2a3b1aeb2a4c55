"""Facts about faults that explain errors: outliers, gravity, faults of the recordings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.hypotheses.changes import SIGNS, Change
from identification.hypotheses.column_search import Explanation
from identification.text import percentage
from identification.validation.evidence import Evidence
from identification.validation.facts.scale import SignFacts
from identification.validation.finding import Finding, Mask, Naming, Thresholds, indices

MOUNTING_STEP: Final = (
    "state how the arm is mounted: `--gravity X Y Z` where a log is read with its URDF, or gravity"
    " of [robot] in the cell file"
)
_SIGMAS: Final = 3.0  # standard deviations of a scale that is not as assumed


@dataclass(frozen=True, eq=False)
class OutlierFacts:
    """Few samples that cause most of the error on held-out motion."""

    few: Mask  # joints that have such (n,)
    share: Array  # of samples (n,)
    overall: float  # error without them, over all axes
    decide: bool  # whether the error exceeds its limit with them only
    explains: float  # share of the squared error that they cause

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> OutlierFacts | None:
        """Compare the errors with and without outliers."""
        if evidence.residuals is None:
            return None
        outliers = evidence.residuals.outliers
        error = evidence.held_out
        few = (outliers.power > limits.outlying_power) & (outliers.share < limits.outliers)
        # An error of rounding has a distribution of its own.
        few &= (outliers.share > 0.0) & (np.nan_to_num(error.relative) > limits.pattern)
        axis = (error.relative > limits.axis) & (outliers.without.relative <= limits.axis)
        all_axes = error.overall > evidence.allowed(limits) >= outliers.without.overall
        return cls(
            few=few,
            share=outliers.share,
            overall=outliers.without.overall,
            decide=bool(few.any()) and (all_axes or bool(np.any(axis & few))),
            explains=1.0 - (outliers.without.overall / max(error.overall, 1e-12)) ** 2,
        )

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the joints with outliers."""
        if not self.few.any():
            return
        shares = naming.each(self.few, lambda joint: percentage(self.share[joint], 2))
        yield Finding(
            "outliers",
            "wrong" if self.decide else "doubtful",
            f"isolated outliers cause most of the error on {naming.motion} ({shares} of the"
            f" samples); without them it is {percentage(self.overall, 1)} over all axes",
            "check the recorded torques for spikes, damaged packets and collisions; remove them,"
            " or use a robust estimator (`hil identify --estimator tukey` or huber)",
            "cause",
            explains=self.explains,
            joints=indices(self.few),
        )


@dataclass(frozen=True)
class GravityFacts:
    """Direction of gravity that fits better than the declared one."""

    off: bool  # whether it predicts much better
    angle: float  # between the two [degrees]
    error: float  # of held-out motion with it, over that with the declared one
    declared: str  # [m/s²]
    best: str  # [m/s²]

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> GravityFacts | None:
        """Compare both directions."""
        gravity = evidence.gravity
        if gravity is None:
            return None
        angle = float(np.degrees(gravity.angle))
        return cls(
            off=gravity.ratio < limits.gravity and angle > limits.gravity_angle,
            angle=angle,
            error=float(np.sqrt(gravity.ratio)),
            declared=_vector(gravity.declared),
            best=_vector(gravity.best),
        )

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the better direction."""
        if self.off:
            yield Finding(
                "gravity",
                "wrong",
                f"with gravity ({self.best}) m/s² in base axes, {self.angle:.0f}° from the declared"
                f" ({self.declared}) m/s², {naming.motion} is predicted with {self.error:.2f} times"
                " the error",
                f"{MOUNTING_STEP}; if it is right, check the zero positions of the joints",
                "cause",
                explains=1.0 - self.error**2,
            )


def _vector(values: Array) -> str:
    """Return the entries of a vector, without negative zeros."""
    return ", ".join(f"{value + 0.0:.2f}" for value in np.round(values, 2))


def is_constant(change: Change) -> bool:
    """Whether a change is that of a torque constant: a scale throughout."""
    return change.meaning == "scale" and change.part is None


@dataclass(frozen=True)
class FaultFacts:
    """Changes of the fitted recordings that make parts of them more predictable."""

    found: tuple[Explanation, ...]
    certain_below: float  # ratio of the errors
    scale_std: Array  # of each joint's torque, as it is assumed, relative (n,)
    matters: Mask  # joints with an error that has to be explained (n,)

    @classmethod
    def of(
        cls,
        evidence: Evidence,
        limits: Thresholds,
        outliers: OutlierFacts | None,
        gravity: GravityFacts | None,
        signs: SignFacts,
    ) -> FaultFacts:
        """Leave out what outliers, gravity, opposite or changed torques explain better."""
        # A constant is relative to those of the other axes, of which one is wrong in one motion.
        changed = {change.joint for change in evidence.changes if change.kind == "gain"}

        def is_left_out(each: Explanation) -> bool:
            change = each.change
            if outliers is not None and outliers.decide:
                return True
            # The lag of commanded positions is that of the servo.
            if evidence.context.commanded_positions and change.meaning == "delay":
                return True
            if gravity is not None and gravity.off and each.ratio > gravity.error:
                return True
            if signs.all_opposite and (change.meaning in SIGNS or is_constant(change)):
                return True
            is_strong = each.ratio < limits.cause or changed <= {*change.joints}
            return is_constant(change) and not is_strong

        begun = () if evidence.diagnosis is None else evidence.diagnosis.begun
        found = (*(evidence.explanations or ()), *begun)
        found = tuple(each for each in found if not is_left_out(each))
        std = evidence.context.scale_std
        std = np.zeros(len(evidence.held_out.rows)) if std is None else std
        matters = np.nan_to_num(evidence.held_out.relative) > limits.unexplained
        return cls(found, limits.cause, std, matters)

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield each change."""
        for each in self.found:
            text = text_of(each, naming)
            begins = each.change.part is not None
            motion = "the recordings" if begins else "the fitted motion"
            certain = each.change.is_discrete or self._ratio_of(each) < self.certain_below
            if self._is_assumed(each):
                std = percentage(self._scale_std_of(each), 1)
                yield Finding(
                    text.check,
                    "information",
                    f"{text.message}, which the assumed uncertainty of the torques includes"
                    f" (standard deviation of the ratio {std})",
                )
                continue
            yield Finding(
                text.check,
                "wrong" if certain else "doubtful",
                f"{text.message}; correcting this multiplies the error of predicted parts of"
                f" {motion} by {each.ratio:.2f}",
                text.step,
                "cause",
                explains=1.0 - each.ratio**2,
            )

    def _ratio_of(self, each: Explanation) -> float:
        """Return the ratio of the errors, of a constant that matters that of its joint alone.

        It is a geometric mean over all joints, of which a scale of one hardly changes the others.
        """
        alone = is_constant(each.change) and bool(self.matters[[*each.change.joints]].any())
        return each.ratio ** (len(self.matters) if alone else 1)

    def _is_assumed(self, each: Explanation) -> bool:
        """Return whether a torque is off by no more than the scale of torques may be."""
        if not is_constant(each.change):
            return False
        return abs(each.size or 0.0) <= _SIGMAS * self._scale_std_of(each)

    def _scale_std_of(self, each: Explanation) -> float:
        """Return the standard deviation of a torque's scale over those of the others.

        Their scales are in that of the change.
        """
        return float(np.hypot(self.scale_std[[*each.change.joints]].max(), each.std))


class FaultText(NamedTuple):
    """A change in words."""

    check: str
    message: str
    step: str


def text_of(each: Explanation, naming: Naming) -> FaultText:
    """Return the message on a change, by its meaning."""
    named = [naming.joints[joint] for joint in each.change.joints] or ["all axes"]
    joints = " and ".join(named)
    is_of_part = each.change.part is not None
    match each.change.meaning:
        case "delay":
            return _delay(each, joints)
        case "scale":
            return _changed("torque", each, joints) if is_of_part else _gain(each, joints)
        case "load friction":
            return _load_friction(each)
        case "torque sign":
            return _torque_sign(joints)
        case "position sign":
            return _position_sign(joints)
        case "axis sign":
            return _axis_sign(joints)
        case "torque order":
            return _order("torques", joints)
        case "position order":
            return _order("positions", joints)
        case "joint order":
            return _order("positions and torques", joints)
        case "angle sum":
            return _coupled_angle(each, naming, "plus", 1)
        case "angle difference":
            return _coupled_angle(each, naming, "less", -1)
        case "payload":
            return _payload(each)
        case "friction":
            return _changed("friction", each, joints)
        case "arm":
            return _changed_arm(each)
        case meaning:
            raise ValueError(f"{meaning} explains no error of a fit")


def _size(each: Explanation, scale: float = 1.0, offset: float = 0.0) -> str:
    """Return offset + scale * size of a change, with its 95 % interval."""
    size = offset + scale * (each.size or 0.0)
    return f"{abs(size):.3g} ± {scale * each.half_interval:.2g}"


def _more(each: Explanation) -> str:
    return "more" if (each.size or 0.0) > 0.0 else "less"


def _part(each: Explanation) -> str:
    return "" if each.change.part is None else each.change.part.name


def _delay(each: Explanation, joints: str) -> FaultText:
    return FaultText(
        "delay",
        f"the torque of {joints} lags the position by {_size(each, scale=1e3)} ms {_more(each)}"
        " than assumed",
        "run `hil identify --delay auto`, or correct the delay at its source",
    )


def _gain(each: Explanation, joints: str) -> FaultText:
    return FaultText(
        "torque constant",
        f"the torque of {joints} is {_size(each, offset=1.0)} times the value consistent with the"
        " other axes",
        f"check torque constant and gear ratio of {joints}; recordings with and without a known"
        " payload determine the constant (`hil torque-constants --loaded`)",
    )


def _load_friction(each: Explanation) -> FaultText:
    return FaultText(
        "friction over load",
        f"friction grows with the load, by {_size(each)} of the transmitted torque (median axis)",
        "fit it: add `load` to the terms of `--friction`, as in"
        " `--friction coulomb,viscous,load,offset`",
    )


def _torque_sign(joints: str) -> FaultText:
    return FaultText(
        "direction of axes",
        f"the torque of {joints} has probably the wrong sign",
        f"check the sign of the torque of {joints} in the column map, or of its torque constant",
    )


def _position_sign(joints: str) -> FaultText:
    return FaultText(
        "direction of axes",
        f"the position of {joints} has probably the wrong sign",
        f"check the sign of the position of {joints} in the column map",
    )


def _axis_sign(joints: str) -> FaultText:
    return FaultText(
        "direction of axes",
        f"{joints} probably turns opposite to the URDF: wrong sign of gear ratio or direction",
        f"jog {joints} by hand and compare its direction of rotation with the URDF's",
    )


def _order(quantity: str, joints: str) -> FaultText:
    return FaultText(
        "order of joints",
        f"the {quantity} of {joints} are probably interchanged",
        "check the order of the columns in the column map against the joints of the URDF",
    )


def _coupled_angle(each: Explanation, naming: Naming, sign: str, factor: int) -> FaultText:
    joint, other = each.change.joints
    return FaultText(
        "coupled angles",
        f"the recorded angle of {naming.joints[joint]} is probably its own {sign} that of"
        f" {naming.joints[other]}",
        "turn one joint alone and see which angles change; if so, state it in the column map of"
        f" the log: coupled = [[{joint + 1}, {other + 1}, {factor}]] in [position] and [velocity]"
        " (joints by their columns, from 1)",
    )


def _payload(each: Explanation) -> FaultText:
    return FaultText(
        "sameness",
        f"in {_part(each)} the arm carried {_size(each)} kg {_more(each)} than in the other data",
        "identify the recordings of each payload separately, or state a known payload in their"
        " cell file ([robot.payload])",
    )


def _changed(quantity: str, each: Explanation, joints: str) -> FaultText:
    return FaultText(
        "sameness",
        f"in {_part(each)} the {quantity} of {joints} is {_size(each, offset=1.0)} times that of"
        " the other data",
        "check what changed between the recordings: temperature, brakes, drive settings of"
        f" {joints}",
    )


def _changed_arm(each: Explanation) -> FaultText:
    return FaultText(
        "sameness",
        f"{_part(each)} is probably of another arm, tool or setting than the other data",
        "identify from recordings of one arm in one condition",
    )
