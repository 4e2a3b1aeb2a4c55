"""Ordinary and weighted least squares by name, on either kind of factor.

Both fit the same rows. Ordinary least squares counts every joint's residual alike, in N·m: the
joints that carry the arm decide. Weighted least squares (eq. 4) counts it in that joint's own
noise. The covariance of either is that of joints with different noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.covariance import clustered_covariance, with_block_covariance
from identification.factor.factor import (
    Estimate,
    Factor,
    QRFactor,
    estimate,
    joint_weights,
    nothing_usable,
    reduced,
)
from identification.factor.phases import PhaseFactor, total_phase
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]


Weighting = Literal["ordinary", "weighted"]


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
    if not isinstance(factor, QRFactor):
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


# Share of equal repetitions that scatter by less than what counts as more than chance.
_CERTAIN: Final = 0.99

Fit = Callable[[Sequence[Samples], PhaseFactor], Estimate]
"""An estimator: some recordings and their factor to an estimate."""


@dataclass(frozen=True, eq=False)
class RepeatedEstimate:
    """Estimates over R repetitions of one motion.

    Attributes:
        pooled: from all samples at once. This is the result. Its covariance is clustered by
            time of the motion, so that an error of the model that repeats is not averaged away.
        repetitions: from each alone, with the covariance of its own blocks.
        phase: sum of all factors, by time of the motion.
        factor: the same without regard to time.
        classical_std: of weighted least squares on all samples if residuals were white (p,).
        independent_std: of the pooled estimate if repetitions were independent: root mean square
            of the repetitions' own standard deviations over sqrt(R) (p,).
        scatter_std: standard deviation over the repetitions over sqrt(R) (p,): what noise alone
            does, NaN for one repetition.
    """

    pooled: Estimate
    repetitions: tuple[Estimate, ...]
    phase: PhaseFactor
    factor: Factor
    classical_std: Array
    independent_std: Array
    scatter_std: Array

    @classmethod
    def of(
        cls,
        model: RobotModel,
        pooled: Estimate,
        repetitions: Sequence[Estimate],
        phase: PhaseFactor,
    ) -> RepeatedEstimate:
        """Put an estimate from all beside those from each."""
        values = np.array([one.values for one in repetitions])
        root = np.sqrt(len(repetitions))
        variances = [np.diag(one.covariance) for one in repetitions]
        factor = phase.total
        return cls(
            pooled=pooled,
            repetitions=tuple(repetitions),
            phase=phase,
            factor=factor,
            classical_std=estimate(model, factor).std,
            independent_std=np.sqrt(np.mean(variances, axis=0)) / root,
            scatter_std=(
                values.std(axis=0, ddof=1) / root
                if len(values) > 1
                else np.full(values.shape[1], np.nan)
            ),
        )

    def with_scatter(self) -> RepeatedEstimate:
        """The estimate with intervals no narrower than its repetitions scatter.

        Blocks of time are shared by the repetitions, and errors of opposite signs in some of them
        (a payload in every other one) cancel there.
        """
        values = np.array([one.values for one in self.repetitions])
        covariance = no_narrower(self.pooled.covariance, values)
        return replace(self, pooled=replace(self.pooled, covariance=covariance))

    @property
    def mean(self) -> Array:
        """Mean over the repetitions (p,), as in the paper's Table 2."""
        return np.asarray(np.mean([one.values for one in self.repetitions], axis=0))

    @property
    def std(self) -> Array:
        """Standard deviation over the repetitions (p,), NaN for one."""
        return np.asarray(self.scatter_std * np.sqrt(len(self.repetitions)))


def no_narrower(covariance: Array, values: Array) -> Array:
    """Covariance (p, p) with standard deviations of at least those of a mean of R values (R, p).

    As far as these are larger beyond chance: a few values scatter by more or less than they should.
    """
    freedom = len(values) - 1
    if freedom < 1:
        return covariance
    std = np.sqrt(np.diag(covariance))
    known = np.isfinite(std) & (std > 0.0)
    scatter = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    ratio = np.where(known, scatter / np.where(known, std, 1.0), 1.0)
    chance = np.sqrt(scipy.stats.chi2.ppf(_CERTAIN, freedom) / freedom)
    wider = np.where(ratio > chance, ratio, 1.0)
    return np.where(np.outer(known, known), covariance * np.outer(wider, wider), covariance)


def estimate_repetitions(
    model: RobotModel,
    recordings: Sequence[Samples],
    fit: Fit | None = None,
    *,
    each: Fit | None = None,
) -> RepeatedEstimate:
    """Estimate from each repetition and from all.

    Args:
        model: the robot.
        recordings: the repetitions.
        fit: the estimator; by default weighted least squares (eq. 4), which reads the samples
            once unless their condition demands QR.
        each: that of single repetitions, by default the same.

    Raises:
        IdentificationError: no repetitions, or one without a usable row.
    """
    if not recordings:
        raise IdentificationError("there are no repetitions to estimate from")

    def weighted(some: Sequence[Samples], factor: PhaseFactor) -> Estimate:
        return fit_least_squares(model, some, phase=factor)

    fit = weighted if fit is None else fit
    each = fit if each is None else each
    phase, repetitions = PhaseFactor.zero(model), []
    for samples in recordings:
        own = PhaseFactor.from_samples(model, samples)
        repetitions.append(each([samples], own))
        phase = phase + own
    return RepeatedEstimate.of(model, fit(recordings, phase), repetitions, phase)
