"""Cluster-robust covariance of least-squares estimates with coloured residuals.

The classical covariance counts every sample as independent and is often an order of magnitude too
small. Here the covariance is the sandwich

    A^-1 (sum_b s_b s_b') A^-1,    s_b = (1 - A_b A^-1)^-1/2 W_b' w e_b

over blocks b of consecutive time, for any correlation inside a block. The leverage correction (Bell
and McCaffrey 2002, "CR2") makes it unbiased for white residuals: a fit leaves 1 - A_b A^-1 of their
scores' covariance. Leaving out one block at a time, (1 - A_b A^-1)^-1, is too wide where few blocks
determine many parameters: by 8 % of friction intervals of ``benchmarks.coverage``, whose 60 to 72
parameters have 79 to 118 blocks.

Model errors repeat in all R repetitions of a motion, so the blocks of all repetitions at equal
times of the motion are added to one. The few blocks require Student's factor for intervals and
limit the rank of the covariance: use its variances, do not invert it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import student_limit
from identification.estimators.loss_functions import Loss
from identification.factor.blocks import FINE_BLOCK, block_slices, merged
from identification.factor.estimate import Estimate, mark_undetermined
from identification.factor.estimation_method import TimeBlocks
from identification.factor.factor import Factor
from identification.factor.normal_equations import (
    MAX_UNDETERMINED_SHARE,
    NormalEquations,
    Solution,
    solve,
)
from identification.factor.rows import augmented_rows
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

# Model errors are correlated over some tenths of a second.
MIN_FINE_BLOCKS: Final = 2  # fine blocks
# Correlation of neighbouring scores up to which blocks are lengthened; the rest is corrected in
# `_sandwich`.
_MAX_BLOCK_CORRELATION: Final = 0.1
_MIN_BLOCKS: Final = 20  # fewer blocks make the covariance itself too uncertain
# Leverages between which the variance changes from own residual to other blocks. On simulated NS 16
# data whose joint 6 moves for 0.2 of 16 s the nominal 95 % intervals of its friction covered 3 to
# 80 % without this.
_LOW_LEVERAGE: Final = 0.5
_HIGH_LEVERAGE: Final = 0.9
# With a prior all directions are determined, up to rounding.
_MAX_CONDITION_WITH_PRIOR: Final = 1e7
# With these, (1 - H)^-1/2 is the mean of the (1 - node H)^-1, a midpoint rule for the integral of
# 1 / (1 - H sin² x) over a quarter turn: within 0.2 % up to the low leverage.
_QUADRATURE_NODES: Final = (float(np.sin(np.pi / 8.0) ** 2), float(np.sin(3.0 * np.pi / 8.0) ** 2))
_BLOCKS_AT_ONCE: Final = 8  # blocks whose matrices fit the cache


@dataclass(frozen=True, eq=False)
class Clustered:
    """Covariance of an estimate by blocks of time."""

    covariance: Array  # (p, p), infinite variances of undetermined parameters
    root: Array  # S (p, k) with S S' the inverse of the information, with that of a prior
    scores: Array  # (R, k), corrected; ``S scores' scores S'`` is the covariance but for a prior's
    determined: NDArray[np.bool_]  # (p,)
    design_effect: float  # mean ratio of the variance to that of white residuals
    interval_factor: float  # standard deviations in half a 95 % interval
    blocks: TimeBlocks
    shares: Array  # of the blocks in the information, (B, k, k): ``S' A_b S``

    def interval_factors(self, rows: Array) -> Array:
        """Return standard deviations in half a 95 % interval of functions (d, p) of the parameters.

        The variance of each is about as uncertain as one from as many scores as there are equal
        blocks that would determine it as well (Satterthwaite 1946; Bell and McCaffrey 2002). What a
        prior determines is certain, and the variance of a block of high leverage is that of the
        others (`leverage_corrected`).
        """
        directions = rows @ self.root
        whole = (directions**2).sum(axis=1)
        of_blocks = np.einsum("dk,bkl,dl->bd", directions, self.shares, directions, optimize=True)
        leverage = np.divide(of_blocks, whole, out=np.zeros_like(of_blocks), where=whole > 0.0)
        squares = (_trusted(leverage) * leverage**2).sum(axis=0)
        counts = 1.0 / np.maximum(squares, 1.0 / max(2, self.blocks.count))
        return np.asarray(student_limit(0.025, np.maximum(1.0, counts - 1.0)))


def block_covariance(
    factor: Factor,
    weights: Array,
    values: Array,
    prior: Array | None = None,
    design_effect: float = 1.0,
) -> Clustered:
    """Return the cluster-robust covariance of a weighted least-squares estimate by its factor.

    With a prior, H = A + d P replaces A, and the prior's scatter ``d² H^-1 P H^-1`` is added to
    that of the data.

    Args:
        factor: of the data, by blocks of time.
        weights: of the joints (n,).
        values: parameters (p,) that solve the factor with these weights.
        prior: information P of a Gaussian prior (p, p).
        design_effect: d, by which it is multiplied.
    """
    used = factor.occupied()
    scores = used.scores(weights, values)
    length = block_length(scores)
    longer = used.merged(length)
    equations = factor.weighted(weights)
    solution = solve(equations)
    if prior is not None:
        solution = solve_with_prior(equations, design_effect * prior)
    root = solution.root
    scores = merged(scores, length)
    shares = np.empty((len(scores), root.shape[1], root.shape[1]))
    for start in range(0, len(scores), _BLOCKS_AT_ONCE):
        chunk = slice(start, start + _BLOCKS_AT_ONCE)
        information = longer.blocks(chunk).by_block(weights)[:, :-1, :-1]
        shares[chunk] = _shares(information, root, root)
    spread = None if prior is None else design_effect**2 * prior
    return _sandwich(shares, scores, solution, longer.block, spread)


def solve_with_prior(equations: NormalEquations, precision: Array) -> Solution:
    """Solve with the information (p, p) of a zero-mean prior that determines every parameter."""
    return solve(equations._replace(A=equations.A + precision), _MAX_CONDITION_WITH_PRIOR)


def cluster_covariance(
    information: Array,
    scores: Array,
    solution: Solution,
    prior: Array | None = None,
    block: float = FINE_BLOCK,
    stretch: int = 1,
) -> Clustered:
    """Return the cluster-robust covariance of blocks.

    Args:
        information: of each block (B, p, p).
        scores: of each block (B, p).
        solution: of the summed information, with the prior's.
        prior: its information (p, p).
        block: duration of the blocks, which are merged to it [s].
        stretch: further factor by which blocks are merged if enough remain.
    """
    used = scores.any(axis=1)
    information = information[used]
    scores = scores[used]
    length = block_length(scores)
    length = max(length, min(stretch * length, len(scores) // _MIN_BLOCKS))
    shares = _shares(merged(information, length), solution.root, solution.root)
    result = _sandwich(shares, merged(scores, length), solution, length * block)
    if prior is not None:
        added = max(1.0, result.design_effect) * solution.inverse @ prior @ solution.inverse
        covariance = result.covariance + added
        mark_undetermined(covariance, solution.determined)
        result = replace(result, covariance=covariance)
    return result


def _sandwich(
    shares: Array, scores: Array, solution: Solution, duration: float, prior: Array | None = None
) -> Clustered:
    """Return the covariance by shares of information (B, k, k) and scores (B, p) of blocks.

    A correlation r of neighbouring scores, its mean or zero, multiplies the variance by 1 + 2 r.
    `prior` (p, p) is the scatter of a prior's scores, to be added.
    """
    scores = scores @ solution.root
    corrected = leverage_corrected(shares, scores)
    corrected *= np.sqrt(1.0 + 2.0 * max(0.0, lag_correlation(scores)))
    moved = corrected @ solution.root.T
    covariance = np.asarray(moved.T @ moved)
    effect = float((corrected**2).sum() / max(1, corrected.shape[1]))
    if prior is not None:
        covariance += solution.inverse @ prior @ solution.inverse
    mark_undetermined(covariance, solution.determined)
    count = len(scores)
    return Clustered(
        covariance=covariance,
        root=solution.root,
        scores=corrected,
        determined=solution.determined,
        design_effect=effect,
        interval_factor=float(student_limit(0.025, max(1, count - 1))),
        blocks=TimeBlocks(count, duration),
        shares=shares,
    )


def with_block_covariance(estimate: Estimate, factor: Factor, weights: Array) -> Estimate:
    """Return an estimate with cluster-robust covariance.

    Args:
        estimate: from the factor.
        factor: of the data, by blocks of time.
        weights: of the joints (n,).
    """
    clustered = block_covariance(factor, weights, estimate.values)
    return replace(
        estimate,
        covariance=clustered.covariance,
        interval_factor=clustered.interval_factor,
        method=replace(estimate.method, blocks=clustered.blocks),
    )


def block_length(scores: Array) -> int:
    """Return the least number of fine blocks per block with uncorrelated scores (B, p)."""
    longest = max(1, len(scores) // _MIN_BLOCKS)
    shortest = min(MIN_FINE_BLOCKS, longest)
    for length in range(shortest, longest):
        if lag_correlation(merged(scores, length)) < _MAX_BLOCK_CORRELATION:
            return length
    return longest


def lag_correlation(scores: Array) -> float:
    """Return the mean correlation of scores (B, k) with the scores of the next block."""
    power = (scores**2).sum(axis=0)
    both = (scores[1:] * scores[:-1]).sum(axis=0)
    return float(np.mean(both[power > 0.0] / power[power > 0.0])) if power.any() else 0.0


def spread(
    information: Array,
    scores: Array,
    root: Array,
    left: Array | None = None,
    *,
    left_out: bool = False,
) -> Array:
    """Return rows (R, p), R >= B, whose outer products sum to the cluster-robust covariance.

    Args:
        information: of blocks (B, p, p), with sum A.
        scores: of blocks (B, p).
        root: S (p, k), with S L' the inverse of A on what is determined.
        left: L (p, k), by default S.
        left_out: see `leverage_corrected`.
    """
    symmetric = left is None
    left = root if left is None else left
    shares = _shares(information, root, left)
    rows = leverage_corrected(shares, scores @ left, symmetric=symmetric, left_out=left_out)
    return rows @ root.T


def leverage_corrected(
    shares: Array, scores: Array, *, symmetric: bool = True, left_out: bool = False
) -> Array:
    """Return rows (R, k), R >= B, whose outer products sum to the covariance for unit information.

    The rows are scores times (1 - H_b)^-1/2. From `_LOW_LEVERAGE` to `_HIGH_LEVERAGE` the residual
    of the block, which vanishes, is replaced by the variance of white residuals, ``h``, times the
    design effect of the rest, at least one.

    Args:
        shares: H_b, information of each block as a share of all (B, k, k).
        scores: of each block (B, k).
        symmetric: whether the shares are.
        left_out: multiply by (1 - H_b)^-1, as by leaving out one block at a time, for decisions
            that a narrow interval would spoil.
    """
    corrected, dependent = _regular(
        shares, scores, symmetric, (1.0,) if left_out else _QUADRATURE_NODES
    )
    power = 1.0 if left_out else 0.5
    regular = np.ones(len(scores), dtype=np.bool_)
    regular[dependent] = False
    unbiased = scores * corrected if left_out else corrected**2  # zero where dependent
    squares = float(unbiased.sum())
    leverage = float(np.einsum("bii,b->", shares, regular.astype(np.float64)))
    rows = [corrected[regular]]
    added = np.zeros((0, scores.shape[1]))
    if dependent:
        factors = _without_by_eigenvectors if symmetric else _without_by_singular_vectors
        u, singular, vt = factors(shares[dependent])
        trusted = _trusted(1.0 - singular)
        own = (scores[dependent][:, None] @ u)[:, 0]
        without_own = own / np.maximum(singular, 1.0 - _HIGH_LEVERAGE) ** power
        squares += float((trusted * without_own**2 * singular ** (2.0 * power - 1.0)).sum())
        leverage += float((trusted * (1.0 - singular)).sum())
        rows.append(((np.sqrt(trusted) * without_own)[:, None] @ vt)[:, 0])
        replaced = np.sqrt((1.0 - trusted) * np.maximum(1.0 - singular, 0.0))
        uncertain = trusted < 1.0
        added = replaced[uncertain][:, None] * vt[uncertain]
    effect = max(1.0, squares / leverage) if leverage > 0.0 else 1.0
    return np.concatenate([*rows, np.sqrt(effect) * added])


def _trusted(leverage: Array) -> Array:
    """Return the share of the variance that a block's own residual gives, by its leverage."""
    return np.clip((_HIGH_LEVERAGE - leverage) / (_HIGH_LEVERAGE - _LOW_LEVERAGE), 0.0, 1.0)


def _without_by_singular_vectors(shares: Array) -> tuple[Array, Array, Array]:
    """Return u (B, k, k), s (B, k) and v' (B, k, k) with ``1 - H = u s v'`` of shares (B, k, k)."""
    u, singular, vt = np.linalg.svd(np.eye(shares.shape[1]) - shares)
    return u, singular, vt


def _without_by_eigenvectors(shares: Array) -> tuple[Array, Array, Array]:
    """Return the same of symmetric shares, in half the time."""
    eigenvalues, vectors = np.linalg.eigh(shares)
    apart = 1.0 - eigenvalues
    return vectors * np.sign(apart)[:, None], np.abs(apart), vectors.transpose(0, 2, 1)


def _regular(
    shares: Array, scores: Array, symmetric: bool, nodes: Sequence[float]
) -> tuple[Array, list[int]]:
    """Return corrected scores (B, k), zero for blocks of high leverage, and these blocks.

    The correction is the mean of (1 - node H)^-1 over nodes.
    """
    lapack = scipy.linalg.lapack
    solve_without = lapack.dposv if symmetric else lapack.dgesv  # the solution is last but one
    k = scores.shape[1]
    corrected = np.zeros_like(scores)
    dependent = []
    work = np.empty((k, k), order="F")
    diagonal = np.arange(k)
    largest = np.sqrt(np.einsum("bij,bij->b", shares, shares))  # at least the largest leverage
    for b, (share, score) in enumerate(zip(shares, scores, strict=True)):
        if largest[b] >= _LOW_LEVERAGE:
            np.add(share, share.T, out=work)
            work *= -0.5
            work[diagonal, diagonal] += _LOW_LEVERAGE
            if lapack.dpotrf(work, overwrite_a=1, clean=0)[1] != 0:
                dependent.append(b)
                continue
        for node in nodes:
            np.multiply(share, -node, out=work)
            work[diagonal, diagonal] += 1.0
            corrected[b] += solve_without(work, score, overwrite_a=1)[-2]
    return corrected / len(nodes), dependent


def _shares(information: Array, root: Array, left: Array) -> Array:
    """Return the information of the blocks relative to their sum (B, k, k)."""
    blocks, p, _ = information.shape
    # One large product is faster.
    half = (information.reshape(blocks * p, p) @ root).reshape(blocks, p, -1)
    return np.asarray(left.T @ half)


# Curvature relative to the weighted squares below which a direction is undetermined.
_MIN_CURVATURE: Final = 1e-3


def clustered_covariance(
    model: RobotModel,
    recordings: Sequence[Samples],
    solution: Solution,
    weights: Array,
    loss: Loss = Loss(),  # noqa: B008 - frozen
) -> Clustered:
    """Return the cluster-robust covariance of a solution with any loss.

    Args:
        model: of the arm.
        recordings: that were fitted.
        solution: of the fit.
        weights: of the joints (n,).
        loss: of the residuals.
    """
    count = max(int(samples.blocks(FINE_BLOCK)[-1]) + 1 for samples in recordings)
    k = solution.root.shape[1]
    information = np.zeros((count, k, k))  # information in coordinates with unit sum of squares
    scores = np.zeros((count, model.n_parameters))
    rows = np.zeros(count, dtype=np.intp)
    for samples in recordings:
        index = samples.blocks(FINE_BLOCK)
        np.add.at(rows, index, np.count_nonzero(samples.usable, axis=1))
        for part, tables in augmented_rows(model, samples):
            for joint, (table, used) in enumerate(zip(tables, model.plan.columns, strict=True)):
                columns = table[:-1]
                error = table[-1] - solution.values[used] @ columns
                scaled = error * np.sqrt(weights[joint])
                score = weights[joint] * loss.weight(scaled) * error
                unit = columns.T @ solution.root[used]
                curved = unit * (weights[joint] * loss.slope(scaled))[:, None]
                for block, at in block_slices(index[part]):
                    scores[block, used] += columns[:, at] @ score[at]
                    information[block] += curved[at].T @ unit[at]
    length = block_length(scores[rows > 0])
    information = merged(information[rows > 0], length)
    curvature, vectors = np.linalg.eigh(information.sum(axis=0))
    steep = curvature > _MIN_CURVATURE
    # Coordinates in which all blocks together have unit information.
    to_unit = vectors[:, steep] / np.sqrt(curvature[steep])
    scale = np.maximum(np.linalg.norm(solution.root, axis=1), np.finfo(np.float64).tiny)
    flat = np.abs(solution.root @ vectors[:, ~steep]).max(axis=1, initial=0.0)
    steep_solution = solution._replace(
        root=solution.root @ to_unit,
        determined=solution.determined & (flat < MAX_UNDETERMINED_SHARE * scale),
    )
    shares = to_unit.T @ information @ to_unit
    return _sandwich(shares, merged(scores[rows > 0], length), steep_solution, length * FINE_BLOCK)
