"""Blocks of time, by which rows are summed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, Indices

Blocks = TypeVar("Blocks", NDArray[np.float64], NDArray[np.intp])

FINE_BLOCK: Final = 0.125  # s
FOLDS: Final = 5
"""Number of interleaved parts of the blocks; each is predicted from the others."""


def block_slices(index: Indices) -> Iterator[tuple[int, slice]]:
    """Yield each value of a rising index with its slice."""
    edges = np.flatnonzero(np.diff(index)) + 1
    for start, stop in pairwise([0, *edges.tolist(), len(index)]):
        if stop > start:
            yield int(index[start]), slice(start, stop)


class EqualRuns(NamedTuple):
    """Consecutive blocks of equally many rows."""

    first: int  # block
    blocks: int
    start: int  # first row
    length: int  # rows per block


def equal_runs(index: Indices) -> list[EqualRuns]:
    """Group :func:`block_slices` of a rising index, for few large operations."""
    groups: list[EqualRuns] = []
    for block, at in block_slices(index):
        length = at.stop - at.start
        last = groups[-1] if groups else None
        if last is not None and last.length == length and last.first + last.blocks == block:
            groups[-1] = last._replace(blocks=last.blocks + 1)
        else:
            groups.append(EqualRuns(block, 1, at.start, length))
    return groups


def add_grams(total: Array, rows: Array, runs: Iterable[EqualRuns]) -> None:
    """Add ``rows rows'`` of each block to the total (B, c, c), in place; rows is (c, k)."""
    for first, count, start, length in runs:
        run_rows = rows[:, start : start + count * length].reshape(len(rows), count, length)
        # A product with the own transpose takes half the work.
        run_rows = run_rows.transpose(1, 0, 2)
        total[first : first + count] += run_rows @ run_rows.transpose(0, 2, 1)


def count_by_block(index: Indices, usable: NDArray[np.bool_]) -> Indices:
    """Return usable rows per block (B, n) of a mask (m, n), by a rising index (m,)."""
    if not len(index):
        return np.zeros((0, usable.shape[1]), dtype=np.intp)
    ends = np.searchsorted(index, np.arange(int(index[-1]) + 1), side="right")
    sums = np.cumsum(usable, axis=0, dtype=np.intp)[np.maximum(ends - 1, 0)]
    sums[ends == 0] = 0
    return np.diff(sums, axis=0, prepend=0)


def merged(blocks: Blocks, length: int) -> Blocks:
    """Sum runs of `length` blocks along the first axis (B, ...); the last may be shorter."""
    total = blocks[::length].copy()
    for later in range(1, length):  # faster than np.add.reduceat
        addend = blocks[later::length]
        total[: len(addend)] += addend
    return total


def part_edges(blocks: int, count: int) -> Indices:
    """Return the first of the blocks of each of `count` equal parts (count,)."""
    return np.arange(count) * blocks // count


def added(first: Blocks, second: Blocks) -> Blocks:
    """Add blocks (B, ...) of possibly different number."""
    longer, shorter = (first, second) if len(first) >= len(second) else (second, first)
    if not len(shorter):
        return longer
    total = longer.copy()
    total[: len(shorter)] += shorter
    return total
