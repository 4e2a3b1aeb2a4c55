r"""Drift of friction over recordings, as an arm warms up, and its effect on an estimate.

Friction that drifts has no single coefficient: at a time x, from -1/2 to 1/2 over the recordings,
the parameters are :math:`\pi + x \sum_j c_j f_j`, with the own friction :math:`f_j` of joint j and
its relative change :math:`c_j`. A fit without drift gives

.. math:: \hat\pi = \pi + \sum_j c_j m_j, \qquad m_j = H^{-1} \sum_b x_b W_b^T w\, W_b f_j

with the information H and blocks b of time. Its mean square distance to the parameters over time,
:math:`\sum_j c_j^2 (m_j m_j^T + f_j f_j^T / 12)`, is added to the covariance: intervals hold
what friction was at any time. Residuals show only what the fit leaves of a drift: :math:`c_j` is
their trend over that share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.distributions import student_limit
from identification.factor.blocks import part_edges
from identification.factor.estimate import Estimate, inverse_variance
from identification.factor.factor import Factor
from identification.model.robot import RobotModel

TREND_PIECES: Final = 12
"""Parts of all recordings together."""
_MIN_PIECES: Final = 4  # parts for a trend
_FALSE_TREND_PROBABILITY: Final = 0.001  # probability of a false trend per joint
_MIN_SHARE_LEFT: Final = 0.1  # share of a drift that a fit leaves, to be scaled up by


class FrictionDrift(NamedTuple):
    """Relative change of friction over time, in P parts of the recordings."""

    share: Array  # (P, n), 0.05 for friction 5 % higher; NaN where a joint did not move
    change: Array  # of a straight line from the start to the end of the recordings (n,)
    change_std: Array  # its standard error (n,)
    freedom: int  # degrees of freedom

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Whether the trend is significant (n,)."""
        limit = student_limit(0.5 * _FALSE_TREND_PROBABILITY, self.freedom)
        return np.asarray(np.abs(self.change) > limit * self.change_std)


class _Trend(NamedTuple):
    """Times of P parts of the recordings, from -1/2 to 1/2 over all, by which a trend is fitted."""

    power: Array  # sums of the squared friction (P, n)
    moving: NDArray[np.bool_]  # (P, n)
    about: Array  # times less their mean over the recordings, part by part of one motion (P, n)
    parts: int  # whose means are subtracted

    @classmethod
    def of(cls, power: Array, recordings: int) -> Self:
        """Return the times of the parts, given their squared friction (P, n)."""
        pieces = len(power)
        usual = np.median(power, axis=0)
        moving = power > 0.1 * np.where(usual > 0.0, usual, np.inf)
        at = (np.arange(pieces) + 0.5) / pieces - 0.5
        parts = pieces // recordings if recordings >= _MIN_PIECES else 1
        trend = cls(power, moving, np.zeros_like(power), parts)
        return trend._replace(about=trend.about_means(np.repeat(at[:, None], power.shape[1], 1)))

    def about_means(self, values: Array) -> Array:
        """Subtract the weighted mean over the recordings from values (P, n), part by part."""
        table = values.reshape(-1, self.parts, values.shape[1])
        weights = np.where(self.moving, self.power, 0.0).reshape(table.shape)
        total = weights.sum(axis=0)
        mean = (weights * table).sum(axis=0) / np.where(total > 0.0, total, 1.0)
        return np.asarray((table - mean).reshape(values.shape))


def with_drift(
    model: RobotModel, estimate: Estimate, recordings: Sequence[Factor], inverse: Array
) -> Estimate:
    """Return the estimate, its covariance widened by errors from significant friction drift.

    Args:
        model: of the arm, p parameters.
        estimate: by the recordings together.
        recordings: their factors by time, in order.
        inverse: of the information of the fit (p, p).
    """
    pulls = _friction_pulls(model, estimate.values, recordings)
    if pulls is None:
        return estimate
    sums = _sums(model, estimate.values, pulls)
    drift = friction_trend(sums)
    if drift is None or not drift.significant.any():
        return estimate
    trend = _Trend.of(np.concatenate(sums, axis=1)[1], len(sums))
    weights = inverse_variance(estimate.noise_std**2)
    friction = np.where(model.friction_columns, estimate.values, 0.0)
    owners = np.full(len(friction), -1)
    owners[model.friction_part] = [
        -1 if term.motor else term.owner for term in model.friction.terms
    ]
    joints = np.flatnonzero(drift.significant)
    changes = _whole_changes(drift, trend, pulls, weights, inverse, joints)
    roots = []
    for joint, change in zip(joints.tolist(), changes.tolist(), strict=True):
        moved = weights[joint] * inverse @ _pull_of_drift(friction, recordings, joint)
        roots += [change * moved, change * np.where(owners == joint, friction, 0.0) / 12.0**0.5]
    spread = np.array(roots).T
    spread[~np.isfinite(np.diag(estimate.covariance))] = 0.0
    return replace(
        estimate,
        covariance=estimate.covariance + spread @ spread.T,
        method=estimate.method.widened("friction_drift"),
    )


def _whole_changes(
    drift: FrictionDrift,
    trend: _Trend,
    pulls: Sequence[Sequence[Array]],
    weights: Array,
    inverse: Array,
    joints: Indices,
) -> Array:
    """Return the changes (k,) of the friction of joints, of which residuals show what a fit leaves.

    Arguments as in :func:`with_drift`.
    """
    by_part = [np.concatenate([parts[joint][:, :-1] for parts in pulls]) for joint in joints]
    trended = np.array(
        [weights[j] * part.T @ trend.about[:, j] for j, part in zip(joints, by_part, strict=True)]
    )
    squares = (weights * np.einsum("pn,pn->n", trend.power, trend.about**2))[joints]
    size = np.sqrt(squares)
    left = np.eye(len(joints)) - trended @ inverse @ trended.T / np.outer(size, size)
    shares, vectors = np.linalg.eigh(left)
    shown = vectors.T @ (size * drift.change[joints])
    return np.asarray(vectors @ (shown / np.maximum(shares, _MIN_SHARE_LEFT)) / size)


def _pull_of_drift(friction: Array, factors: Sequence[Factor], joint: int) -> Array:
    """Return sums ``x W' W f`` of a joint over all blocks (p,), x their time."""
    total = np.zeros(len(friction))
    for place, factor in enumerate(factors):
        used = factor.columns[joint]
        steps = (np.arange(len(factor)) + 0.5) / max(1, len(factor))
        at = (place + steps) / len(factors) - 0.5
        total[used] += at @ (friction[used] @ factor.matrices[joint][:, :-1, :-1])
    return total


def _friction_pulls(
    model: RobotModel, values: Array, factors: Sequence[Factor]
) -> list[list[Array]] | None:
    """Return sums ``[W | y]' f`` of each recording and joint over parts (P, p + 1), f its friction.

    None with too few blocks.
    """
    factors = [factor.occupied() for factor in factors]
    pieces = -(-TREND_PIECES // max(1, len(factors)))
    if min((len(factor) for factor in factors), default=0) < pieces:
        return None
    friction = np.append(np.where(model.friction_columns, values, 0.0), 0.0)
    pulls = []
    for factor in factors:
        edges = part_edges(len(factor), pieces)
        joints = []
        for matrix, used in zip(factor.matrices, factor.columns, strict=True):
            places = np.append(used, factor.n_parameters)
            pull = np.zeros((pieces, len(friction)))
            pull[:, places] = np.add.reduceat(friction[places] @ matrix, edges, axis=0)
            joints.append(pull)
        pulls.append(joints)
    return pulls


def _sums(model: RobotModel, values: Array, pulls: Sequence[Sequence[Array]]) -> list[Array]:
    """Return residual times friction, and squared friction, of each recording (2, P, n)."""
    friction = np.append(np.where(model.friction_columns, values, 0.0), 0.0)
    both = np.column_stack([np.append(-values, 1.0), friction])
    return [
        np.stack([pull @ both for pull in joints], axis=-1).transpose(1, 0, 2) for joints in pulls
    ]


def friction_trend(sums: Sequence[Array]) -> FrictionDrift | None:
    """Fit a trend over all parts in order; None with too few."""
    if sum(run_sums.shape[1] for run_sums in sums) < _MIN_PIECES:
        return None
    product, power = np.concatenate(sums, axis=1)
    trend = _Trend.of(power, len(sums))
    moving = trend.moving
    share = np.where(moving, product / np.where(moving, power, 1.0), np.nan)
    freedom = max(len(power) - trend.parts - 1, 1)
    weight = np.where(moving, power, 0.0)
    y = trend.about_means(np.where(moving, share, 0.0))
    count = np.count_nonzero(moving, axis=0)
    few = count < _MIN_PIECES + trend.parts - 1
    spread = np.where(few, np.nan, np.einsum("pn,pn->n", weight, trend.about**2))
    change = np.einsum("pn,pn,pn->n", weight, trend.about, y) / spread
    residual = np.where(moving, y - change * trend.about, 0.0)
    scale = count / np.maximum(freedom - (len(power) - count), 1)
    std = np.sqrt(((weight * trend.about * residual) ** 2).sum(axis=0) / spread**2 * scale)
    return FrictionDrift(share, change, std, freedom)
