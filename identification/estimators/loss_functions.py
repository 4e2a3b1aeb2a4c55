r"""Loss functions of robust estimation, of residuals x in standard deviations.

A fit uses the weight :math:`u(x) = \psi(x)/x`, a covariance the slope :math:`\psi'(x)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from identification.arrays import Array
from identification.factor.estimation_method import LossName


class Loss:
    """Squared loss, and base class."""

    name: ClassVar[LossName] = "squares"
    tuning: float = np.inf

    def weight(self, x: Array) -> Array:
        """Return psi(x)/x, between 0 and 1, for residuals in standard deviations."""
        return np.ones_like(x)

    def slope(self, x: Array) -> Array:
        """Return psi'(x), at most 1."""
        return np.ones_like(x)


@dataclass(frozen=True)
class Huber(Loss):
    """Square within `tuning` standard deviations, linear beyond (Huber 1964); convex."""

    name = "huber"
    tuning: float = 1.345  #: 1.345 keeps 95 % of the efficiency on Gaussian noise

    def weight(self, x: Array) -> Array:
        """Return min(1, k/|x|)."""
        return self.tuning / np.maximum(np.abs(x), self.tuning)

    def slope(self, x: Array) -> Array:
        """Return one within k, zero beyond."""
        return np.asarray(np.abs(x) <= self.tuning, dtype=np.float64)


@dataclass(frozen=True)
class Tukey(Loss):
    """Bisquare: rows beyond `tuning` standard deviations do not count (Beaton and Tukey 1974)."""

    name = "tukey"
    tuning: float = 4.685  #: 4.685 keeps 95 % of the efficiency on Gaussian noise

    def weight(self, x: Array) -> Array:
        """Return (1 - (x/c)²)² within c, zero beyond."""
        return np.asarray((1.0 - self._squared(x)) ** 2)

    def slope(self, x: Array) -> Array:
        """Return (1 - (x/c)²)(1 - 5 (x/c)²) within c, zero beyond."""
        squared = self._squared(x)
        return (1.0 - squared) * (1.0 - 5.0 * squared)

    def _squared(self, x: Array) -> Array:
        # Clipped: an infinite residual has weight zero, not NaN.
        return np.minimum(np.abs(x) / self.tuning, 1.0) ** 2
