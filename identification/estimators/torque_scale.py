r"""Uncertainty of an estimate by the scale of the measured torques.

Torques of joint j are known up to a factor 1 + s_j: the relative error of its torque constant, or
of its torque sensor. Least squares ``H pi = sum_j w_j W_j' y_j + ...`` is linear in the torques, so
the change by s_j is the solution for the torque of joint j alone,

.. math:: \partial \pi / \partial s_j = H^{-1} w_j W_j^T y_j,

and independent errors of standard deviation u_j add :math:`\sum_j u_j^2 (\partial \pi / \partial
s_j)(\partial \pi / \partial s_j)^T` to the covariance. H may contain the information of a prior.
No residual shows a common factor of all torques; it is exactly linear in the parameters.

The covariance of an estimate is without it: in units of the arm's own torque, which is what a
controller or a simulation of the same arm needs, the parameters have no such error. Estimates keep
:math:`u_j \partial \pi / \partial s_j`, and :func:`absolute` adds it where masses are wanted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.distributions import NORMAL_95
from identification.factor.estimate import Estimate
from identification.factor.factor import Factor

TORQUE_CONSTANT_STD: Final = 0.03
"""Relative standard deviation of a torque constant from a data sheet, or of a torque sensor.

Makers of servo motors state tolerances of 5 to 10 % for the constant of one specimen, magnets lose
some 4 % when they warm by 40 K (0.1 %/K, NdFeB); 3 % is half of a tolerance in between.
"""


def scale_sensitivity(factor: Factor, weights: Array, inverse: Array) -> Array:
    """Return the change of parameters per relative change of each joint's torques (p, n).

    Args:
        factor: of the fitted rows, p parameters and n joints.
        weights: of the joints (n,), 1/variance.
        inverse: of the information H, zero where undetermined (p, p); with a prior, the posterior
            covariance for unit noise.
    """
    pulls = factor.products(np.eye(factor.n_parameters + 1))[:, :-1, -1]
    return np.asarray(inverse @ (weights[:, None] * pulls).T)


def scale_covariance(sensitivity: Array, std: Array, interval_factor: float = NORMAL_95) -> Array:
    """Return the covariance (p, p) by independent errors of the torque scale.

    Args:
        sensitivity: of parameters to each scale (p, n).
        std: relative standard deviations of the scales (n,).
        interval_factor: standard deviations in half a 95 % interval that the covariance is used
            with. Student's factor is for variances estimated from few blocks; that of the scale
            is stated, so that the normal 1.96 applies to it.
    """
    moved = sensitivity * std * (NORMAL_95 / interval_factor)
    return np.asarray(moved @ moved.T)


def with_torque_scale(
    estimate: Estimate, factor: Factor, weights: Array, inverse: Array, std: Array
) -> Estimate:
    """Return an estimate with its change by the scale of torques; the covariance stays.

    Args:
        estimate: from the factor.
        factor: of the data.
        weights: of the joints (n,).
        inverse: of the information (p, p), as for :func:`scale_sensitivity`.
        std: relative standard deviation of each joint's torque (n,).
    """
    change = scale_sensitivity(factor, weights, inverse) * std
    return replace(estimate, scale_change=change if std.any() else None)


def absolute(estimate: Estimate) -> Estimate:
    """Return the estimate with the uncertainty of the torque scale in its covariance.

    Infinite variances stay.
    """
    change = estimate.scale_change
    if change is None:
        return estimate
    added = scale_covariance(change, np.ones(change.shape[1]), estimate.interval_factor)
    determined = np.isfinite(np.diag(estimate.covariance))
    added = np.where(np.outer(determined, determined), added, 0.0)
    return replace(
        estimate,
        covariance=estimate.covariance + added,
        method=estimate.method.widened("torque_scale"),
        scale_change=None,
    )


def described(std: Array, what: str = "the scale of torques") -> str:
    """Return what is assumed, such as "torque constants to 3 %"."""
    low = 100.0 * float(np.min(std))
    high = 100.0 * float(np.max(std))
    return (
        f"{what} to {low:.2g} %"
        if high < 1.05 * low + 1e-9
        else (f"{what} to {low:.2g} to {high:.2g} %")
    )
