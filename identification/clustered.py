r"""Cluster-robust covariance of any estimate that solves sum W' psi(e) = 0, from the samples.

.. math:: D^{-1} \Big(\sum_b s_b s_b^T\Big) D^{-1}, \quad
          D = \sum w\,\psi'(e/\sigma)\,W^T W, \quad s_b = \sum_{t \in b} w\,u(e/\sigma)\,W^T e

as in :mod:`identification.covariance` (blocks of time, repetitions at equal times of the motion
together, Bell and McCaffrey's leverage correction), but from the rows themselves instead of
sums of them. That allows losses other than the square (Huber 1967), and keeps the digits of
ill-conditioned problems: everything is computed in coordinates in which the problem is round.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve
from scipy.stats import t as student

from identification.augmented_rows import augmented_rows
from identification.covariance import FINE_BLOCK, block_length
from identification.estimation import mark_undetermined
from identification.losses import LeastSquares, Loss
from identification.model import RobotModel
from identification.preprocessing import Samples
from identification.row_solution import RowSolution

Array = NDArray[np.float64]

# A direction in which the loss curves less than this share of its weighted squares is flat: the
# estimate could as well be elsewhere.
_FLAT: Final = 1e-3
_PARTICIPATION: Final = 1e-3
# Share of a direction's information that other blocks must have for a block's residual to say
# anything there.
_ALONE: Final = 1e-6


@dataclass(frozen=True, eq=False)
class Clustered:
    """Covariance of an estimate, by blocks of time.

    Attributes:
        covariance: (p, p), infinite variances of what is undetermined.
        determined: (p,).
        design_effect: by how much the mean variance is that of white residuals.
        interval_factor: standard deviations in half a 95 % interval.
        words: what was done.
    """

    covariance: Array
    determined: NDArray[np.bool_]
    design_effect: float
    interval_factor: float
    words: str


class _Blocks(NamedTuple):
    information: Array  # (B, k, k), in coordinates in which that of squares sums to 1
    scores: Array  # (B, p)
    rows: NDArray[np.intp]  # (B,)


def clustered_covariance(
    model: RobotModel,
    recordings: Sequence[Samples],
    solution: RowSolution,
    weights: Array,
    loss: Loss = LeastSquares(),  # noqa: B008 - frozen
) -> Clustered:
    """Covariance of weighted estimates with any loss; samples are read once, one at a time.

    Args:
        model: the robot.
        recordings: what was fitted.
        solution: the estimate, and the root of its inverse information.
        weights: per joint (n,): 1/variance, which also says how many standard deviations a
            residual is.
        loss: what was minimised.
    """
    blocks = _reduce(model, recordings, solution, weights, loss)
    used = blocks.rows > 0
    length = block_length(blocks.scores[used])
    starts = np.arange(0, np.count_nonzero(used), length)
    information = np.add.reduceat(blocks.information[used], starts, axis=0)
    curvature, vectors = np.linalg.eigh(information.sum(axis=0))
    kept = curvature > _FLAT
    # In these coordinates all blocks together have the information 1.
    to_unit = vectors[:, kept] / np.sqrt(curvature[kept])
    scores = np.add.reduceat(blocks.scores[used], starts, axis=0) @ solution.root @ to_unit
    corrected = _leverage_corrected(to_unit.T @ information @ to_unit, scores)
    spread = solution.root @ to_unit @ corrected.T
    size = np.maximum(np.linalg.norm(solution.root, axis=1), np.finfo(np.float64).tiny)
    flat = np.abs(solution.root @ vectors[:, ~kept]).max(axis=1, initial=0.0)
    determined = solution.determined & (flat < _PARTICIPATION * size)
    covariance = spread @ spread.T
    mark_undetermined(covariance, determined)
    count = len(scores)
    return Clustered(
        covariance=covariance,
        determined=determined,
        design_effect=float((corrected**2).sum() / max(1, corrected.shape[1])),
        interval_factor=float(student.ppf(0.975, max(1, count - 1))),
        words=f"cluster-robust covariance over {count} blocks of {length * FINE_BLOCK:g} s",
    )


def _reduce(
    model: RobotModel,
    recordings: Sequence[Samples],
    solution: RowSolution,
    weights: Array,
    loss: Loss,
) -> _Blocks:
    k = solution.root.shape[1]
    count = max(int(_block_of(samples)[-1]) + 1 for samples in recordings)
    blocks = _Blocks(
        np.zeros((count, k, k)),
        np.zeros((count, model.n_parameters)),
        np.zeros(count, dtype=np.intp),
    )
    for samples in recordings:
        index = _block_of(samples)
        np.add.at(blocks.rows, index, np.count_nonzero(samples.usable, axis=1))
        for part, rows in augmented_rows(model, samples):
            for joint, (table, used) in enumerate(zip(rows, model.plan.columns, strict=True)):
                columns, root = table[:-1], solution.root[used]
                error = table[-1] - solution.values[used] @ columns
                scaled = error * np.sqrt(weights[joint])
                score = weights[joint] * loss.weight(scaled) * error
                slope = weights[joint] * loss.slope(scaled)
                unit = columns.T @ root
                curved = unit * slope[:, None]
                for block, at in _runs(index[part]):
                    blocks.scores[block, used] += columns[:, at] @ score[at]
                    blocks.information[block] += curved[at].T @ unit[at]
    return blocks


def _leverage_corrected(information: Array, scores: Array) -> Array:
    """Scores (B, k) times (1 - H_b)^-1, with H = `information` (B, k, k), their sum being 1.

    A direction that one block alone determines has no inverse and is left out.
    """
    corrected = np.empty_like(scores)
    for b, (own, score) in enumerate(zip(information, scores, strict=True)):
        left = np.eye(len(own)) - 0.5 * (own + own.T)
        try:
            lower = np.linalg.cholesky(left)
            sure = np.diag(lower).min(initial=1.0) ** 2 > _ALONE * len(own)
        except np.linalg.LinAlgError:
            sure = False
        if sure:
            corrected[b] = cho_solve((lower, True), score)
            continue
        share, vectors = np.linalg.eigh(left)
        kept = share > _ALONE
        corrected[b] = (vectors[:, kept] / share[kept]) @ (vectors[:, kept].T @ score)
    return corrected


def _block_of(samples: Samples) -> NDArray[np.int64]:
    """Fine block of each sample (m,), rising; rows before the origin belong to the first."""
    since = samples.motion.time - samples.origin
    return np.maximum(np.floor(since / FINE_BLOCK + 1e-9).astype(np.int64), 0)


def _runs(index: NDArray[np.int64]) -> Iterator[tuple[int, slice]]:
    """Yield each value of a rising index with where it stands."""
    edges = np.flatnonzero(np.diff(index)) + 1
    for start, stop in pairwise([0, *edges.tolist(), len(index)]):
        yield int(index[start]), slice(start, stop)
