"""What an arm carries from campaign to campaign: what is stated, and what the torques say.

A payload that a cell states is known, and its torque is no part of the parameters. Parameters that
change although nothing else was stated are a discovered change. Where the statement changes, two
things are tested: the parameters as they are, which stay where they were if the arm now carries
what is stated, and the parameters with the stated body put back, which stay where they were if it
carried the same before and only the statement is new.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import t as student

from hil.batch import payload_change
from hil.batch.payload_change import Change, Projection, State
from hil.batch.types import LevelEstimate
from identification import RobotModel
from identification.model.payload import Payload

Array = NDArray[np.float64]

LEAST_EFFECT: Final = 0.10
"""A change of payload is told if its RMS torque is at least this share of the torque residual."""

Verdict = Literal["agrees", "statement only", "either", "differs", "untested"]

_NORMAL = float(student.ppf(0.975, 1e6))


@dataclass(frozen=True)
class Statement:
    """A campaign that states another payload than the one before.

    Attributes:
        before: what was stated before; None for nothing.
        after: what is stated now.
        verdict: what the torques say: "agrees", the arm carries what is stated as it did before;
            "statement only", it carries the same as before; "either", both are possible; "differs",
            neither is; "untested".
    """

    before: Payload | None
    after: Payload | None
    verdict: Verdict


@dataclass(frozen=True, eq=False)
class PayloadTrend:
    """What the last link carries beside what it carried in the first campaign.

    Attributes:
        changes: of the parameters of each campaign against those before it since the last change;
            None of the first.
        changed: which campaigns differ in what the last link carries, beside what is stated.
        other: which differ in their inertial parameters, but not as a payload would.
        statements: of the campaigns that state another payload than the one before.
        mass: on top of the first campaign's, stated or not [kg] (c,); NaN where it cannot be seen.
        mass_std: (c,).
        untested: why there is no test; "" if there is.
    """

    changes: tuple[Change | None, ...]
    changed: tuple[bool, ...]
    other: tuple[bool, ...]
    statements: tuple[Statement | None, ...]
    mass: Array
    mass_std: Array
    untested: str = ""


def payload_trend(
    model: RobotModel, campaigns: Sequence[LevelEstimate], share: float
) -> PayloadTrend:
    """Find what changed in what the arm carries.

    Args:
        model: the robot.
        campaigns: in order of time.
        share: of campaigns said to differ if nothing has changed.
    """
    onto = _projection(model, campaigns)
    if isinstance(onto, str):
        return _untested(campaigns, onto)
    bare = [
        payload_change.state(onto, one.values, _finite(one.covariance), freedom_of(one))
        for one in campaigns
    ]
    stated = [_stated(model, one.payload)[onto.places] for one in campaigns]
    laden = [
        replace(state, values=state.values + body) for state, body in zip(bare, stated, strict=True)
    ]
    alike = [
        (bare[k - 1], bare[k])
        for k in range(1, len(bare))
        if campaigns[k - 1].payload == campaigns[k].payload
    ]
    test = _Test(onto, payload_change.own_scatter(onto, alike), share)
    changes: list[Change | None] = [None]
    statements: list[Statement | None] = [None]
    changed, other = [False], [False]
    first = 0  # campaign since which nothing has changed
    for k in range(1, len(campaigns)):
        change = test.between(bare[first:k], bare[k])
        different, like = test.different(change), change is not None and change.like_a_payload
        before, after = campaigns[k - 1].payload, campaigns[k].payload
        statement = None
        if before != after:
            # As if what was stated before were stated now.
            put_back = replace(bare[k], values=bare[k].values + stated[k] - stated[k - 1])
            restated = not test.different(test.between(bare[first:k], put_back))
            verdict = _verdict(change, different=different, restated=restated)
            statement = Statement(before, after, verdict)
        told = different and (statement is None or statement.verdict == "differs")
        changes.append(change)
        changed.append(told and like)
        other.append(told and not like)
        statements.append(statement)
        first = k if different else first
    if len(changes) > 1 and not any(changes):
        return _untested(campaigns, "the campaigns are too short to be compared jointly")
    beside = [payload_change.compare(onto, laden[0], state, test.scatter) for state in laden[1:]]
    return PayloadTrend(
        changes=tuple(changes),
        changed=tuple(changed),
        other=tuple(other),
        statements=tuple(statements),
        mass=np.array([0.0, *(np.nan if one is None else one.mass for one in beside)]),
        mass_std=np.array([0.0, *(np.nan if one is None else one.mass_std for one in beside)]),
    )


@dataclass(frozen=True, eq=False)
class _Test:
    """The joint test of one arm."""

    onto: Projection
    scatter: float
    share: float

    def between(self, before: Sequence[State], after: State) -> Change | None:
        return payload_change.compare(self.onto, payload_change.pooled(before), after, self.scatter)

    def different(self, change: Change | None) -> bool:
        return change is not None and change.p_value < self.share and change.effect >= LEAST_EFFECT


def _verdict(change: Change | None, *, different: bool, restated: bool) -> Verdict:
    if change is None:
        return "untested"
    if not different:
        return "either" if restated else "agrees"
    return "statement only" if restated else "differs"


def _stated(model: RobotModel, payload: Payload | None) -> Array:
    """What a payload adds to the base parameters (b,)."""
    if payload is None:
        return np.zeros(model.base.rank)
    joint, body = payload.carried_by(model.chain)
    return np.asarray(model.base.grouping[:, model.layout.links[joint]] @ body)


def _projection(model: RobotModel, campaigns: Sequence[LevelEstimate]) -> Projection | str:
    """The projection onto a payload, or why there is none."""
    if len(campaigns) < 2:
        return "there is one campaign and nothing to compare it with"
    information = [one.information for one in campaigns if one.information is not None]
    if len(information) < len(campaigns) or any(one.covariance is None for one in campaigns):
        return "the estimator gives no information matrix to compare with"
    known = np.all([np.isfinite(one.std) for one in campaigns], axis=0)
    rows = sum(int(one.samples.sum()) for one in campaigns)
    onto = payload_change.projection(model, known, np.sum(information, axis=0), rows)
    return "nothing that is known of this arm depends on what it carries" if onto is None else onto


def _untested(campaigns: Sequence[LevelEstimate], why: str) -> PayloadTrend:
    count = len(campaigns)
    no, unknown = (False,) * count, np.full(count, np.nan)
    stated = [one.payload for one in campaigns]
    statements = [
        None if k == 0 or stated[k] == stated[k - 1] else Statement(stated[k - 1], now, "untested")
        for k, now in enumerate(stated)
    ]
    return PayloadTrend((None,) * count, no, no, tuple(statements), unknown, unknown, why)


def _finite(covariance: Array | None) -> Array:
    assert covariance is not None
    return np.where(np.isfinite(covariance), covariance, 0.0)


def freedom_of(level: LevelEstimate) -> float:
    """Degrees of freedom of the covariance, from the Student factor of its intervals."""
    factor = level.interval_factor
    if factor <= _NORMAL:
        return 1e6
    return float(brentq(lambda freedom: student.ppf(0.975, freedom) - factor, 0.5, 1.1e6))
