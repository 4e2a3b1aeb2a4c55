"""Arms of one type: one with little data borrows from its siblings, as much as they are alike."""

from __future__ import annotations

import numpy as np
import pytest

from identification.estimators.siblings import MIN_ESTIMATES, with_siblings
from identification.factor.estimate import Estimate
from identification.factor.estimation_method import EstimationMethod, LeastSquares

MEAN = np.array([10.0, 5.0, 2.0])
SPREAD = np.array([1.0, 0.1, 0.4])
CORRELATED = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, 0.2], [0.0, 0.2, 1.0]])


def estimated(values, std, *, undetermined=()):
    covariance = np.outer(std, std) * CORRELATED
    for k in undetermined:
        covariance[k] = covariance[:, k] = 0.0
        covariance[k, k] = np.inf
    return Estimate(
        names=("a", "b", "c"),
        units=("1",) * 3,
        values=values,
        covariance=covariance,
        noise_std=np.ones(1),
        samples=np.array([100]),
        method=EstimationMethod(LeastSquares()),
        condition=1.0,
        undetermined=tuple("abc"[k] for k in undetermined),
    )


def type_of(random, count, std):
    """True parameters of the arms of a type, and an estimate of each."""
    true = MEAN + SPREAD * random.standard_normal((count, 3))
    root = np.linalg.cholesky(np.outer(std, std) * CORRELATED)
    measured = [each + root @ random.standard_normal(3) for each in true]
    return true, [estimated(values, std) for values in measured]


@pytest.mark.long
def test_the_spread_between_arms_is_estimated():
    spreads = []
    for seed in range(20):
        _, estimates = type_of(np.random.default_rng(seed), 20, np.array([0.3, 0.3, 0.1]))
        spreads.append(with_siblings(estimates).spread)
    np.testing.assert_allclose(np.mean(np.square(spreads), axis=0), SPREAD**2, rtol=0.3, atol=0.02)


@pytest.mark.long
@pytest.mark.parametrize("count", [4, 10, 20])
def test_values_are_nearer_to_the_truth_and_intervals_cover_it(count):
    """At least 95 %, also where the spread is smaller than the errors."""
    std = np.array([1.0, 0.5, 0.4])
    errors = []
    alone = []
    inside = []
    for seed in range(60):
        true, estimates = type_of(np.random.default_rng(seed), count, std)
        found = with_siblings(estimates).estimates
        for each, single, truth in zip(found, estimates, true, strict=True):
            errors.append(each.values - truth)
            alone.append(single.values - truth)
            inside.append(np.abs(each.values - truth) <= 1.96 * each.std)
    ratio = np.std(errors, axis=0) / np.std(alone, axis=0)
    assert (ratio < [0.95, 0.9, 0.95]).all()
    assert (np.mean(inside, axis=0) > 0.95 - 3.0 * np.sqrt(0.05 * 0.95 / (60 * count))).all()


def test_an_arm_with_much_data_keeps_its_own():
    random = np.random.default_rng(1)
    _, estimates = type_of(random, 8, np.full(3, 1e-4))
    for each, single in zip(with_siblings(estimates).estimates, estimates, strict=True):
        np.testing.assert_allclose(each.values, single.values, atol=1e-4)


def test_what_an_arm_does_not_determine_its_siblings_say():
    random = np.random.default_rng(2)
    true, estimates = type_of(random, 12, np.full(3, 0.05))
    poor = estimated(np.array([true[0, 0], 77.0, true[0, 2]]), np.full(3, 0.05), undetermined=(1,))
    found = with_siblings([poor, *estimates[1:]])
    first = found.estimates[0]
    assert first.undetermined == ()
    assert abs(first.values[1] - MEAN[1]) < 0.3
    assert first.std[1] == pytest.approx(SPREAD[1], rel=0.6)


def test_what_no_arm_determines_stays_undetermined():
    random = np.random.default_rng(3)
    poor = [
        estimated(MEAN + 0.1 * random.standard_normal(3), np.full(3, 0.1), undetermined=(2,))
        for _ in range(5)
    ]
    found = with_siblings(poor)
    assert np.isnan(found.spread[2])
    assert all(each.undetermined == ("c",) and np.isinf(each.std[2]) for each in found.estimates)


def test_of_too_few_arms_there_is_none():
    _, estimates = type_of(np.random.default_rng(0), MIN_ESTIMATES - 1, np.ones(3))
    assert with_siblings(estimates) is None
