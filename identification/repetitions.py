"""One motion, executed many times: an estimate from each, and one from all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.covariance import PhaseFactor, with_block_covariance
from identification.errors import IdentificationError
from identification.estimation import Estimate, estimate, joint_weights
from identification.factor import Factor
from identification.model import RobotModel
from identification.preprocessing import Samples

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RepeatedEstimate:
    """Estimates over R repetitions of one motion.

    Attributes:
        pooled: from the sum of all factors. This is the result. Its covariance is clustered by
            time of the motion, so that an error of the model that repeats is not averaged away.
        repetitions: from each alone (eq. 4), with the covariance of its own blocks.
        factor: sum of all factors.
        classical_std: of the pooled estimate if residuals were white (p,).
        independent_std: of the pooled estimate if repetitions were independent: root mean square
            of the repetitions' own standard deviations over sqrt(R) (p,).
        scatter_std: standard deviation over the repetitions over sqrt(R) (p,): what noise alone
            does, NaN for one repetition.
    """

    pooled: Estimate
    repetitions: tuple[Estimate, ...]
    factor: Factor
    classical_std: Array
    independent_std: Array
    scatter_std: Array

    @property
    def mean(self) -> Array:
        """Mean over the repetitions (p,), as in the paper's Table 2."""
        return np.asarray(np.mean([one.values for one in self.repetitions], axis=0))

    @property
    def std(self) -> Array:
        """Standard deviation over the repetitions (p,), NaN for one."""
        return np.asarray(self.scatter_std * np.sqrt(len(self.repetitions)))


def estimate_repetitions(model: RobotModel, recordings: Iterable[Samples]) -> RepeatedEstimate:
    """Estimate from each repetition and from all; samples are read once, one at a time.

    Raises:
        IdentificationError: no repetitions, or one without a usable row.
    """
    phase: PhaseFactor | None = None
    repetitions = []
    for samples in recordings:
        own = PhaseFactor.from_samples(model, samples)
        weights = joint_weights(own.total)
        repetitions.append(with_block_covariance(estimate(model, own.total, weights), own, weights))
        phase = own if phase is None else phase + own
    if phase is None:
        raise IdentificationError("there are no repetitions to estimate from")
    factor = phase.total
    weights = joint_weights(factor)
    classical = estimate(model, factor, weights)
    values = np.array([one.values for one in repetitions])
    root = np.sqrt(len(repetitions))
    variances = [np.diag(one.covariance) for one in repetitions]
    return RepeatedEstimate(
        pooled=with_block_covariance(classical, phase, weights),
        repetitions=tuple(repetitions),
        factor=factor,
        classical_std=classical.std,
        independent_std=np.sqrt(np.mean(variances, axis=0)) / root,
        scatter_std=(
            values.std(axis=0, ddof=1) / root
            if len(values) > 1
            else np.full(values.shape[1], np.nan)
        ),
    )
