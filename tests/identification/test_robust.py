import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from identification import Factor, Huber, Tukey, estimate, robust_estimate
from identification.estimators.losses import Loss
from tests.identification.two_link import (
    MODEL,
    NOISE,
    P,
    a_motion,
    coloured,
    gaussian,
    recording,
    truth,
)

LOSSES = [Huber(), Tukey()]


def with_outliers(rng, error, share, size):
    """Add errors of `size` standard deviations and one sign to a share of the rows."""
    bad = rng.random(error.shape) < share
    return np.where(bad, size * NOISE * rng.uniform(0.5, 1.5, error.shape), error)


def distance(values, samples):
    """Return the rms error in standard deviations of a fit to good rows."""
    information = Factor.of(MODEL, samples).weighted(1.0 / NOISE**2).A
    off = values - truth()
    return float(np.sqrt(off @ information @ off / P))


class TestLosses:
    @pytest.mark.parametrize("loss", [Loss(), *LOSSES, Huber(0.7), Tukey(3.0)])
    @given(x=st.floats(-1e6, 1e6))
    def test_weights_decrease_from_one_to_zero(self, loss, x):
        one, further = loss.weight(np.array([x])), loss.weight(np.array([1.1 * x]))
        assert 0.0 <= further[0] <= one[0] <= 1.0
        assert loss.weight(np.array([-x])) == one
        assert loss.weight(np.zeros(1)) == 1.0
        assert not Tukey().weight(np.array([np.inf])).any()

    @pytest.mark.parametrize("loss", [Loss(), *LOSSES])
    def test_the_slope_is_the_derivative_of_weight_times_residual(self, loss):
        x = np.linspace(-7.0, 7.0, 1401)
        x = x[np.abs(np.abs(x) - 1.345) > 0.01]  # Huber's has a corner there
        h = 1e-6
        numeric = ((x + h) * loss.weight(x + h) - (x - h) * loss.weight(x - h)) / (2.0 * h)
        np.testing.assert_allclose(loss.slope(x), numeric, atol=1e-4)


class TestRobustEstimate:
    @pytest.mark.parametrize("loss", LOSSES, ids=["huber", "tukey"])
    @given(seed=st.integers(0, 2**16))
    @settings(max_examples=8)
    def test_gaussian_noise_gives_nearly_least_squares(self, loss, seed):
        motion = a_motion(5.0)
        samples = recording(gaussian(np.random.default_rng(seed), motion), motion)
        robust = robust_estimate(MODEL, [samples], loss)
        ordinary = estimate(MODEL, Factor.of(MODEL, samples))
        # 95 % efficiency: the two differ by sqrt(1/0.95 - 1) = 0.23 standard deviations.
        assert (
            np.sqrt(np.mean(((robust.estimate.values - ordinary.values) / ordinary.std) ** 2)) < 0.6
        )
        np.testing.assert_allclose(robust.estimate.noise_std, NOISE, rtol=0.12)
        assert robust.converged
        assert robust.outlying.max() < 0.002

    @pytest.mark.parametrize("loss", LOSSES, ids=["huber", "tukey"])
    @given(seed=st.integers(0, 2**16), size=st.floats(20.0, 300.0))
    @settings(max_examples=8)
    def test_outliers_have_little_effect(self, loss, seed, size):
        motion, rng = a_motion(5.0), np.random.default_rng(seed)
        samples = recording(with_outliers(rng, gaussian(rng, motion), 0.05, size), motion)
        robust = robust_estimate(MODEL, [samples], loss)
        ordinary = estimate(MODEL, Factor.of(MODEL, samples))
        error = distance(robust.estimate.values, samples)
        assert robust.converged
        assert error < distance(ordinary.values, samples) / 2.0
        assert error < 2.5
        np.testing.assert_allclose(robust.outlying, 0.05, atol=0.025)

    def test_tukey_ignores_outliers_of_one_sign(self):
        motion, rng = a_motion(), np.random.default_rng(2)
        bad = recording(with_outliers(rng, gaussian(rng, motion), 0.10, 40.0), motion)
        ordinary = distance(estimate(MODEL, Factor.of(MODEL, bad)).values, bad)
        huber, tukey = (
            distance(robust_estimate(MODEL, [bad], loss).estimate.values, bad) for loss in LOSSES
        )
        assert tukey < huber < ordinary
        assert tukey < 1.5

    @pytest.mark.parametrize("loss", LOSSES, ids=["huber", "tukey"])
    def test_it_minimises_the_loss(self, loss):
        motion, rng = a_motion(2.0), np.random.default_rng(3)
        samples = recording(with_outliers(rng, gaussian(rng, motion), 0.05, 15.0), motion)
        result = robust_estimate(MODEL, [samples], loss)
        rows = MODEL.regressor(*motion[1:]).dense(P)
        scale, usable = result.estimate.noise_std, samples.usable

        def cost(values):
            x = (samples.torque - rows @ values) / scale
            if isinstance(loss, Huber):
                k = loss.tuning
                rho = np.where(np.abs(x) <= k, 0.5 * x**2, k * np.abs(x) - 0.5 * k**2)
            else:
                assert isinstance(loss, Tukey)
                inside = np.minimum((x / loss.tuning) ** 2, 1.0)
                rho = loss.tuning**2 / 6.0 * (1.0 - (1.0 - inside) ** 3)
            psi = np.where(usable, loss.weight(x) * x / scale, 0.0)
            return float(rho[usable].sum()), -np.einsum("mj,mjp->p", psi, rows)

        start = result.estimate.values
        best, gradient = cost(start)
        deviations = result.estimate.std
        assert np.abs(gradient * deviations).max() < 1e-3
        away = start + 0.5 * deviations * rng.standard_normal(P)
        found = minimize(cost, away, jac=True, method="L-BFGS-B", options={"maxiter": 3000})
        assert best <= found.fun + 1e-6 * abs(best)
        middle = [
            np.median(np.abs((samples.torque - rows @ start)[usable[:, j], j])) for j in (0, 1)
        ]
        np.testing.assert_allclose(scale, np.array(middle) / 0.67449, rtol=0.02)

    @pytest.mark.parametrize("loss", LOSSES, ids=["huber", "tukey"])
    @pytest.mark.parametrize("correlation", [0.0, 0.05])
    def test_95_percent_intervals_cover_90_to_99_percent(self, loss, correlation):
        motion = a_motion()
        inside = []
        for seed in range(40):
            rng = np.random.default_rng(seed)
            error = coloured(rng, len(motion.time), 5e-3, correlation)
            bad = rng.random(error.shape) < 0.03
            error = np.where(bad, 30.0 * NOISE * rng.standard_normal(error.shape), error)
            result = robust_estimate(MODEL, [recording(error, motion)], loss).estimate
            inside.append(np.abs(result.values - truth()) < result.interval_factor * result.std)
        assert 0.90 <= np.mean(inside) <= 0.99

    def test_exact_data_are_recovered(self):
        motion = a_motion(3.0)
        samples = recording(np.zeros((len(motion.time), 2)), motion)
        samples.torque[::40] += 500.0
        result = robust_estimate(MODEL, [samples], Tukey())
        np.testing.assert_allclose(result.estimate.values, truth(), rtol=1e-6)

    def test_a_resting_joint_has_no_scale(self):
        motion = a_motion(4.0)
        samples = recording(gaussian(np.random.default_rng(6), motion), motion)
        samples.usable[:, 1] = False
        result = robust_estimate(MODEL, [samples])
        assert np.isnan(result.estimate.noise_std[1])
        assert np.isnan(result.outlying[1])
        assert {"f0_2", "f1_2"} <= set(result.estimate.undetermined)
        assert np.isinf(result.estimate.std[result.estimate.names.index("f0_2")])
        assert "f0_1" not in result.estimate.undetermined

    def test_missing_convergence_is_reported(self):
        motion, rng = a_motion(3.0), np.random.default_rng(7)
        samples = recording(with_outliers(rng, gaussian(rng, motion), 0.05, 30.0), motion)
        result = robust_estimate(MODEL, [samples], most_iterations=1)
        assert not result.converged
        assert "NOT converged" in result.estimate.method
        assert "Huber" in result.estimate.method

    def test_many_outliers_mean_a_wrong_model(self):
        motion, rng = a_motion(5.0), np.random.default_rng(11)
        error = gaussian(rng, motion)
        # The elbow's friction in one direction of some poses is not in the model.
        error[:, 1] += 3.0 * (motion.position[:, 1] > 0.3) * (motion.velocity[:, 1] > 0.0)
        result = robust_estimate(MODEL, [recording(error, motion)], Tukey())
        assert result.doubtful.tolist() == [False, True]
