r"""Estimates with a Gaussian prior on the parameters, from CAD or zero (ridge).

.. math:: \hat\pi = \arg\min \; \sum_j w_j \lVert y_j - W_j \pi \rVert^2
                    + (\pi - \mu)^T C^{-1} (\pi - \mu)

(Hoerl and Kennard 1970 with mu = 0; Gelman et al. 2013, section 14.8).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.least_squares import clustered_fit
from identification.factor.factor import (
    Estimate,
    Factor,
    estimate_of,
    joint_weights,
    mark_undetermined,
    reduced,
    solve_rows,
    total_factor,
)
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]


# Posterior over prior standard deviation of a parameter that is determined by the data, which then
# gave three quarters of its information (inverse variance).
LEARNED: Final = 0.5
_WORST_CONDITION: Final = 1e13  # A weak prior still determines what the data leave open
_FEWEST_ROWS: Final = 2  # per parameter, to estimate the noise


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """Gaussian prior: ``root @ (pi - mean)`` is standard normal."""

    mean: Array  #: (p,)
    root: Array  #: (k, p); flat in directions without information
    words: str  #: origin

    @classmethod
    def of_combinations(
        cls, combinations: Array, mean: Array, std: Array, words: str = "given"
    ) -> GaussianPrior:
        """Return the prior on ``combinations @ s`` of independent s with mean and std (s,).

        An infinite standard deviation makes the direction on which its quantity acts flat. With the
        identity (p, s) and mean zero this is ridge regression in units of `std`.
        """
        flat = np.isinf(std)
        spread = combinations[:, ~flat] * std[~flat]
        size = _length(spread, axis=1)
        seen = _null_space(combinations[:, flat] / size[:, None])
        seen_spread = seen.T @ (spread / size[:, None])
        covariance = seen_spread @ seen_spread.T
        scale = np.sqrt(np.diag(covariance))
        lower = np.linalg.cholesky(covariance / np.outer(scale, scale))
        root = np.linalg.solve(lower, seen.T / scale[:, None]) / size
        return cls(combinations @ mean, np.asarray(root), words)

    @property
    def std(self) -> Array:
        """Standard deviations (p,), infinite where the prior is flat."""
        solution = solve_rows(self.root, np.zeros(len(self.root)), _WORST_CONDITION)
        covariance = solution.inverse
        mark_undetermined(covariance, solution.determined)
        return np.sqrt(np.diag(covariance))


@dataclass(frozen=True, eq=False)
class PosteriorEstimate:
    """Estimate from prior and data."""

    estimate: Estimate  #: its covariance is the posterior's
    prior_mean: Array  #: (p,)
    prior_std: Array  #: (p,), infinite where unknown
    words: str  #: origin of the prior
    design_effect: float  #: variance ratio of coloured to white residuals

    @property
    def ratio(self) -> Array:
        """Posterior over prior standard deviation (p,), 1: all from the prior; without prior 0."""
        flat = np.isinf(self.prior_std)
        ratio = self.estimate.std / np.where(flat, 1.0, self.prior_std)
        return np.where(flat, np.isinf(self.estimate.std).astype(np.float64), ratio)

    @property
    def learned(self) -> NDArray[np.bool_]:
        """Whether each parameter is determined by the data (p,): ratio below `LEARNED`."""
        return np.asarray(self.ratio < LEARNED)

    @property
    def normalized_change(self) -> Array:
        """Change by the data (p,), standard normal if prior and data agree; NaN without prior."""
        tested = self.learned & np.isfinite(self.prior_std)
        allowed = np.where(tested, self.prior_std**2, 1.0) * (
            1.0 - np.where(tested, self.ratio, 0.0) ** 2
        )
        return np.where(tested, (self.estimate.values - self.prior_mean) / np.sqrt(allowed), np.nan)


def with_prior(
    model: RobotModel,
    factor: Factor,
    prior: GaussianPrior,
    weights: Array | None = None,
    *,
    design_effect: float = 1.0,
) -> PosteriorEstimate:
    """Estimate from data and prior; a flat prior gives least squares.

    Weights (n,) are by default those of an ordinary fit without prior. The information of the data
    is divided by `design_effect` (:func:`fit_with_prior`).

    Raises:
        IdentificationError: too few rows to estimate the noise, and no weights.
    """
    if weights is None:
        weights = _weights(factor)
    rows, target = factor.rows(weights)
    data_weight = np.sqrt(1.0 / design_effect)
    # Solved for the change of the prior's mean, which unknown directions keep.
    posterior = solve_rows(
        np.concatenate([data_weight * rows, prior.root]),
        np.concatenate([data_weight * (target - rows @ prior.mean), np.zeros(len(prior.root))]),
        _WORST_CONDITION,
    )
    solution = posterior._replace(
        values=prior.mean + posterior.values,
        condition=solve_rows(rows, target).condition if len(rows) else np.inf,
    )
    method = f"weighted least squares with a Gaussian prior ({prior.words}), posterior covariance"
    if design_effect > 1.0:
        method += f", design effect {design_effect:.3g}"
    estimate = estimate_of(model.units, factor, solution, weights / design_effect, method)
    return PosteriorEstimate(estimate, prior.mean, prior.std, prior.words, design_effect)


def fit_with_prior(
    model: RobotModel,
    recordings: Sequence[Samples],
    prior: GaussianPrior,
    *,
    factor: Factor | None = None,
) -> PosteriorEstimate:
    """Fit recordings with a prior, allowing for coloured residuals.

    The information of the data is divided by the design effect, the mean ratio of the
    cluster-robust variance to that of white residuals (Rao and Scott 1981; Pauli, Racugno and
    Ventura 2011). With a known factor, recordings are read for QR only.

    Raises:
        IdentificationError: no recordings, or no usable row.
    """
    factor = total_factor(model, recordings) if factor is None else factor
    precise = reduced(model, recordings, factor)
    weights = _weights(precise)
    _, clustered = clustered_fit(model, precise, recordings, factor, weights)
    effect = max(1.0, clustered.design_effect)
    result = with_prior(model, precise, prior, weights, design_effect=effect)
    estimate = replace(result.estimate, interval_factor=clustered.interval_factor)
    return replace(result, estimate=estimate)


def _weights(factor: Factor) -> Array:
    rows = int(factor.samples.sum())
    if 0 < rows < _FEWEST_ROWS * factor.n_parameters:
        raise IdentificationError(
            f"{rows} rows are too few to estimate the torque noise with {factor.n_parameters}"
            " parameters; pass the weights"
        )
    return joint_weights(factor) if rows else np.zeros(factor.n_joints)


def _length(columns: Array, axis: int) -> Array:
    """Return lengths to divide by, one for zero."""
    length = np.linalg.norm(columns, axis=axis)
    return np.where(length > 0.0, length, 1.0)


def _null_space(columns: Array) -> Array:
    """Return an orthonormal basis (p, p - r) orthogonal to columns (p, k) of rank r."""
    if columns.shape[1] == 0:
        return np.eye(len(columns))
    left, singular, _ = np.linalg.svd(columns / _length(columns, axis=0), full_matrices=True)
    rank = int(np.count_nonzero(singular > 1e-12 * singular.max(initial=0.0)))
    return np.asarray(left[:, rank:])


# CAD lacks cables, grease and fasteners, and castings deviate from drawings. Assumed; state it per
# arm.
NOMINAL_SHARE: Final = 0.1
_INERTIA, _MOMENT, _MASS = slice(0, 6), slice(6, 9), 9


def nominal_prior(
    model: RobotModel,
    share: float = NOMINAL_SHARE,
    known: Mapping[str, tuple[float, float]] | None = None,
) -> GaussianPrior:
    """Return the prior by the inertias of the URDF.

    The standard deviation of a mass is `share` of it, that of first moments and inertias `share` of
    the largest of the link. First moments of zero are replaced by mass times radius of gyration, a
    missing inertia by the largest of the arm. Rotor inertia, friction and springs are unknown
    unless `known` by mean and standard deviation: `{"I3m": (1.2, 0.2), "f0_1": (40.0, 40.0)}`.

    Raises:
        IdentificationError: the URDF has no inertia.
    """
    others = model.parameter_names[model.base.rank :]
    names = model.layout.names + others
    mean = np.concatenate([model.nominal, np.zeros(len(others))])
    std = np.concatenate([_nominal_std(model, share), np.full(len(others), np.inf)])
    for name, (value, deviation) in (known or {}).items():
        mean[names.index(name)], std[names.index(name)] = value, deviation
    combinations = np.zeros((model.n_parameters, len(names)))
    combinations[: model.base.rank, : len(model.layout.names)] = model.base.grouping
    combinations[model.base.rank :, len(model.layout.names) :] = np.eye(len(others))
    extra = f", {len(known)} given" if known else ""
    return GaussianPrior.of_combinations(
        combinations, mean, std, f"nominal parameters to {100.0 * share:g} %{extra}"
    )


def _nominal_std(model: RobotModel, share: float) -> Array:
    """Return standard deviations of the standard parameters (s,), infinite for rotors."""
    values = np.abs(model.nominal[model.layout.links])
    inertia, mass = values[:, _INERTIA].max(axis=1), values[:, _MASS].copy()
    if not (inertia.any() and mass.any()):
        raise IdentificationError("the URDF gives no inertia to make a prior from")
    inertia[inertia == 0.0], mass[mass == 0.0] = inertia.max(), mass.max()
    moment = values[:, _MOMENT].max(axis=1)
    moment = np.where(moment > 0.0, moment, np.sqrt(mass * inertia))
    std = np.full(model.layout.size, np.inf)
    std[model.layout.links] = share * np.repeat(
        np.column_stack([inertia, moment, mass]), [6, 3, 1], axis=1
    )
    return std
