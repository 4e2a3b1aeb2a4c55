"""Least squares on factors: ordinary, then weighted per joint (the paper's eq. 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.factor.gram import Factor, NormalEquations
from identification.model.robot import RobotModel

Array = NDArray[np.float64]

# Scaled regressors of condition 1e6 leave four of the sixteen digits of a Gram matrix, less than
# any torque measurement has; a real rank deficiency shows as 1e8 and more.
WORST_CONDITION: Final = 1e6
_PARTICIPATION: Final = 1e-3
# Share of the torque's own RMS: what is smaller is rounding of the Gram matrix, not noise, and
# would make a joint that happens to fit exactly the only one that counts.
_SMALLEST_NOISE: Final = 1e-6


@dataclass(frozen=True, eq=False)
class Estimate:
    """Parameters and how well they are known.

    Attributes:
        names: (p,).
        units: (p,).
        values: (p,).
        covariance: (p, p); the variance of an undetermined parameter is infinite.
        noise_std: standard deviation of the torque residual per joint (n,) [N·m or N].
        samples: rows per joint (n,).
        method: how it was made, in words, and what the covariance assumes.
        condition: condition number of the weighted regressor with columns of unit length.
        undetermined: parameters the data say nothing about, alone or as part of a combination.
        interval_factor: standard deviations in half a 95 % interval: 1.96, more where the
            covariance itself comes from few data.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    covariance: Array
    noise_std: Array
    samples: NDArray[np.intp]
    method: str
    condition: float
    undetermined: tuple[str, ...] = ()
    interval_factor: float = 1.96

    @property
    def std(self) -> Array:
        """Standard deviations (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Array:
        """Correlation matrix (p, p); an undetermined parameter correlates with nothing."""
        std = self.std
        scale = np.where(np.isfinite(std) & (std > 0.0), std, 1.0)
        correlation = np.where(np.isfinite(self.covariance), self.covariance, 0.0)
        correlation = correlation / np.outer(scale, scale)
        np.fill_diagonal(correlation, 1.0)
        return np.asarray(correlation)

    def value(self, name: str) -> float:
        """Value of one parameter by name."""
        return float(self.values[self.names.index(name)])


class Solution(NamedTuple):
    """Solution of a least-squares problem, of normal equations ``A x = b`` or of rows.

    Attributes:
        values: (p,), of least (scaled) norm where the data leave a choice.
        root: S (p, k) with S S' the inverse of A on the k directions the data determine.
        condition: of the regressor with columns of unit length, infinite without some column.
        determined: (p,).
    """

    values: Array
    root: Array
    condition: float
    determined: NDArray[np.bool_]

    @property
    def inverse(self) -> Array:
        """Inverse of A on what is determined, zero elsewhere (p, p)."""
        return np.asarray(self.root @ self.root.T)


def solve(equations: NormalEquations) -> Solution:
    """Solve ``A x = b`` with columns scaled to unit length, naming what A does not determine.

    Directions of the scaled parameter space in which the condition exceeds `WORST_CONDITION`
    are left out; the parameters that take part in one of them are undetermined.
    """
    length = np.sqrt(np.diag(equations.A))
    present = length > 0.0
    scale = np.where(present, length, 1.0)
    eigenvalues, vectors = np.linalg.eigh(equations.A / np.outer(scale, scale))
    largest = eigenvalues[-1]
    kept = eigenvalues > largest / WORST_CONDITION**2
    lost = vectors[:, ~kept]
    determined = present & (np.abs(lost).max(axis=1, initial=0.0) < _PARTICIPATION)
    basis = vectors[:, kept]
    root = basis / np.sqrt(eigenvalues[kept]) / scale[:, None]
    smallest = eigenvalues[0] if present.all() else 0.0
    return Solution(
        values=root @ (root.T @ equations.b),
        root=root,
        condition=float(np.sqrt(largest / smallest)) if smallest > 0.0 else np.inf,
        determined=np.asarray(determined),
    )


def residual_variance(factor: Factor, values: Array, inverse: Array, weights: Array) -> Array:
    """Variance of the torque residual per joint (n,), NaN for a joint without rows.

    The p parameters cost as many degrees of freedom, shared among the joints by how much each
    contributes to the information: trace(w_j G_j A^-1).
    """
    augmented = np.append(-values, 1.0)
    squares = np.einsum("i,jik,k->j", augmented, factor.gram, augmented)
    spent = weights * np.einsum("jik,ik->j", factor.gram[:, :-1, :-1], inverse)
    freedom = factor.samples - spent
    rows = np.maximum(factor.samples, 1)
    floor = _SMALLEST_NOISE**2 * factor.gram[:, -1, -1] / rows
    floor = np.maximum(floor, np.finfo(np.float64).tiny)
    variance = np.maximum(squares, 0.0) / np.maximum(freedom, 1.0)
    return np.where(factor.samples > 0, np.maximum(variance, floor), np.nan)


def joint_weights(factor: Factor) -> Array:
    """Inverse variance of each joint's residual in an ordinary fit (n,), zero without rows."""
    ordinary = np.ones(factor.n_joints)
    first = solve(factor.weighted(ordinary))
    variance = residual_variance(factor, first.values, first.inverse, ordinary)
    return np.where(np.isnan(variance), 0.0, 1.0 / variance)


def estimate(model: RobotModel, factor: Factor, weights: Array | None = None) -> Estimate:
    """Weighted least squares (eq. 4).

    The covariance is the classical one, A^-1: honest only if the residuals are white. See
    :mod:`identification.estimators.covariance` for the one that does not need that.

    Args:
        model: the robot.
        factor: the samples; of one repetition, or a sum.
        weights: per joint (n,); by default the inverse residual variance of an ordinary fit.

    Raises:
        IdentificationError: the factor holds no rows.
    """
    if not factor.samples.any():
        raise IdentificationError(nothing_usable(model))
    if weights is None:
        weights = joint_weights(factor)
    solution = solve(factor.weighted(weights))
    variance = residual_variance(factor, solution.values, solution.inverse, weights)
    covariance = solution.inverse
    mark_undetermined(covariance, solution.determined)
    return Estimate(
        names=model.parameter_names,
        units=model.units,
        values=solution.values,
        covariance=covariance,
        noise_std=np.sqrt(variance),
        samples=factor.samples,
        method="weighted least squares, classical covariance (white residuals)",
        condition=solution.condition,
        undetermined=tuple(
            name
            for name, known in zip(model.parameter_names, solution.determined, strict=True)
            if not known
        ),
    )


def nothing_usable(model: RobotModel) -> str:
    """What to say where no row can be fitted."""
    slowest = float(np.min(model.friction.standstill))
    return (
        "there is not one usable sample: no joint moves faster than the standstill speed of"
        f" {slowest:g} away from the ends and gaps of the recording"
    )


def mark_undetermined(covariance: Array, determined: NDArray[np.bool_]) -> None:
    """Give undetermined parameters an infinite variance and no covariance, in place."""
    covariance[~determined, :] = 0.0
    covariance[:, ~determined] = 0.0
    covariance[~determined, ~determined] = np.inf


def total(factors: Sequence[Factor]) -> Factor:
    """Sum of factors: all repetitions as one."""
    result = factors[0]
    for factor in factors[1:]:
        result = result + factor
    return result
