"""Intervals of servo parameters in SI units, and which of them the motion determines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import student_limit
from identification.estimators.prior import DETERMINED_STD_RATIO
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
from identification.servo.servo_fit import ServoFit

_MAX_INTERVAL_FACTOR: Final = 2.0  # upper end over value, above which a parameter is not determined
_VANISHES: Final = np.array([name not in ABSENT for name in NAMES])  # without effect at zero
_NOT_NEGATIVE: Final = np.array([name != "offset" for name in NAMES])
_POWER: Final = np.array([term.torque for term in TERMS])


@dataclass(frozen=True, eq=False)
class ServoIntervals:
    """Values of n joints in SI units with ends of their 95 % intervals, each (n, P).

    Attributes:
        determined: whether the motion determines a parameter, not the prior: its interval ends
            within a factor of two, is clearly narrower than the prior's, and if the term
            is in some models only, unseen windows show it. Nor does a term that they do not show
            change it by more than that factor.
    """

    values: Array
    lower: Array
    upper: Array
    determined: NDArray[np.bool_]


def intervals_of(fit: ServoFit) -> ServoIntervals:
    """Return the intervals of a fit; for a term that is not shown, including no effect."""
    estimate = fit.estimate
    values = in_units(estimate.values)
    covariance = _covariances(fit)
    spread = np.sqrt(np.maximum(np.einsum("npp->np", covariance), 0.0))
    prior = _prior_spread(estimate)
    reach = reach_of(fit) * spread
    ends = [
        np.where(POSITIVE, values * np.exp(sign * np.minimum(reach, 700.0)), values + sign * reach)
        for sign in (-1.0, 1.0)
    ]
    narrow = np.where(POSITIVE, np.exp(np.minimum(reach, 700.0)) <= _MAX_INTERVAL_FACTOR, True)
    least, most = _changed_by_unseen(fit, covariance)
    narrow &= (least >= 1.0 / _MAX_INTERVAL_FACTOR) & (most <= _MAX_INTERVAL_FACTOR)
    determined = np.asarray(
        (spread <= DETERMINED_STD_RATIO * prior) & narrow & estimate.present & fit.shown
    )
    absent = without_absent(natural(estimate.coordinates), estimate.present)
    lower, upper = (np.where(estimate.present, end, absent) for end in ends)
    unseen = estimate.present & ~fit.shown
    without = without_absent(natural(estimate.coordinates), ~unseen)
    lower = np.where(_unseen(fit), 0.0, lower)
    lower = np.where(_NOT_NEGATIVE, np.maximum(lower, 0.0), lower)
    upper = np.where(unseen & np.isinf(without), np.inf, upper)
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


def _unseen(fit: ServoFit) -> NDArray[np.bool_]:
    """Return the terms of the model (n, P) that are not shown and may as well be zero."""
    return np.asarray(fit.estimate.present & ~fit.shown & _VANISHES)


def reach_of(fit: ServoFit) -> float:
    """Return the half-width of a 95 % interval in standard deviations."""
    return float(student_limit(0.025, max(1, fit.windows - 1)))


def widened_covariance(fit: ServoFit) -> Array:
    """Return the covariance of the coordinates and of the delay of the bus (n P + 1, n P + 1).

    Residuals of a window are alike for longer in some directions than in others, and what a model
    lacks may be alike in all windows of a motion. So what they add to the variance is in no
    direction less than its scatter when a window each is left out, or a quarter of all. And a
    term that is not shown may as well have no effect: other terms then take its place, as far as
    the fit lets them.
    """
    estimate = fit.estimate
    n, count = estimate.coordinates.shape
    widened = estimate.covariance.copy()
    unseen = _unseen(fit)
    for joint in range(n):
        own = np.flatnonzero(estimate.present[joint])
        places = joint * count + own
        inside = np.ix_(places, places)
        whole = estimate.covariance[inside]
        spread = estimate.prior.spread[joint, own]
        of_residuals = whole - (whole * spread**-2.0) @ whole
        for between in estimate.between[:, joint]:
            excess = _excess(of_residuals, between[np.ix_(own, own)])
            of_residuals = of_residuals + excess
            widened[inside] += excess
        for place in places[unseen[joint, own]]:
            # Of a logarithm, 1 is the whole effect, to first order.
            variance = widened[place, place]
            response = widened[:, place] / variance
            lacking = max(reach_of(fit) ** -2.0 - variance, 0.0)
            widened += lacking * np.outer(response, response)
    # No motion widens what is known before.
    prior = np.append(estimate.prior.spread.ravel(), np.inf)
    shrunk = np.minimum(1.0, prior / np.sqrt(np.maximum(np.diag(widened), 1e-300)))
    return np.asarray(widened * np.outer(shrunk, shrunk))


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


def _covariances(fit: ServoFit) -> Array:
    """Return covariances of the parameters of each joint (n, P, P), logarithms of positive ones."""
    estimate = fit.estimate
    n, count = estimate.coordinates.shape
    combinations = np.eye(count)
    combinations[_POWER == 1, PLACE["kp"]] -= 1.0
    covariance = widened_covariance(fit)
    covariances = []
    for joint in range(n):
        part = slice(joint * count, (joint + 1) * count)
        present = np.outer(estimate.present[joint], estimate.present[joint])
        whole = np.where(present, covariance[part, part], 0.0)
        covariances.append(combinations @ whole @ combinations.T)
    return np.array(covariances)


def _changed_by_unseen(fit: ServoFit, covariance: Array) -> tuple[Array, Array]:
    """Return factors (n, P) by which terms that are not shown may change each parameter.

    Between no effect of such a term and the largest that the motion or the prior leaves; other
    terms give way in proportion to the effect, not to its logarithm.
    """
    n, count, _ = covariance.shape
    least, most = np.ones((n, count)), np.ones((n, count))
    unseen = _unseen(fit)
    for joint, place in np.argwhere(unseen).tolist():
        variance = covariance[joint, place, place]
        response = np.where(POSITIVE, covariance[joint, :, place] / variance, 0.0)
        prior = fit.estimate.prior.spread[joint, place] ** -2.0
        shown = max(1.0 / variance - prior, 1e-12)
        reach = reach_of(fit)
        largest = min(np.expm1(reach * np.sqrt(variance)), reach / np.sqrt(shown))
        ends = np.stack([-response, largest * response])
        own = np.arange(count) == place
        least[joint] = np.where(own, least[joint], np.minimum(least[joint], 1.0 + ends.min(axis=0)))
        most[joint] = np.where(own, most[joint], np.maximum(most[joint], 1.0 + ends.max(axis=0)))
    return least, most


def _prior_spread(estimate: ServoEstimate) -> Array:
    own = estimate.prior.spread**2
    return np.sqrt(np.where(_POWER == 1, own + own[:, [PLACE["kp"]]], own))
