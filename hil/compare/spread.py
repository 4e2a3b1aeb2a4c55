"""How well a campaign knows a figure, and whether two campaigns differ in it.

A campaign knows a figure twice: by the covariance of its estimate, which sees the noise of the
torques, and by how its repetitions scatter, which also sees whatever changes from one to the next.
The larger variance counts. Repetitions that follow one another are not independent while friction
drifts: n of them, correlated by ρ from one to the next, are worth n (1 - ρ) / (1 + ρ) (Bayley and
Hammersley 1946), with ρ corrected for the bias that its estimate has (Marriott and Pope 1954). Of
few repetitions ρ cannot be estimated; they are worth one.
Differences are tested by Welch's t, many of them together by Holm's procedure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

Array = NDArray[np.float64]

FEWEST: Final = 15
"""Repetitions without which their correlation cannot be estimated. A campaign of fewer is assumed
to be known no better than one of them is: they may all have been made while the arm warmed up."""
_HIGHEST: Final = 0.95


@dataclass(frozen=True)
class Known:
    """A figure of one campaign.

    Attributes:
        value: of the pooled estimate; NaN if the data do not determine it.
        variance: of it.
        freedom: degrees of freedom that the variance was estimated with.
    """

    value: float
    variance: float
    freedom: float

    @property
    def std(self) -> float:
        """Standard deviation."""
        return float(np.sqrt(self.variance))


@dataclass(frozen=True)
class Difference:
    """A figure of one campaign less that of another.

    Attributes:
        value: the difference; NaN if one of them is not known.
        std: its standard deviation.
        freedom: degrees of freedom (Welch and Satterthwaite).
        p_value: of no difference, two-sided, by itself.
    """

    value: float
    std: float
    freedom: float
    p_value: float

    def half(self, share: float) -> float:
        """Half of the interval that is exceeded by a share of cases."""
        return float(student.isf(share / 2.0, self.freedom)) * self.std


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


def difference(before: Known, after: Known) -> Difference:
    """Whether a figure has changed, by Welch's test."""
    value, variance = after.value - before.value, before.variance + after.variance
    if not np.isfinite(value) or not variance > 0.0:
        return Difference(float("nan"), float("nan"), 1.0, float("nan"))
    shares = before.variance**2 / before.freedom + after.variance**2 / after.freedom
    freedom, std = variance**2 / shares, float(np.sqrt(variance))
    return Difference(value, std, freedom, float(2.0 * student.sf(abs(value) / std, freedom)))


def holm(p_values: Array) -> Array:
    """P values adjusted for all of them being looked at (Holm 1979); NaN stays NaN, any shape."""
    flat = np.asarray(p_values, dtype=np.float64).ravel()
    adjusted = np.full(flat.shape, np.nan)
    places = np.flatnonzero(np.isfinite(flat))
    order = places[np.argsort(flat[places], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(factors * flat[order]))
    return adjusted.reshape(np.shape(p_values))
