"""How the parameters were estimated, as plain numbers and words."""

from __future__ import annotations

from hil.results import EndogeneityResult, EstimatorResult, UncertaintyResult
from identification import RobotModel

from .estimating import Estimation
from .options import ESTIMATORS


def estimator_result(model: RobotModel, estimation: Estimation) -> EstimatorResult:
    """Name, words, and the prior that "learned from the data" is measured against."""
    posterior, pooled = estimation.posterior, estimation.result.pooled
    return EstimatorResult(
        name=estimation.estimator,
        words=ESTIMATORS[estimation.estimator]
        if estimation.estimator != "auto"
        else estimation.result.pooled.method,
        prior=posterior if isinstance(posterior, str) else posterior.words,
        condition=pooled.condition,
        grouping=model.base.explanation(),
    )


def endogeneity_result(estimation: Estimation) -> EndogeneityResult | None:
    """Durbin-Wu-Hausman test, None where there was none."""
    test = estimation.endogeneity
    if isinstance(test, str):
        return None
    return EndogeneityResult(
        sentence=test.words,
        biased=test.biased,
        statistic=test.statistic,
        p_value=test.p_value,
        degrees_of_freedom=test.freedom,
        noise=test.noise.tolist(),
        shifted=list(test.shifted),
        shift=test.shift.tolist(),
    )


def uncertainty_result(estimation: Estimation) -> UncertaintyResult:
    """Standard deviations by every route that was taken."""
    result = estimation.result
    pooled, many = result.pooled, len(result.repetitions) > 1
    by_posterior = estimation.estimator == "prior"
    reported = pooled.std.tolist()
    return UncertaintyResult(
        reported="posterior" if by_posterior else "phase_clustered",
        method=pooled.method,
        interval_factor=pooled.interval_factor,
        least_squares=result.classical_std.tolist(),
        independent_repetitions=result.independent_std.tolist() if many else None,
        phase_clustered=None if by_posterior else reported,
        scatter_of_mean=result.scatter_std.tolist() if many else None,
        posterior=reported if by_posterior else None,
    )
