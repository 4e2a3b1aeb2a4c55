"""Drift of friction over recordings, as an arm gets warm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import student_limit
from identification.factor.blocks import part_edges
from identification.factor.factor import Factor
from identification.model.robot import RobotModel

TREND_PIECES: Final = 12
"""Parts of all recordings together."""
_MIN_PIECES: Final = 4  # parts for a trend
_FALSE_TREND_PROBABILITY: Final = 0.001  # probability of a false trend per joint


class FrictionDrift(NamedTuple):
    """Relative change of friction over time, in P parts of the recordings."""

    share: Array  # (P, n), 0.05 for friction 5 % higher; NaN where a joint did not move
    change: Array  # of a straight line from the first to the last part (n,)
    change_std: Array  # its standard error (n,)
    freedom: int  # degrees of freedom

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Whether the trend is significant (n,)."""
        limit = student_limit(0.5 * _FALSE_TREND_PROBABILITY, self.freedom)
        return np.asarray(np.abs(self.change) > limit * self.change_std)


def drift_of_factors(
    model: RobotModel, values: Array, factors: Sequence[Factor]
) -> FrictionDrift | None:
    """Return the drift by the factors by time of recordings in order; None with too few blocks."""
    factors = [factor.occupied() for factor in factors]
    pieces = -(-TREND_PIECES // max(1, len(factors)))
    if min((len(factor) for factor in factors), default=0) < pieces:
        return None
    augmented = np.append(-values, 1.0)
    friction = np.append(np.where(model.friction_columns, values, 0.0), 0.0)
    sums = []
    for factor in factors:
        edges = part_edges(len(factor), pieces)
        products = np.zeros((2, len(factor), model.n_joints))
        for joint, (matrix, used) in enumerate(zip(factor.matrices, factor.columns, strict=True)):
            places = np.append(used, factor.n_parameters)
            by_friction = friction[places] @ matrix
            products[0, :, joint] = by_friction @ augmented[places]
            products[1, :, joint] = by_friction @ friction[places]
        sums.append(np.add.reduceat(products, edges, axis=1))
    return friction_trend(sums)


def friction_trend(sums: Sequence[Array]) -> FrictionDrift | None:
    """Fit a trend over all parts in order; None with too few."""
    if sum(run_sums.shape[1] for run_sums in sums) < _MIN_PIECES:
        return None
    product, power = np.concatenate(sums, axis=1)
    pieces, n = product.shape
    usual = np.median(power, axis=0)
    moving = power > 0.1 * np.where(usual > 0.0, usual, np.inf)
    share = np.where(moving, product / np.where(moving, power, 1.0), np.nan)
    parts = sums[0].shape[1] if len(sums) >= _MIN_PIECES else 1
    freedom = max(pieces - parts - 1, 1)
    weight = np.where(moving, power, 0.0)

    def about_means(values: Array) -> Array:
        """Subtract the weighted mean over the recordings from values (P, n), part by part."""
        table = values.reshape(-1, parts, n)
        weights = weight.reshape(-1, parts, n)
        total = weights.sum(axis=0)
        mean = (weights * table).sum(axis=0) / np.where(total > 0.0, total, 1.0)
        return np.asarray((table - mean).reshape(-1, n))

    at = about_means(np.repeat(np.linspace(-0.5, 0.5, pieces)[:, None], n, axis=1))
    y = about_means(np.where(moving, share, 0.0))
    count = np.count_nonzero(moving, axis=0)
    spread = np.where(count < _MIN_PIECES + parts - 1, np.nan, np.einsum("pn,pn->n", weight, at**2))
    change = np.einsum("pn,pn,pn->n", weight, at, y) / spread
    residual = np.where(moving, y - change * at, 0.0)
    scale = count / np.maximum(freedom - (pieces - count), 1)
    std = np.sqrt(((weight * at * residual) ** 2).sum(axis=0) / spread**2 * scale)
    return FrictionDrift(share, change, std, freedom)
