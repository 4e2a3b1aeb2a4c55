"""Changes of the payload between campaigns, by one joint test.

A body at the last link changes the base parameters b in at most ten directions K. The parameters of
each campaign are projected onto these, by weighted least squares with friction free,

    x = (K' M K)^+ K' M b,    M = inverse of the inertial part of (sum of information)^-1,

and the difference of two campaigns is tested by Hotelling's T² (1931), divided by the median of the
arm's changes between campaigns. A payload stated by a cell is not part of b; if the statement
changes, the parameters are also tested with the stated body added.
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
"""Smallest relevant rms torque of a change, as a share of the torque residual."""
PAYLOAD_LIKE: Final = 0.5
"""Smallest share of a change of inertial parameters that a payload must explain."""

Level = Literal["alarm", "past", "quiet", "changed", "same"]
Verdict = Literal[
    "torques agree",
    "carried before as well",
    "torques cannot tell",
    "torques disagree",
    "not tested",
]

_MASS: Final = LINK_SYMBOLS.index("m")
_MOMENTS: Final = [LINK_SYMBOLS.index(f"mc{axis}") for axis in "xyz"]
# Relative singular values of directions that are observable, and components that are not.
_OBSERVABLE: Final = 1e-4
_UNOBSERVABLE: Final = 1e-3
# Scale of a payload's mass, moments and inertia.
_SCALE: Final = {"m": 1.0, "c": 0.3, "I": 0.1}
_MIN_CHANGES: Final = 4  # for the median of the arm's changes
_MIN_FREEDOM: Final = 2  # degrees of freedom of the denominator
_NORMAL: Final = float(student.ppf(0.975, 1e6))
_SIGNIFICANT: Final = 2.0  # standard deviations


@dataclass(frozen=True)
class Finding:
    """One finding about an arm."""

    #: "alarm" of the last campaign, "past" of earlier ones, "quiet" for information; in a
    #: comparison "changed" or "same"
    level: Level
    words: str  #: a sentence
    next_step: str = ""  #: remedy


@dataclass(frozen=True, eq=False)
class Projection:
    """Projection of the base parameters onto those of a body at the last link."""

    places: NDArray[np.intp]  #: inertial parameters determined by all campaigns (d,)
    metric: Array  #: M (d, d)
    directions: Array  #: K in an orthonormal basis of metric M (d, r)
    #: inertial parameters of the body from the coordinates (10, r), as `LINK_SYMBOLS`; NaN for
    #: unobservable ones
    body: Array
    rows: int  #: samples of all joints in M

    @property
    def rank(self) -> int:
        """Number r of coordinates."""
        return int(self.directions.shape[1])

    @property
    def to_coordinates(self) -> Array:
        """Matrix (r, d) from parameters to coordinates."""
        return np.asarray(self.directions.T @ self.metric)


class State(NamedTuple):
    """Projected parameters of a campaign."""

    values: Array  #: parameters at `Projection.places` (d,)
    covariance: Array  #: of its coordinates (r, r)
    freedom: float  #: degrees of freedom of the covariance


@dataclass(frozen=True, eq=False)
class Change:
    """Change of a campaign from the earlier ones."""

    statistic: float  #: scaled T², F distributed without a change
    p_value: float  #: of no change
    share: float  #: of the change of all inertial parameters that a payload explains
    effect: float  #: rms torque of the change, in standard deviations of the torque residual
    mass: float  #: added mass [kg]; NaN if unobservable
    mass_std: float  #: [kg]
    moment: Array  #: added mass times centre in the last joint's frame (3,) [kg m]
    moment_std: Array  #: (3,)


def projection(
    model: RobotModel, known: NDArray[np.bool_], information: Array, rows: int
) -> Projection | None:
    """Return the projection; None if no determined parameter depends on a body at the last link.

    `known` (p,) are determined by all campaigns; `information` (p, p) is the weighted Gram matrix
    over all campaigns and `rows` the samples of all joints in it.
    """
    places = np.flatnonzero(known[: model.base.rank])
    last = model.layout.links[-1]
    names = [model.layout.names[k] for k in last]
    scale = np.array([_SCALE["c" if name.startswith("mc") else name[0]] for name in names])
    grouping = model.base.grouping[np.ix_(places, last)] * scale
    if not grouping.any():
        return None
    inertial = np.arange(len(places))
    everything = pinvh(information[np.ix_(known, known)])
    metric = pinvh(everything[np.ix_(inertial, inertial)])
    # Columns of unit length in the metric, for any units.
    squares, basis = np.linalg.eigh(grouping.T @ metric @ grouping)
    observable = squares > _OBSERVABLE**2 * squares[-1]
    if not observable.any():
        return None
    to_body = basis[:, observable] / np.sqrt(squares[observable])
    body = scale[:, None] * to_body
    body[np.abs(basis[:, ~observable]).max(axis=1, initial=0.0) > _UNOBSERVABLE] = np.nan
    return Projection(places, metric, grouping @ to_body, body, rows)


def state(onto: Projection, values: Array, covariance: Array, freedom: float) -> State:
    """Project the parameters (p,) and covariance (p, p) of a campaign."""
    own = covariance[np.ix_(onto.places, onto.places)]
    return State(values[onto.places], onto.to_coordinates @ own @ onto.to_coordinates.T, freedom)


def compare(onto: Projection, before: State, after: State, scatter: float = 1.0) -> Change | None:
    """Test for a change of payload, None with too few degrees of freedom.

    `scatter` is the ratio of T² between campaigns of this arm to its expected value.
    """
    difference = after.values - before.values
    coordinates = onto.to_coordinates @ difference
    covariance = before.covariance + after.covariance
    freedom = _denominator_freedom(onto, before, after)
    if freedom < _MIN_FREEDOM:
        return None
    squared = float(coordinates @ np.linalg.solve(covariance, coordinates))
    statistic = squared * freedom / ((freedom + onto.rank - 1) * onto.rank)
    explained = float(coordinates @ coordinates)
    total = float(difference @ onto.metric @ difference)
    body = onto.body @ coordinates
    std = np.sqrt(scatter * np.einsum("ir,rs,is->i", onto.body, covariance, onto.body))
    return Change(
        statistic=statistic,
        p_value=float(fisher.sf(statistic / scatter, onto.rank, freedom)),
        share=explained / total if total > 0.0 else 0.0,
        effect=math.sqrt(explained / max(1, onto.rows)),
        mass=float(body[_MASS]),
        mass_std=float(std[_MASS]),
        moment=body[_MOMENTS],
        moment_std=std[_MOMENTS],
    )


def _denominator_freedom(onto: Projection, one: State, other: State) -> float:
    return min(one.freedom, other.freedom) - onto.rank + 1


def _own_scatter(onto: Projection, pairs: Sequence[tuple[State, State]]) -> float:
    """Return the median ratio of T² to its expected value over unchanged campaigns, at least 1."""
    ratios = [
        change.statistic / float(fisher.median(onto.rank, _denominator_freedom(onto, one, other)))
        for one, other in pairs
        if (change := compare(onto, one, other)) is not None
    ]
    return max(1.0, float(np.median(ratios))) if len(ratios) >= _MIN_CHANGES else 1.0


# Trend


@dataclass(frozen=True)
class Statement:
    """A change of the stated payload, and whether the torques confirm it."""

    before: Payload | None
    after: Payload | None
    verdict: Verdict = "not tested"


@dataclass(frozen=True, eq=False)
class PayloadTrend:
    """Payload of the last link over c campaigns, relative to the first."""

    #: of each campaign from the earlier ones since the last change; None for the first
    changes: tuple[Change | None, ...]
    changed: tuple[bool, ...]  #: whether the payload changed, beside the stated change
    other: tuple[bool, ...]  #: whether inertial parameters changed in another way
    statements: tuple[Statement | None, ...]  #: of campaigns with a new stated payload
    mass: Array  #: difference of total payload to the first campaign [kg] (c,); NaN if unobservable
    mass_std: Array  #: (c,)
    untested: str = ""  #: reason if there is no test


def payload_trend(
    model: RobotModel, campaigns: Sequence[LevelEstimate], share: float
) -> PayloadTrend:
    """Compute the trend of the payload; `share` is the false-alarm rate per campaign."""
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
    first = 0  # first campaign after the last change
    for k in range(1, len(campaigns)):
        values, covariances, freedoms = zip(*bare[first:k], strict=True)
        mean = np.sum(covariances, axis=0) / len(values) ** 2
        history = State(np.mean(values, axis=0), mean, float(np.sum(freedoms)))
        change = compare(onto, history, bare[k], scatter)
        differs, statement = different(change), None
        if not same[k - 1]:
            # The test with the earlier statement.
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
        return _untested(campaigns, "the campaigns are too short")
    beside = [compare(onto, laden[0], one, scatter) for one in laden[1:]]
    masses = [(math.nan, math.nan) if one is None else (one.mass, one.mass_std) for one in beside]
    mass, mass_std = np.array([(0.0, 0.0), *masses]).T
    return PayloadTrend(
        tuple(changes), tuple(changed), tuple(other), tuple(statements), mass, mass_std
    )


def _stated(model: RobotModel, payload: Payload | None) -> Array:
    """Return the contribution of a payload to the base parameters (b,)."""
    if payload is None:
        return np.zeros(model.base.rank)
    joint, body = payload.carried_by(model.chain)
    return np.asarray(model.base.grouping[:, model.layout.links[joint]] @ body)


def _projection(model: RobotModel, campaigns: Sequence[LevelEstimate]) -> Projection | str:
    """Return the projection, or the reason why there is none."""
    if len(campaigns) < 2:
        return "there is only one campaign"
    information = [one.information for one in campaigns if one.information is not None]
    known = np.all([np.isfinite(one.std) for one in campaigns], axis=0)
    rows = sum(int(one.samples.sum()) for one in campaigns)
    onto = projection(model, known, np.sum(information, axis=0), rows)
    return "no determined parameter depends on the payload" if onto is None else onto


def _untested(campaigns: Sequence[LevelEstimate], reason: str) -> PayloadTrend:
    no, unknown = (False,) * len(campaigns), np.full(len(campaigns), np.nan)
    pairs = pairwise(one.payload for one in campaigns)
    statements = (None, *(Statement(*pair) if pair[0] != pair[1] else None for pair in pairs))
    return PayloadTrend((None,) * len(no), no, no, statements, unknown, unknown, reason)


def freedom_of(level: LevelEstimate) -> float:
    """Return the degrees of freedom of the covariance, from the Student factor of its intervals."""
    factor = level.interval_factor
    if factor <= _NORMAL:
        return 1e6
    return float(brentq(lambda freedom: student.ppf(0.975, freedom) - factor, 0.5, 1.1e6))


def payload_findings(payload: PayloadTrend, names: Sequence[str]) -> list[Finding]:
    """Return the findings about the payload in chronological order."""
    found = []
    for k, (change, statement) in enumerate(zip(payload.changes, payload.statements, strict=True)):
        level: Level = "alarm" if k == len(payload.changes) - 1 else "past"
        if statement is not None:
            words = (
                f"From {names[k]} on the cell states {_load(statement.after)} instead of"
                f" {_load(statement.before)}: {statement.verdict}."
            )
            step = "Measure mass and centre of the payload and correct the cell file."
            wrong = statement.verdict == "torques disagree"
            found.append(Finding(level, words, step) if wrong else Finding("quiet", words))
        where = f"between {names[k - 1]} and {names[k]}"
        if change is not None and payload.changed[k]:
            beside = "" if statement is None else ", besides the stated change,"
            words = f"The payload{beside} has changed {where}: {_describe(change)}."
            step = "State the payload in the cell file, or check the tool and its mounting."
            found.append(Finding(level, words, step))
        elif change is not None and payload.other[k]:
            words = (
                f"Inertial parameters have changed {where}, of which a payload explains only"
                f" {100.0 * change.share:.0f} %."
            )
            step = "Check torque constants, calibration and bodies mounted on other links."
            found.append(Finding(level, words, step))
    return found


def _load(payload: Payload | None) -> str:
    return f"a payload of {payload.mass:g} kg" if payload and payload.mass else "no payload"


def _describe(change: Change) -> str:
    if not math.isfinite(change.mass):
        return "centre or inertia (this arm does not determine the mass)"
    mass = f"{change.mass:+.2f} ± {change.mass_std:.2g} kg"
    if abs(change.mass) < _SIGNIFICANT * change.mass_std:
        return f"centre or inertia, not significantly the mass ({mass})"
    if not np.isfinite(change.moment).all():
        return mass
    centre = ", ".join(f"{one:.0f}" for one in 1e3 * change.moment / change.mass)
    return f"{mass}, centred at ({centre}) mm in the frame of the last joint"
