"""Comparison of two methods over their searches, repetitions and held-out motions."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from scipy import stats

from hil.base.arrays import Array
from hil.study.settings import BOOTSTRAP_DRAWS

from .results import Verdict

#: A difference of errors below this share exists and does not matter
SMALL_DIFFERENCE: Final = 0.02
MIN_UNITS: Final = 3  #: Searches needed for their scatter
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
    """Compare the errors of the estimates of two methods, by search and motion (s, m).

    Both have errors on the same m motions. Searches are resampled, and with them the motions: luck
    of a search and noise of its repetitions act on all motions that its estimate predicts. The
    repetitions of a search are not resampled as well: their noise is in the scatter of searches,
    each of which has its own, and what friction drifts from one to the next is not random. Of n
    units n - 1 are sampled, since a mean of n would scatter by (n - 1) / n too little. The interval
    is Student's, with the degrees of freedom of the fewest units.
    """
    before, after = np.log(first), np.log(second)
    logs = after.mean(axis=0) - before.mean(axis=0)
    ratio = float(np.exp(logs.mean()))
    motions = len(logs)
    fewest = min(len(first), len(second))
    low = high = None
    if fewest >= MIN_UNITS and motions > 1:
        random = np.random.default_rng(_SEED)
        change = _weights(len(after), random) @ after - _weights(len(before), random) @ before
        draws = (change * _weights(motions, random)).sum(axis=1)
        width = stats.t.ppf(0.975, min(fewest, motions) - 1) * draws.std(ddof=1)
        low, high = (float(bound) for bound in ratio * np.exp([-width, width]))
    wins = int((logs < 0.0).sum())
    return Ratio(ratio, wins, motions, low, high, verdict_of(ratio, low, high))


def _weights(count: int, random: np.random.Generator) -> Array:
    """Return the weights (draws, count) of means over count - 1 units with replacement."""
    return random.multinomial(count - 1, [1.0 / count] * count, BOOTSTRAP_DRAWS) / (count - 1.0)


def verdict_of(ratio: float, low: float | None, high: float | None) -> Verdict:
    """Return the verdict on the second method: significant if the interval excludes 1."""
    if low is None or high is None:
        return "too few"
    if low <= 1.0 <= high:
        return "none"
    if ratio < 1.0:
        return "slightly better" if 1.0 - ratio < SMALL_DIFFERENCE else "better"
    return "slightly worse" if ratio - 1.0 < SMALL_DIFFERENCE else "worse"
