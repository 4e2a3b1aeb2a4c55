"""Is the result good? One sentence, and the reasons where it is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from identification.evidence import Evidence


@dataclass(frozen=True)
class Thresholds:
    """What a good result keeps to. Shares are of the axis's measured torque, both as RMS.

    The figures come from simulated NS 16 campaigns in which one sign was turned (each gear
    ratio, each wrist coupling, each torque constant, each Coulomb and viscous friction) against
    campaigns without a fault, unmodelled effects off and on.

    Attributes:
        overall: relative torque error over all axes. Fits of real arms that people publish with
            pride lie between 4 and 9 %.
        axis: relative torque error of one axis, noise included. Wrist axes of real arms, whose
            torque is mostly friction, reach 20 %; 35 % is not a model of an axis.
        systematic: slow error of one axis that neither noise nor a change of friction explains.
            Right models: below 0.1 % without, 1.9 % with ripple, drifting friction, elasticity
            and delay. One turned sign: 4.2 % and more on some axis.
        turned: squared slow error with an axis turned the other way, over that as it is. With the
            right directions: 0.83 and more. With the first axis of the NS 16 turned, which
            `systematic` misses when it moves slowly: 0.01 to 0.17 without, 0.33 to 0.54 with
            effects.
        inconsistency: difference between the torque that one repetition's own estimate and the
            pooled one predict on the training motion, as a share of the torque. Noise of the
            size that `axis` allows makes 2 %.
        friction: change of friction between training and unseen motion above which it is worth
            a word. It is taken out of the systematic error and never a reason to say no.
        generalisation: error on unseen motion over the error on the training motion, per axis:
            what is above is doubtful, and where the axis also misses by more than half of `axis`
            it is not good.
        nominal: by how much the overall error may exceed the nominal model's. A model that
            predicts worse than the data sheet is not worth using.
        rows: samples of unseen motion that an axis must have moved for; with fewer it was not
            tested.
        noticeable: systematic error that is worth a word. Torque constants of wrist axes that
            are wrong by 30 % show as 1 to 3 %, which right models with effects reach as well.
    """

    overall: float = 0.12
    axis: float = 0.35
    systematic: float = 0.03
    turned: float = 0.7
    inconsistency: float = 0.10
    friction: float = 0.03
    generalisation: float = 2.5
    nominal: float = 0.005
    rows: int = 100
    noticeable: float = 0.01


@dataclass(frozen=True)
class Verdict:
    """Answer to "is the result good?".

    Attributes:
        good: whether the model may be used.
        line: one sentence: whether it predicts unseen motion well, and by how much.
        reasons: what is wrong, in words; empty if good.
        doubts: what is not as it should be, but too small or too uncertain to say no.
    """

    good: bool
    line: str
    reasons: tuple[str, ...]
    doubts: tuple[str, ...] = ()


def judge(
    joint_names: Sequence[str],
    evidence: Evidence,
    thresholds: Thresholds = Thresholds(),
    *,
    tested_on: str = "unseen motion",
) -> Verdict:
    """Give the verdict.

    Args:
        joint_names: names of the n axes.
        evidence: see :func:`gather`.
        thresholds: what a good result keeps to.
        tested_on: what the held-out motion was, in words.
    """
    reasons = (
        *_untested(joint_names, evidence, thresholds),
        *_undetermined(evidence),
        *evidence.implausible.impossible,
        *_errors(joint_names, evidence, thresholds),
        *_growth(joint_names, evidence, thresholds, serious=True),
        *_turned(joint_names, evidence, thresholds),
        *_systematic(joint_names, evidence, thresholds),
        *_inconsistent(joint_names, evidence, thresholds),
        *_nominal(evidence, thresholds),
    )
    measure = _measure(joint_names, evidence, thresholds)
    if reasons:
        line = f"The model must not be relied on: {reasons[0]}; {measure}."
    else:
        line = f"The model predicts {tested_on} well: {measure}."
    doubts = (
        *evidence.implausible.doubtful,
        *_growth(joint_names, evidence, thresholds, serious=False),
        *_friction(joint_names, evidence, thresholds),
        *_noticeable(joint_names, evidence, thresholds),
    )
    return Verdict(good=not reasons, line=line, reasons=reasons, doubts=doubts)


def _measure(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> str:
    """How well unseen motion is predicted, in figures."""
    error = evidence.held_out
    if not error.rows.any():
        return "no torque error was measured"
    worst = int(np.nanargmax(error.relative))
    text = (
        f"torque error {error.overall:.1%} over all axes, {error.relative[worst]:.1%} at worst"
        f" ({names[worst]})"
    )
    systematic, change = evidence.systematic, evidence.friction_change
    if systematic is not None and not np.all(np.isnan(systematic)):
        axis = int(np.nanargmax(systematic))
        text += f"; beyond what noise explains {systematic[axis]:.1%} at worst ({names[axis]})"
        if change is not None and np.abs(change).max() > limit.friction:
            text += f", friction changed by up to {np.abs(change).max():.0%} apart"
    return text


def _untested(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> list[str]:
    """An axis that hardly moved has no error, which must not pass for a small one."""
    rows = evidence.held_out.rows
    untested = [name for axis, name in enumerate(names) if rows[axis] < limit.rows]
    if not untested:
        return []
    return [
        f"{', '.join(untested)} moved in fewer than {limit.rows} samples of unseen motion, which"
        " tests nothing"
    ]


def _noticeable(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> list[str]:
    share = evidence.systematic
    if share is None:
        return [
            "without repetitions of one motion an error of the drive train (a coupling or torque"
            " constant) cannot be told from noise, and was not looked for"
        ]
    return [
        f"noise does not explain {share[axis]:.1%} of the torque of {name} on unseen motion: the"
        " model lacks something small, or a torque constant is off"
        for axis, name in enumerate(names)
        if limit.noticeable < share[axis] <= limit.systematic
    ]


def _undetermined(evidence: Evidence) -> list[str]:
    names = evidence.estimate.undetermined
    if not names:
        return []
    listed = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
    return [f"the motion does not determine {listed}"]


def _errors(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> list[str]:
    found = []
    error = evidence.held_out
    if error.overall > limit.overall:
        found.append(
            f"the torque error on unseen motion is {error.overall:.1%} over all axes, more than"
            f" {limit.overall:.0%}"
        )
    for axis, name in enumerate(names):
        if error.relative[axis] > limit.axis:
            found.append(
                f"the torque error of {name} on unseen motion is {error.relative[axis]:.0%}, more"
                f" than {limit.axis:.0%}"
            )
    return found


def _growth(
    names: Sequence[str], evidence: Evidence, limit: Thresholds, *, serious: bool
) -> list[str]:
    unseen, seen = evidence.held_out.relative, evidence.training.relative
    found = []
    for axis, name in enumerate(names):
        growth = unseen[axis] / max(seen[axis], 1e-12)
        is_serious = unseen[axis] > 0.5 * limit.axis
        if growth > limit.generalisation and is_serious == serious:
            found.append(
                f"the torque error of {name} grows {growth:.1f} times from the training motion"
                f" to unseen motion, to {unseen[axis]:.1%}"
            )
    return found


def _systematic(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> list[str]:
    share = evidence.systematic
    if share is None:
        return []
    return [
        f"noise does not explain a torque error of {name} of {share[axis]:.1%} on unseen motion"
        f" (limit {limit.systematic:.1%}); a sign, coupling or constant of the drive train may be"
        " wrong, or the model lacks something"
        for axis, name in enumerate(names)
        if share[axis] > limit.systematic
    ]


def _friction(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> list[str]:
    change = evidence.friction_change
    if change is None:
        return []
    return [
        f"friction of {name} was {abs(change[axis]):.0%}"
        f" {'higher' if change[axis] > 0.0 else 'lower'} on unseen motion than when it was"
        " estimated; was the arm as warm?"
        for axis, name in enumerate(names)
        if abs(change[axis]) > limit.friction
    ]


def _turned(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> list[str]:
    gain = evidence.gain_if_turned
    if gain is None or gain.min() >= limit.turned:
        return []
    # Arms have mirror images: two axes may do equally well.
    alike = " or ".join(name for axis, name in enumerate(names) if gain[axis] < 1.2 * gain.min())
    return [
        f"unseen motion is predicted with {np.sqrt(gain.min()):.2f} times the error if {alike}"
        " counts the other way round: the sign of its gear ratio or direction may be wrong"
    ]


def _inconsistent(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> list[str]:
    share = evidence.disagreement
    if share is None:
        return []
    return [
        f"repetitions disagree: their estimates differ by up to {share[axis]:.0%} of the torque"
        f" of {name}, more than {limit.inconsistency:.0%}"
        for axis, name in enumerate(names)
        if share[axis] > limit.inconsistency
    ]


def _nominal(evidence: Evidence, limit: Thresholds) -> list[str]:
    if evidence.nominal is None:
        return []
    if evidence.held_out.overall <= evidence.nominal.overall + limit.nominal:
        return []
    return [
        f"the nominal model predicts better: {evidence.nominal.overall:.1%} against"
        f" {evidence.held_out.overall:.1%}"
    ]
