"""Whether something grows over hours, and by how much values differ anyway.

Nothing here assumes a distribution: the trend is that of Theil and Sen with Kendall's interval (Sen
1968), over several pieces of a run as Hirsch and Slack (1984) have it: only samples of one piece
are compared. Samples that follow each other resemble each other, which makes the intervals somewhat
too narrow; so a judgement asks for the size of a trend and not only for its sign.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from drivers.exchange.control import BINS, PER_OCTAVE, SHORTEST

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Slope:
    """A trend with its interval, per unit of time; infinite bounds where nothing can be said."""

    value: float
    low: float
    high: float


def slope(pieces: Sequence[tuple[Array, Array]], confidence: float) -> Slope:
    """The common trend of several series.

    Args:
        pieces: times and values, (n,) each.
        confidence: two-sided, of the interval.
    """
    slopes: list[Array] = []
    variance = 0.0
    for times, values in pieces:
        if len(times) < 2:
            continue
        first, second = np.triu_indices(len(times), 1)
        slopes.append((values[second] - values[first]) / (times[second] - times[first]))
        variance += _variance_of_s(values)
    every = np.sort(np.concatenate(slopes)) if slopes else np.zeros(0)
    count = len(every)
    if not count:
        return Slope(0.0, -math.inf, math.inf)
    reach = NormalDist().inv_cdf(0.5 + 0.5 * confidence) * math.sqrt(variance)
    low, high = math.floor(0.5 * (count - reach)), math.ceil(0.5 * (count + reach))
    return Slope(
        float(np.median(every)),
        float(every[low]) if low >= 0 else -math.inf,
        float(every[high]) if high < count else math.inf,
    )


def _variance_of_s(values: Array) -> float:
    """Of Kendall's S without a trend, with ties."""
    n = len(values)
    ties = np.unique(values, return_counts=True)[1].astype(float)
    tied = float(np.sum(ties * (ties - 1.0) * (2.0 * ties + 5.0)))
    return (n * (n - 1.0) * (2.0 * n + 5.0) - tied) / 18.0


def quantile(counts: Sequence[int] | Array, share: float) -> float:
    """Latency not exceeded by this share of the answers, s, between the edges of its bin.

    On a logarithmic scale, so that it moves as the counts do and not in steps of a bin.
    """
    total = float(np.sum(counts))
    if total <= 0.0:
        return math.nan
    upto = np.cumsum(counts) / total
    index = int(np.searchsorted(upto, share, side="left"))
    index = min(index, BINS - 1)
    below = float(upto[index - 1]) if index else 0.0
    inside = (share - below) / (float(upto[index]) - below)
    return float(SHORTEST * 2.0 ** ((index - 1.0 + inside) / PER_OCTAVE))


def largest_rise(series: Sequence[float] | Array) -> float:
    """By how much some later value exceeds some earlier one at most; -inf for fewer than two."""
    rise, least = -math.inf, math.inf
    for value in series:
        rise, least = max(rise, value - least), min(least, value)
    return float(rise)
