"""A robust control chart of a short history, and a test for drift that assumes no distribution.

The chart asks of each value whether it could belong to the values before it. Location is their
median and scale their Qn (Rousseeuw and Croux 1993), so that an odd value in the history neither
moves the centre nor widens the limits. Values that departed are no history for later ones.

The limits are Student's: Qn of n normal values is as uncertain as a standard deviation of about
0.6 (n - 1) + 0.5 values, found by simulation (n = 5 to 30, tail 1e-2 and 1e-3, on the safe side).

Drift is Kendall's rank correlation with time (Mann 1945), exact for few values, with the slope of
Theil and Sen (Sen 1968).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kendalltau, theilslopes
from scipy.stats import t as student

Array = NDArray[np.float64]

FEWEST: Final = 5
"""Earlier values without which nothing is judged."""

_QN_NORMAL: Final = 2.2219
# Slope of the interval of a drift.
_CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class Limits:
    """Where a value would be, judged by those before it.

    Attributes:
        centre: median of the earlier values.
        low: lower limit, -inf where only a rise counts.
        high: upper limit.
        history: number of earlier values used.
    """

    centre: float
    low: float
    high: float
    history: int


@dataclass(frozen=True)
class Drift:
    """A slope in time.

    Attributes:
        slope: per unit of time.
        low: lower end of its 95 % interval.
        high: upper end.
        p_value: of no drift, two-sided.
    """

    slope: float
    low: float
    high: float
    p_value: float


def qn_scale(values: Array) -> float:
    """Qn, a robust standard deviation: a low quantile of all distances between two values.

    Half of the values (n,) may be anything.
    """
    n = len(values)
    if n < 2:
        return 0.0
    first, second = np.triu_indices(n, 1)
    half = n // 2 + 1
    place = half * (half - 1) // 2 - 1
    distance = np.partition(np.abs(values[first] - values[second]), place)[place]
    correction = n / (n + (1.4 if n % 2 else 3.8))
    return float(_QN_NORMAL * correction * distance)


def limits(
    earlier: Array, earlier_std: Array, std: float, share: float, *, rise_only: bool = False
) -> Limits | None:
    """Limits for a value after a history, None for one too short.

    Args:
        earlier: values (n,).
        earlier_std: standard deviations that they came with (n,); zero where unknown.
        std: standard deviation of the value to be judged; zero where unknown.
        share: of values beyond the limits if nothing has changed.
        rise_only: whether only values above the history count.
    """
    n = len(earlier)
    if n < FEWEST:
        return None
    centre = float(np.median(earlier))
    typical = float(np.median(earlier_std))
    # Few values may lie close together by chance, but not closer than each is known.
    scale = max(qn_scale(earlier), typical)
    # A campaign of fewer repetitions than usual is known less well than the history scatters.
    own = scale**2 + max(0.0, std**2 - typical**2)
    spread = math.sqrt(own + scale**2 * math.pi / (2.0 * n))
    tail = share if rise_only else share / 2.0
    reach = float(student.isf(tail, 0.6 * (n - 1) - 0.5)) * spread
    return Limits(centre, -math.inf if rise_only else centre - reach, centre + reach, n)


def chart(
    values: Array,
    stds: Array,
    share: float,
    *,
    least: float = 0.0,
    rise_only: bool = False,
) -> tuple[tuple[Limits | None, ...], tuple[bool, ...]]:
    """Judge each value by those before it that did not depart themselves.

    Args:
        values: in order of time (n,); NaN where there is none.
        stds: standard deviations that they came with (n,).
        share: of values beyond the limits if nothing has changed.
        least: smallest departure from the centre that matters.
        rise_only: whether only values above the history count.

    Returns:
        limits per value, None before there are enough; and which values depart.
    """
    kept: list[int] = []
    found: list[Limits | None] = []
    departs: list[bool] = []
    for k, value in enumerate(values):
        band = limits(values[kept], stds[kept], float(stds[k]), share, rise_only=rise_only)
        beyond = (
            band is not None
            and not band.low <= value <= band.high
            and abs(value - band.centre) >= least
            and math.isfinite(value)
        )
        found.append(band)
        departs.append(bool(beyond))
        if math.isfinite(value) and not beyond:
            kept.append(k)
    return tuple(found), tuple(departs)


def drift(time: Sequence[float] | Array, values: Array) -> Drift | None:
    """Slope of values (n,) in time (n,), None for fewer than `FEWEST` or one instant."""
    at = np.asarray(time, dtype=np.float64)
    known = np.isfinite(values)
    at, own = at[known], values[known]
    if len(own) < FEWEST or np.ptp(at) == 0.0 or np.ptp(own) == 0.0:
        return None
    slope, _, low, high = theilslopes(own, at, _CONFIDENCE)
    return Drift(float(slope), float(low), float(high), float(kendalltau(at, own).pvalue))
