"""Covariance, robust estimates, and estimates with a prior: intervals cover, limits are known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from identification.errors import IdentificationError
from identification.estimators.covariance import cluster_covariance, spread
from identification.estimators.least_squares import estimate_repetitions
from identification.estimators.losses import Huber, Loss, Tukey
from identification.estimators.prior import GaussianPrior, fit_with_prior, nominal_prior, with_prior
from identification.estimators.robust import robust_estimate
from identification.factor.factor import Factor, NormalEquations, estimate, solve
from tests.identification.two_link import (
    MODEL,
    NOISE,
    P,
    a_motion,
    coloured,
    gaussian,
    one_sine,
    recording,
    simulated,
    truth,
)


class TestRepeatedRecordings:
    def test_a_repeated_error_is_not_averaged(self):
        motion = a_motion()
        rng = np.random.default_rng(3)
        repeated = coloured(rng, len(motion.time), 5e-3, 0.05)
        runs = [
            recording(repeated + 0.1 * NOISE * rng.standard_normal(repeated.shape), motion)
            for _ in range(16)
        ]
        one, many = estimate_repetitions(MODEL, runs[:1]), estimate_repetitions(MODEL, runs)
        # Sixteen repetitions of one error count as one, unlike their scatter.
        np.testing.assert_allclose(many.pooled.std, one.pooled.std, rtol=0.35)
        assert np.median(many.std / 4.0 / many.pooled.std) < 0.1
        error = np.abs(many.pooled.values - truth())
        assert np.mean(error < many.pooled.interval_factor * many.pooled.std) > 0.85

    def test_they_are_added_at_equal_times_of_the_motion(self):
        """The same motion with another clock."""
        motion = a_motion(4.0)
        early = recording(np.zeros((len(motion.time), 2)), motion)
        late = replace(
            early,
            motion=motion._replace(time=motion.time + 7.3),
            origin=early.origin + 7.3,
        )
        one, two = (Factor.by_time(MODEL, samples) for samples in (early, late))
        for both, own in zip((one + two).gram, one.gram, strict=True):
            np.testing.assert_allclose(both, 2.0 * own, rtol=1e-9, atol=1e-8)


class TestBlocks:
    @pytest.mark.parametrize("correlation", [0.0, 0.02, 0.05, 0.1])
    def test_95_percent_intervals_cover_90_to_99_percent(self, correlation):
        motion = a_motion()
        honest, classical = [], []
        for seed in range(120):
            noise = coloured(np.random.default_rng(seed), len(motion.time), 5e-3, correlation)
            result = estimate_repetitions(MODEL, [recording(noise, motion)])
            error = np.abs(result.pooled.values - truth())
            honest.append(error < result.pooled.interval_factor * result.pooled.std)
            classical.append(error < 1.96 * result.classical_std)
        assert 0.90 <= np.mean(honest) <= 0.99
        if correlation >= 0.02:
            assert np.mean(classical) < 0.75

    def test_leverage_correction_is_leaving_out_one_block(self):
        # CR3: corrected score is A times the change without the block.
        motion = a_motion(4.0)
        noise = coloured(np.random.default_rng(9), len(motion.time), 5e-3, 0.02)
        phase = Factor.by_time(MODEL, recording(noise, motion))
        weights = 1.0 / NOISE**2
        weighted = phase.by_block(weights)
        a_blocks, b_blocks = weighted[:, :-1, :-1], weighted[:, :-1, -1]
        a, b = a_blocks.sum(axis=0), b_blocks.sum(axis=0)
        values = np.linalg.solve(a, b)
        scores = b_blocks - a_blocks @ values
        np.testing.assert_allclose(phase.scores(weights, values), scores, atol=1e-8)
        without = np.linalg.solve(a - a_blocks, (b - b_blocks)[:, :, None])[:, :, 0]
        moved = values - without
        rows = spread(a_blocks, scores, solve(phase.weighted(weights)).root)
        np.testing.assert_allclose(rows.T @ rows, moved.T @ moved, rtol=1e-9)

    def test_variance_determined_by_few_blocks_is_correct(self):
        """The elbow moves for 0.2 s only, in two blocks with almost no residual."""
        motion = a_motion()
        at = np.clip((motion.time - 5.0) / 0.2, 0.0, 1.0)
        for array, own in zip(
            motion[1:4],
            (
                0.6 * (10 * at**3 - 15 * at**4 + 6 * at**5),
                3.0 * (30 * at**2 - 60 * at**3 + 30 * at**4),
                15.0 * (60 * at - 180 * at**2 + 120 * at**3),
            ),
            strict=True,
        ):
            array[:, 1] = own
        inside, alone, classical = [], [], []
        for seed in range(150):
            noise = coloured(np.random.default_rng(seed), len(motion.time), 5e-3, 0.05)
            result = estimate_repetitions(MODEL, [recording(noise, motion)])
            pooled = result.pooled
            assert not pooled.undetermined
            inside.append(np.abs(pooled.values - truth()) < pooled.interval_factor * pooled.std)
            alone.append(pooled.std)
            classical.append(result.classical_std)
        elbow = [MODEL.parameter_names.index(name) for name in ("f0_2", "f1_2", "I2m")]
        covered = np.mean(inside, axis=0)
        assert 0.90 <= covered.mean() <= 0.99
        assert covered[elbow].min() > 0.85
        assert np.all(np.median(np.array(alone) / classical, axis=0)[elbow] > 1.0)

    @pytest.mark.parametrize("shared", [0.0, 0.09])
    def test_correlation_of_neighbouring_blocks_counts(self, shared):
        """Mean of blocks that are correlated with the next one."""
        rng = np.random.default_rng(3)
        blocks, k = 300, 40
        weight = (1.0 - np.sqrt(1.0 - 4.0 * shared**2)) / (2.0 * shared) if shared else 0.0
        white = rng.standard_normal((blocks + 1, k)) / np.sqrt(blocks * (1.0 + weight**2))
        scores = white[1:] + weight * white[:-1]
        information = np.tile(np.eye(k) / blocks, (blocks, 1, 1))
        solution = solve(NormalEquations(np.eye(k), scores.sum(axis=0)))
        found = cluster_covariance(information, scores, solution)
        assert found.blocks == blocks // 2
        assert np.trace(found.covariance) / k == pytest.approx(1.0 + 2.0 * shared, rel=0.05)


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


ROTORS = {"I1m": (0.3, 0.2), "I2m": (0.1, 0.05)}
FRICTION = {"f0_1": (4.0, 2.0), "f0_2": (2.0, 1.0), "f1_1": (1.5, 1.0), "f1_2": (0.8, 0.5)}
KNOWN = ROTORS | FRICTION


def one_sine_each(duration=6.0, *, held_elbow=False):
    time = np.arange(0.0, duration, 5e-3)
    return one_sine(time, centre=np.array([0.0, 0.4]), held_elbow=held_elbow)


@cache
def noisy(held_elbow=False):
    return simulated(MODEL, truth(), one_sine_each(held_elbow=held_elbow), NOISE)


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

    @pytest.mark.parametrize("correlation", [0.0, 0.05])
    def test_95_percent_intervals_cover_90_to_99_percent(self, correlation):
        prior = nominal_prior(MODEL, known=KNOWN)
        spread = np.linalg.inv(prior.root)  # no flat direction
        motion = one_sine_each()
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

    def test_a_urdf_without_inertia_has_none(self):
        bare = replace(MODEL, chain=replace(MODEL.chain, inertial=np.zeros((2, 10))))
        with pytest.raises(IdentificationError, match="no inertia"):
            nominal_prior(bare)
