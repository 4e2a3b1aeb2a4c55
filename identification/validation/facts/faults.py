"""Facts about faults that explain errors: outliers, gravity, faults of the recordings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, assert_never

import numpy as np

from identification.arrays import Array
from identification.hypotheses.faults import Kind
from identification.text import percentage
from identification.validation.causes import Cause
from identification.validation.evidence import Evidence
from identification.validation.facts.scale import SignFacts
from identification.validation.finding import Finding, Mask, Naming, Thresholds

MOUNTING_STEP: Final = (
    "state how the arm is mounted: `--gravity X Y Z` where a log is read with its URDF, or gravity"
    " of [robot] in the cell file"
)
_SIGMAS: Final = 3.0  # standard deviations of a scale that is not as assumed
_SIGN_OR_SCALE: Final[tuple[Kind, ...]] = ("torque sign", "axis sign", "gain")


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


@dataclass(frozen=True)
class FaultFacts:
    """Faults whose correction makes parts of the fitted recordings more predictable."""

    causes: tuple[Cause, ...]
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
        causes = evidence.causes or ()
        if outliers is not None and outliers.decide:
            causes = ()
        if evidence.context.commanded_positions:  # the lag is that of the servo
            causes = tuple(cause for cause in causes if cause.fault.kind != "delay")
        if gravity is not None and gravity.off:
            causes = tuple(cause for cause in causes if not cause.ratio > gravity.error)
        if signs.all_opposite:
            causes = tuple(cause for cause in causes if cause.fault.kind not in _SIGN_OR_SCALE)
        # A constant is relative to those of the other axes, of which one is wrong in one motion.
        changed = {change.joint for change in evidence.changes if change.kind == "gain"}
        causes = tuple(
            cause
            for cause in causes
            if cause.fault.kind != "gain"
            or cause.ratio < limits.cause
            or changed <= {*cause.fault.joints}
        )
        std = evidence.context.scale_std
        std = np.zeros(len(evidence.held_out.rows)) if std is None else std
        matters = np.nan_to_num(evidence.held_out.relative) > limits.unexplained
        return cls(causes, limits.cause, std, matters)

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield each fault."""
        for cause in self.causes:
            joints = [naming.joints[joint] for joint in cause.fault.joints] or ["all axes"]
            text = _text(cause, " and ".join(joints), naming)
            certain = cause.fault.discrete or self._ratio_of(cause) < self.certain_below
            if self._is_assumed(cause):
                std = percentage(self._scale_std_of(cause), 1)
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
                f"{text.message}; correcting this multiplies the error of predicted parts of the"
                f" fitted motion by {cause.ratio:.2f}",
                text.step,
                "cause",
                explains=1.0 - cause.ratio**2,
            )

    def _ratio_of(self, cause: Cause) -> float:
        """Return the ratio of the errors, of a gain that matters that of its joint alone.

        It is a geometric mean over all joints, of which a gain of one hardly changes the others.
        """
        alone = cause.fault.kind == "gain" and bool(self.matters[[*cause.fault.joints]].any())
        return cause.ratio ** (len(self.matters) if alone else 1)

    def _is_assumed(self, cause: Cause) -> bool:
        """Return whether a torque is off by no more than the scale of torques may be."""
        if cause.fault.kind != "gain" or cause.fault.part is not None:
            return False
        return abs(cause.size or 0.0) <= _SIGMAS * self._scale_std_of(cause)

    def _scale_std_of(self, cause: Cause) -> float:
        """Return the standard deviation of a torque's scale over those of the others.

        Their scales are in that of the cause.
        """
        return float(np.hypot(self.scale_std[[*cause.fault.joints]].max(), cause.std))


class _Text(NamedTuple):
    check: str
    message: str
    step: str


def _text(cause: Cause, joints: str, naming: Naming) -> _Text:
    """Return the message on a cause of each kind."""
    match cause.fault.kind:
        case "delay":
            return _delay(cause, joints)
        case "gain":
            return _gain(cause, joints)
        case "load friction":
            return _load_friction(cause)
        case "torque sign":
            return _torque_sign(joints)
        case "axis sign":
            return _axis_sign(joints)
        case "torque order":
            return _order("torques", joints)
        case "position order":
            return _order("positions", joints)
        case "joint order":
            return _order("positions and torques", joints)
        case "angle sum":
            return _coupled_angle(cause, naming, "plus", 1)
        case "angle difference":
            return _coupled_angle(cause, naming, "less", -1)
        case "payload":
            return _payload(cause)
        case "changed gain":
            return _changed("torque", cause, joints)
        case "changed friction":
            return _changed("friction", cause, joints)
        case "changed arm":
            return _changed_arm(cause)
        case kind:
            assert_never(kind)


def _size(cause: Cause, scale: float = 1.0, offset: float = 0.0) -> str:
    """Return offset + scale * size of a cause, with its 95 % interval."""
    size = offset + scale * (cause.size or 0.0)
    return f"{abs(size):.3g} ± {scale * cause.half_interval:.2g}"


def _more(cause: Cause) -> str:
    return "more" if (cause.size or 0.0) > 0.0 else "less"


def _part(cause: Cause) -> str:
    return "" if cause.fault.part is None else cause.fault.part.name


def _delay(cause: Cause, joints: str) -> _Text:
    return _Text(
        "delay",
        f"the torque of {joints} lags the position by {_size(cause, scale=1e3)} ms {_more(cause)}"
        " than assumed",
        "run `hil identify --delay auto`, or correct the delay at its source",
    )


def _gain(cause: Cause, joints: str) -> _Text:
    return _Text(
        "torque constant",
        f"the torque of {joints} is {_size(cause, offset=1.0)} times the value consistent with the"
        " other axes",
        f"check torque constant and gear ratio of {joints}; recordings with and without a known"
        " payload determine the constant (`hil torque-constants --loaded`)",
    )


def _load_friction(cause: Cause) -> _Text:
    return _Text(
        "friction over load",
        f"friction grows with the load, by {_size(cause)} of the transmitted torque (median axis)",
        "fit it: add `load` to the terms of `--friction`, as in"
        " `--friction coulomb,viscous,load,offset`",
    )


def _torque_sign(joints: str) -> _Text:
    return _Text(
        "direction of axes",
        f"the torque of {joints} has probably the wrong sign",
        f"check the sign of the torque of {joints} in the column map, or of its torque constant",
    )


def _axis_sign(joints: str) -> _Text:
    return _Text(
        "direction of axes",
        f"{joints} probably turns opposite to the URDF: wrong sign of gear ratio or direction",
        f"jog {joints} by hand and compare its direction of rotation with the URDF's",
    )


def _order(quantity: str, joints: str) -> _Text:
    return _Text(
        "order of joints",
        f"the {quantity} of {joints} are probably interchanged",
        "check the order of the columns in the column map against the joints of the URDF",
    )


def _coupled_angle(cause: Cause, naming: Naming, sign: str, factor: int) -> _Text:
    joint, other = cause.fault.joints
    return _Text(
        "coupled angles",
        f"the recorded angle of {naming.joints[joint]} is probably its own {sign} that of"
        f" {naming.joints[other]}",
        "turn one joint alone and see which angles change; if so, state it in the column map of"
        f" the log: coupled = [[{joint + 1}, {other + 1}, {factor}]] in [position] and [velocity]"
        " (joints by their columns, from 1)",
    )


def _payload(cause: Cause) -> _Text:
    return _Text(
        "sameness",
        f"in {_part(cause)} the arm carried {_size(cause)} kg {_more(cause)} than in the other"
        " data",
        "identify the recordings of each payload separately, or state a known payload in their"
        " cell file ([robot.payload])",
    )


def _changed(quantity: str, cause: Cause, joints: str) -> _Text:
    return _Text(
        "sameness",
        f"in {_part(cause)} the {quantity} of {joints} is {_size(cause, offset=1.0)} times that of"
        " the other data",
        "check what changed between the recordings: temperature, brakes, drive settings of"
        f" {joints}",
    )


def _changed_arm(cause: Cause) -> _Text:
    return _Text(
        "sameness",
        f"{_part(cause)} is probably of another arm, tool or setting than the other data",
        "identify from recordings of one arm in one condition",
    )
