"""Cubic spline through samples; the import of `scipy.interpolate` takes longer than its use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy

from identification.arrays import Array

MIN_SAMPLES: Final = 4
"""Samples that a spline needs."""


@dataclass(frozen=True, eq=False)
class CubicSpline:
    """Piecewise cubics with continuous second derivatives, the third also next to the ends."""

    time: Array  # of the samples (m,)
    coefficients: Array  # of the powers 0 to 3 of the time since a sample (4, m - 1, n)

    @classmethod
    def through(cls, time: Array, values: Array) -> CubicSpline:
        """Return the spline through values (m, n) at increasing times (m,) (de Boor 1978, IV)."""
        step = np.diff(time)[:, None]
        slope = np.diff(values, axis=0) / step
        first, last = time[2] - time[0], time[-1] - time[-3]
        band = np.zeros((3, len(time)))
        band[0, 1:] = np.append(first, step[:-1])
        band[1] = np.concatenate([step[1], 2.0 * (step[:-1] + step[1:])[:, 0], step[-2]])
        band[2, :-1] = np.append(step[1:], last)
        right = np.empty_like(values, dtype=np.float64)
        right[1:-1] = 3.0 * (step[1:] * slope[:-1] + step[:-1] * slope[1:])
        right[0] = ((step[0] + 2.0 * first) * step[1] * slope[0] + step[0] ** 2 * slope[1]) / first
        right[-1] = (
            step[-1] ** 2 * slope[-2] + (2.0 * last + step[-1]) * step[-2] * slope[-1]
        ) / last
        derivative = scipy.linalg.solve_banded((1, 1), band, right)
        bend = (derivative[:-1] + derivative[1:] - 2.0 * slope) / step
        second = (slope - derivative[:-1]) / step - bend
        return cls(time, np.stack([values[:-1], derivative[:-1], second, bend / step]))

    def __call__(self, at: Array, derivative: int = 0) -> Array:
        """Return values or derivatives at times (k,): (k, n); outside, the last cubics go on."""
        piece = np.clip(np.searchsorted(self.time, at, side="right") - 1, 0, len(self.time) - 2)
        since = (at - self.time[piece])[:, None]
        powers = np.polynomial.polynomial.polyder(self.coefficients, derivative)
        result = powers[-1][piece]
        for coefficient in powers[-2::-1]:
            result *= since
            result += coefficient[piece]
        return np.asarray(result)
