"""Intervals of servo parameters in SI units, and which of them the motion determines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import student_limit
from identification.servo.choice import ServoFit
from identification.servo.fit import ServoEstimate
from identification.servo.parameters import (
    ABSENT,
    NAMES,
    PLACE,
    POSITIVE,
    TERMS,
    in_units,
    natural,
    without_absent,
)

_LEARNT: Final = 0.5  # of the prior's deviation, above which the motion says little
_FACTOR: Final = 3.0  # upper end over value, above which a parameter is not determined
_POWER: Final = np.array([term.torque for term in TERMS])


@dataclass(frozen=True, eq=False)
class ServoIntervals:
    """Values of n joints in SI units with ends of their 95 % intervals, each (n, P).

    Attributes:
        determined: whether the motion determines a parameter, not the prior.
    """

    values: Array
    lower: Array
    upper: Array
    determined: NDArray[np.bool_]


def intervals_of(fit: ServoFit) -> ServoIntervals:
    """Return the intervals of a fit; that of a term that is not shown includes no effect."""
    estimate = fit.estimate
    values = in_units(estimate.values)
    spread = _spread(estimate)
    prior = _prior_spread(estimate)
    reach = student_limit(0.025, max(1, fit.windows - 1)) * spread
    ends = [
        np.where(POSITIVE, values * np.exp(sign * np.minimum(reach, 700.0)), values + sign * reach)
        for sign in (-1.0, 1.0)
    ]
    narrow = np.where(POSITIVE, np.exp(np.minimum(reach, 700.0)) <= _FACTOR, True)
    determined = np.asarray((spread <= _LEARNT * prior) & narrow & estimate.present & fit.shown)
    absent = without_absent(natural(estimate.coordinates), estimate.present)
    lower, upper = (np.where(estimate.present, end, absent) for end in ends)
    unseen = estimate.present & ~fit.shown
    without = without_absent(natural(estimate.coordinates), ~unseen)
    friction = np.array([name not in ABSENT for name in NAMES])
    lower = np.where(unseen & friction, 0.0, lower)
    upper = np.where(unseen & ~friction & np.isinf(without), np.inf, upper)
    return ServoIntervals(values, lower, upper, determined)


def sampled(
    coordinates: Array,
    present: NDArray[np.bool_],
    covariance: Array,
    freedom: int,
    count: int,
    seed: int,
) -> Array:
    """Return parameters in SI units (count, n, P) drawn from the posterior, correlated.

    Student's distribution, as of the intervals.

    Args:
        coordinates: of the estimate (n, P).
        present: terms of the model (n, P).
        covariance: of the coordinates and of the delay of the bus (n P + 1, n P + 1).
        freedom: windows that were fitted, less one.
        count: number of draws.
        seed: of them.
    """
    generator = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    shifts = generator.standard_normal((count, len(values))) @ root.T
    shifts *= np.sqrt(freedom / generator.chisquare(freedom, (count, 1)))
    samples = coordinates + shifts[:, :-1].reshape(count, *coordinates.shape)
    return in_units(without_absent(natural(samples), present))


def widened_covariance(estimate: ServoEstimate) -> Array:
    """Return the covariance of the coordinates and of the delay of the bus (n P + 1, n P + 1).

    Residuals of a window are alike for longer in some directions than in others. So what they add
    to the variance is in no direction less than its scatter when a window each is left out.
    """
    n, count = estimate.coordinates.shape
    widened = estimate.covariance.copy()
    for joint in range(n):
        places = joint * count + np.flatnonzero(estimate.present[joint])
        inside = np.ix_(places, places)
        own = np.ix_(places - joint * count, places - joint * count)
        whole = estimate.covariance[inside]
        spread = estimate.prior.spread[joint, places - joint * count]
        of_residuals = whole - (whole * spread**-2.0) @ whole
        widened[inside] += _excess(of_residuals, estimate.between[joint][own])
    return widened


def _excess(covariance: Array, other: Array) -> Array:
    """Return what is lacking of a covariance (k, k) to be no less than another in any direction."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    size = np.sqrt(np.maximum(values, 1e-12 * values.max(initial=0.0)))
    known = size > 0.0
    root = vectors[:, known] * size[known]
    inverse = vectors[:, known] / size[known]
    relative, directions = np.linalg.eigh(inverse.T @ other @ inverse)
    lacking = root @ directions
    return np.asarray((lacking * np.maximum(relative - 1.0, 0.0)) @ lacking.T)


def _spread(estimate: ServoEstimate) -> Array:
    """Return standard deviations of the parameters (n, P), logarithms of positive ones."""
    n, count = estimate.coordinates.shape
    combinations = np.eye(count)
    combinations[_POWER == 1, PLACE["kp"]] -= 1.0
    covariance = widened_covariance(estimate)
    variances = []
    for joint in range(n):
        part = slice(joint * count, (joint + 1) * count)
        present = np.outer(estimate.present[joint], estimate.present[joint])
        whole = np.where(present, covariance[part, part], 0.0)
        variances.append(np.einsum("pa,ab,pb->p", combinations, whole, combinations))
    return np.sqrt(np.maximum(variances, 0.0))


def _prior_spread(estimate: ServoEstimate) -> Array:
    own = estimate.prior.spread**2
    return np.sqrt(np.where(_POWER == 1, own + own[:, [PLACE["kp"]]], own))
