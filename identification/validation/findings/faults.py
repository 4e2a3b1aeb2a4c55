"""Findings about faults that explain errors: outliers, gravity, faults of the recordings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.hypotheses.column_scores import SEPARATE_ERROR_RATIO
from identification.hypotheses.explanation import Explanation
from identification.hypotheses.joint_changes import SIGNS, Change, Meaning
from identification.validation.evidence import Evidence
from identification.validation.finding import (
    Finding,
    FindingKey,
    Mask,
    RemedyKey,
    Thresholds,
    Value,
)
from identification.validation.findings.scale import all_opposite

_THROUGHOUT: Final[Mapping[Meaning, tuple[FindingKey, RemedyKey]]] = {
    "delay": ("delay of the torque", "use the delay found"),
    "drift": ("drift of a joint", "check the encoder of a joint"),
    "scale": ("torque constant", "check the constant"),
    "spring": ("spring", "describe the spring"),
    "load friction": ("load friction", "fit load friction"),
    "torque sign": ("torque sign", "check the sign in the map"),
    "position sign": ("position sign", "check the sign of the position"),
    "axis sign": ("axis sign", "jog the axes"),
    "torque order": ("torque order", "check the order"),
    "position order": ("position order", "check the order"),
    "joint order": ("joint order", "check the order"),
    "angle sum": ("angle sum", "state the coupled angle"),
    "angle difference": ("angle difference", "state the coupled difference"),
    "drive sum": ("drive sum", "state the coupled drive"),
    "drive difference": ("drive difference", "state the opposite coupled drive"),
}
_OF_PART: Final[Mapping[Meaning, tuple[FindingKey, RemedyKey]]] = {
    "payload": ("payload of a part", "separate the payloads"),
    "scale": ("torque of a part", "check what changed in between"),
    "friction": ("friction of a part", "check what changed in between"),
    "arm": ("arm of a part", "separate the arms"),
}


def _few_outliers(evidence: Evidence, limits: Thresholds) -> Mask:
    """Return the joints in which few samples cause most of the held-out error (n,)."""
    if evidence.residuals is None:
        return np.zeros(len(evidence.held_out.rows), dtype=np.bool_)
    outliers = evidence.residuals.outliers
    few = (outliers.power > limits.outlying_power) & (outliers.share < limits.outliers)
    # An error of rounding has a distribution of its own.
    relative = np.nan_to_num(evidence.held_out.relative)
    return np.asarray(few & (outliers.share > 0.0) & (relative > limits.pattern))


def _outliers_decide(evidence: Evidence, limits: Thresholds) -> bool:
    """Whether the error exceeds its limit with outliers only."""
    few = _few_outliers(evidence, limits)
    if evidence.residuals is None or not few.any():
        return False
    error = evidence.held_out
    without = evidence.residuals.outliers.without
    axis = (error.relative > limits.axis) & (without.relative <= limits.axis)
    all_axes = error.overall > evidence.allowed(limits) >= without.overall
    return all_axes or bool(np.any(axis & few))


def outliers(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints in which few samples cause most of the error on held-out motion."""
    few = _few_outliers(evidence, limits)
    if evidence.residuals is None or not few.any():
        return None
    found = evidence.residuals.outliers
    without = found.without.overall
    is_of_positions = bool(found.of_positions[few].all())
    return Finding(
        "outliers",
        "wrong" if _outliers_decide(evidence, limits) else "doubtful",
        "check the positions for steps" if is_of_positions else "check the torque for spikes",
        "cause",
        {"without": without},
        explains=1.0 - (without / max(evidence.held_out.overall, 1e-12)) ** 2,
    ).about(few, outlying=found.share)


def gravity_error(evidence: Evidence, limits: Thresholds) -> float | None:
    """Return the held-out error with another gravity over that with the declared one.

    None if the declared direction predicts about as well.
    """
    gravity = evidence.gravity
    if gravity is None:
        return None
    off = gravity.ratio < limits.gravity and np.degrees(gravity.angle) > limits.gravity_angle
    return float(np.sqrt(gravity.ratio)) if off else None


def gravity(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return a direction of gravity that fits much better than the declared one."""
    error = gravity_error(evidence, limits)
    if evidence.gravity is None or error is None:
        return None
    values: dict[str, Value] = {
        "best": _vector(evidence.gravity.best),
        "option": _vector(evidence.gravity.best, " "),
        "declared": _vector(evidence.gravity.declared),
        "angle": float(np.degrees(evidence.gravity.angle)),
        "error": error,
    }
    step: RemedyKey = "state the mounting"
    return Finding("gravity", "wrong", step, "cause", values, explains=1.0 - error**2)


def _vector(values: Array, between: str = ", ") -> str:
    """Return the entries of a vector, without negative zeros."""
    return between.join(f"{value + 0.0:.2f}" for value in np.round(values, 2))


def faults(evidence: Evidence, limits: Thresholds) -> tuple[Finding, ...]:
    """Return changes of the fitted recordings that make parts of them more predictable."""
    begun = () if evidence.diagnosis is None else evidence.diagnosis.begun
    return tuple(
        _fault(each, evidence, limits)
        if each.change.part is None or each.is_certain
        else _of_a_part(each, limits)
        for each in (*(evidence.explanations or ()), *begun)
        if not _is_left_out(each, evidence, limits)
    )


def _of_a_part(each: Explanation, limits: Thresholds) -> Finding:
    """Return that something in a part is other than in the rest, and what it may be."""
    change = each.change
    values: dict[str, Value] = {**fault_values(each), "nearest": (change, *each.others)}
    if "size" in values and not each.others:
        values["mass" if change.meaning == "payload" else "factor"] = values["size"]
    if each.rivals:
        values["alike"] = ((change, *each.others), *each.rivals)
    if each.excess > SEPARATE_ERROR_RATIO:
        values["excess"] = each.excess
    return Finding(
        "undetermined change of a part" if each.rivals else "unexplained part",
        "wrong" if each.ratio < limits.cause else "doubtful",
        "find what changed in between",
        "cause",
        values,
        explains=1.0 - each.ratio**2,
    )


def _is_left_out(each: Explanation, evidence: Evidence, limits: Thresholds) -> bool:
    """Whether outliers, gravity, opposite or changed torques explain more than a change."""
    change = each.change
    if _outliers_decide(evidence, limits):
        return True
    # Play, which the positions alone show, resembles a delay, and a drift of its joint.
    of_play = {each.joint for each in evidence.context.play}
    if of_play and (
        change.meaning == "delay" or (change.meaning == "drift" and of_play & {*change.joints})
    ):
        return True
    # The lag of commanded positions is that of the servo.
    if evidence.context.commanded_positions and change.meaning == "delay":
        return True
    error = gravity_error(evidence, limits)
    if error is not None and each.ratio > error:
        return True
    if (change.meaning in SIGNS or change.is_constant) and all_opposite(evidence):
        return True
    # A constant is relative to those of the other axes, of which one is wrong in one motion.
    changed = {change.joint for change in evidence.changes if change.kind == "gain"}
    is_strong = each.ratio < limits.cause or changed <= {*change.joints}
    return change.is_constant and not is_strong


def _fault(each: Explanation, evidence: Evidence, limits: Thresholds) -> Finding:
    scale_std = evidence.context.scale_std
    if scale_std is None:
        scale_std = np.zeros(len(evidence.held_out.rows))
    matters = np.nan_to_num(evidence.held_out.relative) > limits.unexplained
    key, remedy = fault_keys(each.change)
    if each.rivals:
        key, each = "torque constant or spring", each._replace(size=None)
    values = fault_values(each)
    if each.is_assumed(scale_std):
        return Finding(
            "torque constant, as assumed",
            "information",
            values={**values, "scale_std": each.relative_std(scale_std)},
            joints=each.change.joints,
        )
    # The ratio is a geometric mean over all joints, of which a scale of one hardly changes the
    # others: of a constant that matters it is that of its joint alone.
    alone = each.change.is_constant and bool(matters[[*each.change.joints]].any())
    ratio = each.ratio ** (len(matters) if alone else 1)
    certain = each.change.is_discrete or ratio < limits.cause
    return Finding(
        key,
        "wrong" if certain else "doubtful",
        remedy,
        "cause",
        values,
        explains=1.0 - each.ratio**2,
        joints=each.change.joints,
    )


def fault_keys(change: Change) -> tuple[FindingKey, RemedyKey]:
    """Return what a change of recordings is called, and what to do about it."""
    if change.part is not None and change.meaning in _OF_PART:
        return _OF_PART[change.meaning]
    return _THROUGHOUT[change.meaning]


def fault_values(each: Explanation) -> dict[str, Value]:
    """Return the figures of a change: its size as it is stated, if it is determined.

    That is ms of a delay, degrees of a drift, the factor of a scale. `difference` has the sign of
    the size, `whole` is what the ratio is of.
    """
    is_factor = each.change.meaning in ("scale", "friction")
    unit = {"delay": 1e3, "drift": np.degrees(1.0)}.get(each.change.meaning, 1.0)
    values: dict[str, Value] = {"ratio": each.ratio, "whole": "the fitted motion"}
    if each.size is not None:
        values |= {
            "size": abs(unit * each.size + (1.0 if is_factor else 0.0)),
            "half_interval": unit * each.half_interval,
            "difference": each.size,
        }
    if each.change.part is not None:
        values |= {"part": each.change.part.name, "whole": "the recordings"}
    return values
