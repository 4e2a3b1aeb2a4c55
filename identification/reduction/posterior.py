"""Posterior of an arm's parameters: prior and sums over rows, with how strongly each counts."""

from __future__ import annotations

from dataclasses import dataclass, replace

from identification.arrays import Array
from identification.estimators.consistent import SolverError, consistent_values
from identification.estimators.prior import (
    BodyPrior,
    PosteriorEstimate,
    body_prior,
    design_effect_of,
    fit_posterior,
    posterior_values,
)
from identification.factor.factor import Factor
from identification.model.robot import RobotModel
from identification.selection.scores import Known
from identification.selection.settings import Strength


@dataclass(frozen=True, eq=False)
class Posterior:
    """Prior of an arm, and how strongly it counts."""

    model: RobotModel
    prior: BodyPrior
    design_effect: float  #: rows that count as one
    consistent: bool  #: whether parameters that no bodies have are excluded

    @classmethod
    def of(
        cls, model: RobotModel, factor: Factor, share: float, known: Known, strength: Strength
    ) -> Posterior:
        """Return the posterior of an arm by its fitted rows.

        Args:
            model: of the arm.
            factor: of the rows, by time.
            share: standard deviation of the described bodies, relative to these.
            known: mean and standard deviation of parameters that are known beforehand, by name.
            strength: of the prior against the data.
        """
        prior = body_prior(model, factor, share, known, wide_rotors=strength.wide_rotors)
        effect = design_effect_of(factor, prior.gaussian)
        return cls(model, prior.with_weight(strength.weight), effect, strength.consistent)

    @property
    def precision(self) -> Array:
        """Information of the prior, with the weight that it has against all rows (p, p)."""
        return self.design_effect * self.prior.belief.gaussian.information

    def believed(self, factor: Factor) -> Array:
        """Return the parameters (p,) by what is believed, without a stronger prior."""
        return posterior_values(factor, self.prior.belief.gaussian, self.design_effect)[0]

    def free(self, factor: Factor, share: float = 1.0) -> PosteriorEstimate:
        """Fit a factor that is this share of the rows, whatever bodies the parameters need."""
        effect = share * self.design_effect
        return fit_posterior(self.model, factor, self.prior.gaussian, effect)

    def weights(self, factor: Factor, share: float = 1.0) -> Array:
        """Return the weights of the joints (n,): inverse variances of their residuals."""
        return posterior_values(factor, self.prior.gaussian, share * self.design_effect)[1]

    def fit(self, factor: Factor, share: float = 1.0) -> PosteriorEstimate:
        """Fit a factor that is this share of the rows, with the prior counting as for all."""
        result = self.free(factor, share)
        if not self.consistent:
            return result
        values = self.values(factor, share)
        noise = factor.residual_rms(values)
        return replace(result, estimate=replace(result.estimate, values=values, noise_std=noise))

    def values(self, factor: Factor, share: float = 1.0) -> Array:
        """Return the parameters (p,) from a factor that is this share of the rows."""
        effect = share * self.design_effect
        values, weights = posterior_values(factor, self.prior.gaussian, effect)
        if not self.consistent:
            return values
        return consistent_values(self.model, factor, weights, values, self.prior, effect)

    def solved(self, factor: Factor) -> tuple[Posterior, PosteriorEstimate, SolverError | None]:
        """Fit a factor; if that fails, without restriction to possible bodies, with the error."""
        try:
            return self, self.fit(factor), None
        except SolverError as error:
            free = replace(self, consistent=False)
            return free, free.fit(factor), error
