"""Intervals of an estimate: with the errors that the scatter of its residuals does not show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.estimators.delay import with_uncertain_delay
from identification.estimators.elasticity import fitted_gears, with_elastic_gears
from identification.estimators.friction_drift import with_drift
from identification.estimators.friction_form import (
    FormUncertainty,
    form_uncertainty,
    with_uncertain_form,
)
from identification.estimators.least_squares import no_narrower
from identification.estimators.torque_scale import with_torque_scale
from identification.factor.estimate import Estimate, inverse_variance
from identification.factor.factor import Factor
from identification.factor.normal_equations import solve
from identification.reduction.posterior import Posterior
from identification.reduction.reduction import Reduction


class Widened(NamedTuple):
    """An estimate whose intervals allow for what its model lacks."""

    pooled: Estimate  #: with the scatter of repetitions and the error of the delay
    estimate: Estimate  #: with everything
    form: FormUncertainty | None  #: of the friction law; None if it was not examined


def _delayed(
    estimate: Estimate, total: Reduction, variance: float, precision: Array | None
) -> Estimate:
    """Return the estimate with the error of the delay in its intervals.

    Args:
        estimate: of p parameters.
        total: sums of the fitted rows.
        variance: mean square error of the delay [s²].
        precision: information (p, p) of a prior in addition to the rows.
    """
    if not variance or total.rates is None:
        return estimate
    return with_uncertain_delay(estimate, total.factor, total.rates, variance, precision)


def widened(
    estimate: Estimate,
    total: Reduction,
    posterior: Posterior,
    precision: Array | None,
    *,
    delay_variance: float,
    repetitions: Array | None,
    torque_scale: Array,
    recordings: Sequence[Factor],
) -> Widened:
    """Return the estimate with all errors that the scatter of its residuals does not show.

    Its change by the scale of the torques is added to it, not to the intervals.

    Args:
        estimate: of p parameters and n joints.
        total: sums of the fitted rows.
        posterior: of the arm.
        precision: information (p, p) of the prior, if the estimate has one.
        delay_variance: mean square error of the delay [s²].
        repetitions: parameters from each repetition of one motion (R, p); None: of several motions.
        torque_scale: relative standard deviation of each joint's torque (n,).
        recordings: factors of the recordings in order, whose friction may drift.
    """
    if repetitions is not None:
        covariance = no_narrower(estimate.covariance, repetitions)
        estimate = replace(estimate, covariance=covariance)
    estimate = _delayed(estimate, total, delay_variance, precision)
    model = posterior.model
    factor = total.factor
    # The scores of a stronger prior, or of possible bodies, are not zero.
    believed = None if precision is None else posterior.believed(factor)
    inverse = _inverse(estimate, factor, precision)
    result = estimate
    if torque_scale.any():
        weights = inverse_variance(estimate.noise_std**2)
        result = with_torque_scale(estimate, factor, weights, inverse, torque_scale)
    form = None
    if total.unmodelled is not None:
        effect = posterior.design_effect
        if total.unmodelled.elastic is not None:
            gears = fitted_gears(
                result,
                factor,
                total.unmodelled.elastic,
                effect,
                precision,
                believed,
                total.times,
                excess_scores(estimate, total, estimate.values if believed is None else believed),
            )
            result = with_elastic_gears(result, gears)
        own = estimate if believed is None else replace(estimate, values=believed)
        form = form_uncertainty(model, own, factor, total.unmodelled.forms, precision)
        result = with_uncertain_form(result, form)
    return Widened(estimate, with_drift(model, result, recordings, inverse), form)


def excess_scores(estimate: Estimate, total: Reduction, values: Array) -> Array:
    """Return the scores (p,) of rows with unmodelled effects beyond their share of all scores."""
    assert total.unmodelled is not None
    forms = total.unmodelled.forms
    weights = inverse_variance(estimate.noise_std**2)
    size = len(values)
    padded = np.append(values, np.zeros(forms.n_parameters - size))
    shown = forms.scores(weights, padded)[:, :size].sum(axis=0)
    return np.asarray(total.times * shown - total.factor.scores(weights, values).sum(axis=0))


def _inverse(estimate: Estimate, factor: Factor, precision: Array | None) -> Array:
    """Return the inverse of the information of rows and prior (p, p), zero where undetermined."""
    equations = factor.weighted(inverse_variance(estimate.noise_std**2))
    if precision is not None:
        equations = equations._replace(A=equations.A + precision)
    return solve(equations).inverse
