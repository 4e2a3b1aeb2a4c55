"""Parameters of several arms of one type: each has its own, spread about a common mean.

The mean and the spread of each parameter between arms are estimated from all of them, by the
expectation and maximisation of the restricted likelihood (Laird and Ware 1982); an arm whose data
say little of a parameter borrows from its siblings, one whose data say much keeps its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from identification.arrays import Array, Indices
from identification.factor.estimate import Estimate

MIN_ESTIMATES: Final = 3
"""Arms from which on their spread is estimated."""
_MAX_ROUNDS: Final = 300
_SPREAD_TOLERANCE: Final = 1e-3  # relative change of the spread
_MIN_SPREAD: Final = 1e-4  # as a share of the size of a parameter


@dataclass(frozen=True, eq=False)
class Siblings:
    """Arms of one type.

    Attributes:
        mean: of the parameters over the type (p,), NaN where fewer than three arms determine one.
        spread: their standard deviation between arms (p,), likewise.
        estimates: of the arms, each with what its siblings say.
    """

    mean: Array
    spread: Array
    estimates: tuple[Estimate, ...]


def with_siblings(estimates: Sequence[Estimate]) -> Siblings | None:
    """Return the arms of one type, from the estimate of each alone; None if there are too few."""
    if len(estimates) < MIN_ESTIMATES:
        return None
    stds = np.array([each.std for each in estimates])
    values = np.array([each.values for each in estimates])
    determined = np.isfinite(stds) & (stds > 0.0)
    used = np.flatnonzero(determined.sum(axis=0) >= MIN_ESTIMATES)
    if not len(used):
        return None
    shown = np.where(determined, values, 0.0)[:, used]
    counts = determined[:, used].sum(axis=0)
    rms = np.sqrt((shown**2).sum(axis=0) / counts)
    rms = np.maximum(rms, np.nanmedian(np.where(determined, stds, np.nan)[:, used], axis=0))
    information = np.array([_information(each, used, rms) for each in estimates])
    scaled = shown / rms
    centre = scaled.sum(axis=0) / counts
    spread = (np.where(determined[:, used], scaled - centre, 0.0) ** 2).sum(axis=0) / counts
    spread = np.maximum(spread, _MIN_SPREAD**2)
    for _ in range(_MAX_ROUNDS):
        previous = spread
        mean, of_mean, centred, covariances = _expected(information, scaled, spread)
        squares = (centred - mean) ** 2 + np.diagonal(covariances, axis1=1, axis2=2)
        spread = np.maximum(squares.mean(axis=0), _MIN_SPREAD**2)
        if np.all(np.abs(spread - previous) <= _SPREAD_TOLERANCE * previous):
            break
    # The spread of few arms is known poorly, and may have come out too small (Morris 1983).
    doubt = 2.0 / max(1.0, len(estimates) - 3.0)
    wide = spread + doubt * _marginal_variance(information, spread)
    mean, of_mean, centred, _ = _expected(information, scaled, wide)
    found = []
    for number, each in enumerate(estimates):
        own = np.linalg.inv(information[number] + np.diag(1.0 / wide))
        pulled = own / wide
        shift = np.where(determined[number, used], scaled[number] - centred[number], 0.0)
        covariance = own + pulled @ of_mean @ pulled.T
        alone = np.where(determined[number, used], stds[number, used] / rms, 0.0) ** 2
        excess = np.maximum(alone - np.diag(covariance), 0.0)  # no wider than without siblings
        covariance = covariance + np.diag(np.minimum(doubt * shift**2, excess))
        found.append(_replaced(each, used, centred[number] * rms, covariance, rms))
    every = np.full((2, len(stds[0])), np.nan)
    every[:, used] = mean * rms, np.sqrt(spread) * rms
    return Siblings(every[0], every[1], tuple(found))


def _marginal_variance(information: Array, spread: Array) -> Array:
    """Return the variance of each estimated parameter about the mean of the type (p,)."""
    own = np.linalg.inv(information + np.diag(1.0 / spread))
    marginal = information - information @ own @ information
    precision = np.diagonal(marginal, axis1=1, axis2=2)
    return np.asarray(len(information) / np.maximum(precision.sum(axis=0), 1e-12))


def _information(estimate: Estimate, used: Indices, rms: Array) -> Array:
    """Return the information on some parameters in units of their size; none of undetermined."""
    covariance = estimate.covariance[np.ix_(used, used)]
    known = np.flatnonzero(np.isfinite(np.diag(covariance)) & (np.diag(covariance) > 0.0))
    information = np.zeros_like(covariance)
    if len(known):
        scale = rms[known]
        part = covariance[np.ix_(known, known)] / np.outer(scale, scale)
        information[np.ix_(known, known)] = np.linalg.pinv(part, hermitian=True)
    return np.asarray(information, dtype=np.float64)


def _expected(
    information: Array, values: Array, spread: Array
) -> tuple[Array, Array, Array, Array]:
    """Return mean (p,), its covariance, the values of the arms (r, p), and their covariances.

    The covariances (r, p, p) are of the differences of the arms from the mean.
    """
    identity = np.eye(len(spread))
    own = np.asarray(np.linalg.inv(information + np.diag(1.0 / spread)))
    marginal = information - information @ own @ information
    of_mean = np.linalg.pinv(marginal.sum(axis=0), hermitian=True)
    mean = of_mean @ np.einsum("rpq,rq->p", marginal, values)
    sides = np.einsum("rpq,rq->rp", information, values) + mean / spread
    centred = np.einsum("rpq,rq->rp", own, sides)
    pulled = own / spread - identity
    return mean, of_mean, centred, own + pulled @ of_mean @ pulled.transpose(0, 2, 1)


def _replaced(
    estimate: Estimate, used: Indices, values: Array, covariance: Array, rms: Array
) -> Estimate:
    """Return an estimate with other values and covariance of some parameters."""
    every = estimate.values.copy()
    every[used] = values
    whole = estimate.covariance.copy()
    whole[used, :] = 0.0
    whole[:, used] = 0.0
    whole[np.ix_(used, used)] = covariance * np.outer(rms, rms)
    names = {estimate.names[k] for k in used}
    return replace(
        estimate,
        values=every,
        covariance=whole,
        undetermined=tuple(name for name in estimate.undetermined if name not in names),
        method=estimate.method.widened("siblings"),
    )
