r"""Cluster-robust covariance of any estimate that solves sum W' psi(e) = 0, from the samples.

.. math:: D^{-1} \left(\sum_b s_b s_b^T\right) D^{-1}, \quad
          D = \sum w\,\psi'(e/\sigma)\,W^T W, \quad s_b = \sum_{t \in b} w\,u(e/\sigma)\,W^T e

as in :mod:`identification.estimators.covariance` (blocks of time, repetitions at equal times of the
motion together, Bell and McCaffrey's leverage correction), but from the rows themselves instead of
sums of them. That allows losses other than the square (Huber 1967), and keeps the digits of
ill-conditioned problems: everything is computed in coordinates in which the problem is round.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.distributions import student_limit
from identification.estimators.covariance import Clustered, block_length, leverage_corrected
from identification.estimators.losses import LeastSquares, Loss
from identification.factor.factor import Solution, augmented_rows, mark_undetermined
from identification.factor.phases import FINE_BLOCK, block_runs, fine_blocks, merged
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

# A direction in which the loss curves less than this share of its weighted squares is flat: the
# estimate could as well be elsewhere.
_FLAT: Final = 1e-3
_PARTICIPATION: Final = 1e-3


class _Blocks(NamedTuple):
    information: Array  # (B, k, k), in coordinates in which that of squares sums to 1
    scores: Array  # (B, p)
    rows: NDArray[np.intp]  # (B,)


def clustered_covariance(
    model: RobotModel,
    recordings: Sequence[Samples],
    solution: Solution,
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
    information = merged(blocks.information[used], length)
    curvature, vectors = np.linalg.eigh(information.sum(axis=0))
    steep = curvature > _FLAT
    # In these coordinates all blocks together have the information 1.
    to_unit = vectors[:, steep] / np.sqrt(curvature[steep])
    scores = merged(blocks.scores[used], length) @ solution.root @ to_unit
    corrected = leverage_corrected(to_unit.T @ information @ to_unit, scores)
    spread = solution.root @ to_unit @ corrected.T
    size = np.maximum(np.linalg.norm(solution.root, axis=1), np.finfo(np.float64).tiny)
    flat = np.abs(solution.root @ vectors[:, ~steep]).max(axis=1, initial=0.0)
    determined = solution.determined & (flat < _PARTICIPATION * size)
    covariance = spread @ spread.T
    mark_undetermined(covariance, determined)
    count = len(scores)
    return Clustered(
        covariance=covariance,
        determined=determined,
        design_effect=float((corrected**2).sum() / max(1, corrected.shape[1])),
        interval_factor=float(student_limit(0.025, max(1, count - 1))),
        words=f"cluster-robust covariance over {count} blocks of {length * FINE_BLOCK:g} s",
        blocks=count,
    )


def _reduce(
    model: RobotModel,
    recordings: Sequence[Samples],
    solution: Solution,
    weights: Array,
    loss: Loss,
) -> _Blocks:
    k = solution.root.shape[1]
    count = max(int(fine_blocks(samples)[-1]) + 1 for samples in recordings)
    blocks = _Blocks(
        np.zeros((count, k, k)),
        np.zeros((count, model.n_parameters)),
        np.zeros(count, dtype=np.intp),
    )
    for samples in recordings:
        index = fine_blocks(samples)
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
                for block, at in block_runs(index[part]):
                    blocks.scores[block, used] += columns[:, at] @ score[at]
                    blocks.information[block] += curved[at].T @ unit[at]
    return blocks
