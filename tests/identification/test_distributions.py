"""Quantiles and tails are those of `scipy.stats`, and of each other."""

from __future__ import annotations

import numpy as np
from scipy import stats

from identification.distributions import (
    NORMAL_95,
    fisher_limit,
    fisher_tail,
    student_freedom,
    student_limit,
    student_tail,
)

VALUES = np.array([0.0, 0.3, 2.0, 9.0])


def test_tails_are_those_of_the_distributions() -> None:
    np.testing.assert_allclose(student_tail(VALUES, 7.0), stats.t.sf(VALUES, 7.0))
    np.testing.assert_allclose(fisher_tail(VALUES, 2.0, 30.0), stats.f.sf(VALUES, 2.0, 30.0))


def test_a_limit_is_exceeded_with_its_probability() -> None:
    shares = np.array([0.5, 0.05, 1e-3])
    np.testing.assert_allclose(student_tail(student_limit(shares, 9.0), 9.0), shares)
    np.testing.assert_allclose(fisher_tail(fisher_limit(shares, 3.0, 9.0), 3.0, 9.0), shares)


def test_degrees_of_freedom_are_those_of_a_limit() -> None:
    for freedom in (1.0, 4.5, 44.0, 1e4):
        limit = float(student_limit(0.025, freedom))
        np.testing.assert_allclose(student_freedom(0.025, limit), freedom, rtol=1e-6)
    assert student_freedom(0.025, 1.95) == student_freedom(0.025, -float(stats.norm.ppf(0.025)))
    assert student_freedom(0.025, 1.95) == np.inf
    assert student_freedom(0.025, NORMAL_95) > 1e4  # rounded to two digits
