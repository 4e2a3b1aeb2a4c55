"""Ordinary and weighted least squares by name, on either kind of factor.

Both fit the same rows. Ordinary least squares counts every joint's residual alike, in N·m: the
joints that carry the arm decide. Weighted least squares (eq. 4) counts it in that joint's own
noise. The covariance of either is that of joints with different noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.clustered import clustered_covariance
from identification.estimators.covariance import with_block_covariance
from identification.factor.estimation import (
    Estimate,
    Solution,
    estimate,
    joint_weights,
    mark_undetermined,
    nothing_usable,
    residual_variance,
)
from identification.factor.gram import Factor
from identification.factor.phases import PhaseFactor, total_phase
from identification.factor.qr import (
    QRFactor,
    qr_estimate,
    qr_joint_weights,
    qr_residual_variance,
    reduced,
    solve_weighted,
)
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]
Weighting = Literal["ordinary", "weighted"]


def ordinary_least_squares(model: RobotModel, factor: Factor | QRFactor) -> Estimate:
    r"""Least squares with every joint's residual counted alike.

    The covariance is the sandwich for white residuals whose variance differs by joint
    (White 1980), with :math:`A = \sum_j G_j`:

    .. math:: A^{-1} \left(\sum_j \sigma_j^2\, G_j\right) A^{-1}

    Raises:
        IdentificationError: the factor holds no rows.
    """
    ones = np.ones(factor.n_joints)
    result = weighted_least_squares(model, factor, ones)
    solution = solve_weighted(factor, ones)
    variance = np.nan_to_num(result.noise_std**2)
    covariance = solution.root @ _middle(factor, solution, variance) @ solution.root.T
    mark_undetermined(covariance, solution.determined)
    return replace(
        result,
        covariance=covariance,
        method="ordinary least squares, sandwich covariance (white residuals, noise per joint)",
    )


def weighted_least_squares(
    model: RobotModel, factor: Factor | QRFactor, weights: Array | None = None
) -> Estimate:
    """Least squares with one weight per joint (n,), by default 1/variance of its residual.

    Raises:
        IdentificationError: the factor holds no rows.
    """
    if isinstance(factor, QRFactor):
        return qr_estimate(model, factor, weights)
    return estimate(model, factor, weights)


def fit_least_squares(
    model: RobotModel,
    recordings: Sequence[Samples],
    weighting: Weighting = "weighted",
    *,
    phase: PhaseFactor | None = None,
) -> Estimate:
    """Fit recordings, by QR where the condition demands it, with cluster-robust covariance.

    Args:
        model: the robot.
        recordings: can be gone through twice: a sequence, not a generator.
        weighting: whether joints count alike or by their own noise (eq. 4).
        phase: of the recordings, if it is known: they are then read for QR only.

    Raises:
        IdentificationError: no recordings, or not one usable row.
    """
    phase = total_phase(model, recordings) if phase is None else phase
    factor = reduced(model, recordings, phase.total)
    if not factor.samples.any():
        raise IdentificationError(nothing_usable(model))
    weights = np.ones(model.n_joints) if weighting == "ordinary" else weights_of(factor)
    if isinstance(factor, Factor):
        plain = estimate(model, factor, weights)
        return with_block_covariance(plain, phase, weights, f"{weighting} least squares")
    solution = solve_weighted(factor, weights)
    clustered = clustered_covariance(model, recordings, solution, weights)
    return replace(
        qr_estimate(model, factor, weights),
        covariance=clustered.covariance,
        interval_factor=clustered.interval_factor,
        method=f"{weighting} least squares by QR, {clustered.words}",
    )


def weights_of(factor: Factor | QRFactor) -> Array:
    """Inverse variance of each joint's residual in an ordinary fit (n,), zero without rows."""
    if isinstance(factor, QRFactor):
        return qr_joint_weights(factor)
    return joint_weights(factor)


def variance_of(factor: Factor | QRFactor, solution: Solution, weights: Array) -> Array:
    """Variance of the torque residual per joint (n,), NaN for a joint without rows."""
    if isinstance(factor, QRFactor):
        return qr_residual_variance(factor, solution, weights)
    return residual_variance(factor, solution.values, solution.inverse, weights)


def _middle(factor: Factor | QRFactor, solution: Solution, variance: Array) -> Array:
    """Sum of variance times S' G_j S (k, k), S being the solution's root."""
    if isinstance(factor, QRFactor):
        rows = np.sqrt(variance)[:, None, None] * (factor.triangle[:, :, :-1] @ solution.root)
        flat = rows.reshape(-1, solution.root.shape[1])
        return np.asarray(flat.T @ flat)
    gram = np.tensordot(variance, factor.gram[:, :-1, :-1], axes=1)
    return np.asarray(solution.root.T @ gram @ solution.root)
