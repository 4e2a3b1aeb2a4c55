"""What the residual follows, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from identification.validation.evidence import Evidence
from identification.validation.findings.finding import Finding, joined
from identification.validation.residual_checks import ResidualChecks
from identification.validation.residual_profile import Profile
from identification.validation.thresholds import Thresholds

Array = NDArray[np.float64]


def noise(_: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """What the samples are worth, given how long the residual remembers."""
    checks = evidence.residuals
    if checks is None:
        return
    rows, worth = (
        int(checks.colour.rows.sum()),
        float(np.nansum(checks.colour.effective_rows)),
    )
    parameters = len(evidence.estimate.names)
    memory = 1e3 * float(np.nanmedian(checks.colour.time))
    text = (
        f"the residual is correlated over {memory:.3g} ms (median axis), so that {rows} rows are"
        f" worth about {worth:.0f} independent ones, for {parameters} parameters"
    )
    if worth < limit.rows_per_parameter * parameters:
        yield Finding(
            "whiteness",
            "doubtful",
            f"the recordings are short: {text}",
            "record a longer motion, or the same one several times",
        )
    else:
        yield Finding("whiteness", "good", f"{text}; the standard deviations allow for that")


def over_speed(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """A friction law of another form."""
    checks = evidence.residuals
    if checks is None:
        return
    joints = _stand_out(checks, checks.speed.rms, checks.speed.significant, limit)
    if not joints:
        yield Finding(
            "residual over speed",
            "good",
            "what is left over hardly depends on the joints' speed",
        )
        return
    yield Finding(
        "residual over speed",
        "doubtful",
        "what is left over depends on speed: "
        f"{_worst_bins(names, joints, checks, checks.speed, evidence, '/s')}: friction may not"
        " be of the form that was fitted",
        f"try further friction terms for {_names(names, joints)} (Stribeck, asymmetric, third)",
        "symptom",
    )


def over_position(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Gravity, geometry, or something that hangs on the arm."""
    checks = evidence.residuals
    if checks is None:
        return
    joints = _stand_out(checks, checks.position.rms, checks.position.significant, limit)
    if not joints:
        yield Finding(
            "residual over position",
            "good",
            "what is left over hardly depends on the posture",
        )
        return
    yield Finding(
        "residual over position",
        "doubtful",
        "what is left over depends on position: "
        f"{_worst_bins(names, joints, checks, checks.position, evidence, '')}",
        "check the URDF's geometry and gravity direction, and look for a hose, spring or payload"
        " that the model does not have",
        "symptom",
    )


def over_motor_angle(
    names: Sequence[str], evidence: Evidence, limit: Thresholds
) -> Iterator[Finding]:
    """Torque ripple."""
    checks = evidence.residuals
    if checks is None or checks.ripple is None:
        return
    ripple = checks.ripple
    joints = _stand_out(checks, ripple.rms, ripple.significant, limit)
    if not joints:
        yield Finding("torque ripple", "good", "no torque ripple stands out")
        return
    share = checks.share(ripple.rms)
    matters = [j for j in joints if share[j] > limit.ripple]
    found = ", ".join(
        f"{names[j]} ({ripple.strongest(j)} per motor turn, {share[j]:.1%} of its torque)"
        for j in matters or joints
    )
    text = f"a torque ripple comes and goes with the motors' turning: {found}"
    if not matters:
        yield Finding("torque ripple", "information", f"{text}, which is usual")
        return
    yield Finding(
        "torque ripple",
        "doubtful",
        text,
        "let it average out over a long motion, or compensate it apart: the model does not have it",
    )


def over_time(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Friction that changed while the recordings were made."""
    checks = evidence.residuals
    if checks is None or checks.drift is None:
        return
    change, significant = checks.drift.change, checks.drift.significant
    # Friction that hardly makes torque may change as it likes.
    weight = np.ones(len(names)) if checks.friction_share is None else checks.friction_share
    size = np.abs(change) * weight
    matters = [j for j in range(len(names)) if significant[j] and size[j] > limit.drift]
    joints = matters or [int(j) for j in np.flatnonzero(significant)]
    if not joints:
        yield Finding(
            "friction over time",
            "good",
            "no change of friction stands out while the recordings were made",
        )
        return
    found = ", ".join(
        f"{names[j]} by {abs(change[j]):.1%} {'up' if change[j] > 0.0 else 'down'}" for j in joints
    )
    text = f"friction changed while the recordings were made: {found}"
    if not matters:
        yield Finding(
            "friction over time",
            "information",
            f"{text}; that is at most {size[joints].max():.1%} of an axis's torque",
        )
        return
    yield Finding(
        "friction over time",
        "doubtful",
        text,
        "warm the arm up by moving it before recording",
        "cause",
    )


def saturation(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Motors at their limit."""
    share = evidence.surroundings.saturated
    if share is None:
        return
    joints = [j for j in range(len(names)) if share[j] > limit.saturated]
    if not joints:
        yield Finding("saturation", "good", "no torque or current was at its limit")
        return
    found = ", ".join(f"{names[j]} in {share[j]:.1%} of its samples" for j in joints)
    yield Finding(
        "saturation",
        "doubtful",
        f"torque or current was at its limit: {found}; what is logged there may be less than what"
        " was needed",
        f"slow the motion down where {_names(names, joints)} is at its limit",
        "cause",
    )


def _stand_out(
    checks: ResidualChecks,
    rms: Array,
    significant: NDArray[np.bool_],
    limit: Thresholds,
) -> list[int]:
    """Joints with a pattern that is beyond chance, and large enough to matter."""
    large = (checks.share(rms) > limit.pattern) & (rms > limit.pattern_of_residual * checks.rms)
    return [int(j) for j in np.flatnonzero(significant & large)]


def _names(names: Sequence[str], joints: Sequence[int]) -> str:
    return joined([names[j] for j in joints])


def _worst_bins(
    names: Sequence[str],
    joints: Sequence[int],
    checks: ResidualChecks,
    profile: Profile,
    evidence: Evidence,
    per: str,
) -> str:
    """Where each joint's pattern is largest, in units."""
    share = checks.share(profile.rms)
    found = []
    for j in joints:
        at, size = profile.worst(j)
        torque, angle = ("N·m", "rad") if evidence.revolute(j) else ("N", "m")
        found.append(
            f"{names[j]} ({size:+.3g} {torque} about {at:.2g} {angle}{per}, {share[j]:.1%} of its"
            " torque)"
        )
    return ", ".join(found)
