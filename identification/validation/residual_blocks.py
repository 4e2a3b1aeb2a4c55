"""Means of a coloured residual, with standard errors that allow for its colour.

What a torque model leaves over is correlated over tenths of a second: a thousand samples of one
move say about as much as one number. Means are therefore judged by how much they differ from
block to block of time, not from sample to sample (cluster-robust, Liang and Zeger 1986), which
assumes nothing about what happens inside a block. Repetitions of one motion share their blocks:
an error that repeats with the motion is not confirmed by being repeated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.signals.samples import Samples

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Errors of a model come and go with the moves of the arm.
BLOCK: Final = 0.5  # s
# A mean over fewer blocks has no standard error worth the name.
FEWEST_BLOCKS: Final = 5


class BlockMean(NamedTuple):
    """Means over blocks of time; every array has the shape of what was averaged.

    Attributes:
        mean: NaN with fewer than `FEWEST_BLOCKS` blocks.
        std: standard error, likewise.
        rows: samples.
        blocks: blocks with at least one sample.
    """

    mean: Array
    std: Array
    rows: Array
    blocks: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class BlockSums:
    """Sums over blocks of time, of any quantity: (B, ...) each.

    Attributes:
        values: sum of the quantity over the samples of a block.
        weights: sum of what it is divided by: a number of samples, or the power of a regressor.
    """

    values: Array
    weights: Array

    def plus(self, other: BlockSums, *, same_motion: bool) -> BlockSums:
        """Blocks of both: one after the other, or of equal times in one motion as one."""
        if not same_motion:
            return BlockSums(
                np.concatenate([self.values, other.values]),
                np.concatenate([self.weights, other.weights]),
            )
        return BlockSums(_added(self.values, other.values), _added(self.weights, other.weights))

    def mean(self) -> BlockMean:
        """Mean over all blocks, sum of values over sum of weights, and its standard error."""
        weights = self.weights.sum(axis=0)
        blocks = np.count_nonzero(self.weights, axis=0)
        enough = blocks >= FEWEST_BLOCKS
        divisor = np.where(enough, weights, 1.0)
        mean = self.values.sum(axis=0) / divisor
        scores = (self.values - mean * self.weights) / divisor
        freedom = np.maximum(blocks - 1, 1)
        std = np.sqrt((scores**2).sum(axis=0) * blocks / freedom)
        return BlockMean(
            np.where(enough, mean, np.nan),
            np.where(enough, std, np.nan),
            weights,
            blocks,
        )


def block_index(samples: Samples, length: float = BLOCK) -> Indices:
    """Block of each row (m,), counted from the beginning of the motion."""
    since = samples.motion.time - samples.origin
    return np.maximum(np.floor(since / length + 1e-9).astype(np.intp), 0)


def binned_sums(
    block: Indices, bins: Indices, n_bins: int, values: Array, rows: NDArray[np.bool_]
) -> Array:
    """Sum of values (m,) over the rows that count (m,), by block and bin: (B, n_bins)."""
    count = int(block[-1]) + 1 if len(block) else 0
    place = block * n_bins + bins
    summed = np.bincount(place, weights=np.where(rows, values, 0.0), minlength=count * n_bins)
    return np.asarray(summed.reshape(count, n_bins), dtype=np.float64)


def _added(first: Array, second: Array) -> Array:
    total = np.zeros((max(len(first), len(second)), *first.shape[1:]))
    total[: len(first)] += first
    total[: len(second)] += second
    return total
