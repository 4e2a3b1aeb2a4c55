r"""Instrumental variables: an estimate that noise in the measured positions does not bias.

The regressor W is computed from measured positions and their second derivatives. Its noise makes
least squares shrink what stands in front of the noisiest columns, the inertias, and no number of
samples helps. With instruments Z that correlate with the motion and not with its noise,

.. math:: \hat\pi = (Z^T \Omega W)^{-1} Z^T \Omega y

is consistent whatever that noise is (IDIM-IV: Janot, Vandanjon and Gautier 2014). Z is here the
regressor of the planned or simulated motion, column by column, so there are as many instruments
as parameters; Omega holds one weight per joint. The price is variance: the standard deviation of a
parameter grows by 1/sqrt(R²), R² being the share of its column that the instruments explain apart
from the other columns (Shea 1997).

What instruments cannot mend: a smoother that is too narrow takes part of the motion itself out of
W, and noise that turns the sign of a slow speed is no error that averages to zero. So smooth less
than for least squares, and leave slow rows out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.distributions import student_limit
from identification.errors import IdentificationError
from identification.estimators.covariance import block_length, spread, with_block_covariance
from identification.factor.factor import (
    WORST_CONDITION,
    Estimate,
    Factor,
    estimate,
    estimate_of,
    joint_weights,
    residual_variance,
)
from identification.factor.phases import FINE_BLOCK, PhaseFactor, measured_part, merged
from identification.model.robot import RobotModel

Array = NDArray[np.float64]

# A first-stage F below 10 leaves more than a tenth of the bias of least squares (Staiger and
# Stock 1997). Each block of time is counted as one independent sample, no matter how many rows.
WEAK: Final = 10.0
_PARTICIPATION: Final = 1e-3


@dataclass(frozen=True, eq=False)
class InstrumentalEstimate:
    """Estimate with instrumental variables, beside that of least squares on the same rows.

    Attributes:
        estimate: by instrumental variables, with cluster-robust covariance.
        least_squares: of the same rows and weights, likewise.
        weights: per joint (n,).
        strength: Shea's partial R² per parameter (p,), zero where the instruments say nothing.
        weak: names of parameters whose instrument is too weak for the estimate to be trusted.
    """

    estimate: Estimate
    least_squares: Estimate
    weights: Array
    strength: Array
    weak: tuple[str, ...]


class CrossSolution(NamedTuple):
    """Solution of ``Z^T W pi = Z^T y``.

    Attributes:
        values: (p,), of least (scaled) norm where the instruments leave a choice.
        right: R (p, k), and
        left: L (p, k): R L^T is the inverse of Z^T W on the k directions determined.
        condition: square root of the scaled condition of Z^T W, comparable to that of W.
        determined: (p,).
    """

    values: Array
    right: Array
    left: Array
    condition: float
    determined: NDArray[np.bool_]

    @property
    def inverse(self) -> Array:
        """Inverse of Z^T W on what is determined, zero elsewhere (p, p)."""
        return np.asarray(self.right @ self.left.T)


def solve_cross(total: Array) -> CrossSolution:
    """Solve the instrumental equations of a Gram matrix of [Z | W | y] (2 p + 1, 2 p + 1)."""
    p = len(total) // 2
    length = np.sqrt(np.diag(total)[:-1])
    scale = np.where(length > 0.0, length, 1.0)
    left, right = scale[:p], scale[p:]
    u, singular, vt = np.linalg.svd(total[:p, p : 2 * p] / np.outer(left, right))
    large = singular > singular[0] / WORST_CONDITION**2
    lost = np.abs(vt[~large]).max(axis=0, initial=0.0)
    root = np.sqrt(singular[large])
    own_right, own_left = vt[large].T / root / right[:, None], u[:, large] / root / left[:, None]
    return CrossSolution(
        values=own_right @ (own_left.T @ total[:p, -1]),
        right=own_right,
        left=own_left,
        condition=float(np.sqrt(singular[0] / singular[-1])) if singular[-1] > 0.0 else np.inf,
        determined=np.asarray(lost < _PARTICIPATION),
    )


def estimate_instrumental(
    model: RobotModel, factor: PhaseFactor, weights: Array | None = None
) -> InstrumentalEstimate:
    """Estimate with instrumental variables.

    Args:
        model: the robot.
        factor: see :func:`identification.factor.phases.instrument_factor`; of one repetition,
            or a sum.
        weights: per joint (n,); by default the inverse residual variances of an instrumental fit
            whose weights are those of least squares.

    Raises:
        IdentificationError: the factor holds no rows, or belongs to another model.
    """
    if factor.parameter_names[model.n_parameters :] != model.parameter_names:
        raise IdentificationError("the samples belong to a model of other parameters")
    if not factor.samples.any():
        raise IdentificationError("there is not one row in which samples and instruments move")
    measured = measured_part(factor)
    rows = measured.total
    if weights is None:
        weights = _weights(factor, rows)
    blocks = factor.weighted(weights)[factor.samples.any(axis=1)]
    total = blocks.sum(axis=0)
    solution = solve_cross(total)
    strength = np.where(solution.determined, partial_r2(total), 0.0)
    first_stage = strength / np.maximum(1.0 - strength, 1e-12) * len(blocks)
    return InstrumentalEstimate(
        estimate=_with_covariance(model, rows, blocks, solution, weights),
        least_squares=with_block_covariance(estimate(model, rows, weights), measured, weights),
        weights=weights,
        strength=strength,
        weak=tuple(
            name for name, f in zip(model.parameter_names, first_stage, strict=True) if f < WEAK
        ),
    )


def partial_r2(total: Array) -> Array:
    """Shea's partial R² (p,) of a Gram matrix of [Z | W | y] (2 p + 1, 2 p + 1).

    The share of each column of W, apart from what it has in common with the others, that the
    instruments explain: (W'W)^-1_kk over (W'Z (Z'Z)^-1 Z'W)^-1_kk (Shea 1997).
    """
    p = len(total) // 2
    scale = np.sqrt(np.maximum(np.diag(total)[:-1], 1e-300))
    scaled = total[:-1, :-1] / np.outer(scale, scale)
    zz, zw, ww = scaled[:p, :p], scaled[:p, p:], scaled[p:, p:]
    explained = zw.T @ _inverse(zz) @ zw
    own, by_instruments = np.diag(_inverse(ww)), np.diag(_inverse(explained))
    known = (own > 0.0) & (by_instruments > 0.0)
    share = np.where(known, own / np.where(known, by_instruments, 1.0), 0.0)
    return np.clip(share, 0.0, 1.0)


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric matrix without the directions that carry no information."""
    return np.asarray(np.linalg.pinv(matrix, rcond=1.0 / WORST_CONDITION**2, hermitian=True))


def _weights(factor: PhaseFactor, rows: Factor) -> Array:
    """Inverse residual variance per joint (n,) of an instrumental fit, zero without rows."""
    first = joint_weights(rows)
    solution = solve_cross(factor.weighted(first).sum(axis=0))
    variance = residual_variance(rows, solution.values, rows.solve(first).root, first)
    return np.where(np.isnan(variance), 0.0, 1.0 / variance)


def _with_covariance(
    model: RobotModel, rows: Factor, blocks: Array, solution: CrossSolution, weights: Array
) -> Estimate:
    """Estimate with the sandwich over blocks: how it moves when one block is left out.

    The same as for least squares (:mod:`identification.estimators.covariance`), with Z'W for W'W.
    """
    p = rows.n_parameters
    cross, moments = blocks[:, :p, p : 2 * p], blocks[:, :p, -1]
    length = block_length(moments - cross @ solution.values)
    cross = merged(cross, length)
    scores = merged(moments, length) - cross @ solution.values
    moved = spread(cross, scores, solution.right, solution.left)
    return estimate_of(
        model,
        rows,
        rows.solve(weights)._replace(
            values=solution.values, condition=solution.condition, determined=solution.determined
        ),
        moved.T @ moved,
        weights,
        f"instrumental variables, cluster-robust covariance over {len(scores)} blocks of"
        f" {length * FINE_BLOCK:g} s",
        float(student_limit(0.025, max(1, len(scores) - 1))),
    )
