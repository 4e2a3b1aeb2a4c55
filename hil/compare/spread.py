"""How well a campaign knows a figure, and whether campaigns differ in it.

A campaign knows a figure twice: by the covariance of its estimate, which sees the noise of the
torques, and by how its repetitions scatter. The larger variance counts. Repetitions that follow one
another are not independent while friction drifts: n of them, correlated by ρ from one to the next,
are worth n (1 - ρ) / (1 + ρ) (Bayley and Hammersley 1946), ρ being corrected for the bias of its
estimate (Marriott and Pope 1954). Differences are tested by Welch's t, all together by Holm's
procedure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import t as student

Array = NDArray[np.float64]

FEWEST: Final = 15
"""Repetitions without which their correlation cannot be estimated. A campaign of fewer is assumed
to be known no better than one of them is: they may all have been made while the arm warmed up."""
CONFIDENCE: Final = 0.95
"""Of intervals, each by itself."""
_HIGHEST: Final = 0.95


class Known(NamedTuple):
    """A figure of one campaign: value, its variance, and degrees of freedom of the variance."""

    value: float
    variance: float
    freedom: float


@dataclass(frozen=True, eq=False)
class Tested:
    """Figures (k) of c campaigns, all others tested against the first; NaN for what is not known.

    Attributes:
        value: (k, c).
        std: (k, c).
        change: against the first campaign (k, c); NaN of the first itself, as the next ones.
        half: of the 95 % interval of the change (k, c).
        p_value: of no change (k, c), adjusted for all figures and campaigns.
        limit: smallest change that would count (k, c).
        changed: whether the change is more than chance and large enough to count (k, c).
        slight: whether it is more than chance and not large enough (k, c).
    """

    value: Array
    std: Array
    change: Array
    half: Array
    p_value: Array
    limit: Array
    changed: NDArray[np.bool_]
    slight: NDArray[np.bool_]

    @property
    def shares(self) -> Array:
        """Change and the ends of its interval as shares of the first campaign's value (k, c, 3)."""
        ends = np.stack([self.change, self.change - self.half, self.change + self.half], axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(ends / np.abs(self.value[:, :1, None]))


def known(value: float, variance: float, freedom: float, repetitions: Array) -> Known:
    """A figure from its estimate and from the estimates of single repetitions.

    Args:
        value: of the pooled estimate.
        variance: by its covariance; infinite if undetermined.
        freedom: of that covariance.
        repetitions: of each repetition, in order (m,); NaN where one does not determine it.
    """
    if not np.isfinite(variance):
        return Known(float("nan"), float("nan"), 1.0)
    own = repetitions[np.isfinite(repetitions)]
    if len(own) < 2:
        return Known(value, variance, freedom)
    worth = effective_count(own)
    scatter = float(np.var(own, ddof=1)) / worth
    if scatter <= variance:
        return Known(value, variance, freedom)
    return Known(value, scatter, len(own) - 1.0 if len(own) < FEWEST else max(1.0, worth - 1.0))


def effective_count(repetitions: Array) -> float:
    """How many independent repetitions these (m,) are worth, between 1 and m."""
    m = len(repetitions)
    if m < FEWEST:
        return 1.0
    centred = repetitions - repetitions.mean()
    size = float(centred @ centred)
    if size == 0.0:
        return float(m)
    raw = float(centred[:-1] @ centred[1:]) / size
    rho = min(max(raw + (1.0 + 4.0 * raw) / (m - 1), 0.0), _HIGHEST)
    return max(1.0, m * (1.0 - rho) / (1.0 + rho))


def against_first(figures: ArrayLike, share: float, least: ArrayLike = 0.0) -> Tested:
    """Test all campaigns but the first against it.

    Args:
        figures: a :class:`Known` for each figure and campaign (k, c, 3).
        share: of cases in which any of the tests finds a change where there is none.
        least: smallest change of each figure that counts (k,).
    """
    value, variance, freedom = np.moveaxis(np.asarray(figures, dtype=np.float64), 2, 0)
    change, total = value - value[:, :1], variance + variance[:, :1]
    change[:, 0] = np.nan
    change[~(total > 0.0)] = np.nan
    squares = variance**2 / freedom
    least = np.reshape(least, (-1, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        both = np.where(np.isfinite(change), total**2 / (squares + squares[:, :1]), np.nan)
        std = np.where(np.isfinite(change), np.sqrt(total), np.nan)
        p_value = holm(2.0 * student.sf(np.abs(change) / std, both))
    tests = max(1, int(np.isfinite(p_value).sum()))
    sure, large = p_value < share, np.abs(change) >= least
    return Tested(
        value=value,
        std=np.sqrt(variance),
        change=change,
        half=student.isf(0.5 - 0.5 * CONFIDENCE, both) * std,
        p_value=p_value,
        # What Holm's procedure asks of the first of all tests.
        limit=np.maximum(student.isf(share / tests / 2.0, both) * std, least),
        changed=sure & large,
        slight=sure & ~large,
    )


def holm(p_values: Array) -> Array:
    """P values adjusted for all of them being looked at (Holm 1979); NaN stays NaN, any shape."""
    flat = np.asarray(p_values, dtype=np.float64).ravel()
    adjusted = np.full(flat.shape, np.nan)
    places = np.flatnonzero(np.isfinite(flat))
    order = places[np.argsort(flat[places], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(factors * flat[order]))
    return adjusted.reshape(np.shape(p_values))
