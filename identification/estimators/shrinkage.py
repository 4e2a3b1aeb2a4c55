r"""Least squares drawn towards the physically consistent solution.

.. math:: \hat\pi = \pi_c + (A + \lambda D)^{-1}\,(b - A\,\pi_c), \qquad D = \mathrm{diag}(A)

with the weighted normal equations A, b of the samples and :math:`\pi_c` the parameters nearest to
them that some machine can have (:mod:`identification.estimators.consistent`). It is the mean of a
Gaussian posterior whose prior has the information :math:`\lambda` of each column's own, whatever
its unit. What the motion determines well follows the data, even where no rigid machine would (gains
a few per cent apart); what it hardly determines follows the machine, so that other motions are
predicted as well. :math:`\lambda = 0` is weighted least squares, infinity the consistent solution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.estimators.consistent import (
    Consistency,
    ConsistentEstimate,
    consistent_estimate,
)
from identification.estimators.covariance import block_covariance
from identification.factor.factor import (
    Estimate,
    Factor,
    NormalEquations,
    estimate,
    joint_weights,
    solve,
    undetermined_names,
)
from identification.factor.phases import PhaseFactor, total_phase
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shrinkage:
    """How far an estimate is drawn towards the consistent solution.

    Attributes:
        strength: information of the prior, as a share of the data's in each column; zero for
            least squares, infinite for the consistent solution itself.
        prior_weight: rows of data that the nominal bodies count for in the consistent solution.
    """

    strength: float = 0.0
    prior_weight: float = 0.1

    def describe(self) -> str:
        """The estimator in words."""
        if self.strength == 0.0:
            return "least squares"
        nominal = f"nominal bodies weigh {self.prior_weight:g} rows"
        if math.isinf(self.strength):
            return f"physically consistent ({nominal})"
        return f"regularised towards the consistent solution by {self.strength:g} ({nominal})"


def consistent_centre(
    model: RobotModel,
    factor: Factor,
    weights: Array,
    prior_weight: float,
    near: Array | None = None,
) -> ConsistentEstimate:
    """Physically consistent parameters of the samples.

    Args:
        model: the robot.
        factor: the samples.
        weights: per joint (n,).
        prior_weight: see `Shrinkage`.
        near: `solution` of much the same samples; quick, and good for comparisons.

    Raises:
        IdentificationError: there are no rows, or no such parameters were found.
    """
    return consistent_estimate(
        model,
        factor,
        estimate(model, factor, weights),
        weights=weights,
        options=Consistency(prior_weight=prior_weight),
        near=near,
    )


def shrunk_values(equations: NormalEquations, centre: Array, strength: float) -> Array:
    """Parameters (p,) drawn towards the centre (p,); what has no data stays there."""
    if math.isinf(strength):
        return centre
    prior = strength * np.diag(equations.A)
    moved = equations._replace(A=equations.A + np.diag(prior), b=equations.b - equations.A @ centre)
    return np.asarray(centre + solve(moved).values)


def fitted_values(model: RobotModel, factor: Factor, shrinkage: Shrinkage) -> Array:
    """Parameters (p,) of a factor, without their covariance.

    Raises:
        IdentificationError: no consistent parameters were found.
    """
    weights = joint_weights(factor)
    equations = factor.weighted(weights)
    if shrinkage.strength == 0.0:
        return solve(equations).values
    centre = consistent_centre(model, factor, weights, shrinkage.prior_weight).estimate.values
    return shrunk_values(equations, centre, shrinkage.strength)


def fit_shrunk(
    model: RobotModel,
    recordings: Sequence[Samples],
    shrinkage: Shrinkage,
    *,
    centre: Array | None = None,
    phase: PhaseFactor | None = None,
) -> Estimate:
    """Fit recordings; the covariance is that of least squares, cluster-robust.

    The consistent solution comes from the same samples: as a prior it knows no more than they do,
    and where they leave parameters open the nominal bodies decide, whose errors nobody knows.

    Args:
        model: the robot.
        recordings: the samples.
        shrinkage: how far.
        centre: what to draw towards (p,), by default the consistent solution of these samples.
        phase: of the recordings, if it is known.

    Raises:
        IdentificationError: no usable row, or no consistent parameters were found.
    """
    phase = total_phase(model, recordings) if phase is None else phase
    factor = phase.total
    free = estimate(model, factor)
    weights = joint_weights(factor)
    if centre is None:
        centre = consistent_centre(model, factor, weights, shrinkage.prior_weight).estimate.values
    equations = factor.weighted(weights)
    values = shrunk_values(equations, centre, shrinkage.strength)
    found = block_covariance(phase, weights, free.values)
    variance = factor.squared_errors(values) / np.maximum(factor.samples, 1)
    return replace(
        free,
        values=values,
        covariance=found.covariance,
        noise_std=np.where(factor.samples > 0, np.sqrt(variance), np.nan),
        interval_factor=found.interval_factor,
        undetermined=undetermined_names(model.parameter_names, found.determined),
        method=f"weighted least squares, {shrinkage.describe()}; {found.words}",
    )
