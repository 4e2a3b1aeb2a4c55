"""What is left over against speed or position: the mean residual in bins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.distributions import student_limit
from identification.signals.samples import Samples
from identification.validation.residual_blocks import (
    BlockMean,
    BlockSums,
    binned_sums,
    block_index,
)

Array = NDArray[np.float64]

BINS: Final = 12
# Chance that a joint without any such error is mistaken for one with it, over all its bins.
CHANCE: Final = 0.001


@dataclass(frozen=True, eq=False)
class Profile:
    """Mean residual of n joints in K bins of their own speed or position.

    Attributes:
        edges: of the bins, (n, K + 1) [rad/s, m/s, rad or m].
        bins: mean and standard error of the residual (n, K) [N·m or N], NaN in a bin that too
            few blocks of time have seen.
    """

    edges: Array
    bins: BlockMean

    @property
    def centres(self) -> Array:
        """Middle of each bin (n, K)."""
        return 0.5 * (self.edges[:, 1:] + self.edges[:, :-1])

    @property
    def rms(self) -> Array:
        """Root mean square over the samples of what the bins explain (n,) [N·m or N].

        The standard errors are subtracted, so that noise alone gives about zero.
        """
        seen = np.isfinite(self.bins.mean)
        rows = np.where(seen, self.bins.rows, 0.0)
        squares = np.where(seen, self.bins.mean**2 - self.bins.std**2, 0.0)
        total = np.maximum(rows.sum(axis=1), 1.0)
        return np.asarray(np.sqrt(np.maximum((rows * squares).sum(axis=1) / total, 0.0)))

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Whether some bin of a joint is off by more than chance explains (n,).

        Student's t of the worst bin, at `CHANCE` shared among the bins (Bonferroni).
        """
        seen = np.isfinite(self.bins.mean)
        freedom = np.maximum(self.bins.blocks - 1, 1)
        limit = student_limit(0.5 * CHANCE / np.maximum(seen.sum(axis=1), 1)[:, None], freedom)
        std = np.where(seen & (self.bins.std > 0.0), self.bins.std, np.inf)
        return np.asarray((np.abs(np.where(seen, self.bins.mean, 0.0)) > limit * std).any(axis=1))

    def worst(self, joint: int) -> tuple[float, float]:
        """Middle of the bin in which a joint's mean residual is most certain, and that residual."""
        seen = np.isfinite(self.bins.mean[joint]) & (self.bins.std[joint] > 0.0)
        std = np.where(seen, self.bins.std[joint], np.inf)
        k = int((np.abs(np.nan_to_num(self.bins.mean[joint])) / std).argmax())
        return float(self.centres[joint, k]), float(np.nan_to_num(self.bins.mean[joint, k]))


def equal_edges(runs: Sequence[Array], usable: Sequence[NDArray[np.bool_]]) -> Array:
    """Edges (n, `BINS` + 1) of equal bins over what each joint did in the rows that count.

    Args:
        runs: speed or position of each recording (m, n).
        usable: rows that count (m, n).
    """
    lowest = np.min(
        [np.where(u, x, np.inf).min(axis=0) for x, u in zip(runs, usable, strict=True)],
        axis=0,
    )
    highest = np.max(
        [np.where(u, x, -np.inf).max(axis=0) for x, u in zip(runs, usable, strict=True)],
        axis=0,
    )
    moved = np.isfinite(lowest) & (highest > lowest)
    lowest, highest = np.where(moved, lowest, 0.0), np.where(moved, highest, 1.0)
    return np.asarray(np.linspace(lowest, highest, BINS + 1, axis=1))


def profile_sums(samples: Samples, residual: Array, over: Array, edges: Array) -> BlockSums:
    """Sums of a recording's residual (m, n) by block, joint and bin of `over` (m, n)."""
    block = block_index(samples)
    values, weights = [], []
    for joint in range(residual.shape[1]):
        inner = edges[joint, 1:-1]
        bins = np.searchsorted(inner, over[:, joint], side="right").astype(np.intp)
        rows = samples.usable[:, joint]
        n_bins = len(inner) + 1
        values.append(binned_sums(block, bins, n_bins, residual[:, joint], rows))
        weights.append(binned_sums(block, bins, n_bins, np.ones(len(rows)), rows))
    return BlockSums(np.stack(values, axis=1), np.stack(weights, axis=1))
