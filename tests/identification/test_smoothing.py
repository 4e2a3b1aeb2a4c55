import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import BSpline
from scipy.signal import butter, sosfiltfilt

from identification.signals.smoothing import fit_smoothing_spline, low_pass


def noisy_sines(sigma, *, jitter=0.0):
    """Time and two channels of a few hertz."""
    rng = np.random.default_rng(3)
    time = np.arange(8000) * 1e-3 + jitter * rng.uniform(-1.0, 1.0, 8000)
    return time, sines(time) + sigma * rng.standard_normal((8000, 2))


def sines(time, derivative=0):
    w = 2.0 * np.pi * np.array([[0.7, 1.9], [2.3, 3.1]])
    a = np.array([[0.9, 0.4], [0.2, 0.3]])
    phase = w * time[:, None, None] + a + derivative * np.pi / 2.0
    return np.asarray((a * w**derivative * np.sin(phase)).sum(axis=1))


class TestLowPass:
    def test_it_is_a_zero_phase_butterworth(self):
        # |H|^2 of a third-order Butterworth is 1 / (1 + (w/w_c)^6), the smoother's own gain.
        time, values = noisy_sines(0.1)
        sections = butter(3, 6.0, fs=1000.0, output="sos")
        expected = sosfiltfilt(sections, values, axis=0)
        inner = slice(1000, -1000)
        np.testing.assert_allclose(low_pass(time, values, 6.0)[inner], expected[inner], atol=2e-4)

    @given(st.floats(1.0, 60.0), st.integers(0, 2**16))
    def test_it_is_linear_and_keeps_constants(self, bandwidth, seed):
        rng = np.random.default_rng(seed)
        time = np.arange(400) * 2e-3
        x, y = rng.standard_normal((2, 400, 3))
        combined = low_pass(time, 2.0 * x - 0.5 * y, bandwidth)
        apart = 2.0 * low_pass(time, x, bandwidth) - 0.5 * low_pass(time, y, bandwidth)
        np.testing.assert_allclose(combined, apart, atol=1e-9)
        np.testing.assert_allclose(low_pass(time, np.ones((400, 1)), bandwidth), 1.0, atol=1e-9)


class TestSmoothingSpline:
    @given(
        coefficients=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
        tolerance=st.floats(1e-12, 1e-2),
        seed=st.integers(0, 2**16),
    )
    def test_parabolas_pass_unchanged(self, coefficients, tolerance, seed):
        # The roughness of a parabola is zero.
        time = np.sort(np.random.default_rng(seed).uniform(0.0, 2.0, 300))
        polynomial = np.polynomial.Polynomial(coefficients)
        spline = fit_smoothing_spline(time, polynomial(time)[:, None], np.array([tolerance]))
        np.testing.assert_allclose(spline(time)[:, 0], polynomial(time), atol=1e-7)
        np.testing.assert_allclose(spline(time, 1)[:, 0], polynomial.deriv()(time), atol=1e-5)
        np.testing.assert_allclose(spline(time, 2)[:, 0], polynomial.deriv(2)(time), atol=1e-3)

    def test_quintics_are_reproduced_with_small_tolerance(self):
        time = np.linspace(0.0, 1.0, 400)
        polynomial = np.polynomial.Polynomial([0.2, -1.0, 3.0, 2.0, -4.0, 1.5])
        spline = fit_smoothing_spline(time, polynomial(time)[:, None], np.array([1e-24]))
        # Rounding, divided by the knot spacing once per derivative.
        for derivative, tolerance in ((0, 1e-12), (1, 1e-8), (2, 1e-4)):
            expected = polynomial.deriv(derivative)(time) if derivative else polynomial(time)
            np.testing.assert_allclose(spline(time, derivative)[:, 0], expected, atol=tolerance)

    @pytest.mark.parametrize(
        ("sigma", "jitter"), [(1e-6, 0.0), (1e-4, 0.0), (1e-2, 0.0), (1e-4, 4e-4)]
    )
    def test_the_mean_squared_residual_is_the_tolerance(self, sigma, jitter):
        time, values = noisy_sines(sigma, jitter=jitter)
        spline = fit_smoothing_spline(time, values, np.full(2, sigma**2))
        measured = np.mean((values - spline(time)) ** 2, axis=0)
        np.testing.assert_allclose(measured, sigma**2, rtol=1e-3)
        if jitter:
            error = (spline(time, 2) - sines(time, 2))[200:-200]
            assert np.std(error) < 0.01 * np.std(sines(time, 2))

    def test_derivatives_are_better_than_differences(self):
        sigma = 1e-5
        time, values = noisy_sines(sigma)
        spline = fit_smoothing_spline(time, values, np.full(2, sigma**2))
        inner = slice(200, -200)
        error = [np.std((spline(time, d) - sines(time, d))[inner]) for d in range(3)]
        assert error[0] < 0.4 * sigma
        assert error[1] < 2e-3 * np.std(sines(time, 1))
        assert error[2] < 5e-3 * np.std(sines(time, 2))
        differences = np.gradient(np.gradient(values, time, axis=0), time, axis=0)
        assert np.std((differences - sines(time, 2))[inner]) > 50 * error[2]

    def test_it_minimises_squares_plus_roughness(self):
        # Small enough for a dense solution by SciPy splines and quadrature.
        rng = np.random.default_rng(5)
        time = np.sort(rng.uniform(0.0, 1.0, 40))
        values = np.sin(5.0 * time) + 0.05 * rng.standard_normal(40)
        spline = fit_smoothing_spline(time, values[:, None], np.array([0.05**2]))
        k = len(spline.coefficients)
        knots = spline.start + spline.spacing * np.arange(-5, k + 1)
        basis = BSpline(knots, np.eye(k), 5)
        third = basis.derivative(3)
        roughness = np.zeros((k, k))
        for i in range(k):
            for j in range(max(0, i - 5), i + 1):
                pieces = [
                    quad(lambda t, i=i, j=j: third(t)[i] * third(t)[j], *knots[p : p + 2])[0]
                    for p in range(max(i, 5), min(j + 6, k))
                ]
                roughness[i, j] = roughness[j, i] = sum(pieces)
        density = len(time) / (time[-1] - time[0])
        penalty = density / (2.0 * np.pi * spline.bandwidth[0]) ** 6
        rows = basis(time)
        dense = np.linalg.solve(rows.T @ rows + penalty * roughness, rows.T @ values)
        np.testing.assert_allclose(spline(time)[:, 0], rows @ dense, atol=1e-9)

    def test_knots_are_refined_to_the_tolerance(self):
        # 120 Hz at 1 kHz: one knot per four samples cannot follow, one per sample can.
        time = np.arange(2000) * 1e-3
        values = np.sin(2.0 * np.pi * 120.0 * time)[:, None]
        spline = fit_smoothing_spline(time, values, np.array([1e-8]))
        assert spline.spacing < 3e-3
        assert np.mean((values - spline(time)) ** 2) <= 1.001e-8
