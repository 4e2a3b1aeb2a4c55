"""Cubic splines through samples are those of scipy."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from identification.signals.cubic_spline import MIN_SAMPLES, CubicSpline


@pytest.mark.parametrize("count", [MIN_SAMPLES, MIN_SAMPLES + 1, 300])
@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_are_those_of_scipy(count, derivative):
    rng = np.random.default_rng(count)
    time = np.cumsum(rng.uniform(0.5, 1.5, count))
    values = rng.normal(size=(count, 3))
    at = np.append(np.linspace(time[0] - 0.2, time[-1] + 0.2, 500), time)
    expected = scipy.interpolate.CubicSpline(time, values)(at, derivative)
    found = CubicSpline.through(time, values)(at, derivative)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-11)
