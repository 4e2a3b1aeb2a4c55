"""Findings about the fitted motion: which parameters it determines, and how well."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, Mask, Thresholds, Value


def _friction_pair(joint: int) -> tuple[str, str]:
    """Return the labels of Coulomb friction and offset of a joint."""
    return f"f0_{joint + 1}", f"fo_{joint + 1}"


def _without_friction(labels: Sequence[str], n_joints: int) -> tuple[int, ...]:
    """Return the joints of which Coulomb or viscous friction is among labels."""
    return tuple(
        joint
        for joint in range(n_joints)
        if not {f"{symbol}_{joint + 1}" for symbol in ("f0", "f1")}.isdisjoint(labels)
    )


def _one_way(evidence: Evidence) -> Mask:
    if evidence.one_way is None:
        return np.zeros(len(evidence.held_out.rows), dtype=np.bool_)
    return evidence.one_way


def _only_sum(evidence: Evidence) -> Mask:
    """Return the joints for which only the sum of friction and offset is determined (n,).

    Both are the same column for a joint that moved in one direction.
    """
    labels = {*evidence.estimate.undetermined}
    one_way = _one_way(evidence)
    both = [{*_friction_pair(joint)} <= labels for joint in range(len(one_way))]
    return np.array(both, dtype=np.bool_) & one_way


def undetermined(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return parameters without an estimate that motion in one direction does not explain."""
    joints = np.flatnonzero(_only_sum(evidence)).tolist()
    explained = {label for joint in joints for label in _friction_pair(joint)}
    labels = [label for label in evidence.estimate.undetermined if label not in explained]
    if not labels:
        return None
    values: dict[str, Value] = {
        "parameters": tuple(labels),
        "count": len(labels),
        "total": len(evidence.estimate.values),
    }
    if friction := _without_friction(labels, len(evidence.held_out.rows)):
        values["friction_joints"] = friction
    return Finding("undetermined", "wrong", "design a motion", values=values)


def undetermined_in_one_direction(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return the joints for which only the sum of friction and offset is determined."""
    joints = _only_sum(evidence)
    if not joints.any():
        return None
    coulomb, offset = zip(*map(_friction_pair, range(len(joints))), strict=True)
    found = Finding("undetermined in one direction", "wrong", "move in both directions")
    return found.about(joints, coulomb=coulomb, offset=offset)


def poor_excitation(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return a large condition number of the regressor with unit columns."""
    condition = evidence.estimate.condition
    if evidence.estimate.undetermined or not condition > limits.condition:
        return None
    values: dict[str, Value] = {"condition": condition, "limit": limits.condition}
    return Finding("poor excitation", "doubtful", "design a motion", values=values)


def one_direction(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return the other joints that moved in one direction only."""
    joints = _one_way(evidence) & ~_only_sum(evidence)
    if not joints.any():
        return None
    return Finding("one direction", "doubtful", "move in both directions").about(joints)


def good_excitation(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return that every parameter is well determined."""
    condition = evidence.estimate.condition
    if evidence.estimate.undetermined or condition > limits.condition:
        return None
    return Finding("good excitation", "good", values={"condition": condition})
