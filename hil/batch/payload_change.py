"""Whether the arm carries something else than before: one test on all it would change.

A body at the last link adds its ten inertial parameters to that link's, and through the grouping
to base parameters of links before it: they move together, in ten directions at most of the base
parameters' space. The base parameters of each campaign are projected onto these directions,

    x = (K' M K)^+ K' M b,    M = inverse of the inertial part of (sum of information)^-1,

which is least squares for the body with friction free. The same projection serves all
campaigns, so x of one less x of another is what was put on in between. Their difference is tested
jointly by Hotelling's T² (1931), the chi-square test for a covariance that was estimated from a
finite number of blocks. What campaigns differ by anyhow is part of the measure: T² is divided by
the median that the arm's own changes of campaign have, where there are enough of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import pinvh
from scipy.stats import f as fisher

from identification import RobotModel
from identification.model.wrench import LINK_SYMBOLS

Array = NDArray[np.float64]

_MASS_PLACE: Final = LINK_SYMBOLS.index("m")
_MOMENT_PLACES: Final = [LINK_SYMBOLS.index(f"mc{axis}") for axis in "xyz"]

PAYLOAD_LIKE: Final = 0.5
"""Share of a change of the inertial parameters that a payload has to explain to be one."""

# Directions in which a body changes less than this share of the strongest are not seen.
_SEEN: Final = 1e-4
_BLIND: Final = 1e-3
# What is put on an arm: of this order.
_MASS, _MOMENT, _INERTIA = 1.0, 0.3, 0.1
# Median of the arm's own changes from fewer than this says nothing of what campaigns scatter.
_FEWEST_CHANGES: Final = 4
# A covariance of fewer blocks than coordinates cannot be tested.
_FEWEST_SPARE: Final = 2


@dataclass(frozen=True, eq=False)
class Projection:
    """From parameters to what a body at the last link would have.

    Attributes:
        places: inertial parameters that all campaigns determine (d,).
        metric: M (d, d).
        directions: K in an orthonormal basis of metric M (d, r).
        body: ten inertial parameters of the body from the coordinates (10, r), as `LINK_SYMBOLS`;
            rows of NaN for those that cannot be seen.
        rows: samples of all joints that M is made of.
    """

    places: NDArray[np.intp]
    metric: Array
    directions: Array
    body: Array
    rows: int

    @property
    def rank(self) -> int:
        """Number r of coordinates."""
        return int(self.directions.shape[1])

    @property
    def reader(self) -> Array:
        """Matrix (r, d) from parameters to coordinates."""
        return np.asarray(self.directions.T @ self.metric)


@dataclass(frozen=True, eq=False)
class State:
    """A campaign as the test sees it.

    Attributes:
        values: parameters at `Projection.places` (d,).
        covariance: of its coordinates (r, r).
        freedom: blocks that the covariance was estimated from, less one.
    """

    values: Array
    covariance: Array
    freedom: float


@dataclass(frozen=True, eq=False)
class Change:
    """What a campaign has beside those before it.

    Attributes:
        statistic: T² over its degrees of freedom, F distributed if campaigns differed by no more
            than their covariance says.
        scatter: what `statistic` was divided by, at least 1.
        p_value: of nothing having changed.
        share: of the change of all inertial parameters that a payload explains.
        effect: RMS torque of the change, in standard deviations of the torque residual.
        mass: of what was put on [kg], negative if taken off; NaN where it cannot be seen.
        mass_std: its standard deviation [kg].
        moment: mass times centre in the last joint's frame (3,) [kg m].
        moment_std: (3,).
    """

    statistic: float
    scatter: float
    p_value: float
    share: float
    effect: float
    mass: float
    mass_std: float
    moment: Array
    moment_std: Array

    @property
    def like_a_payload(self) -> bool:
        """Whether a body on the last link explains enough of the change to be the cause."""
        return self.share >= PAYLOAD_LIKE


def projection(
    model: RobotModel, known: NDArray[np.bool_], information: Array, rows: int
) -> Projection | None:
    """The projection, None where a body at the last link would change nothing that is known.

    Args:
        model: the robot.
        known: parameters that every campaign determines (p,).
        information: weighted Gram matrix (p, p), a sum over all campaigns.
        rows: samples in that sum, of all joints.
    """
    places = np.flatnonzero(known[: model.base.rank])
    last = model.layout.links[-1]
    scale = np.array([_usual(model.standard_names[k]) for k in last])
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
    reader = onto.reader
    return State(values[onto.places], reader @ own @ reader.T, freedom)


def pooled(states: Sequence[State]) -> State:
    """Mean of campaigns between which nothing changed."""
    count = len(states)
    return State(
        values=np.mean([one.values for one in states], axis=0),
        covariance=np.sum([one.covariance for one in states], axis=0) / count**2,
        freedom=float(np.sum([one.freedom for one in states])),
    )


def compare(onto: Projection, before: State, after: State, scatter: float = 1.0) -> Change | None:
    """Test whether something was put on or taken off, None where blocks are too few to tell.

    Args:
        onto: the projection.
        before: state of the campaigns before.
        after: of the one in question.
        scatter: by how much T² of this arm is larger than it should be, see :func:`own_scatter`.
    """
    difference = after.values - before.values
    coordinates = onto.reader @ difference
    covariance = before.covariance + after.covariance
    # The mean of many campaigns is known so well that the blocks of the other one are what counts.
    freedom = min(before.freedom, after.freedom)
    if freedom < onto.rank - 1 + _FEWEST_SPARE:
        return None
    squared = float(coordinates @ np.linalg.solve(covariance, coordinates))
    spare = freedom - onto.rank + 1
    statistic = squared * spare / (freedom * onto.rank)
    explained = float(coordinates @ coordinates)
    whole = float(difference @ onto.metric @ difference)
    body = onto.body @ coordinates
    std = np.sqrt(scatter * np.einsum("ir,rs,is->i", onto.body, covariance, onto.body))
    return Change(
        statistic=statistic,
        scatter=scatter,
        p_value=float(fisher.sf(statistic / scatter, onto.rank, spare)),
        share=explained / whole if whole > 0.0 else 0.0,
        effect=math.sqrt(explained / max(1, onto.rows)),
        mass=float(body[_MASS_PLACE]),
        mass_std=float(std[_MASS_PLACE]),
        moment=body[_MOMENT_PLACES],
        moment_std=std[_MOMENT_PLACES],
    )


def own_scatter(onto: Projection, pairs: Sequence[tuple[State, State]]) -> float:
    """How much more campaigns of this arm differ than their covariances say, at least 1.

    The median over successive campaigns that state the same payload, so that a payload put on once
    is no part of it.
    """
    ratios = []
    for one, other in pairs:
        change = compare(onto, one, other)
        if change is not None:
            spare = min(one.freedom, other.freedom) - onto.rank + 1
            ratios.append(change.statistic / float(fisher.median(onto.rank, spare)))
    return max(1.0, float(np.median(ratios))) if len(ratios) >= _FEWEST_CHANGES else 1.0


def _usual(name: str) -> float:
    """Size of a standard parameter of what people put on arms, in its unit."""
    if name.startswith("mc"):
        return _MOMENT
    return _INERTIA if name.startswith("I") else _MASS
