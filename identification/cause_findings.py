"""What explains an error on all axes at once: gravity, a load, friction, spikes in the log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.causes import Cause, Kind
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


def causes(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Faults with which, once mended, parts of what was fitted are predicted better."""
    found = evidence.causes
    if found is None:
        return
    hidden = spoilt_by_outliers(evidence, limit)
    gravity_ratio = _gravity_ratio(evidence, limit)
    for cause in () if hidden else found.found:
        if cause.ratio > gravity_ratio:
            continue
        check, words, step = _CAUSES[cause.fault.kind](names, cause)
        yield Finding(
            check,
            "wrong" if cause.fault.discrete or cause.ratio < limit.cause else "doubtful",
            f"{words}; with that, parts of the fitted motion are predicted from the rest with"
            f" {cause.ratio:.2f} times the error",
            step,
            "cause",
        )
    if found.undecided and not evidence.in_sample and not found.found:
        yield Finding(
            "direction of axes",
            "information",
            "the data do not determine the direction of"
            f" {listed([names[j] for j in found.undecided], len(names))}: counting the other way"
            " round would fit about as well",
        )


def _gravity_ratio(evidence: Evidence, limit: Thresholds) -> float:
    """Error with another gravity over that as declared, infinite where gravity is right."""
    found = evidence.gravity
    if found is None or not found.off(limit.gravity, limit.gravity_angle):
        return np.inf
    return float(np.sqrt(found.ratio))


_Words = tuple[str, str, str]


def _of(names: Sequence[str], cause: Cause) -> str:
    return listed([names[j] for j in cause.fault.joints], len(names)) or "all axes"


def _figure(cause: Cause, scale: float = 1.0, offset: float = 0.0) -> str:
    size = abs(offset + scale * (cause.size or 0.0))
    return f"{size:.3g} ± {abs(scale) * 2.0 * cause.std:.2g}"


def _where(cause: Cause) -> str:
    return "" if cause.fault.part is None else cause.fault.part.words


def _delay(names: Sequence[str], cause: Cause) -> _Words:
    verb = "lags" if (cause.size or 0.0) > 0.0 else "leads"
    return (
        "delay",
        f"the torque of {_of(names, cause)} {verb} the position by {_figure(cause, 1e3)} ms more"
        " than assumed",
        "identify with --delay auto, and correct the delay where it arises",
    )


def _gain(names: Sequence[str], cause: Cause) -> _Words:
    joint = _of(names, cause)
    return (
        "torque constant",
        f"the torque of {joint} is {_figure(cause, 1.0, 1.0)} times what the torques of the other"
        " axes ask for",
        f"check torque constant and gear ratio of {joint}; a known payload settles it (hil gains)",
    )


def _torque_sign(names: Sequence[str], cause: Cause) -> _Words:
    joint = _of(names, cause)
    return (
        "direction of axes",
        f"the torque of {joint} seems to have the other sign",
        f"check the sign of the torque of {joint} in the column map, or of its torque constant",
    )


def _axis_sign(names: Sequence[str], cause: Cause) -> _Words:
    joint = _of(names, cause)
    return (
        "direction of axes",
        f"{joint} seems to count the other way round than in the URDF: the sign of its gear ratio"
        " or direction may be wrong",
        f"jog {joint} by hand and compare its direction of rotation with the URDF's",
    )


def _order(of: str) -> Callable[[Sequence[str], Cause], _Words]:
    def words(names: Sequence[str], cause: Cause) -> _Words:
        first, second = (names[j] for j in cause.fault.joints)
        return (
            "order of joints",
            f"the {of} of {first} and {second} seem to stand in each other's column",
            "check the order of the columns in the column map against the joints of the URDF",
        )

    return words


def _payload(_: Sequence[str], cause: Cause) -> _Words:
    more = "more" if (cause.size or 0.0) > 0.0 else "less"
    return (
        "sameness",
        f"in {_where(cause)} the arm seems to have carried {_figure(cause)} kg {more} than in the"
        " rest of what was fitted",
        "fit only recordings with one payload, or state what each carries (hil import log"
        " --payload)",
    )


def _changed(what: str) -> Callable[[Sequence[str], Cause], _Words]:
    def words(names: Sequence[str], cause: Cause) -> _Words:
        joint = _of(names, cause)
        return (
            "sameness",
            f"in {_where(cause)} the {what} of {joint} seems to be {_figure(cause, 1.0, 1.0)} times"
            " that in the rest of what was fitted",
            f"look at what changed in between: temperature, brakes, drive settings of {joint}",
        )

    return words


def _changed_arm(_: Sequence[str], cause: Cause) -> _Words:
    return (
        "sameness",
        f"{_where(cause)} seems to be of another arm, tool or setting than the rest of what was"
        " fitted",
        "identify from recordings of one arm in one condition",
    )


_CAUSES: Final[dict[Kind, Callable[[Sequence[str], Cause], _Words]]] = {
    "delay": _delay,
    "gain": _gain,
    "torque sign": _torque_sign,
    "torque order": _order("torques"),
    "axis sign": _axis_sign,
    "position order": _order("positions"),
    "joint order": _order("positions and torques"),
    "payload": _payload,
    "changed gain": _changed("torque"),
    "changed friction": _changed("friction"),
    "changed arm": _changed_arm,
}


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
