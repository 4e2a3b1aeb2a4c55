from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from planner.fourier import supremum

# Rounded, because the reference cannot divide by the very small; see the second example for those.
numbers = st.floats(-10.0, 10.0).map(lambda x: round(x, 6))


def largest_on(p: np.polynomial.Polynomial, start: float, stop: float) -> float:
    """The largest value at the ends and wherever a root of the slope may lie."""
    slope = p.deriv()
    size = np.max(np.abs(slope.coef))
    # Roots of a polynomial whose first coefficient is next to nothing are inexact. The largest
    # value is not below any value, so more places to look at do no harm.
    roots = [slope.trim(share * size).roots() for share in (0.0, 1e-5, 1e-3)]
    places = np.clip(np.concatenate([[start, stop], *(each.real for each in roots)]), start, stop)
    return float(np.max(p(places)))


@given(st.lists(numbers, min_size=1, max_size=5), numbers, st.floats(0.01, 10.0))
@example([0.0], 0.0, 1.0)
@example([5e-324, 1.0], 0.0, 1.0)
def test_is_never_below_the_largest_value_and_hardly_above(coefficients, start, length):
    p = np.polynomial.Polynomial(coefficients)
    stop = start + length
    far = max(abs(start), abs(stop))
    bounds = [sum(abs(c) * far**k for k, c in enumerate(p.deriv(order).coef)) for order in (0, 2)]
    found = supremum(p, start, stop, largest=bounds[0], curvature=bounds[1])
    exact = largest_on(p, start, stop)
    assert exact - 1e-13 * bounds[0] <= found <= exact + 2e-10 * bounds[0] + 1e-290


@given(st.floats(0.1, 0.9), st.floats(1e-4, 1e-2))
def test_a_narrow_peak_between_the_first_samples_is_found(where, width):
    def peak(t: np.ndarray) -> np.ndarray:
        return np.exp(-(((t - where) / width) ** 2))

    found = supremum(peak, 0.0, 1.0, largest=1.0, curvature=2.0 / width**2)
    assert found == pytest.approx(1.0, abs=2e-10)


def test_what_needs_too_many_samples_is_bounded_from_the_outset():
    for curvature in (1e20, np.inf, np.nan):
        assert supremum(np.sin, 0.0, 1e6, largest=1.5, curvature=curvature) == 1.5
