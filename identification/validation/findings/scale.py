"""Findings about sign and scale of the torque, and about impossible signs of parameters."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.validation.evidence import Evidence
from identification.validation.finding import (
    Finding,
    Level,
    Mask,
    RemedyKey,
    Thresholds,
    Value,
)
from identification.validation.findings.diagnosis import is_other
from identification.validation.physical_signs import WrongSign

# Beyond this ratio the unit is wrong, or motor torques are in place of joint torques (gear ratios
# are 30 to 200); descriptions in use are closer.
_IMPOSSIBLE_SCALE: Final = 10.0
_SIGN_TOLERANCE: Final = 0.5  # of -1: scale of a torque of the opposite sign


class _TorqueScale(NamedTuple):
    """Measured torque of each axis over the torque of the nominal inertias."""

    scale: Array  # (n,), NaN where unknown
    tolerance: Array  # (n,)
    negated: bool  # whether all of them are negative
    opposite: Mask  # axes whose torque has the opposite sign, not all of them (n,)
    off: Mask  # axes of another scale (n,)
    impossible: bool  # whether the scale common to most axes is that of another quantity


def _torque_scale(evidence: Evidence) -> _TorqueScale | None:
    """Separate opposite signs from other scales; None if the torque is other than stated."""
    scale = evidence.context.nominal_scale
    if scale is None or is_other(evidence):
        return None
    negated = scale.negated
    if evidence.explanations is not None and not negated:
        # Torques of another joint or with the wrong sign have no nominal size.
        scale = scale.without(j for each in evidence.explanations for j in each.change.joints)
    common = scale.common
    off = np.isfinite(scale.scale) if common != 1.0 else scale.off
    near = np.abs(scale.scale + 1.0) < _SIGN_TOLERANCE
    opposite = off & (scale.scale + scale.tolerance < 0.0) & near
    return _TorqueScale(
        scale=scale.scale,
        tolerance=scale.tolerance,
        negated=negated,
        opposite=opposite & (not negated),
        off=off & ~opposite & (not negated),
        impossible=bool(abs(np.log(common)) > np.log(_IMPOSSIBLE_SCALE)),
    )


def scale_of_torque(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return the axes whose torque differs in scale from the nominal inertias."""
    found = _torque_scale(evidence)
    if found is None or not found.off.any():
        return None
    level: Level = "wrong" if found.impossible else "doubtful"
    return Finding("scale of the torque", level, "check the scale", "cause").about(
        found.off, scale=found.scale, tolerance=found.tolerance
    )


def _negated(evidence: Evidence, found: _TorqueScale | None) -> Mask:
    """Return the axes with a known scale, if all of them are negative (n,)."""
    if found is None:
        return np.zeros(len(evidence.held_out.rows), dtype=np.bool_)
    return np.isfinite(found.scale) & found.negated


def _is_backwards(evidence: Evidence) -> bool:
    return evidence.diagnosis is not None and evidence.diagnosis.is_backwards


def _driven(evidence: Evidence, found: _TorqueScale | None) -> Mask:
    """Return the axes that friction would drive, if it drives all with a known one (n,)."""
    dissipation = evidence.dissipation
    positive = found is not None and bool(np.any(found.scale - found.tolerance > 0.0))
    if (
        dissipation is None
        or _is_backwards(evidence)
        or positive
        or _negated(evidence, found).any()
    ):
        return np.zeros(len(evidence.held_out.rows), dtype=np.bool_)
    return dissipation.all_driving


def all_opposite(evidence: Evidence) -> bool:
    """Whether all torques have the opposite sign, or time runs backwards: one cause of many."""
    if _is_backwards(evidence):
        return True
    found = _torque_scale(evidence)
    return bool(_negated(evidence, found).any() or _driven(evidence, found).any())


def all_torques_opposite(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return that all torques have the opposite sign of the nominal inertial ones."""
    found = _torque_scale(evidence)
    negated = _negated(evidence, found)
    if found is None or not negated.any():
        return None
    return Finding("all torques opposite", "wrong", "negate all torques", "cause").about(
        negated, scale=found.scale
    )


def all_axes_driven(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return that friction would drive every axis."""
    driven = _driven(evidence, _torque_scale(evidence))
    dissipation = evidence.dissipation
    if dissipation is None or not driven.any():
        return None
    return Finding("all axes driven by friction", "wrong", "negate all torques", "cause").about(
        driven, friction=dissipation.torque, half_interval=2.0 * dissipation.std
    )


def torque_opposite(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return single axes whose torque has the opposite sign."""
    found = _torque_scale(evidence)
    if found is None or not found.opposite.any():
        return None
    step: RemedyKey = "check the sign of the torque"
    return Finding("torque opposite", "wrong", step, "cause").about(
        found.opposite, scale=found.scale
    )


def _of_sign(sign: WrongSign, level: Level) -> Finding:
    remedies: dict[Level, RemedyKey] = {
        "wrong": "check all signs",
        "doubtful": "use the consistent estimate",
    }
    is_chosen = sign.kind == "little friction at speed by a chosen term"
    return Finding(
        sign.kind,
        level,
        "compare with basic friction" if is_chosen else remedies[level],
        "symptom" if level == "wrong" else "condition",
        {"name": sign.name, **sign.figures, "unit": sign.unit},
        joints=sign.joints,
    )


def physical_signs(evidence: Evidence, _: Thresholds) -> tuple[Finding, ...]:
    """Return impossible signs of parameters that opposite torques do not explain."""
    signs = evidence.implausible
    added = tuple(_of_sign(sign, "doubtful") for sign in signs.added)
    if all_opposite(evidence):
        return added
    consistency = evidence.consistency
    none_fit: tuple[Finding, ...] = ()
    if consistency is not None and consistency.impossible:
        step: RemedyKey = "describe a balancer" if consistency.is_balanced else "check all signs"
        values: dict[str, Value] = {"consistency": consistency}
        none_fit = (Finding("no consistent parameters", "wrong", step, "symptom", values),)
    return (
        *(_of_sign(sign, "wrong") for sign in signs.impossible),
        *none_fit,
        *(_of_sign(sign, "doubtful") for sign in signs.doubtful),
        *added,
    )
