r"""Covariance of a least-squares estimate whose residuals are not white.

What torque models leave over is coloured: ripple, friction that drifts, a servo's limit cycle.
The classical covariance counts every sample as new information and is then too small, often by
an order of magnitude. Here the covariance is the cluster-robust sandwich

    A^-1 (sum_b s_b s_b') A^-1,    s_b = (1 - A_b A^-1)^-1 W_b' w e_b

over blocks b of consecutive time, which assumes nothing about what happens inside a block. The
factor in front of the scores (Bell and McCaffrey 2002, "CR3") gives back what the fit has removed
from the residuals; the result is that of leaving one block out at a time. A direction that one
block alone determines takes its variance from the other blocks. The kernel
estimators that work on scores as they are (Newey and West 1987) were tried on simulated NS 16
data: with noise correlated over 50 ms their nominal 95 % intervals covered 88 %, these 95 %.

Over R repetitions of one motion, what the model gets wrong is the same every time. It does not
average out, and treating repetitions as independent would shrink it by sqrt(R). So the blocks of
all repetitions at equal times of the motion form one: what repeats adds up, noise averages.

Blocks are few, hence Student's factor for intervals, and a covariance matrix of a rank that is
no higher than their number: good for variances, not to be inverted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.distributions import student_limit
from identification.estimators.losses import Loss
from identification.factor.factor import (
    Estimate,
    Solution,
    augmented_rows,
    mark_undetermined,
    solve,
)
from identification.factor.phases import FINE_BLOCK, PhaseFactor, block_runs, fine_blocks, merged
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]


# Errors of a model come and go with the moves of the arm, that is over some tenths of a second.
SHORTEST_BLOCK: Final = 2  # fine blocks
# Blocks are lengthened until the scores of neighbours hardly correlate (`_sandwich` allows for
# what is left), ...
_CORRELATED: Final = 0.1
# ... but fewer blocks than this would make the covariance itself too uncertain.
_FEWEST_BLOCKS: Final = 20
# Leverage up to which a block's own residual tells the variance, and from which on the other
# blocks' do. On simulated NS 16 data whose joint 6 moves for 0.2 of 16 s, with noise correlated
# over 50 ms, the nominal 95 % intervals of that joint's friction covered 3 to 80 % without this.
_OWN: Final = 0.5
_OTHERS: Final = 0.9
# Share of a direction's information that other blocks must have for leaving one out to mean
# anything there.
_ALONE: Final = 1e-6
_AT_ONCE: Final = 8  # blocks whose matrices fit the cache


@dataclass(frozen=True, eq=False)
class Clustered:
    """Covariance of an estimate, by blocks of time.

    Attributes:
        covariance: (p, p), infinite variances of what is undetermined.
        determined: (p,).
        design_effect: by how much the mean variance is that of white residuals.
        interval_factor: standard deviations in half a 95 % interval.
        words: what was done.
        blocks: of time.
    """

    covariance: Array
    determined: NDArray[np.bool_]
    design_effect: float
    interval_factor: float
    words: str
    blocks: int


def block_covariance(
    phase: PhaseFactor, weights: Array, values: Array, prior: Array | None = None
) -> Clustered:
    """Cluster-robust covariance of a weighted least-squares estimate, from its factor alone.

    With a Gaussian prior H = A + diag(prior) takes the place of the information A, and the prior's
    own part, ``H^-1 diag(prior) H^-1``, counts times the design effect, as the data's does.

    Args:
        phase: the samples, of one repetition or of all.
        weights: per joint (n,).
        values: solution of `phase.total` with these weights (p,).
        prior: information of an independent prior per parameter (p,).
    """
    phase = phase.occupied()
    scores = phase.scores(weights, values)
    length = block_length(scores)
    longer = phase.merged(length)
    equations = phase.total.weighted(weights)
    if prior is not None:
        equations = equations._replace(A=equations.A + np.diag(prior))
    solution = solve(equations)
    root, scores = solution.root, merged(scores, length)
    shares = np.empty((len(scores), root.shape[1], root.shape[1]))
    for start in range(0, len(scores), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        information = longer.blocks(part).weighted(weights)[:, :-1, :-1]
        shares[part] = _shares(information, root, root)
    return _sandwich(shares, scores, solution, length * FINE_BLOCK, prior)


def cluster_covariance(
    information: Array,
    scores: Array,
    solution: Solution,
    prior: Array | None = None,
    block: float = FINE_BLOCK,
    stretch: int = 1,
) -> Clustered:
    """Cluster-robust covariance of an estimate whose fine blocks are given.

    Args:
        information: of the blocks (B, p, p).
        scores: what the blocks' residuals pull with (B, p).
        solution: of the sum of the information, with the prior's.
        prior: see :func:`block_covariance`.
        block: length of each [s].
        stretch: by how much blocks are longer than scores ask for, as far as enough are left.
    """
    used = scores.any(axis=1)
    information, scores = information[used], scores[used]
    length = block_length(scores)
    length = max(length, min(stretch * length, len(scores) // _FEWEST_BLOCKS))
    shares = _shares(merged(information, length), solution.root, solution.root)
    return _sandwich(shares, merged(scores, length), solution, length * block, prior)


def _sandwich(
    shares: Array,
    scores: Array,
    solution: Solution,
    duration: float,
    prior: Array | None = None,
) -> Clustered:
    """Covariance from blocks of some seconds: shares of information (B, k, k), scores (B, p).

    Scores that correlate by r with those of the next block alone add up to a variance 1 + 2 r times
    as large; r is the mean over the directions, at least zero. A few blocks may still be too short.
    """
    scores = scores @ solution.root
    corrected = leverage_corrected(shares, scores)
    corrected *= np.sqrt(1.0 + 2.0 * max(0.0, _neighbours(scores)))
    moved = corrected @ solution.root.T
    covariance = np.asarray(moved.T @ moved)
    effect = float((corrected**2).sum() / max(1, corrected.shape[1]))
    if prior is not None:
        covariance += max(1.0, effect) * (solution.inverse * prior) @ solution.inverse
    mark_undetermined(covariance, solution.determined)
    count = len(scores)
    return Clustered(
        covariance=covariance,
        determined=solution.determined,
        design_effect=effect,
        interval_factor=float(student_limit(0.025, max(1, count - 1))),
        words=f"cluster-robust covariance over {count} blocks of {duration:g} s",
        blocks=count,
    )


def with_block_covariance(
    estimate: Estimate, phase: PhaseFactor, weights: Array, name: str = "weighted least squares"
) -> Estimate:
    """Return the estimate with the cluster-robust instead of the classical covariance.

    Args:
        estimate: made from `phase.total` with the weights.
        phase: the samples, of one repetition or of all.
        weights: per joint (n,).
        name: of the estimator, for `Estimate.method`.
    """
    found = block_covariance(phase, weights, estimate.values)
    return replace(
        estimate,
        covariance=found.covariance,
        interval_factor=found.interval_factor,
        method=f"{name}, {found.words}",
    )


def block_length(scores: Array) -> int:
    """Fine blocks per block: as few as leave neighbouring scores (B, p) hardly correlated."""
    longest = max(1, len(scores) // _FEWEST_BLOCKS)
    shortest = min(SHORTEST_BLOCK, longest)
    for length in range(shortest, longest):
        if _neighbours(merged(scores, length)) < _CORRELATED:
            return length
    return longest


def _neighbours(scores: Array) -> float:
    """Mean correlation of scores (B, k) with those of the next block."""
    power, both = (scores**2).sum(axis=0), (scores[1:] * scores[:-1]).sum(axis=0)
    return float(np.mean(both[power > 0.0] / power[power > 0.0])) if power.any() else 0.0


def spread(information: Array, scores: Array, root: Array, left: Array | None = None) -> Array:
    """Rows (R, p), R >= B, whose outer products sum to the cluster-robust covariance.

    Args:
        information: of the blocks (B, p, p); their sum A is what the estimate was solved with.
        scores: what the blocks' residuals pull with (B, p).
        root: S (p, k), with S L' the inverse of A on what is determined.
        left: L (p, k), by default S, as it is for a symmetric A.
    """
    left = root if left is None else left
    return leverage_corrected(_shares(information, root, left), scores @ left) @ root.T


def left_out(information: Array, scores: Array, root: Array, left: Array | None = None) -> Array:
    """How much an estimate moves when one block of its samples is left out (B, p).

    Block by block, to compare two estimates of the same samples; for a covariance see
    :func:`spread`, whose arguments these are. Nothing moves in a direction that only the block
    left out determines.
    """
    left = root if left is None else left
    shares, scores = _shares(information, root, left), scores @ left
    moved = np.empty_like(scores)
    lapack, identity = scipy.linalg.lapack, np.eye(scores.shape[1])
    for b, (share, score) in enumerate(zip(shares, scores, strict=True)):
        others = identity - share
        factor, pivots, _ = lapack.dgetrf(others)
        certain, _ = lapack.dgecon(factor, np.abs(others).sum(axis=0).max(initial=0.0))
        if certain > _ALONE:
            moved[b] = lapack.dgetrs(factor, pivots, score)[0]
        else:
            moved[b] = np.linalg.lstsq(others, score, rcond=_ALONE)[0]
    return np.asarray(moved @ root.T)


def leverage_corrected(shares: Array, scores: Array) -> Array:
    """Rows (R, k), R >= B, whose outer products sum to the covariance for an information of one.

    Scores (B, k) times (1 - H_b)^-1, with H = `shares` (B, k, k). Where one block alone determines
    a direction its residual vanishes there, and so would the variance; before that, all depends
    on the one residual of that block. So between the leverages `_OWN` and `_OTHERS` what the
    block's residual says gives way to the variance of white residuals, ``h``, times the design
    effect of the rest, but at least one.
    """
    own, dependent = _regular(shares, scores)
    regular = np.ones(len(scores), dtype=np.bool_)
    regular[dependent] = False
    squares = float((scores * own).sum())  # zero where dependent
    leverage = float(np.einsum("bii,b->", shares, regular.astype(np.float64)))
    rows, added = [own[regular]], []
    identity = np.eye(scores.shape[1])
    for b in dependent:
        u, rest, vt = np.linalg.svd(identity - shares[b])
        trusted = np.clip((rest - (1.0 - _OTHERS)) / (_OTHERS - _OWN), 0.0, 1.0)
        without_own = (u.T @ scores[b]) / np.maximum(rest, 1.0 - _OTHERS)
        squares += float((trusted * without_own**2 * rest).sum())
        leverage += float((trusted * (1.0 - rest)).sum())
        rows.append(((np.sqrt(trusted) * without_own) @ vt)[None])
        replaced = np.sqrt((1.0 - trusted) * np.maximum(1.0 - rest, 0.0))
        added.append((replaced[:, None] * vt)[trusted < 1.0])
    effect = max(1.0, squares / leverage) if leverage > 0.0 else 1.0
    return np.concatenate([*rows, *(np.sqrt(effect) * one for one in added)])


def _regular(shares: Array, scores: Array) -> tuple[Array, list[int]]:
    """Corrected scores (B, k), zero for the blocks on which some direction depends by `_OWN`.

    And which blocks those are. One block at a time, in memory that stays in the cache.
    """
    lapack, k = scipy.linalg.lapack, scores.shape[1]
    corrected, dependent = np.zeros_like(scores), []
    work, diagonal = np.empty((k, k), order="F"), np.arange(k)
    for b, (share, score) in enumerate(zip(shares, scores, strict=True)):
        np.add(share, share.T, out=work)
        work *= -0.5
        work[diagonal, diagonal] += _OWN
        if lapack.dpotrf(work, overwrite_a=1, clean=0)[1] != 0:
            dependent.append(b)
            continue
        np.negative(share, out=work)
        work[diagonal, diagonal] += 1.0
        corrected[b] = lapack.dgesv(work, score, overwrite_a=1)[2]
    return corrected, dependent


def _shares(information: Array, root: Array, left: Array) -> Array:
    """Information of the blocks where that of all together is 1 (B, k, k)."""
    blocks, p, _ = information.shape
    # One large product instead of many small ones.
    half = (information.reshape(blocks * p, p) @ root).reshape(blocks, p, -1)
    return np.asarray(left.T @ half)


# A direction in which the loss curves less than this share of its weighted squares is flat: the
# estimate could as well be elsewhere.
_FLAT: Final = 1e-3
_PARTICIPATION: Final = 1e-3


def clustered_covariance(
    model: RobotModel,
    recordings: Sequence[Samples],
    solution: Solution,
    weights: Array,
    loss: Loss = Loss(),  # noqa: B008 - frozen
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
    count = max(int(fine_blocks(samples)[-1]) + 1 for samples in recordings)
    k = solution.root.shape[1]
    information = np.zeros((count, k, k))  # in coordinates in which that of squares sums to 1
    scores, rows = np.zeros((count, model.n_parameters)), np.zeros(count, dtype=np.intp)
    for samples in recordings:
        index = fine_blocks(samples)
        np.add.at(rows, index, np.count_nonzero(samples.usable, axis=1))
        for part, tables in augmented_rows(model, samples):
            for joint, (table, used) in enumerate(zip(tables, model.plan.columns, strict=True)):
                columns = table[:-1]
                error = table[-1] - solution.values[used] @ columns
                scaled = error * np.sqrt(weights[joint])
                score = weights[joint] * loss.weight(scaled) * error
                unit = columns.T @ solution.root[used]
                curved = unit * (weights[joint] * loss.slope(scaled))[:, None]
                for block, at in block_runs(index[part]):
                    scores[block, used] += columns[:, at] @ score[at]
                    information[block] += curved[at].T @ unit[at]
    length = block_length(scores[rows > 0])
    information = merged(information[rows > 0], length)
    curvature, vectors = np.linalg.eigh(information.sum(axis=0))
    steep = curvature > _FLAT
    # In these coordinates all blocks together have the information 1.
    to_unit = vectors[:, steep] / np.sqrt(curvature[steep])
    size = np.maximum(np.linalg.norm(solution.root, axis=1), np.finfo(np.float64).tiny)
    flat = np.abs(solution.root @ vectors[:, ~steep]).max(axis=1, initial=0.0)
    steep_solution = solution._replace(
        root=solution.root @ to_unit,
        determined=solution.determined & (flat < _PARTICIPATION * size),
    )
    shares = to_unit.T @ information @ to_unit
    return _sandwich(shares, merged(scores[rows > 0], length), steep_solution, length * FINE_BLOCK)
