"""How much of a residual is noise: its correlation in time, and what its samples are worth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

# Longer than any move of an arm takes to forget the one before.
LONGEST_LAG: Final = 0.5  # s
_MOST_LAGS: Final = 1000


@dataclass(frozen=True, eq=False)
class Autocorrelation:
    """Autocorrelation of the residual of n joints at L + 1 lags.

    Attributes:
        lag: (L + 1,) [s], from zero.
        correlation: (L + 1, n), one at lag zero; NaN for a joint without rows.
        rows: samples that were correlated (n,).
    """

    lag: Array
    correlation: Array
    rows: NDArray[np.intp]

    @property
    def time(self) -> Array:
        """Integrated correlation time per joint (n,) [s], half a sampling step for white noise.

        The sum over lags ends where two neighbours together are no longer positive (initial
        positive sequence, Geyer 1992): beyond that an estimated autocorrelation is noise.
        """
        step = self.lag[1] if len(self.lag) > 1 else 0.0
        pairs = self.correlation[: len(self.lag) // 2 * 2].reshape(-1, 2, len(self.rows)).sum(1)
        positive = np.cumprod(pairs > 0.0, axis=0)
        return np.asarray(step * ((pairs * positive).sum(axis=0) - 0.5))

    @property
    def effective_rows(self) -> Array:
        """Independent samples that would say as much about a mean as these do (n,)."""
        step = self.lag[1] if len(self.lag) > 1 else 1.0
        return np.asarray(self.rows / np.maximum(2.0 * self.time / step, 1.0))


def autocorrelation(
    residuals: Iterable[tuple[Array, Rows]], step: float, longest: float = LONGEST_LAG
) -> Autocorrelation:
    """Autocorrelation over several recordings, each with one clock step.

    Pairs of rows count if both do, so that gaps and reversals need not be bridged.

    Args:
        residuals: of each recording torque residual (m, n) and which rows count (m, n).
        step: sampling step [s].
        longest: lag [s].
    """
    lags = max(2, min(_MOST_LAGS, round(longest / step)))
    products: Array | None = None
    pairs: Array | None = None
    for residual, usable in residuals:
        kept = np.where(usable, residual, 0.0)
        own = _products(kept, lags), _products(usable.astype(np.float64), lags)
        products = own[0] if products is None else products + own[0]
        pairs = own[1] if pairs is None else pairs + own[1]
    if products is None or pairs is None:
        raise ValueError("there is no residual to correlate")
    covariance = products / np.maximum(np.rint(pairs), 1.0)
    power = covariance[0]
    correlation = np.where(power > 0.0, covariance / np.where(power > 0.0, power, 1.0), np.nan)
    return Autocorrelation(
        lag=np.asarray(step * np.arange(lags + 1), dtype=np.float64),
        correlation=correlation,
        rows=np.rint(pairs[0]).astype(np.intp),
    )


def _products(values: Array, lags: int) -> Array:
    """Sums of x(t) x(t + l) for l = 0 .. lags, per column: (lags + 1, n)."""
    m, n = values.shape
    found = np.zeros((lags + 1, n))
    reach = min(lags, m - 1)
    length = scipy.fft.next_fast_len(m + reach, real=True)  # so long that nothing wraps round
    power = np.abs(scipy.fft.rfft(values, length, axis=0)) ** 2
    found[: reach + 1] = scipy.fft.irfft(power, length, axis=0)[: reach + 1]
    return found


def steps_of(times: Sequence[Array]) -> float:
    """Usual sampling step of several clocks [s]."""
    return float(np.median([np.median(np.diff(time)) for time in times if len(time) > 1]))
