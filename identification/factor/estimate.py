"""Parameters with their covariance, by weighted least squares on a factor (eq. 4 of the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.distributions import NORMAL_95
from identification.factor.estimation_method import EstimationMethod, LeastSquares
from identification.factor.factor import Factor, require_rows
from identification.factor.normal_equations import Solution
from identification.model.robot import RobotModel

Known = Literal["yes", "roughly", "no"]
KNOWN_STD_SHARES: Final = (0.1, 0.5)
"""Standard deviations, as shares of the estimate, up to which a parameter is known, or roughly."""


def residual_variance(factor: Factor, values: Array, root: Array, weights: Array) -> Array:
    """Return the variance of the torque residual per joint (n,), NaN without rows.

    Degrees of freedom are shared by the information trace(w_j S' G_j S) of joints.

    Args:
        factor: of the data.
        values: parameters (p,).
        root: S, a root of the inverse information (p, k).
        weights: of the joints (n,).
    """
    squares = factor.products(np.append(-values, 1.0)[:, None])[:, 0, 0]
    spent = weights * np.trace(factor.products(root), axis1=1, axis2=2)
    variance = np.maximum(squares, 0.0) / np.maximum(factor.samples - spent, 1.0)
    return np.where(factor.samples > 0, np.maximum(variance, factor.smallest_variance), np.nan)


def joint_weights(factor: Factor) -> Array:
    """Return the inverse residual variance per joint in an ordinary fit (n,), zero without rows."""
    ordinary = np.ones(factor.n_joints)
    first = factor.solve(ordinary)
    return inverse_variance(residual_variance(factor, first.values, first.root, ordinary))


def inverse_variance(variance: Array) -> Array:
    """Return weights (n,) of joints, zero for variances of NaN or infinity."""
    finite = np.isfinite(variance)
    return np.where(finite, 1.0 / np.where(finite, variance, 1.0), 0.0)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Parameters with their covariance, in units of the torque of this arm.

    What the torque of a joint is called in N·m is known to the scale of its sensor or torque
    constant only. That is no error of parameters that are used with the same torques; intervals of
    masses need it as well, see :func:`identification.estimators.torque_scale.absolute`.
    """

    names: tuple[str, ...]  #: (p,)
    units: tuple[str, ...]  #: (p,)
    values: Array  #: (p,)
    covariance: Array  #: (p, p); the variance of an undetermined parameter is infinite
    noise_std: Array  #: standard deviation of the torque residual per joint (n,) [N·m or N]
    samples: Indices  #: rows per joint (n,)
    method: EstimationMethod
    condition: float  #: condition number of the weighted regressor with unit columns
    undetermined: tuple[str, ...] = ()  #: undetermined parameters, alone or in a combination
    #: standard deviations in half a 95 % interval: 1.96, more for covariances of few data
    interval_factor: float = NORMAL_95
    #: change of the parameters by a standard deviation of the scale of each joint's torque (p, n);
    #: None: it is exact
    scale_change: Array | None = None

    @property
    def std(self) -> Array:
        """Standard deviations (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def known(self) -> tuple[Known, ...]:
        """How well each parameter is known (p,), by :data:`KNOWN_STD_SHARES`."""
        well, roughly = (self.std <= share * np.abs(self.values) for share in KNOWN_STD_SHARES)
        return tuple(
            "no" if name in self.undetermined or not rough else "yes" if good else "roughly"
            for name, good, rough in zip(self.names, well, roughly, strict=True)
        )

    def value(self, name: str) -> float:
        """Return one parameter by name."""
        return float(self.values[self.names.index(name)])


def estimate(model: RobotModel, factor: Factor, weights: Array | None = None) -> Estimate:
    """Estimate by weighted least squares (eq. 4); weights (n,) by default from an ordinary fit.

    The covariance is the classical one, A^-1, valid for white residuals; see
    :mod:`identification.estimators.covariance` for others.

    Raises:
        IdentificationError: the factor has no rows.
    """
    require_rows(model, factor)
    if weights is None:
        weights = joint_weights(factor)
    method = EstimationMethod(LeastSquares(by_qr=factor.storage == "qr"))
    return estimate_of(model.units, factor, factor.solve(weights), weights, method)


def estimate_of(
    units: Sequence[str],
    factor: Factor,
    solution: Solution,
    weights: Array,
    method: EstimationMethod,
    covariance: Array | None = None,
    interval_factor: float = NORMAL_95,
) -> Estimate:
    """Return the estimate of a solution.

    Args:
        units: of the parameters.
        factor: that was solved.
        solution: of it.
        weights: of the joints (n,).
        method: that gave it.
        covariance: of the parameters (p, p); by default A^-1.
        interval_factor: standard deviations in half a 95 % interval.
    """
    covariance = solution.inverse if covariance is None else covariance.copy()
    mark_undetermined(covariance, solution.determined)
    variance = residual_variance(factor, solution.values, solution.root, weights)
    return Estimate(
        names=factor.parameter_names,
        units=tuple(units),
        values=solution.values,
        covariance=covariance,
        noise_std=np.sqrt(variance),
        samples=factor.samples,
        method=method,
        condition=solution.condition,
        undetermined=undetermined_names(factor.parameter_names, solution.determined),
        interval_factor=interval_factor,
    )


def mark_undetermined(covariance: Array, determined: NDArray[np.bool_]) -> None:
    """Set infinite variance and zero covariance of undetermined parameters, in place."""
    covariance[~determined, :] = 0.0
    covariance[:, ~determined] = 0.0
    covariance[~determined, ~determined] = np.inf


def undetermined_names(names: Sequence[str], determined: NDArray[np.bool_]) -> tuple[str, ...]:
    """Return the names (p,) of undetermined parameters (p,)."""
    return tuple(
        name for name, is_determined in zip(names, determined, strict=True) if not is_determined
    )
