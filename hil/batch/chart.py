"""A robust control chart of a short history, and a test for drift that assumes no distribution.

The chart asks of each value whether it could belong to the values before it. Location is their
median and scale their Qn (Rousseeuw and Croux 1993), so that an odd value in the history neither
moves the centre nor widens the limits. Values that departed are no history for later ones, unless
`FEWEST` of them in a row stay on one side: they are a new level, by which later ones are judged. A
value that belongs to an earlier level has returned to it. Scatter is that about all levels.

The limits are Student's: Qn of n normal values is as uncertain as a standard deviation of about
0.6 (n - 1) + 0.5 values, found by simulation (n = 5 to 30, tail 1e-2 and 1e-3, on the safe side).

Drift is Kendall's rank correlation with time (Mann 1945), exact for few values, with the slope of
Theil and Sen (Sen 1968).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kendalltau, theilslopes
from scipy.stats import t as student

Array = NDArray[np.float64]

FEWEST: Final = 5
"""Earlier values without which nothing is judged, and values in a row that make a new level."""

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
class Chart:
    """A history judged, value by value.

    Attributes:
        limits: by the level that the value belongs to, or was expected at; None before there are
            enough values.
        departs: which values belong to no level that was known then.
        levels: number of the level that a value belongs to, from 0; -1 for one that is not known,
            or departed and made no new level.
    """

    limits: tuple[Limits | None, ...]
    departs: tuple[bool, ...]
    levels: tuple[int, ...]


@dataclass(frozen=True)
class Drift:
    """A slope in time.

    Attributes:
        slope: per unit of time.
        low: lower end of its 95 % interval.
        high: upper end.
        p_value: of no drift, two-sided.
        span: time from the first value to the last.
    """

    slope: float
    low: float
    high: float
    p_value: float
    span: float


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


def limits(earlier: Array, earlier_std: Array, std: float, share: float) -> Limits | None:
    """Limits for a value after a history of one level, None for one too short.

    Args:
        earlier: values (n,).
        earlier_std: standard deviations that they came with (n,); zero where unknown.
        std: standard deviation of the value to be judged; zero where unknown.
        share: of values beyond the limits if nothing has changed.
    """
    return _Levels(earlier, earlier_std, share, [list(range(len(earlier)))]).limits(0, std)


def chart(
    values: Array,
    stds: Array,
    share: float,
    *,
    least: float = 0.0,
    rise_only: bool = False,
) -> Chart:
    """Judge each value by those before it that did not depart themselves.

    Args:
        values: in order of time (n,); NaN where there is none.
        stds: standard deviations that they came with (n,).
        share: of values beyond the limits if nothing has changed.
        least: smallest departure from the centre that matters.
        rise_only: whether only values above the history count.
    """
    known = _Levels(values, stds, 2.0 * share if rise_only else share, [[]])
    now, away = 0, list[int]()
    found: list[Limits | None] = []
    departs, levels = [False] * len(values), [-1] * len(values)
    for k, value in enumerate(values):
        expected = known.limits(now, float(stds[k]))
        if not math.isfinite(value):
            found.append(expected)
            continue
        home = known.home(k, now, least, rise_only=rise_only)
        if home is not None:
            now, levels[k], away = home, home, []
            found.append(known.limits(home, float(stds[k])))
            known.members[home].append(k)
            continue
        assert expected is not None
        found.append(expected)
        departs[k] = True
        if away and (value > expected.centre) != (values[away[-1]] > expected.centre):
            away = []
        away.append(k)
        if len(away) == FEWEST:
            now = len(known.members)
            known.members.append(away)
            for one in away:
                levels[one] = now
            away = []
    if rise_only:
        found = [None if one is None else replace(one, low=-math.inf) for one in found]
    return Chart(tuple(found), tuple(departs), tuple(levels))


@dataclass(frozen=True, eq=False)
class _Levels:
    """Levels of a history, which scatter alike."""

    values: Array
    stds: Array
    share: float
    members: list[list[int]]

    def limits(self, level: int, std: float) -> Limits | None:
        """Where a value with a standard deviation would be if it belonged to a level."""
        own = self.members[level]
        if len(own) < FEWEST:
            return None
        centre = float(np.median(self.values[own]))
        every = np.concatenate(self.members)
        residuals = np.concatenate(
            [self.values[one] - np.median(self.values[one]) for one in self.members]
        )
        # Each level has taken its own median from its residuals.
        spare = len(every) - len(self.members)
        scatter = qn_scale(residuals) * math.sqrt((len(every) - 1) / spare)
        typical = float(np.median(self.stds[every]))
        # Few values may lie close together by chance, but not closer than each is known.
        scale = max(scatter, typical)
        # A campaign of fewer repetitions than usual is known less well than the history scatters.
        one = scale**2 + max(0.0, std**2 - typical**2)
        spread = math.sqrt(one + scale**2 * math.pi / (2.0 * len(own)))
        reach = float(student.isf(self.share / 2.0, 0.6 * spare - 0.5)) * spread
        return Limits(centre, centre - reach, centre + reach, len(own))

    def home(self, k: int, now: int, least: float, *, rise_only: bool) -> int | None:
        """The level that a value belongs to: the present one rather than those before it."""
        value, std = float(self.values[k]), float(self.stds[k])
        for level in (now, *(one for one in reversed(range(len(self.members))) if one != now)):
            band = self.limits(level, std)
            if band is None or band.low <= value <= band.high or abs(value - band.centre) < least:
                return level
        below = value < float(np.median(self.values[self.members[now]]))
        return now if rise_only and below else None


def drift(time: Sequence[float] | Array, values: Array) -> Drift | None:
    """Slope of values (n,) in time (n,), None for fewer than `FEWEST` or one instant."""
    at = np.asarray(time, dtype=np.float64)
    known = np.isfinite(values)
    at, own = at[known], values[known]
    if len(own) < FEWEST or np.ptp(at) == 0.0 or np.ptp(own) == 0.0:
        return None
    slope, _, low, high = theilslopes(own, at, _CONFIDENCE)
    p_value = float(kendalltau(at, own).pvalue)
    return Drift(float(slope), float(low), float(high), p_value, float(np.ptp(at)))
