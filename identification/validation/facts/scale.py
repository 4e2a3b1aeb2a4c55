"""Facts about sign and scale of the torque, and about impossible signs of parameters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.validation.consistency import ELEMENTS
from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, Mask, Naming

IMPOSSIBLE: Final = "physical signs"
"""Name of the check whether bodies with these parameters can exist."""
# Beyond this ratio the unit is wrong, or motor torques are in place of joint torques (gear ratios
# are 30 to 200); descriptions in use are closer.
_IMPOSSIBLE_SCALE: Final = 10.0
_NEAR: Final = 0.5  # of -1: scale of a torque of the opposite sign
_NEGATE: Final = "set scale = -1 for the torques in the column map, or negate all torque constants"
_BALANCED: Final = (
    f"describe {ELEMENTS} that carries part of the weight in [[robot.elements]] of the cell file;"
    " else check the sign of the torque and the direction of each axis"
)
_SIGNS: Final = (
    "check the sign of the torque and the direction of each axis in the column map or cell"
)


@dataclass(frozen=True, eq=False)
class ScaleFacts:
    """Measured torque of each axis over that of the nominal inertias."""

    scale: Array  # (n,), NaN where unknown
    tolerance: Array  # (n,)
    negated: bool  # whether all of them are negative
    opposite: Mask  # axes whose torque has the opposite sign, not all of them (n,)
    off: Mask  # axes of another scale (n,)
    impossible: bool  # whether the scale common to most axes is that of another quantity

    @classmethod
    def of(cls, evidence: Evidence) -> ScaleFacts | None:
        """Separate opposite signs from other scales."""
        scale = evidence.context.nominal_scale
        if scale is None:
            return None
        negated = scale.negated
        if evidence.explanations is not None and not negated:
            # Torques of another joint or with the wrong sign have no nominal size.
            scale = scale.without(j for each in evidence.explanations for j in each.change.joints)
        common = scale.common
        off = np.isfinite(scale.scale) if common != 1.0 else scale.off
        near = np.abs(scale.scale + 1.0) < _NEAR
        opposite = off & (scale.scale + scale.tolerance < 0.0) & near
        return cls(
            scale=scale.scale,
            tolerance=scale.tolerance,
            negated=negated,
            opposite=opposite & (not negated),
            off=off & ~opposite & (not negated),
            impossible=bool(abs(np.log(common)) > np.log(_IMPOSSIBLE_SCALE)),
        )

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the axes of another scale."""
        if not self.off.any():
            return
        scales = naming.each(
            self.off, lambda joint: f"{self.scale[joint]:.3g} ± {self.tolerance[joint]:.2g}"
        )
        yield Finding(
            "scale of the torque",
            "wrong" if self.impossible else "doubtful",
            f"ratio of measured torque to the torque of the nominal inertias: {scales}",
            "check unit, side (motor or joint), torque constant and gear ratio of the torque of"
            f" {naming.of(self.off)}, the payload, and the masses of the URDF",
            "cause",
        )


@dataclass(frozen=True, eq=False)
class SignFacts:
    """Axes whose torque has the opposite sign."""

    scale: Array  # measured torque over that of the nominal inertias (n,)
    negated: Mask  # axes with a known scale, if all of them are negative (n,)
    opposite: Mask  # single axes (n,)
    driving: Mask  # axes that friction would drive, if it drives all with a known one (n,)
    friction: tuple[str, ...]  # of each axis at its top speed, with its interval

    @classmethod
    def of(cls, evidence: Evidence, scale: ScaleFacts | None) -> SignFacts:
        """Compare the torque with nominal inertias and friction."""
        none = np.zeros(len(evidence.held_out.rows), dtype=np.bool_)
        negated = none if scale is None else np.isfinite(scale.scale) & scale.negated
        driving = none
        friction = tuple("" for _ in none)
        if (dissipation := evidence.dissipation) is not None:
            positive = scale is not None and bool(np.any(scale.scale - scale.tolerance > 0.0))
            driving = dissipation.all_driving & (not (positive or bool(negated.any())))
            friction = tuple(dissipation.described)
        return cls(
            scale=np.full(len(none), np.nan) if scale is None else scale.scale,
            negated=negated,
            opposite=none if scale is None else scale.opposite,
            driving=driving,
            friction=friction,
        )

    @property
    def all_opposite(self) -> bool:
        """Whether the torques of all axes have the opposite sign, one cause of many signs."""
        return bool(self.negated.any() or self.driving.any())

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield all torques of the opposite sign, or single ones."""

        def scale(joint: int) -> str:
            return f"{self.scale[joint]:.2g}"

        if self.negated.any():
            yield Finding(
                "direction of axes",
                "wrong",
                "all torques have the opposite sign of the nominal inertial torques: ratio"
                f" {naming.each(self.negated, scale)}",
                _NEGATE,
                "cause",
            )
        if self.driving.any():
            friction = naming.each(self.driving, lambda joint: self.friction[joint])
            yield Finding(
                "direction of axes",
                "wrong",
                "all torques have the opposite sign: friction would drive every axis,"
                f" {friction} at top speed",
                _NEGATE,
                "cause",
            )
        if self.opposite.any():
            yield Finding(
                "direction of axes",
                "wrong",
                "the torque has the opposite sign of the nominal inertial torque: ratio"
                f" {naming.each(self.opposite, scale)}",
                f"check the sign of the torque of {naming.of(self.opposite)} in the column map, or"
                " of its torque constant",
                "cause",
            )


@dataclass(frozen=True)
class PhysicalSignFacts:
    """Messages on physically impossible signs of parameters."""

    impossible: tuple[str, ...]
    doubtful: tuple[str, ...]
    added_friction: tuple[str, ...]  # friction that falls by a term that nobody stated
    inconsistency: str = ""  # that no rigid bodies produce the predicted torque
    is_balanced: bool = False  # whether a spring or a balancer would explain that

    @classmethod
    def of(cls, evidence: Evidence, signs: SignFacts) -> PhysicalSignFacts:
        """Leave out signs that opposite torques explain."""
        implausible = evidence.implausible
        consistency = evidence.consistency
        if signs.all_opposite:
            return cls((), (), implausible.added)
        if consistency is None or not consistency.impossible:
            return cls(*implausible)
        inconsistency = f"{consistency.sentence}: {consistency.remedy}"
        is_balanced = consistency.is_balanced
        return cls(*implausible, inconsistency=inconsistency, is_balanced=is_balanced)

    def findings(self, _: Naming) -> Iterator[Finding]:
        """Yield each message."""
        for message in self.impossible:
            yield Finding(IMPOSSIBLE, "wrong", message, _SIGNS, "symptom")
        if self.inconsistency:
            step = _BALANCED if self.is_balanced else _SIGNS
            yield Finding(IMPOSSIBLE, "wrong", self.inconsistency, step, "symptom")
        step = "use the consistent estimate where the model must be physical (simulation, URDF)"
        for message in self.doubtful:
            yield Finding(IMPOSSIBLE, "doubtful", message, step)
        step = "compare with `hil identify --friction coulomb,viscous,offset`"
        for message in self.added_friction:
            yield Finding("friction law", "doubtful", message, step)
