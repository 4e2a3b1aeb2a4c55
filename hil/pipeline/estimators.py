"""Estimators by name: what each is, and its fit of a factor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Literal

import numpy as np

from hil.base.arrays import Array
from identification.estimators.consistent import consistent_estimate
from identification.estimators.least_squares import Fit, Weighting, fit_least_squares
from identification.factor.estimate import Estimate, joint_weights
from identification.factor.factor import Factor
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Estimator = Literal["auto", "wls", "ols", "huber", "tukey", "prior", "consistent", "iv"]

ESTIMATORS: Final[dict[Estimator, str]] = {
    "auto": "posterior of a prior on bodies, drives and friction; residuals and inner prediction "
    "set its strength",
    "wls": "weighted least squares (eq. 4), residuals weighted by the noise of their joint",
    "ols": "ordinary least squares, equal weights of all joints",
    "huber": "iteratively reweighted least squares, Huber loss",
    "tukey": "iteratively reweighted least squares, Tukey's bisquare loss",
    "prior": "posterior of the URDF's bodies, as uncertain as stated in [nominal]",
    "consistent": "weighted least squares over physically consistent parameters",
    "iv": "instrumental variables, with the commanded motion as instruments",
}
OF_PRIOR: Final = ("auto", "prior")
"""Those that are a posterior; :mod:`hil.pipeline.estimating` has their prior."""


def fit_of(model: RobotModel, name: str) -> Fit:
    """Return the fit function of an estimator that works on factors, without prior."""

    def fit(recordings: Sequence[Samples], factor: Factor) -> Estimate:
        weighting: Weighting = "ordinary" if name == "ols" else "weighted"
        result = fit_least_squares(model, recordings, weighting, factor=factor)
        if name == "consistent":
            result = consistent_estimate(model, factor, result).estimate
        return result

    return fit


def values_of(model: RobotModel, name: Estimator) -> Callable[[Factor], Array]:
    """Return the parameters (p,) by an estimator without prior as a function of a factor.

    Robust losses and instruments need samples; weighted least squares represents them.
    """
    if name == "ols":
        return lambda factor: factor.solve(np.ones(model.n_joints)).values
    if name == "consistent":
        return lambda factor: consistent_estimate(model, factor).estimate.values
    return lambda factor: factor.solve(joint_weights(factor)).values
