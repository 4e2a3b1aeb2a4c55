"""Facts about patterns of the torque residual."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from identification.arrays import Array
from identification.text import percentage
from identification.validation.evidence import Evidence
from identification.validation.facts.sameness import WARMER
from identification.validation.finding import Finding, Mask, Naming, Thresholds, indices
from identification.validation.residuals import Profile, ResidualChecks, Ripple


def _notable(checks: ResidualChecks, pattern: Profile | Ripple, limits: Thresholds) -> Mask:
    """Return the joints whose pattern is significant and large enough (n,)."""
    large = checks.share(pattern.rms) > limits.pattern
    return pattern.significant & large & (pattern.rms > limits.pattern_of_residual * checks.rms)


@dataclass(frozen=True)
class WhitenessFacts:
    """Rows of the fitted recordings, and how many independent ones they equal."""

    memory: float  # correlation time of the median axis [ms]
    rows: int
    worth: float  # independent rows
    parameters: int
    short: bool  # whether they are few

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> WhitenessFacts | None:
        """Compare the independent rows with the number of parameters."""
        if evidence.residuals is None:
            return None
        correlation = evidence.residuals.autocorrelation
        parameters = len(evidence.estimate.names)
        worth = float(np.nansum(correlation.effective_rows))
        return cls(
            memory=1e3 * float(np.nanmedian(correlation.time)),
            rows=int(correlation.rows.sum()),
            worth=worth,
            parameters=parameters,
            short=worth < limits.rows_per_parameter * parameters,
        )

    def findings(self, _: Naming) -> Iterator[Finding]:
        """Yield how many rows the recordings are worth."""
        text = (
            f"the residual is correlated over {self.memory:.3g} ms (median axis), {self.rows} rows"
            f" equal {self.worth:.0f} independent ones, for {self.parameters} parameters"
        )
        if self.short:
            yield Finding(
                "whiteness",
                "doubtful",
                f"the recordings are short: {text}",
                "record a longer motion, or the same one several times",
            )
        else:
            message = f"{text}; the standard deviations include this"
            yield Finding("whiteness", "good", message)


@dataclass(frozen=True, eq=False)
class ProfileFacts:
    """Residual that depends on the joint's own speed or position."""

    quantity: Literal["speed", "position"]
    joints: Mask  # whose residual depends on it (n,)
    worst: tuple[str, ...]  # mean residual of each joint where it is most significant

    @classmethod
    def of_speed(cls, evidence: Evidence, limits: Thresholds) -> ProfileFacts | None:
        """Return the dependence on speed."""
        checks = evidence.residuals
        if checks is None:
            return None
        return cls._of(evidence, checks, checks.speed, "speed", limits)

    @classmethod
    def of_position(cls, evidence: Evidence, limits: Thresholds) -> ProfileFacts | None:
        """Return the dependence on position."""
        checks = evidence.residuals
        if checks is None:
            return None
        return cls._of(evidence, checks, checks.position, "position", limits)

    @classmethod
    def _of(
        cls,
        evidence: Evidence,
        checks: ResidualChecks,
        profile: Profile,
        quantity: Literal["speed", "position"],
        limits: Thresholds,
    ) -> ProfileFacts:
        share = checks.share(profile.rms)
        worst = []
        for joint in range(len(share)):
            place, error = profile.worst(joint)
            torque, length = ("N·m", "rad") if evidence.revolute(joint) else ("N", "m")
            unit = f"{length}/s" if quantity == "speed" else length
            worst.append(
                f"({error:+.3g} {torque} about {place:.2g} {unit},"
                f" {percentage(share[joint], 1)} of its torque)"
            )
        return cls(quantity, _notable(checks, profile, limits), tuple(worst))

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the joints of such a residual, or that there are none."""
        check = f"residual over {self.quantity}"
        if not self.joints.any():
            message = f"the residual does not depend noticeably on {self.quantity}"
            yield Finding(check, "good", message)
            return
        worst = naming.each(self.joints, lambda joint: self.worst[joint])
        message = f"the residual depends on {self.quantity}: {worst}"
        step = (
            "check the URDF's geometry and gravity direction, and for a hose, spring or payload"
            " that the model lacks"
        )
        if self.quantity == "speed":
            message += "; the friction law may have another form"
            step = (
                f"try further friction terms for {naming.of(self.joints)} (Stribeck, asymmetric,"
                " third)"
            )
        yield Finding(check, "doubtful", message, step, "symptom", joints=indices(self.joints))


@dataclass(frozen=True, eq=False)
class RippleFacts:
    """Residual that follows the motor angle."""

    share: Array  # of the torque (n,)
    harmonic: tuple[int, ...]  # the strongest of each joint, per motor turn
    joints: Mask  # with a notable ripple (n,)
    large: Mask  # with a large one (n,)
    limit: float  # of the share

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> RippleFacts | None:
        """Compare the ripple with its limit; None without gear ratios."""
        checks = evidence.residuals
        if checks is None or checks.ripple is None:
            return None
        share = checks.share(checks.ripple.rms)
        joints = _notable(checks, checks.ripple, limits)
        return cls(
            share=share,
            harmonic=tuple(checks.ripple.strongest(joint) for joint in range(len(share))),
            joints=joints,
            large=joints & (share > limits.ripple),
            limit=limits.ripple,
        )

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the joints of large ripple, else those of any."""

        def size(joint: int) -> str:
            share = percentage(self.share[joint], 1)
            return f"({self.harmonic[joint]} per motor turn, {share} of its torque)"

        if not self.joints.any():
            yield Finding("torque ripple", "good", "no torque ripple is significant")
        elif not self.large.any():
            yield Finding(
                "torque ripple",
                "information",
                "torque ripple with the motor angle, of usual size:"
                f" {naming.each(self.joints, size)}",
            )
        else:
            yield Finding(
                "torque ripple",
                "doubtful",
                f"torque ripple with the motor angle exceeds {percentage(self.limit)} of the"
                f" torque: {naming.each(self.large, size)}",
                "record a long motion, which averages it, or compensate it separately: the model"
                " does not include it",
            )


@dataclass(frozen=True, eq=False)
class DriftFacts:
    """Change of friction during the recordings."""

    change: Array  # relative (n,)
    torque: Array  # change of torque, as a share of it (n,)
    joints: Mask  # of a significant change (n,)
    large: Mask  # of a large one (n,)
    limit: float  # of the share

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> DriftFacts | None:
        """Compare the change with its limit; None with too few recordings."""
        checks = evidence.residuals
        if checks is None or checks.drift is None:
            return None
        # A change counts by its share of the torque.
        torque = np.abs(checks.drift.change) * checks.friction_share
        joints = checks.drift.significant
        large = joints & (torque > limits.drift)
        return cls(checks.drift.change, torque, joints, large, limits.drift)

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the joints of a large change, else those of any."""

        def change(joint: int) -> str:
            return f"by {percentage(self.change[joint], 1, signed=True)}"

        if not self.joints.any():
            yield Finding(
                "friction over time",
                "good",
                "friction did not change significantly during the recordings",
            )
        elif not self.large.any():
            most = percentage(self.torque[self.joints].max(), 1)
            yield Finding(
                "friction over time",
                "information",
                f"friction changed during the recordings: {naming.each(self.joints, change)}, at"
                f" most {most} of an axis's torque",
            )
        else:
            yield Finding(
                "friction over time",
                "doubtful",
                f"friction changed during the recordings: {naming.each(self.large, change)}, more"
                f" than {percentage(self.limit)} of the torque",
                WARMER,
                "cause",
                reservation=f"friction of {naming.of(self.large)} changed during the recordings",
                joints=indices(self.large),
            )
