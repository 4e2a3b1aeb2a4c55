"""Means over blocks of time, with standard errors by the scatter of the blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array, Indices

# Model errors are correlated over tenths of a second.
BLOCK_SECONDS: Final = 0.5  # s
MIN_BLOCKS: Final = 5  # fewer blocks give no standard error


class BlockMean(NamedTuple):
    """Means over blocks of time; every array has the shape of the averaged values."""

    mean: Array  # NaN with fewer than `MIN_BLOCKS` blocks
    std: Array  # standard error, likewise
    rows: Array  # samples
    blocks: Indices  # blocks with at least one sample


def block_mean(parts: Sequence[Array], repeated: int = 1) -> BlockMean:
    """Return sum of values over sum of weights, with standard error by blocks.

    Each part holds both sums by blocks (2, B, ...); the first `repeated` parts share blocks.
    """
    shared = np.zeros((2, max(p.shape[1] for p in parts[:repeated]), *parts[0].shape[2:]))
    for part in parts[:repeated]:
        shared[:, : part.shape[1]] += part
    values, weights = np.concatenate([shared, *parts[repeated:]], axis=1)
    total = weights.sum(axis=0)
    blocks = np.count_nonzero(weights, axis=0)
    enough = blocks >= MIN_BLOCKS
    divisor = np.where(enough, total, 1.0)
    mean = values.sum(axis=0) / divisor
    scores = (values - mean * weights) / divisor
    std = np.sqrt((scores**2).sum(axis=0) * blocks / np.maximum(blocks - 1, 1))
    return BlockMean(np.where(enough, mean, np.nan), np.where(enough, std, np.nan), total, blocks)
