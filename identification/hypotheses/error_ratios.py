"""Ratios of the errors of two fits or predictions, by joint and by block."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array


class ErrorRatios(NamedTuple):
    """Errors of blocks, each over the error of another prediction.

    Attributes:
        joints: ratio of the errors of all blocks (n,), 1 where none is compared.
        changes: logarithm of the ratio of each block (B, n), 0 where it is not compared.
        tested: which blocks are compared (B, n).
    """

    joints: Array
    changes: Array
    tested: NDArray[np.bool_]

    @classmethod
    def of(cls, squares: Array, other: Array) -> ErrorRatios:
        """Compare squared errors (B, n), where both are positive."""
        tested = np.isfinite(squares) & np.isfinite(other) & (squares > 0.0) & (other > 0.0)
        totals = [np.where(tested, each, 0.0).sum(axis=0) for each in (squares, other)]
        changes = np.zeros(tested.shape)
        changes[tested] = 0.5 * np.log(squares[tested] / other[tested])
        return cls(error_ratio(*totals), changes, tested)

    @property
    def some_joints(self) -> NDArray[np.bool_]:
        """The joints with a block that is compared (n,)."""
        return np.asarray(self.tested.any(axis=0))

    @property
    def some_blocks(self) -> NDArray[np.bool_]:
        """The blocks with a joint that is compared (B,)."""
        return np.asarray(self.tested.any(axis=1))


def error_ratio(squares: Array, other: Array) -> Array:
    """Return the errors of joints over others by their squares (n,), 1 where one is zero."""
    both = (squares > 0.0) & (other > 0.0)
    ratio = np.ones(len(both))
    ratio[both] = np.sqrt(squares[both] / other[both])
    return ratio


def geometric_mean(ratios: Array) -> float:
    """Return the geometric mean of ratios; 1 of none."""
    return float(np.exp(np.log(ratios).mean())) if len(ratios) else 1.0


def mean_and_error(changes: Array) -> tuple[float, float]:
    """Return the mean of changes by block and its standard error, infinite of less than two."""
    several = len(changes) > 1
    error = float(np.std(changes, ddof=1) / np.sqrt(len(changes))) if several else np.inf
    return float(changes.mean()), error
