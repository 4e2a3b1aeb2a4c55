"""Ordinary and weighted (eq. 4) least squares, of one recording or repetitions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from identification.arrays import Array
from identification.distributions import chi_squared_limit
from identification.estimators.covariance import Clustered, block_covariance, clustered_covariance
from identification.factor.estimate import Estimate, estimate, estimate_of, joint_weights
from identification.factor.estimation_method import EstimationMethod, LeastSquares
from identification.factor.factor import Factor, reduced, total_factor
from identification.factor.normal_equations import Solution
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Weighting = Literal["ordinary", "weighted"]


def fit_least_squares(
    model: RobotModel,
    recordings: Sequence[Samples],
    weighting: Weighting = "weighted",
    *,
    factor: Factor | None = None,
) -> Estimate:
    """Fit recordings with cluster-robust covariance, by QR if the condition requires it.

    Args:
        model: of the arm.
        recordings: prepared.
        weighting: "weighted" weights joints by their noise (eq. 4).
        factor: of the recordings, if known: they are then read for QR only.

    Raises:
        IdentificationError: no recordings, or no usable row.
    """
    factor = total_factor(model, recordings) if factor is None else factor
    precise = reduced(model, recordings, factor)
    weights = np.ones(model.n_joints) if weighting == "ordinary" else joint_weights(precise)
    solution, clustered = clustered_fit(model, precise, recordings, factor, weights)
    fit = LeastSquares(weighting, by_qr=precise.storage == "qr")
    return estimate_of(
        model.units,
        precise,
        solution,
        weights,
        EstimationMethod(fit, clustered.blocks),
        clustered.covariance,
        clustered.interval_factor,
    )


def clustered_fit(
    model: RobotModel,
    precise: Factor,
    recordings: Sequence[Samples],
    by_time: Factor,
    weights: Array,
) -> tuple[Solution, Clustered]:
    """Solve with weights and return the cluster-robust covariance; QR reads the samples.

    Args:
        model: of the arm.
        precise: factor that is solved.
        recordings: prepared.
        by_time: their factor by blocks of time.
        weights: of the joints (n,).
    """
    solution = precise.solve(weights)
    if precise.storage == "qr":
        return solution, clustered_covariance(model, recordings, solution, weights)
    return solution, block_covariance(by_time, weights, solution.values)


# Probability that the scatter of equal repetitions is significant for none of the parameters.
_SCATTER_CONFIDENCE: Final = 0.99

Fit = Callable[[Sequence[Samples], Factor], Estimate]
"""Estimator: recordings and their factor by time to an estimate."""


@dataclass(frozen=True, eq=False)
class RepeatedEstimate:
    """Estimates from R repetitions of one motion."""

    pooled: Estimate  #: result, from all samples, with covariance clustered by time of the motion
    values: Array  #: parameters from each alone (R, p)
    factor: Factor  #: sum of the factors, by time of the motion
    classical_std: Array  #: of weighted least squares with white residuals (p,)

    @classmethod
    def of(
        cls, model: RobotModel, pooled: Estimate, values: Sequence[Array], factor: Factor
    ) -> RepeatedEstimate:
        """Combine the estimate from all repetitions with the estimates from each.

        Args:
            model: of the arm.
            pooled: estimate from all.
            values: parameters (p,) from each.
            factor: of all.
        """
        return cls(pooled, np.array(values), factor, estimate(model, factor).std)

    @property
    def mean(self) -> Array:
        """Mean over the repetitions (p,), as in the paper's Table 2."""
        return np.asarray(self.values.mean(axis=0))

    @property
    def std(self) -> Array:
        """Standard deviation over the repetitions (p,), NaN for one."""
        if len(self.values) == 1:
            return np.full(len(self.pooled.values), np.nan)
        return np.asarray(self.values.std(axis=0, ddof=1))


def no_narrower(covariance: Array, values: Array) -> Array:
    """Widen a covariance (p, p) where the mean of R values (R, p) scatters significantly more."""
    freedom = len(values) - 1
    if freedom < 1:
        return covariance
    std = np.sqrt(np.diag(covariance))
    determined = np.isfinite(std) & (std > 0.0)
    scatter = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    ratio = np.where(determined, scatter / np.where(determined, std, 1.0), 1.0)
    certain = _SCATTER_CONFIDENCE ** (1.0 / max(1, int(determined.sum())))
    chance = np.sqrt(chi_squared_limit(1.0 - certain, freedom) / freedom)
    wider = np.where(ratio > chance, ratio, 1.0)
    return np.where(
        np.outer(determined, determined), covariance * np.outer(wider, wider), covariance
    )


def estimate_repetitions(
    model: RobotModel,
    recordings: Sequence[Samples],
    fit: Fit | None = None,
    *,
    each: Callable[[Sequence[Samples], Factor], Array] | None = None,
    factors: Sequence[Factor] = (),
) -> RepeatedEstimate:
    """Estimate from each repetition and from all, by default by weighted least squares (eq. 4).

    Args:
        model: of the arm.
        recordings: of the repetitions; a single one has the estimate from all.
        fit: estimator.
        each: gives the parameters (p,) from a single repetition; by default the same estimator.
        factors: of the recordings by time, if known.

    Raises:
        IdentificationError: a repetition without a usable row.
    """

    def weighted(some: Sequence[Samples], factor: Factor) -> Estimate:
        return fit_least_squares(model, some, factor=factor)

    fit = fit or weighted
    factors = factors or [Factor.by_time(model, samples) for samples in recordings]
    total = sum(factors, Factor.zero(model))
    pooled = fit(recordings, total)
    values = [pooled.values]
    if len(recordings) > 1:
        values = [
            fit([samples], factor).values if each is None else each([samples], factor)
            for samples, factor in zip(recordings, factors, strict=True)
        ]
    return RepeatedEstimate.of(model, pooled, values, total)
