"""What an arm carries from campaign to campaign: one test on all that a payload would change.

A body at the last link changes base parameters in ten directions at most. Those of each campaign
are projected onto these directions K, by least squares for the body with friction free,

    x = (K' M K)^+ K' M b,    M = inverse of the inertial part of (sum of information)^-1,

and the difference of two campaigns is tested jointly by Hotelling's T² (1931), divided by the
median that the arm's own changes of campaign have. A payload that a cell states is no part of the
parameters; where the statement changes, they are tested with the stated body put back, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress, pairwise
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import pinvh
from scipy.optimize import brentq
from scipy.stats import f as fisher
from scipy.stats import t as student

from hil.batch.types import LevelEstimate
from identification import RobotModel
from identification.model.payload import Payload
from identification.model.regressor import LINK_SYMBOLS

Array = NDArray[np.float64]

LEAST_EFFECT: Final = 0.10
"""A change of payload counts if its RMS torque is at least this share of the torque residual."""
PAYLOAD_LIKE: Final = 0.5
"""Share of a change of the inertial parameters that a payload has to explain to be one."""

Level = Literal["alarm", "past", "quiet", "changed", "same"]
Verdict = Literal[
    "torques agree",
    "carried before as well",
    "torques cannot tell",
    "torques disagree",
    "not tested",
]

_MASS_PLACE: Final = LINK_SYMBOLS.index("m")
_MOMENT_PLACES: Final = [LINK_SYMBOLS.index(f"mc{axis}") for axis in "xyz"]
# Directions in which a body changes less than this share of the strongest are not seen.
_SEEN: Final = 1e-4
_BLIND: Final = 1e-3
# What is put on an arm (mass, moments, inertia) is of this order.
_USUAL: Final = {"m": 1.0, "c": 0.3, "I": 0.1}
# Median of the arm's own changes from fewer than this says nothing of what campaigns scatter.
_FEWEST_CHANGES: Final = 4
# A covariance of fewer blocks than coordinates cannot be tested.
_FEWEST_SPARE: Final = 2
_NORMAL: Final = float(student.ppf(0.975, 1e6))
_CERTAIN: Final = 2.0


@dataclass(frozen=True)
class Finding:
    """One thing to know about an arm."""

    #: "alarm" concerns the last campaign, "past" earlier ones, "quiet" nothing; in a comparison
    #: "changed", or "same" for what did not, or by little, or is not known
    level: Level
    words: str  #: a sentence
    next_step: str = ""  #: what to do about it; "" for nothing


@dataclass(frozen=True, eq=False)
class Projection:
    """From parameters to what a body at the last link would have."""

    places: NDArray[np.intp]  #: inertial parameters that all campaigns determine (d,)
    metric: Array  #: M (d, d)
    directions: Array  #: K in an orthonormal basis of metric M (d, r)
    #: ten inertial parameters of the body from the coordinates (10, r), as `LINK_SYMBOLS`; rows of
    #: NaN for those that cannot be seen
    body: Array
    rows: int  #: samples of all joints that M is made of

    @property
    def rank(self) -> int:
        """Number r of coordinates."""
        return int(self.directions.shape[1])

    @property
    def reader(self) -> Array:
        """Matrix (r, d) from parameters to coordinates."""
        return np.asarray(self.directions.T @ self.metric)


class State(NamedTuple):
    """A campaign as the test sees it."""

    values: Array  #: parameters at `Projection.places` (d,)
    covariance: Array  #: of its coordinates (r, r)
    freedom: float  #: blocks that the covariance was estimated from, less one


@dataclass(frozen=True, eq=False)
class Change:
    """What a campaign has beside those before it."""

    #: T² over its degrees of freedom, F distributed if campaigns differed by no more than their
    #: covariance says
    statistic: float
    p_value: float  #: of nothing having changed
    share: float  #: of the change of all inertial parameters that a payload explains
    effect: float  #: RMS torque of the change, in standard deviations of the torque residual
    mass: float  #: of what was put on [kg], negative if subtracted; NaN where it cannot be seen
    mass_std: float  #: its standard deviation [kg]
    moment: Array  #: mass times centre in the last joint's frame (3,) [kg m]
    moment_std: Array  #: (3,)


def projection(
    model: RobotModel, known: NDArray[np.bool_], information: Array, rows: int
) -> Projection | None:
    """The projection, None where a body at the last link would change nothing that is known.

    Every campaign determines the `known` parameters (p,); `information` is the weighted Gram matrix
    (p, p), a sum over all campaigns, and `rows` the samples of all joints in that sum.
    """
    places = np.flatnonzero(known[: model.base.rank])
    last = model.layout.links[-1]
    names = [model.standard_names[k] for k in last]
    scale = np.array([_USUAL["c" if name.startswith("mc") else name[0]] for name in names])
    grouping = model.base.grouping[np.ix_(places, last)] * scale
    if not grouping.any():
        return None
    inertial = np.arange(len(places))
    everything = pinvh(information[np.ix_(known, known)])
    metric = pinvh(everything[np.ix_(inertial, inertial)])
    # Columns of unit length in the metric, whatever the units.
    squares, basis = np.linalg.eigh(grouping.T @ metric @ grouping)
    seen = squares > _SEEN**2 * squares[-1]
    if not seen.any():
        return None
    to_body = basis[:, seen] / np.sqrt(squares[seen])
    body = scale[:, None] * to_body
    body[np.abs(basis[:, ~seen]).max(axis=1, initial=0.0) > _BLIND] = np.nan
    return Projection(places, metric, grouping @ to_body, body, rows)


def state(onto: Projection, values: Array, covariance: Array, freedom: float) -> State:
    """A campaign with parameters (p,) and covariance (p, p) as the test sees it."""
    own = covariance[np.ix_(onto.places, onto.places)]
    return State(values[onto.places], onto.reader @ own @ onto.reader.T, freedom)


def compare(onto: Projection, before: State, after: State, scatter: float = 1.0) -> Change | None:
    """Test whether something was put on or subtracted, None where blocks are too few to tell.

    `scatter` says by how much T² of this arm is larger than it should be.
    """
    difference = after.values - before.values
    coordinates = onto.reader @ difference
    covariance = before.covariance + after.covariance
    spare = _spare(onto, before, after)
    if spare < _FEWEST_SPARE:
        return None
    squared = float(coordinates @ np.linalg.solve(covariance, coordinates))
    statistic = squared * spare / ((spare + onto.rank - 1) * onto.rank)
    explained = float(coordinates @ coordinates)
    whole = float(difference @ onto.metric @ difference)
    body = onto.body @ coordinates
    std = np.sqrt(scatter * np.einsum("ir,rs,is->i", onto.body, covariance, onto.body))
    return Change(
        statistic=statistic,
        p_value=float(fisher.sf(statistic / scatter, onto.rank, spare)),
        share=explained / whole if whole > 0.0 else 0.0,
        effect=math.sqrt(explained / max(1, onto.rows)),
        mass=float(body[_MASS_PLACE]),
        mass_std=float(std[_MASS_PLACE]),
        moment=body[_MOMENT_PLACES],
        moment_std=std[_MOMENT_PLACES],
    )


def _spare(onto: Projection, one: State, other: State) -> float:
    """Degrees of freedom of the denominator.

    The mean of many campaigns is known so well that the blocks of the other one are what counts.
    """
    return min(one.freedom, other.freedom) - onto.rank + 1


def _own_scatter(onto: Projection, pairs: Sequence[tuple[State, State]]) -> float:
    """How much more campaigns of this arm differ than their covariances say, at least 1.

    The median over successive campaigns that state the same payload, so that a payload put on once
    is no part of it.
    """
    ratios = [
        change.statistic / float(fisher.median(onto.rank, _spare(onto, one, other)))
        for one, other in pairs
        if (change := compare(onto, one, other)) is not None
    ]
    return max(1.0, float(np.median(ratios))) if len(ratios) >= _FEWEST_CHANGES else 1.0


# From campaign to campaign


@dataclass(frozen=True)
class Statement:
    """A campaign that states another payload than the one before, None being none.

    `verdict` says whether the arm, by its torques, carries what is stated as it did before, the
    same as before (only the statement is new), one of these, or neither.
    """

    before: Payload | None
    after: Payload | None
    verdict: Verdict = "not tested"


@dataclass(frozen=True, eq=False)
class PayloadTrend:
    """What the last link carries beside what it carried in the first of c campaigns."""

    #: of the parameters of each campaign against those before it since the last change; None of the
    #: first
    changes: tuple[Change | None, ...]
    #: which campaigns differ in what the last link carries, beside what is stated
    changed: tuple[bool, ...]
    #: which differ in their inertial parameters, but not as a payload would
    other: tuple[bool, ...]
    #: of the campaigns that state another payload than the one before
    statements: tuple[Statement | None, ...]
    #: on top of the first campaign's, stated or not [kg] (c,); NaN where it cannot be seen
    mass: Array
    mass_std: Array  #: (c,)
    untested: str = ""  #: why there is no test; "" if there is


def payload_trend(
    model: RobotModel, campaigns: Sequence[LevelEstimate], share: float
) -> PayloadTrend:
    """Find what changed in what the arm carries, from campaigns in order of time.

    `share` is that of campaigns said to differ if nothing has changed.
    """
    onto = _projection(model, campaigns)
    if isinstance(onto, str):
        return _untested(campaigns, onto)
    stated = [_stated(model, one.payload)[onto.places] for one in campaigns]
    bare, laden = list[State](), list[State]()
    for one, load in zip(campaigns, stated, strict=True):
        covariance = np.nan_to_num(np.asarray(one.covariance), posinf=0.0)
        own = state(onto, one.values, covariance, freedom_of(one))
        bare.append(own)
        laden.append(own._replace(values=own.values + load))
    same = [one.payload == other.payload for one, other in pairwise(campaigns)]
    scatter = _own_scatter(onto, list(compress(pairwise(bare), same)))

    def different(change: Change | None) -> bool:
        return change is not None and change.p_value < share and change.effect >= LEAST_EFFECT

    changes, statements = list[Change | None]([None]), list[Statement | None]([None])
    changed, other = [False], [False]
    first = 0  # campaign since which nothing has changed
    for k in range(1, len(campaigns)):
        values, covariances, freedoms = zip(*bare[first:k], strict=True)
        mean = np.sum(covariances, axis=0) / len(values) ** 2
        history = State(np.mean(values, axis=0), mean, float(np.sum(freedoms)))
        change = compare(onto, history, bare[k], scatter)
        differs, statement = different(change), None
        if not same[k - 1]:
            # As if what was stated before were stated now.
            put_back = bare[k]._replace(values=bare[k].values + stated[k] - stated[k - 1])
            restated = not different(compare(onto, history, put_back, scatter))
            verdict: Verdict = "torques disagree" if differs else "torques agree"
            if restated:
                verdict = "carried before as well" if differs else "torques cannot tell"
            if change is None:
                verdict = "not tested"
            statement = Statement(campaigns[k - 1].payload, campaigns[k].payload, verdict)
        found = differs and (statement is None or statement.verdict == "torques disagree")
        like = change is not None and change.share >= PAYLOAD_LIKE
        changes.append(change)
        changed.append(found and like)
        other.append(found and not like)
        statements.append(statement)
        first = k if differs else first
    if not any(changes):
        return _untested(campaigns, "the campaigns are too short to be compared jointly")
    beside = [compare(onto, laden[0], one, scatter) for one in laden[1:]]
    masses = [(math.nan, math.nan) if one is None else (one.mass, one.mass_std) for one in beside]
    mass, mass_std = np.array([(0.0, 0.0), *masses]).T
    return PayloadTrend(
        tuple(changes), tuple(changed), tuple(other), tuple(statements), mass, mass_std
    )


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
    onto = projection(model, known, np.sum(information, axis=0), rows)
    return "nothing that is known of this arm depends on its payload" if onto is None else onto


def _untested(campaigns: Sequence[LevelEstimate], why: str) -> PayloadTrend:
    no, unknown = (False,) * len(campaigns), np.full(len(campaigns), np.nan)
    pairs = pairwise(one.payload for one in campaigns)
    statements = (None, *(Statement(*pair) if pair[0] != pair[1] else None for pair in pairs))
    return PayloadTrend((None,) * len(no), no, no, statements, unknown, unknown, why)


def freedom_of(level: LevelEstimate) -> float:
    """Degrees of freedom of the covariance, from the Student factor of its intervals."""
    factor = level.interval_factor
    if factor <= _NORMAL:
        return 1e6
    return float(brentq(lambda freedom: student.ppf(0.975, freedom) - factor, 0.5, 1.1e6))


def payload_findings(payload: PayloadTrend, names: Sequence[str]) -> list[Finding]:
    """What was found of what an arm carries, campaign by campaign."""
    found = []
    for k, (change, statement) in enumerate(zip(payload.changes, payload.statements, strict=True)):
        level: Level = "alarm" if k == len(payload.changes) - 1 else "past"
        if statement is not None:
            words = (
                f"From {names[k]} on the cell states {_load(statement.after)} instead of"
                f" {_load(statement.before)}: {statement.verdict}."
            )
            step = "Weigh the payload and measure its centre, then correct the cell file."
            wrong = statement.verdict == "torques disagree"
            found.append(Finding(level, words, step) if wrong else Finding("quiet", words))
        where = f"between {names[k - 1]} and {names[k]}"
        if change is not None and payload.changed[k]:
            beside = "" if statement is None else ", beside what is stated,"
            words = f"The payload{beside} has changed {where}: {_what(change)}."
            step = "State the payload in the cell file, or check the tool and its fastening."
            found.append(Finding(level, words, step))
        elif change is not None and payload.other[k]:
            words = (
                f"Inertial parameters have changed {where}, but not as by something put on the"
                f" last link: that explains {100.0 * change.share:.0f} % of the change."
            )
            step = "Check the torque constants and the calibration, and what links before it carry."
            found.append(Finding(level, words, step))
    return found


def _load(payload: Payload | None) -> str:
    return f"a payload of {payload.mass:g} kg" if payload and payload.mass else "nothing"


def _what(change: Change) -> str:
    """Mass if it can be seen, and how far from the last joint it sits if that is known."""
    if not math.isfinite(change.mass):
        moment = float(np.linalg.norm(np.nan_to_num(change.moment)))
        return f"first moment by {moment:.2g} kg·m, while its mass cannot be seen by this arm"
    mass = f"{change.mass:+.2f} ± {change.mass_std:.2g} kg"
    if abs(change.mass) < _CERTAIN * change.mass_std:
        return f"its mass not significantly ({mass}), but its centre or inertia"
    if not np.isfinite(change.moment).all():
        return mass
    centre = ", ".join(f"{1e3 * c / change.mass:.0f}" for c in change.moment)
    return f"{mass}, centred at ({centre}) mm of the last joint"
