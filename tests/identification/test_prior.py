from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.errors import IdentificationError
from identification.estimators.prior import GaussianPrior, fit_with_prior, nominal_prior, with_prior
from identification.factor.factor import Factor, estimate
from identification.model.robot import RobotModel
from sim_fixtures.ns16 import urdf_text
from tests.identification.two_link import MODEL, NOISE, P, coloured, one_sine, simulated, truth

ROTORS = {"I1m": (0.3, 0.2), "I2m": (0.1, 0.05)}
FRICTION = {"f0_1": (4.0, 2.0), "f0_2": (2.0, 1.0), "f1_1": (1.5, 1.0), "f1_2": (0.8, 0.5)}
KNOWN = ROTORS | FRICTION


def a_motion(duration=6.0, *, held_elbow=False):
    time = np.arange(0.0, duration, 5e-3)
    return one_sine(time, centre=np.array([0.0, 0.4]), held_elbow=held_elbow)


@cache
def noisy(held_elbow=False):
    return simulated(MODEL, truth(), a_motion(held_elbow=held_elbow), NOISE)


def some_covariance(seed, size=1.0):
    root = np.random.default_rng(seed).standard_normal((P, P))
    return size * (root @ root.T + 0.1 * np.eye(P))


def prior_of(mean, covariance):
    root = np.linalg.cholesky(covariance)
    return GaussianPrior.of_combinations(root, np.linalg.solve(root, mean), np.ones(len(mean)))


def independent(mean, std):
    return GaussianPrior.of_combinations(np.eye(len(mean)), mean, std)


class TestGaussianPrior:
    @given(seed=st.integers(0, 999), flat=st.integers(0, 3))
    def test_infinite_is_the_limit_of_large_deviations(self, seed, flat):
        random = np.random.default_rng(seed)
        combinations = np.hstack([np.eye(4), random.standard_normal((4, 3))])
        std = random.uniform(0.5, 2.0, 7)
        std[random.permutation(7)[:flat]] = np.inf
        prior = GaussianPrior.of_combinations(combinations, np.zeros(7), std)
        # Woodbury's identity in the limit of infinite variances.
        known, endless = combinations[:, np.isfinite(std)], combinations[:, np.isinf(std)]
        finite = np.linalg.inv((known * std[np.isfinite(std)] ** 2) @ known.T)
        seen = finite @ endless
        expected = finite - seen @ np.linalg.inv(endless.T @ seen) @ seen.T
        size = np.abs(finite).max()
        np.testing.assert_allclose(prior.root.T @ prior.root / size, expected / size, atol=1e-9)
        assert len(prior.root) == 4 - flat


class TestPosterior:
    @given(seed=st.integers(0, 999), size=st.floats(1e-3, 1e3))
    def test_it_is_that_of_the_textbook(self, seed, size):
        mean = np.random.default_rng(seed).standard_normal(P)
        covariance, weights = some_covariance(seed, size), 1.0 / NOISE**2
        factor = Factor.of(MODEL, noisy())
        equations, precision = factor.weighted(weights), np.linalg.inv(covariance)
        posterior = np.linalg.inv(equations.A + precision)
        expected = posterior @ (equations.b + precision @ mean)
        prior = prior_of(mean, covariance)
        for kind in (factor, Factor.of(MODEL, noisy(), "qr")):
            found = with_prior(MODEL, kind, prior, weights)
            np.testing.assert_allclose(found.estimate.values, expected, rtol=1e-6, atol=1e-7)
            np.testing.assert_allclose(found.estimate.std, np.sqrt(np.diag(posterior)), rtol=1e-6)
            assert found.estimate.undetermined == ()
            assert (found.ratio < 1.0).all()

    @pytest.mark.parametrize("storage", ["gram", "qr"])
    def test_an_infinite_prior_is_weighted_least_squares(self, storage):
        factor = Factor.of(MODEL, noisy(), storage)
        expected = estimate(MODEL, Factor.of(MODEL, noisy()))
        for std in (1e7, np.inf):
            prior = independent(np.full(P, 3.0), np.full(P, std))
            found = with_prior(MODEL, factor, prior)
            np.testing.assert_allclose(found.estimate.values, expected.values, rtol=1e-8)
            np.testing.assert_allclose(found.estimate.std, expected.std, rtol=1e-8)
            np.testing.assert_allclose(found.estimate.noise_std, expected.noise_std, rtol=1e-8)
            assert found.learned.all()

    @pytest.mark.parametrize("storage", ["gram", "qr"])
    def test_without_data_it_is_the_prior(self, storage):
        nothing = Factor.zero(MODEL, storage=storage)
        prior = nominal_prior(MODEL, known=KNOWN)
        found = with_prior(MODEL, nothing, prior)
        np.testing.assert_allclose(found.estimate.values, prior.mean)
        np.testing.assert_allclose(found.estimate.std, prior.std, rtol=1e-9)
        np.testing.assert_allclose(found.ratio, 1.0, rtol=1e-9)
        assert not found.learned.any()
        assert found.estimate.undetermined == ()

    def test_undetermined_parameters_keep_the_prior(self):
        prior = nominal_prior(MODEL, known=KNOWN)
        found = with_prior(MODEL, Factor.of(MODEL, noisy(held_elbow=True)), prior)
        at = {name: index for index, name in enumerate(found.estimate.names)}
        for name in ("f0_2", "f1_2"):  # the elbow stands still
            assert found.ratio[at[name]] == pytest.approx(1.0, rel=1e-9)
            assert found.estimate.values[at[name]] == pytest.approx(FRICTION[name][0], rel=1e-9)
            assert not found.learned[at[name]]
        assert found.ratio[at["f0_1"]] < 0.2
        assert found.learned[at["f0_1"]]
        assert found.estimate.undetermined == ()
        assert np.isfinite(found.estimate.std).all()
        # No parameter is less certain than before.
        assert (found.ratio <= 1.0 + 1e-9).all()

    def test_unknown_parameters_stay_at_the_prior_mean(self):
        prior = nominal_prior(MODEL, known=ROTORS)
        found = with_prior(MODEL, Factor.of(MODEL, noisy(held_elbow=True)), prior)
        assert set(found.estimate.undetermined) == {"f0_2", "f1_2"}
        assert np.isinf(found.estimate.std[-3])
        unknown = np.array([name in found.estimate.undetermined for name in found.estimate.names])
        np.testing.assert_array_equal(found.ratio[unknown], 1.0)
        np.testing.assert_array_equal(found.estimate.values[unknown], 0.0)

    def test_few_rows_require_weights(self):
        samples = noisy()
        few = replace(
            samples, usable=samples.usable & (np.arange(len(samples.torque)) % 200 == 7)[:, None]
        )
        prior = nominal_prior(MODEL, known=KNOWN)
        with pytest.raises(IdentificationError, match="too few"):
            with_prior(MODEL, Factor.of(MODEL, few), prior)
        found = with_prior(MODEL, Factor.of(MODEL, few), prior, 1.0 / NOISE**2)
        assert np.isfinite(found.estimate.values).all()

    @pytest.mark.parametrize("correlation", [0.0, 0.05])
    def test_95_percent_intervals_cover_90_to_99_percent(self, correlation):
        prior = nominal_prior(MODEL, known=KNOWN)
        spread = np.linalg.inv(prior.root)  # no flat direction
        motion = a_motion()
        inside, surprise, naive = [], [], []
        for seed in range(80):
            rng = np.random.default_rng(seed)
            values = prior.mean + spread @ rng.standard_normal(P)
            samples = simulated(MODEL, values, motion)
            samples.torque[:] += coloured(rng, len(motion.time), 5e-3, correlation)
            result = fit_with_prior(MODEL, [samples], prior)
            found, white = (
                result.estimate,
                with_prior(MODEL, Factor.of(MODEL, samples), prior).estimate,
            )
            inside.append(np.abs(found.values - values) < found.interval_factor * found.std)
            naive.append(np.abs(white.values - values) < 1.96 * white.std)
            surprise.append(result.normalized_change[np.isfinite(result.normalized_change)])
        assert 0.90 <= np.mean(inside) <= 0.99
        # The change by the data is what the prior allows.
        assert 0.85 < np.std(np.concatenate(surprise)) < 1.15
        if correlation:
            assert np.mean(naive) < 0.85
            assert result.design_effect > 3.0
        else:
            assert result.design_effect < 2.0

    def test_a_wrong_prior_is_detected(self):
        wrong = KNOWN | {"f0_1": (20.0, 1.0)}
        result = fit_with_prior(MODEL, [noisy()], nominal_prior(MODEL, known=wrong))
        at = result.estimate.names.index("f0_1")
        assert result.learned[at]
        assert result.normalized_change[at] < -4.0
        others = np.delete(result.normalized_change, at)
        assert np.nanmax(np.abs(others)) < 4.0


class TestNominalPrior:
    def test_it_is_that_of_sampled_arms(self):
        prior = nominal_prior(MODEL, 0.1, known=KNOWN)
        nominal = MODEL.nominal.reshape(2, 11)
        rng = np.random.default_rng(3)
        sampled = np.repeat(nominal[None], 20_000, axis=0)
        sampled[:, :, 10] = [0.3, 0.1] + np.array([0.2, 0.05]) * rng.standard_normal((20_000, 2))
        for link in range(2):
            for part in (slice(0, 6), slice(6, 9), slice(9, 10)):
                size = 0.1 * np.abs(nominal[link, part]).max()
                count = part.stop - part.start
                sampled[:, link, part] += size * rng.standard_normal((20_000, count))
        base = sampled.reshape(20_000, -1) @ MODEL.base.grouping.T
        rank = MODEL.base.rank
        np.testing.assert_allclose(
            prior.mean[:rank],
            MODEL.base.grouping
            @ np.where(np.arange(22) == 10, 0.3, np.where(np.arange(22) == 21, 0.1, MODEL.nominal)),
        )
        covariance = np.linalg.inv(prior.root.T @ prior.root)[:rank, :rank]
        scale = np.outer(prior.std[:rank], prior.std[:rank])
        assert np.abs((np.cov(base.T) - covariance) / scale).max() < 0.04
        np.testing.assert_allclose(prior.std[rank:], [2.0, 1.0, 1.0, 0.5])

    def test_rotors_and_friction_have_none(self):
        model = RobotModel.from_urdf(urdf_text())
        std = dict(zip(model.parameter_names, nominal_prior(model).std, strict=True))
        flat = {name for name, value in std.items() if np.isinf(value)}
        # A flat rotor makes only its own group flat.
        groups = {
            name
            for name, row in zip(model.base.names, model.base.grouping, strict=True)
            if any(row[model.layout.names.index(f"I{j}m")] != 0.0 for j in range(1, 7))
        }
        assert flat == groups | set(model.parameter_names[model.base.rank :])
        assert {"I3m", "I4m", "f0_1", "f2_6"} <= flat
        assert all(value > 0.0 for value in std.values())

    def test_a_urdf_without_inertia_has_none(self):
        bare = replace(MODEL, chain=replace(MODEL.chain, inertial=np.zeros((2, 10))))
        with pytest.raises(IdentificationError, match="no inertia"):
            nominal_prior(bare)

    def test_missing_moments_or_mass_are_scaled(self):
        inertial = MODEL.chain.inertial.copy()
        inertial[0, 6:9], inertial[1] = 0.0, 0.0
        model = replace(MODEL, chain=replace(MODEL.chain, inertial=inertial))
        prior = nominal_prior(model, known=KNOWN)
        assert np.isfinite(prior.std).all()
        assert np.all(prior.std > 0.0)
