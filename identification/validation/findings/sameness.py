"""Findings about what differs on held-out motion: the load, the torque of a joint, its friction."""

from __future__ import annotations

import numpy as np

from identification.arrays import Array
from identification.hypotheses.unseen_changes import UnseenChange
from identification.validation.evidence import Evidence
from identification.validation.finding import (
    Finding,
    Level,
    Mask,
    RemedyKey,
    Thresholds,
    Value,
)
from identification.validation.findings.faults import gravity_error
from identification.validation.prediction import MAX_FRICTION_CHANGE


def load(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return a body on the last link on held-out motion only, if it explains the error."""
    found = evidence.load
    if found is None or found.explained < limits.load:
        return None
    half_interval = found.half_interval
    is_known = bool(np.isfinite(half_interval))
    if 2 * found.axes < len(evidence.held_out.rows):
        return None
    # A mass whose interval includes zero is no load; one without an interval is not known.
    if half_interval < np.inf and abs(found.mass) <= half_interval and found.is_throughout:
        return None
    values: dict[str, Value] = {"explained": found.explained}
    if found.is_throughout:  # else the mass is that of no time
        values |= {"mass": abs(found.mass), "difference": found.mass}
    if is_known and found.is_throughout:
        values["half_interval"] = half_interval
    return Finding("load", "wrong", "record with one payload", "cause", values)


def _changes(evidence: Evidence, limits: Thresholds) -> tuple[UnseenChange, ...] | None:
    """Return the changes of joints; None if another cause would look like one."""
    # Or it has spoilt the parameters.
    if load(evidence, limits) is not None or gravity_error(evidence, limits) is not None:
        return None
    # A gain of the fitted motion has not: of that motion only, it is what changed.
    others = [each for each in evidence.explanations or () if not each.change.is_constant]
    if any(each.change.is_discrete or each.ratio < limits.cause for each in others):
        return None
    if evidence.diagnosis is not None and evidence.diagnosis.begun:
        return None
    return evidence.changes


def _mask(changes: list[int], evidence: Evidence) -> Mask:
    return np.isin(np.arange(len(evidence.held_out.rows)), changes)


def changed_torque_of_large_errors(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints whose torque is a multiple of the fitted motion's."""
    return _changed_torque(evidence, limits, matters=True)


def changed_torque_of_small_errors(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints whose error needs no explanation."""
    return _changed_torque(evidence, limits, matters=False)


def _changed_torque(evidence: Evidence, limits: Thresholds, *, matters: bool) -> Finding | None:
    gains = [each for each in _changes(evidence, limits) or () if each.kind == "gain"]
    is_large = evidence.held_out.relative > limits.unexplained
    joints = _mask([each.joint for each in gains], evidence) & (is_large == matters)
    if not joints.any():
        return None
    factor, half_interval = np.full((2, len(joints)), np.nan)
    for each in gains:
        factor[each.joint] = each.ratio
        half_interval[each.joint] = 2.0 * each.std
    level: Level = "wrong" if matters else "doubtful"
    return Finding("changed torque", level, "check what changed", "cause").about(
        joints, factor=factor, half_interval=half_interval
    )


def friction(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints whose friction on held-out motion differs from the estimate.

    By changes beyond temperature, else by repetitions, which tell friction from noise.
    """
    found = _changes(evidence, limits)
    n = len(evidence.held_out.rows)
    nowhere = np.zeros(n, dtype=np.bool_)
    if found is not None:
        of_friction = [each for each in found if each.kind == "friction"]
        change = np.full(n, np.nan)
        for each in found:
            change[each.joint] = each.ratio - 1.0
        joints = _mask([each.joint for each in of_friction], evidence)
        alike = joints & _mask([each.joint for each in found if each.alike], evidence)
        # An error below that of a pattern is one of rounding or smoothing.
        noticed = evidence.held_out.relative > limits.pattern
        large = joints & (np.abs(change) > MAX_FRICTION_CHANGE)
        if np.any(large & noticed):
            return _large_change(change, large, large & alike)
        if evidence.friction_change is None:
            return _small_change(change, joints, alike, limits)
    if evidence.friction_change is None:
        return None
    change = evidence.friction_change
    share, apart = evidence.systematic, evidence.systematic_without_friction
    share = np.zeros(n) if share is None else np.nan_to_num(share)
    beyond = (share if apart is None else np.nan_to_num(apart)) > limits.systematic
    explained = (share > limits.systematic) & ~beyond
    if explained.any():
        return _large_change(change, explained, nowhere)
    return _small_change(change, (np.abs(change) > limits.friction) & ~beyond, nowhere, limits)


def _large_change(change: Array, joints: Mask, alike: Mask) -> Finding:
    """Return a change beyond what temperature causes, of the joints whose change is."""
    values = _alike(alike) | {"limit": MAX_FRICTION_CHANGE}
    return Finding("changed friction", "wrong", _remedy(alike), "cause", values).about(
        joints, change=change
    )


def _small_change(change: Array, joints: Mask, alike: Mask, limits: Thresholds) -> Finding | None:
    if not joints.any():
        return None
    values = _alike(alike) | {"limit": limits.friction}
    step: RemedyKey = _remedy(alike)
    return Finding("slightly changed friction", "doubtful", step, "cause", values).about(
        joints, change=change
    )


def _remedy(alike: Mask) -> RemedyKey:
    if alike.any():
        return "warm the arm up, and check what else changed"
    return "warm the arm up"


def _alike(alike: Mask) -> dict[str, Value]:
    """Return the joints of little more than friction, whose torque may be another as well."""
    return {"alike_joints": tuple(np.flatnonzero(alike).tolist())} if alike.any() else {}
