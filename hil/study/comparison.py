"""Comparison of two methods over their searches, repetitions and held-out motions."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from scipy import stats

from hil.base.arrays import Array

from .results import Verdict

SMALL: Final = 0.02  #: A difference of errors below this share exists and does not matter
MIN_UNITS: Final = 3  #: Searches needed for their scatter
_DRAWS: Final = 2000
_SEED: Final = 20140901


class Ratio(NamedTuple):
    """Errors with a second method over errors with a first."""

    ratio: float  #: geometric mean over searches and motions
    wins: int  #: motions that the second predicts better, in the mean over searches
    motion_count: int
    low: float | None  #: 95 % interval; None with too few searches or motions
    high: float | None
    verdict: Verdict

    def fields(self) -> dict[str, Any]:
        """Return the fields of `StudyComparison`."""
        return self._asdict()


def compared(first: Array, second: Array) -> Ratio:
    """Compare the errors of the mean estimates of two methods.

    Each is given by products y_r' G y_t of the estimates of a search's repetitions on each motion,
    (s, m, r, r), of the same m motions; searches and repetitions may differ in number.

    Searches are resampled, in each of them its repetitions, and with both the motions (hierarchical
    bootstrap): noise and luck of a search act on all motions that its estimate predicts. Of n units
    n - 1 are sampled, since a mean of n would scatter by (n - 1) / n too little. The interval is
    Student's, with the degrees of freedom of the fewest units.
    """
    before, after = (
        _logarithms(products.mean(axis=(2, 3))).mean(axis=0) for products in (first, second)
    )
    logs = after - before
    ratio = float(np.exp(logs.mean()))
    motions = len(logs)
    fewest = min(len(first), len(second))
    low = high = None
    if fewest >= MIN_UNITS and motions > 1:
        random = np.random.default_rng(_SEED)
        change = _resampled(second, random) - _resampled(first, random)
        draws = (change * _weights(motions, _DRAWS, random)).sum(axis=1)
        width = stats.t.ppf(0.975, min(fewest, motions) - 1) * draws.std(ddof=1)
        low, high = (float(bound) for bound in ratio * np.exp([-width, width]))
    wins = int((logs < 0.0).sum())
    return Ratio(ratio, wins, motions, low, high, verdict_of(ratio, low, high))


def _logarithms(squared: Array) -> Array:
    """Return the logarithms of errors from their squares."""
    return np.asarray(0.5 * np.log(np.maximum(squared, np.finfo(np.float64).tiny)))


def _resampled(products: Array, random: np.random.Generator) -> Array:
    """Return the mean log error over resampled searches and repetitions, (draws, m)."""
    searches, motions, repetitions, _ = products.shape
    total = np.zeros((_DRAWS, motions))
    shares = _weights(searches, _DRAWS, random)
    for search in range(searches):
        weights = _weights(repetitions, _DRAWS, random)
        squared = np.einsum("dr,mrt,dt->dm", weights, products[search], weights, optimize=True)
        total += shares[:, search, None] * _logarithms(squared)
    return total


def _weights(count: int, draws: int, random: np.random.Generator) -> Array:
    """Return the weights (draws, count) of means over count - 1 units with replacement."""
    if count == 1:
        return np.ones((draws, 1))
    return random.multinomial(count - 1, [1.0 / count] * count, draws) / (count - 1.0)


def verdict_of(ratio: float, low: float | None, high: float | None) -> Verdict:
    """Return the verdict on the second method: significant if the interval excludes 1."""
    if low is None or high is None:
        return "too few"
    if low <= 1.0 <= high:
        return "none"
    if ratio < 1.0:
        return "slightly better" if 1.0 - ratio < SMALL else "better"
    return "slightly worse" if ratio - 1.0 < SMALL else "worse"
