"""Quantiles and tails are those of `scipy.stats`, and of each other."""

from __future__ import annotations

import numpy as np
from scipy import stats

from identification.distributions import fisher_limit, fisher_tail, student_limit, student_tail

VALUES = np.array([0.0, 0.3, 2.0, 9.0])


def test_tails_are_those_of_the_distributions() -> None:
    np.testing.assert_allclose(student_tail(VALUES, 7.0), stats.t.sf(VALUES, 7.0))
    np.testing.assert_allclose(fisher_tail(VALUES, 2.0, 30.0), stats.f.sf(VALUES, 2.0, 30.0))


def test_a_limit_is_exceeded_with_its_probability() -> None:
    shares = np.array([0.5, 0.05, 1e-3])
    np.testing.assert_allclose(student_tail(student_limit(shares, 9.0), 9.0), shares)
    np.testing.assert_allclose(fisher_tail(fisher_limit(shares, 3.0, 9.0), 3.0, 9.0), shares)
