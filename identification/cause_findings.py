"""What explains an error on all axes at once: gravity, a load, friction, spikes in the log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from identification.evidence import Evidence
from identification.finding import Finding, listed
from identification.thresholds import Thresholds
from identification.validation import FRICTION_CHANGE

Array = NDArray[np.float64]


def gravity(_: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Gravity that pulls another way than the cell says."""
    found = evidence.gravity
    if found is not None and found.off(limit.gravity, limit.gravity_angle):
        declared, best = (_vector(one) for one in (found.declared, found.best))
        yield Finding(
            "gravity",
            "wrong",
            f"gravity seems to pull along {best} in the axes of the base,"
            f" {np.degrees(found.angle):.0f}° from {declared} as declared: with it"
            f" {evidence.tested_on} is predicted with {np.sqrt(found.ratio):.2f} times the error",
            "check how the arm is mounted, and set gravity of [robot] in the cell file to that; if"
            " it is right, check the zero positions of the joints",
            "cause",
        )


def _vector(gravity: Array) -> str:
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in np.round(gravity, 2)) + ") m/s²"


def load(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """A body that hung on the arm on one side only."""
    found = evidence.load
    if found is None or found.explained < limit.load or 2 * found.axes < len(names):
        return
    more = f"{abs(found.mass):.2g} kg {'more' if found.mass > 0.0 else 'less'}"
    yield Finding(
        "load",
        "wrong",
        f"on {evidence.tested_on} the arm seems to have carried {more} than on what was fitted: a"
        f" body on its last link explains {_most(found.explained)} of what the errors exceed those"
        " of the fit by",
        "record both with the same tool and payload, or identify and predict with the payload that"
        " was carried",
        "cause",
    )


def _most(share: float) -> str:
    return "more than 99%" if share > 0.99 else f"{share:.0%}"


def outliers(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Single samples that make most of the error."""
    checks = evidence.residuals
    if checks is None or checks.outliers is None:
        return
    found = checks.outliers
    joints = [
        j
        for j in range(len(names))
        if found.share[j] > 0.0
        and found.share[j] < limit.outliers
        and found.power[j] > limit.outlying_power
    ]
    if not joints:
        return
    most = max(joints, key=lambda j: float(found.share[j]))
    yield Finding(
        "outliers",
        "wrong" if spoilt_by_outliers(evidence, limit) else "doubtful",
        f"single samples far outside of all others make most of the error of"
        f" {listed([names[j] for j in joints])} on {evidence.tested_on} (at most"
        f" {found.share[most]:.2%} of the samples, {names[most]}); without them it is"
        f" {found.without.overall:.1%} over all axes",
        "look at the torques in the log: spikes, torn packets, collisions; mend or leave them out,"
        " and fit with --estimator tukey or huber, which they cannot pull far",
        "cause",
    )


def spoilt_by_outliers(evidence: Evidence, limit: Thresholds) -> bool:
    """Whether the error on unseen motion is beyond its limit with a few samples only."""
    checks = evidence.residuals
    if checks is None or checks.outliers is None:
        return False
    found, error = checks.outliers, evidence.held_out
    few = found.share < limit.outliers
    axis = (error.relative > limit.axis) & (found.without.relative <= limit.axis)
    overall = error.overall > limit.overall >= found.without.overall
    return bool(np.any(axis & few)) or (overall and bool(few.all()))


def friction_change(
    names: Sequence[str], evidence: Evidence, limit: Thresholds
) -> Iterator[Finding]:
    """Friction that was another one on unseen motion."""
    change = evidence.friction_change
    if change is None:
        return
    decisive = evidence.spoilt_by_friction(limit.systematic)
    worth = np.abs(change) > limit.friction
    told = np.flatnonzero(decisive | (worth & ~evidence.beyond_friction(limit.systematic)))
    if not told.size:
        return
    words = f"friction of {_changes(names, change, told)} on {evidence.tested_on} than when it was"
    words += " estimated"
    if decisive.any():
        spoilt = listed([names[j] for j in np.flatnonzero(decisive).tolist()], len(names))
        words += f", more than the {FRICTION_CHANGE:.0%} that warm gears excuse; that explains the"
        words += f" error of {spoilt}"
    yield Finding(
        "friction",
        "wrong" if decisive.any() else "doubtful",
        f"{words}; was the arm as warm?",
        "warm the arm up by moving it before recording",
        "cause",
    )


def _changes(names: Sequence[str], change: Array, joints: NDArray[np.intp]) -> str:
    """What friction did, joints that did the same together."""
    alike: dict[str, list[str]] = {}
    for j in joints.tolist():
        what = f"{abs(change[j]):.0%} {'higher' if change[j] > 0.0 else 'lower'}"
        alike.setdefault(what, []).append(names[j])
    return ", of ".join(f"{listed(those, len(names))} was {what}" for what, those in alike.items())
