"""Findings about patterns of the torque residual."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, Mask, Thresholds, Value
from identification.validation.residuals import Profile, ResidualChecks
from identification.validation.ripple import Ripple

_NO_FRICTION: Final = -1.0  # relative change of a friction that vanishes


def _notable(checks: ResidualChecks, pattern: Profile | Ripple, limits: Thresholds) -> Mask:
    """Return the joints whose pattern is significant and large enough (n,)."""
    large = checks.share(pattern.rms) > limits.pattern
    return pattern.significant & large & (pattern.rms > limits.pattern_of_residual * checks.rms)


def correlation(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Compare the independent rows of the fitted recordings with the number of parameters."""
    if evidence.residuals is None:
        return None
    autocorrelation = evidence.residuals.autocorrelation
    if np.isnan(autocorrelation.time).all():
        return None  # no rows
    parameters = len(evidence.estimate.names)
    worth = float(np.nansum(autocorrelation.effective_rows))
    values: dict[str, Value] = {
        "memory": 1e3 * float(np.nanmedian(autocorrelation.time)),
        "rows": int(autocorrelation.rows.sum()),
        "worth": worth,
        "parameters": parameters,
    }
    if worth < limits.rows_per_parameter * parameters:
        return Finding("short recordings", "doubtful", "record a longer motion", values=values)
    return Finding("correlated residual", "good", values=values)


def over_speed(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints whose residual depends on their speed, or that there are none."""
    checks = evidence.residuals
    if checks is None:
        return None
    joints = _notable(checks, checks.speed, limits) & ~evidence.unfitted
    if not joints.any():
        return Finding("no residual over speed", "good")
    found = Finding("residual over speed", "doubtful", "try friction terms", "symptom")
    return _with_worst(found, evidence, joints, checks.speed, "/s")


def over_position(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints whose residual depends on their position, or that there are none."""
    checks = evidence.residuals
    if checks is None:
        return None
    joints = _notable(checks, checks.position, limits) & ~evidence.unfitted
    if not joints.any():
        return Finding("no residual over position", "good")
    found = Finding("residual over position", "doubtful", "check the geometry", "symptom")
    return _with_worst(found, evidence, joints, checks.position)


def _with_worst(
    found: Finding, evidence: Evidence, joints: Mask, profile: Profile, per_second: str = ""
) -> Finding:
    """Add the mean residual of each joint where it is most significant."""
    checks = evidence.residuals
    assert checks is not None
    n = len(joints)
    at, error = zip(*(profile.worst(joint) for joint in range(n)), strict=True)
    turns = [evidence.revolute(joint) for joint in range(n)]
    return found.about(
        joints,
        at=at,
        error=error,
        torque_unit=["N·m" if turn else "N" for turn in turns],
        unit=[f"{'rad' if turn else 'm'}{per_second}" for turn in turns],
        relative=checks.share(profile.rms),
    )


def ripple(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints whose residual repeats with the motor angle, else with their own."""
    checks = evidence.residuals
    if checks is None:
        return None
    found = checks.ripple
    share = checks.share(found.rms)
    joints = _notable(checks, found, limits) & ~evidence.unfitted
    large = joints & (share > limits.ripple)
    if found.turn == "joint":
        if not joints.any():
            return None
        finding = Finding("ripple over the angle", "information", role="cause")
        if large.any():
            finding = replace(finding, level="doubtful", remedy="average the ripple")
        return finding.about(joints, relative=share, periods=found.periods)
    harmonic = [round(periods) for periods in found.periods.tolist()]
    if not joints.any():
        return Finding("no ripple", "good")
    if not large.any():
        return Finding("usual ripple", "information").about(
            joints, relative=share, harmonic=harmonic
        )
    limit = {"limit": limits.ripple}
    return Finding("large ripple", "doubtful", "average the ripple", values=limit).about(
        large, relative=share, harmonic=harmonic
    )


def friction_drift(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints whose friction changed during the recordings, or that there are none.

    None where a fault explains most of the residual: what is left of its pattern resembles drift.
    """
    checks = evidence.residuals
    if checks is None or checks.drift is None:
        return None
    if any(each.ratio < limits.cause for each in evidence.explanations or ()):
        return None
    change: Array = checks.drift.change
    # A change counts by its share of the torque.
    torque = np.abs(change) * checks.friction_share
    joints = checks.drift.significant & (change > _NO_FRICTION)
    large = joints & (torque > limits.drift)
    if not joints.any():
        return Finding("no friction drift", "good")
    if not large.any():
        most = {"most": float(torque[joints].max())}
        return Finding("small friction drift", "information", values=most).about(
            joints, change=change
        )
    limit = {"limit": limits.drift}
    return Finding("large friction drift", "doubtful", "warm the arm up", "cause", limit).about(
        large, change=change
    )
