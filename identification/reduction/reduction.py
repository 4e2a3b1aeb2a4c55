"""Recordings reduced to the sums that an estimate and its intervals need.

A recording is read once, whoever estimates: a single identification, a batch, or a campaign after
each repetition. Sums of recordings add; an estimate follows from them alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce as reduce_left
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.estimators.delay import factor_and_rates, rate_products
from identification.estimators.elasticity import ElasticTorque
from identification.estimators.friction_form import form_factor
from identification.estimators.prior import body_prior, posterior_values
from identification.factor.factor import Factor, mean_factor
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

MAX_UNMODELLED_REPETITIONS: Final = 3
"""Repetitions of one motion that are reduced to `Unmodelled` sums, which all of them share."""


@dataclass(frozen=True, eq=False)
class Unmodelled:
    """Sums with effects that are not in the model; they enter the intervals only."""

    forms: Factor  #: with further terms of friction, by time
    #: with the torque of elastic gears; None if positions may be measured behind the gears
    elastic: ElasticTorque | None

    def scaled(self, times: float) -> Unmodelled:
        """Return the sums with every row weighted by `times`."""
        elastic = None if self.elastic is None else self.elastic.scaled(times)
        return Unmodelled(self.forms.scaled(times), elastic)

    def __add__(self, other: Unmodelled) -> Unmodelled:
        """Return the sums over both."""
        elastic = self.elastic
        if elastic is not None and other.elastic is not None:
            elastic = elastic.plus(other.elastic)
        return Unmodelled(self.forms + other.forms, elastic or other.elastic)


@dataclass(frozen=True, eq=False)
class Reduction:
    """Sums over the fitted rows of one recording, or of several."""

    factor: Factor  #: by time
    #: products of the rows with their rates (n, p, p + 1), see
    #: :func:`identification.estimators.delay.rate_products`; None: the delay is known
    rates: Array | None = None
    unmodelled: Unmodelled | None = None  #: None: of none of the recordings

    @classmethod
    def total(cls, model: RobotModel, reductions: Iterable[Reduction]) -> Reduction:
        """Return the sum, of no recordings as well."""
        return sum(reductions, cls(Factor.zero(model)))

    def __add__(self, other: Reduction) -> Reduction:
        """Return the sums over both.

        Raises:
            IdentificationError: the two belong to different models.
        """
        rates = self.rates if other.rates is None else other.rates
        if self.rates is not None and other.rates is not None:
            rates = self.rates + other.rates
        unmodelled = self.unmodelled or other.unmodelled
        if self.unmodelled is not None and other.unmodelled is not None:
            unmodelled = self.unmodelled + other.unmodelled
        return Reduction(self.factor + other.factor, rates, unmodelled)

    @property
    def times(self) -> float:
        """Number of rows over the number of rows with unmodelled effects."""
        if self.unmodelled is None:
            return np.inf
        return float(self.factor.samples.sum()) / max(1, int(self.unmodelled.forms.samples.sum()))

    def for_all_rows(self) -> Reduction:
        """Return these sums with unmodelled effects that represent all rows.

        So that reductions of different motions add in the proportion of their rows.
        """
        if self.unmodelled is None or not self.unmodelled.forms.samples.any():
            return self
        return replace(self, unmodelled=self.unmodelled.scaled(self.times))


def reduce(
    model: RobotModel,
    versions: Sequence[Samples],
    shares: Sequence[float],
    *,
    uncertain_delay: bool,
    known: Mapping[str, tuple[float, float]],
    unmodelled: bool,
    elastic: bool,
) -> Reduction:
    """Reduce a recording.

    Args:
        model: of the arm.
        versions: the recording, smoothed once or several times.
        shares: weight of each version in the sums, together one.
        uncertain_delay: whether the sums by which a delay moves the parameters are needed.
        known: mean and standard deviation of parameters that are known beforehand, by name.
        unmodelled: whether the recording is one of those that show what the model lacks.
        elastic: whether positions are of motors, in front of elastic gears.
    """
    if uncertain_delay and not unmodelled:
        both = [factor_and_rates(model, samples) for samples in versions]
        rows = mean_factor([factor for factor, _ in both], shares)
        return Reduction(rows, np.tensordot(shares, [sums for _, sums in both], axes=1))
    if not unmodelled:
        return Reduction(mean_factor([Factor.by_time(model, each) for each in versions], shares))
    rows = mean_factor([form_factor(model, samples) for samples in versions], shares)
    # The rows without further terms of friction are part of those with them.
    factor = rows.restricted(np.arange(model.n_parameters))
    rates = None
    if uncertain_delay:
        rates = np.tensordot(shares, [rate_products(model, each) for each in versions], axes=1)
    if not factor.samples.any():
        return Reduction(factor, rates)
    torque = None
    if elastic:
        values, _ = posterior_values(factor, body_prior(model, factor, stated=known).gaussian)
        every = [
            ElasticTorque.of(model, samples, values).scaled(share)
            for samples, share in zip(versions, shares, strict=True)
        ]
        torque = reduce_left(ElasticTorque.plus, every)
    return Reduction(factor, rates, Unmodelled(rows, torque))
