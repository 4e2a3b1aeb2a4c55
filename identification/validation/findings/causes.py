"""What explains an error on all axes at once: gravity, a load, friction, spikes in the log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.validation.causes import Cause, Kind
from identification.validation.evidence import Evidence
from identification.validation.findings.finding import Finding, joined
from identification.validation.prediction import FRICTION_CHANGE
from identification.validation.residual_checks import Outliers
from identification.validation.thresholds import Thresholds

Array = NDArray[np.float64]


def gravity(_: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Gravity in another direction than the cell says."""
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


def causes(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Faults whose correction makes parts of the fitted recordings better predictable."""
    found = evidence.causes
    if found is None:
        return
    hidden = spoilt_by_outliers(evidence, limit)
    gravity_ratio = _gravity_ratio(evidence, limit)
    for cause in () if hidden else found.found:
        if cause.ratio > gravity_ratio:
            continue
        template = _TEMPLATES[cause.fault.kind]
        figures = _figures(names, cause, template)
        yield Finding(
            template.check,
            "wrong" if cause.fault.discrete or cause.ratio < limit.cause else "doubtful",
            f"{template.statement.format(**figures)}; with that corrected, parts of the fitted"
            f" motion are predicted from the rest with {cause.ratio:.2f} times the error",
            template.step.format(**figures),
            "cause",
        )
    if found.undecided and not evidence.in_sample and not found.found:
        yield Finding(
            "direction of axes",
            "information",
            "the data do not determine the direction of"
            f" {joined([names[j] for j in found.undecided], len(names))}: the opposite direction"
            " fits about as well",
        )


def _gravity_ratio(evidence: Evidence, limit: Thresholds) -> float:
    """Error with another gravity over that as declared, infinite where gravity is right."""
    found = evidence.gravity
    if found is None or not found.off(limit.gravity, limit.gravity_angle):
        return np.inf
    return float(np.sqrt(found.ratio))


class _Template(NamedTuple):
    """What is said of one kind of cause: templates that :func:`_figures` fill.

    Attributes:
        check: what was looked at.
        statement: what seems to be wrong.
        step: what to do about it.
        scale: from a cause's size to the figure that is shown.
        offset: added to that.
    """

    check: str
    statement: str
    step: str
    scale: float = 1.0
    offset: float = 0.0


def _order(of: str) -> _Template:
    return _Template(
        "order of joints",
        f"the {of} of {{first}} and {{last}} seem to be interchanged",
        "check the order of the columns in the column map against the joints of the URDF",
    )


def _change(of: str) -> _Template:
    return _Template(
        "sameness",
        f"in {{part}} the {of} of {{joints}} seems to be {{size}} times that in the rest of the"
        " fitted recordings",
        "look at what changed in between: temperature, brakes, drive settings of {joints}",
        offset=1.0,
    )


_TEMPLATES: Final[dict[Kind, _Template]] = {
    "delay": _Template(
        "delay",
        "the torque of {joints} lags the position by {size} ms {more} than assumed",
        "run `hil identify --delay auto`, and correct the delay where it arises",
        scale=1e3,
    ),
    "gain": _Template(
        "torque constant",
        "the torque of {joints} is {size} times what fits the torques of the other axes",
        "check torque constant and gear ratio of {joints}; recordings with and without a known"
        " payload determine the constant (`hil gains --loaded`)",
        offset=1.0,
    ),
    "torque sign": _Template(
        "direction of axes",
        "the torque of {joints} seems to have the other sign",
        "check the sign of the torque of {joints} in the column map, or of its torque constant",
    ),
    "axis sign": _Template(
        "direction of axes",
        "{joints} seems to turn in the direction opposite to the URDF's: the sign of its gear ratio"
        " or direction may be wrong",
        "jog {joints} by hand and compare its direction of rotation with the URDF's",
    ),
    "torque order": _order("torques"),
    "position order": _order("positions"),
    "joint order": _order("positions and torques"),
    "payload": _Template(
        "sameness",
        "in {part} the arm seems to have carried {size} kg {more} than in the rest of the fitted"
        " recordings",
        "identify the recordings of each payload separately, and state a payload that is known in"
        " their cell file ([robot.payload])",
    ),
    "changed gain": _change("torque"),
    "changed friction": _change("friction"),
    "changed arm": _Template(
        "sameness",
        "{part} seems to be of another arm, tool or setting than the rest of the fitted recordings",
        "identify from recordings of one arm in one condition",
    ),
}


def _figures(names: Sequence[str], cause: Cause, template: _Template) -> dict[str, str]:
    """What the fields of a template stand for."""
    joints = [names[j] for j in cause.fault.joints] or ["all axes"]
    size, scale = cause.size or 0.0, template.scale
    return {
        "joints": joined(joints, len(names)),
        "first": joints[0],
        "last": joints[-1],
        "part": "" if cause.fault.part is None else cause.fault.part.words,
        "size": f"{abs(template.offset + scale * size):.3g} ± {scale * 2.0 * cause.std:.2g}",
        "more": "more" if size > 0.0 else "less",
    }


def load(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """A body that hung on the arm on one side only."""
    found = evidence.load
    if found is None or found.explained < limit.load or 2 * found.axes < len(names):
        return
    more = f"{abs(found.mass):.3g} kg {'more' if found.mass > 0.0 else 'less'}"
    if np.isfinite(found.half_interval):
        more = more.replace(" kg", f" ± {found.half_interval:.2g} kg")
    yield Finding(
        "load",
        "wrong",
        f"on {evidence.tested_on} the arm seems to have carried {more} than on what was fitted: a"
        f" body on its last link explains {_most(found.explained)} of the error beyond that of the"
        " fit",
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
    found, joints = checks.outliers, _spiked(checks.outliers, limit)
    if not joints:
        return
    most = max(joints, key=lambda j: float(found.share[j]))
    yield Finding(
        "outliers",
        "wrong" if spoilt_by_outliers(evidence, limit) else "doubtful",
        f"single samples far outside of all others cause most of the error of"
        f" {joined([names[j] for j in joints])} on {evidence.tested_on} (at most"
        f" {found.share[most]:.2%} of the samples, {names[most]}); without them it is"
        f" {found.without.overall:.1%} over all axes",
        "look at the torques in the log: spikes, damaged packets, collisions; correct or leave them"
        " out, and fit with an estimator that bounds their influence (`hil identify --estimator"
        " tukey`, or huber)",
        "cause",
    )


def spoilt_by_outliers(evidence: Evidence, limit: Thresholds) -> bool:
    """Whether the error on unseen motion is beyond its limit with a few samples only."""
    checks = evidence.residuals
    if checks is None or checks.outliers is None:
        return False
    found, error = checks.outliers, evidence.held_out
    few = np.isin(np.arange(len(found.share)), _spiked(found, limit))
    axis = (error.relative > limit.axis) & (found.without.relative <= limit.axis)
    overall = error.overall > limit.overall >= found.without.overall
    return bool(np.any(axis & few)) or (overall and bool(few.any()))


def _spiked(found: Outliers, limit: Thresholds) -> list[int]:
    """Joints of which few samples make most of the error."""
    most = (found.power > limit.outlying_power) & (found.share < limit.outliers)
    return [int(joint) for joint in np.flatnonzero(most & (found.share > 0.0))]


def friction_change(
    names: Sequence[str], evidence: Evidence, limit: Thresholds
) -> Iterator[Finding]:
    """Friction that was another one on unseen motion."""
    change = evidence.friction_change
    if change is None:
        return
    decisive = evidence.spoilt_by_friction(limit.systematic)
    worth = np.abs(change) > limit.friction
    joints = np.flatnonzero(decisive | (worth & ~evidence.beyond_friction(limit.systematic)))
    if not joints.size:
        return
    words = (
        f"friction of {_changes(names, change, joints)} on {evidence.tested_on} than when it was"
    )
    words += " estimated"
    if decisive.any():
        spoilt = joined([names[j] for j in np.flatnonzero(decisive).tolist()], len(names))
        words += (
            f", more than the {FRICTION_CHANGE:.0%} expected of warmer gears; that explains the"
        )
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
    return ", of ".join(f"{joined(those, len(names))} was {what}" for what, those in alike.items())
