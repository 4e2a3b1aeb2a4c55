"""Findings about the recorded torque: without bodies or gravity, other zeros, another arm."""

from __future__ import annotations

from typing import Final

import numpy as np

from identification.distributions import SIGNIFICANT_SIGMAS
from identification.hypotheses.diagnosis import RigidTorque, TorqueDiagnosis
from identification.hypotheses.readings import Step
from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, RemedyKey, Thresholds, Value

_MAX_SCALE_RATIO: Final = 3.0  # of the torque to that of the masses; descriptions in use are closer


def is_other(evidence: Evidence) -> bool:
    """Whether a torque differs from its description: as a whole, reversed in time, or in zeros."""
    found = evidence.diagnosis
    if found is None:
        return False
    zeros = any(step.sure for step in found.zeros) or found.has_clear_zeros
    return found.is_otherwise or found.is_backwards or zeros


def other_meanings(evidence: Evidence, _: Thresholds) -> tuple[Finding, ...]:
    """Return how the torque differs from its description."""
    return () if evidence.diagnosis is None else of_diagnosis(evidence.diagnosis)


def of_diagnosis(found: TorqueDiagnosis) -> tuple[Finding, ...]:
    """Return how a torque differs from its description: whole, time, zeros, undetermined signs."""
    findings = [_zeros(found), *(_open(step) for step in found.discrete if not step.sure)]
    if found.rigid.is_nothing:
        findings.insert(0, without_bodies(found.rigid))
    elif found.is_weightless or found.is_partly_weightless:
        findings.insert(0, _without_gravity(found))
    elif found.is_rate:
        findings.insert(0, rate_of_torque())
    elif found.time is not None:
        times = {"time": found.time}
        findings.insert(
            0, Finding("other times", "wrong", "state the sampling rate", "cause", times)
        )
    if found.is_backwards:
        findings.insert(0, Finding("rows backwards", "wrong", "reverse the rows", "cause"))
    return tuple(finding for finding in findings if finding is not None)


def without_bodies(rigid: RigidTorque) -> Finding:
    """Return that a torque has almost no rigid-body part."""
    values = {"over_friction": float(rigid.over_friction.max()), "scale": rigid.scale}
    return Finding("no bodies", "wrong", "record all torque", "cause", values)


def rate_of_torque() -> Finding:
    """Return that a torque is the rate of one."""
    return Finding("rate of a torque", "wrong", "record the torque itself", "cause")


def another_run(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return that no masses explain a torque."""
    found = evidence.diagnosis
    if found is None or not (found.is_unexplained or found.is_unseen_unexplained):
        return None
    error, motion = found.error, "the fitted motion"
    if not found.is_unexplained and found.unseen_error is not None:
        error, motion = found.unseen_error, "the unseen motion"
    values: dict[str, Value] = {"error": error, "motion": motion}
    return Finding("torque of another run", "wrong", "record both in one run", "cause", values)


def _without_gravity(found: TorqueDiagnosis) -> Finding:
    assert found.weightless is not None
    ratio = {"ratio": found.weightless.ratio}
    if found.is_partly_weightless:
        return Finding("part of gravity", "wrong", "record torque with gravity", "cause", ratio)
    return Finding("no gravity", "wrong", "state that gravity was removed", "cause", ratio)


def _zeros(found: TorqueDiagnosis) -> Finding | None:
    """Return zeros of joints that differ from the URDF's, or the nearest to the data."""
    steps = found.zeros
    if not steps:
        return None
    offsets = np.zeros(len(found.rigid.over_friction))
    for step in steps:
        offsets[list(step.change.joints)] += step.change.size
    values: dict[str, Value] = {
        "error": _ratio(steps[0]),
        "offsets": tuple((offsets + 0.0).tolist()),
    }
    if all(step.sure for step in steps):
        finding = Finding("zeros", "wrong", "correct the zeros", "cause", values)
    elif found.has_clear_zeros:
        remedy: RemedyKey = "correct the zeros if so"
        finding = Finding("zeros, not all certain", "wrong", remedy, "cause", values)
    else:
        finding = Finding("zeros, nearest", "doubtful", "compare a posture")
    return finding.about(offsets != 0.0, degrees=np.degrees(offsets))


def _ratio(step: Step) -> float:
    """Return the error with a change over that without."""
    return step.error / max(step.before, 1e-300)


def _open(step: Step) -> Finding:
    """Return a sign or an order that is other than stated, or the nearest to an explanation."""
    change = step.change
    if not (step.is_explained and step.alike):
        values: dict[str, Value] = {"change": change}
        return Finding(
            "nearest", "doubtful", "compare with the map", values=values, joints=change.joints
        )
    alike = (change, *(other for other, _ in step.alike if other.is_discrete))
    values = {"change": change, "alike": alike, "error": _ratio(step)}
    return Finding("alike", "wrong", "jog and compare", "cause", values, joints=change.joints)


def another_arm(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Find masses that differ from the description, however well the model predicts.

    None where another finding says more, and where no joint shows a torque that its bodies must
    have: centres of mass that are uncertain by more than what a balanced arm lifts say no scale.
    """
    if evidence.diagnosis is None or is_other(evidence):
        return None
    rigid = evidence.diagnosis.rigid
    nominal = evidence.context.nominal_scale
    if not np.isfinite(rigid.scale) or nominal is None or not np.isfinite(nominal.scale).any():
        return None
    far = SIGNIFICANT_SIGMAS * rigid.std
    if rigid.scale - far < _MAX_SCALE_RATIO and rigid.scale + far > 1.0 / _MAX_SCALE_RATIO:
        return None
    scale = {"scale": rigid.scale}
    return Finding("another arm", "wrong", "check masses and units", "cause", scale)
