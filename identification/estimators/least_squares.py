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
from identification.factor.factor import (
    Estimate,
    Factor,
    JointFactor,
    estimate,
    joint_weights,
    mark_undetermined,
    nothing_usable,
    reduced,
)
from identification.factor.phases import PhaseFactor, total_phase
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]
Weighting = Literal["ordinary", "weighted"]


def ordinary_least_squares(model: RobotModel, factor: JointFactor) -> Estimate:
    r"""Least squares with the same weight for every joint's residual.

    The covariance is the sandwich for white residuals whose variance differs by joint
    (White 1980), with :math:`A = \sum_j G_j`:

    .. math:: A^{-1} \left(\sum_j \sigma_j^2\, G_j\right) A^{-1}

    Raises:
        IdentificationError: the factor holds no rows.
    """
    ones = np.ones(factor.n_joints)
    result = estimate(model, factor, ones)
    solution = factor.solve(ones)
    variance = np.nan_to_num(result.noise_std**2)
    middle = np.tensordot(variance, factor.products(solution.root), axes=1)
    covariance = solution.root @ middle @ solution.root.T
    mark_undetermined(covariance, solution.determined)
    return replace(
        result,
        covariance=covariance,
        method="ordinary least squares, sandwich covariance (white residuals, noise per joint)",
    )


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
    weights = np.ones(model.n_joints) if weighting == "ordinary" else joint_weights(factor)
    if isinstance(factor, Factor):
        classical = estimate(model, factor, weights)
        return with_block_covariance(classical, phase, weights, f"{weighting} least squares")
    solution = factor.solve(weights)
    clustered = clustered_covariance(model, recordings, solution, weights)
    return replace(
        estimate(model, factor, weights),
        covariance=clustered.covariance,
        interval_factor=clustered.interval_factor,
        method=f"{weighting} least squares by QR, {clustered.words}",
    )
