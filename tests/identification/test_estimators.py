"""Robust, consistent and prior estimates, their covariance, and the delay of the torque."""

import re
from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace
from unittest.mock import patch

import clarabel
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.signal import lfilter

from hil.cell import Cell
from identification import (
    Coupling,
    DelayEstimate,
    Factor,
    FrictionLaw,
    GaussianPrior,
    Huber,
    IdentificationError,
    Payload,
    Preprocessing,
    Recording,
    RobotModel,
    Tukey,
    consistent_estimate,
    estimate,
    estimate_delay,
    estimate_instrumental,
    estimate_repetitions,
    fit_least_squares,
    instrument_factor,
    prepare,
    rate_products,
    robust_estimate,
    with_prior,
    with_uncertain_delay,
    write_urdf,
)
from identification.distributions import student_limit
from identification.estimators import prior as prior_module
from identification.estimators.consistent import consistent_values, is_consistent
from identification.estimators.covariance import (
    Clustered,
    block_length,
    cluster_covariance,
    leverage_corrected,
    spread,
)
from identification.estimators.delay import (
    MAX_ESTIMATED_DELAY,
    UndeterminedDelay,
    delay_sensitivity,
)
from identification.estimators.delay_messages import undetermined_words
from identification.estimators.loss_functions import Loss
from identification.estimators.prior import (
    OFFSET_STD_SHARE,
    TorqueSums,
    body_lengths,
    body_prior,
    design_effect_of,
    fit_posterior,
    nominal_ratio,
    posterior_values,
)
from identification.export.urdf import NotConsistentError
from identification.factor.estimate import joint_weights
from identification.factor.estimation_method import (
    EstimationMethod,
    LeastSquares,
    PriorOrigin,
    Reweighted,
    TimeBlocks,
)
from identification.factor.factor import total_factor
from identification.factor.normal_equations import NormalEquations, rows_of, solve
from identification.model.motion import Motion
from identification.model.nominal_masses import MassFault
from identification.model.pseudo_inertia import pseudo_inertia
from identification.signals.recording import in_succession
from identification.signals.smoothing import low_pass
from sim_fixtures import ControllerSettings, SimulatedController
from sim_fixtures.ns16 import CELL_PATH, urdf_text
from tests.identification import three_axes
from tests.identification.robots import robot_text
from tests.identification.two_link import (
    MODEL,
    NOISE,
    URDF,
    P,
    a_motion,
    as_samples,
    coloured,
    four_sines,
    gaussian,
    one_sine,
    recording,
    simulated,
    sine_motion,
    truth,
    values_of,
)
from tests.sim_fixtures.bench import DRIVE, MinimalPC
from tests.sim_fixtures.bench import TRUTH as PLANT
from tests.tiers import quick_ones


class TestRepeatedRecordings:
    def test_a_repeated_error_is_not_averaged(self):
        motion = a_motion()
        rng = np.random.default_rng(3)
        repeated = coloured(rng, len(motion.time), 5e-3, 0.05)
        runs = [
            recording(repeated + 0.1 * NOISE * rng.standard_normal(repeated.shape), motion)
            for _ in range(16)
        ]
        single_run = estimate_repetitions(MODEL, runs[:1])
        many = estimate_repetitions(MODEL, runs)
        # Sixteen repetitions of one error count as one, unlike their scatter.
        np.testing.assert_allclose(many.pooled.std, single_run.pooled.std, rtol=0.35)
        assert np.median(many.std / 4.0 / many.pooled.std) < 0.1
        error = np.abs(many.pooled.values - truth())
        assert np.mean(error < many.pooled.interval_factor * many.pooled.std) > 0.85


def posterior_of(factor, model=MODEL, **stated):
    """Posterior of the bodies' prior."""
    return fit_posterior(model, factor, body_prior(model, factor, stated=stated).gaussian)


PIECES = {
    "ordinary": lambda pieces: fit_least_squares(MODEL, pieces, "ordinary"),
    "weighted": lambda pieces: fit_least_squares(MODEL, pieces),
    "prior": lambda pieces: posterior_of(total_factor(MODEL, pieces)).estimate,
    "huber": lambda pieces: robust_estimate(MODEL, pieces, Huber()).estimate,
    "tukey": lambda pieces: robust_estimate(MODEL, pieces, Tukey()).estimate,
    "consistent": lambda pieces: (
        consistent_estimate(
            MODEL, total_factor(MODEL, pieces), fit_least_squares(MODEL, pieces)
        ).estimate
    ),
}


@cache
def whole():
    """A recording with outliers, and its plan."""
    plan = a_motion(5.0)
    rng = np.random.default_rng(7)
    motion = replace(plan, acceleration=plan.acceleration + rng.normal(0.0, 0.3, (1000, 2)))
    samples = recording(coloured(rng, 1000, 5e-3, 0.02), motion)
    samples.torque[100:110] += 40.0
    return samples, plan


class TestParts:
    """Any split of a recording gives the same values and covariance."""

    @pytest.mark.parametrize("name", quick_ones([*PIECES][:2], [*PIECES, "instrumental"]))
    @given(places=st.lists(st.integers(1, 999), max_size=12))
    @settings(max_examples=6, deadline=None)
    def test_they_add_up(self, name, places):
        samples, plan = whole()
        undivided, many = (
            self.found(name, [(samples.between(*part), plan.rows(slice(*part))) for part in parts])
            for parts in ([(0, 1000)], list(pairwise(sorted({0, *places, 1000}))))
        )
        assert np.max(np.abs(undivided.values - many.values) / undivided.std) < 1e-9
        np.testing.assert_allclose(many.std, undivided.std, rtol=1e-9)
        assert many.method.blocks == undivided.method.blocks

    def found(self, name, pieces):
        if name in PIECES:
            return PIECES[name]([samples for samples, _ in pieces])
        factors = [instrument_factor(MODEL, *piece) for piece in pieces]
        return estimate_instrumental(MODEL, sum(factors[1:], factors[0])).estimate


class TestBlocks:
    @pytest.mark.long
    @pytest.mark.parametrize("correlation", [0.0, 0.02, 0.05, 0.1])
    def test_95_percent_intervals_cover_90_to_99_percent(self, correlation):
        motion = a_motion()
        honest = []
        classical = []
        for seed in range(120):
            noise = coloured(np.random.default_rng(seed), len(motion.time), 5e-3, correlation)
            result = estimate_repetitions(MODEL, [recording(noise, motion)])
            error = np.abs(result.pooled.values - truth())
            honest.append(error < result.pooled.interval_factor * result.pooled.std)
            classical.append(error < 1.96 * result.classical_std)
        assert 0.90 <= np.mean(honest) <= 0.99
        if correlation >= 0.02:
            assert np.mean(classical) < 0.75

    def test_leaving_out_one_block_at_a_time(self):
        """The score is A times the change without the block."""
        motion = a_motion(4.0)
        noise = coloured(np.random.default_rng(9), len(motion.time), 5e-3, 0.02)
        phase = Factor.by_time(MODEL, recording(noise, motion))
        weights = 1.0 / NOISE**2
        weighted = phase.by_block(weights)
        a_blocks = weighted[:, :-1, :-1]
        b_blocks = weighted[:, :-1, -1]
        a = a_blocks.sum(axis=0)
        b = b_blocks.sum(axis=0)
        values = np.linalg.solve(a, b)
        scores = b_blocks - a_blocks @ values
        np.testing.assert_allclose(phase.scores(weights, values), scores, atol=1e-8)
        without = np.linalg.solve(a - a_blocks, (b - b_blocks)[:, :, None])[:, :, 0]
        moved = values - without
        rows = spread(a_blocks, scores, solve(phase.weighted(weights)).root, left_out=True)
        np.testing.assert_allclose(rows.T @ rows, moved.T @ moved, rtol=1e-9)

    @pytest.mark.parametrize("largest", [0.1, 0.45])
    def test_covariance_is_unbiased_for_white_residuals(self, largest):
        """Whose scores have the covariance H - H² after the fit; the truth is the unit matrix.

        `largest` is the leverage of one block in one direction.
        """
        rng = np.random.default_rng(4)
        rows = rng.standard_normal((30, 4, 5))
        rows[:, :, -1] *= np.sqrt(1.0 - largest)
        rows[7, 0, -1] = np.sqrt(30.0 * 4.0 * largest)
        information = np.swapaxes(rows, 1, 2) @ rows
        root = solve(NormalEquations(information.sum(axis=0), np.ones(5))).root
        shares = root.T @ information @ root
        left = shares - shares @ shares
        eigenvalues, vectors = np.linalg.eigh(left)
        halves = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))[:, None]
        total = np.zeros((5, 5))
        for k in range(5):
            corrected = leverage_corrected(shares, halves[:, :, k])
            total += corrected.T @ corrected
        np.testing.assert_allclose(np.linalg.eigvalsh(total), 1.0, rtol=3e-3)

    @pytest.mark.parametrize("largest", [0.1, 0.7, 1.0])
    def test_symmetric_shares_have_the_covariance_of_general_ones(self, largest):
        """Of blocks of low leverage, and one of a high one that has a direction for itself."""
        rng = np.random.default_rng(11)
        rows = rng.standard_normal((30, 4, 5))
        rows[:, :, -1] *= np.sqrt(1.0 - largest)
        rows[7, 0, -1] = 20.0 * np.sqrt(largest)
        information = np.swapaxes(rows, 1, 2) @ rows
        scores = (np.swapaxes(rows, 1, 2) @ rng.standard_normal((30, 4, 1)))[..., 0]
        root = solve(NormalEquations(information.sum(axis=0), scores.sum(axis=0))).root
        symmetric = spread(information, scores, root)
        general = spread(information, scores, root, left=root)
        np.testing.assert_allclose(symmetric.T @ symmetric, general.T @ general, rtol=1e-9)

    @pytest.mark.parametrize("shared", [0.0, 0.09])
    def test_correlation_of_neighbouring_blocks_counts(self, shared):
        """Mean of blocks that are correlated with the next one."""
        rng = np.random.default_rng(3)
        blocks = 300
        k = 40
        weight = (1.0 - np.sqrt(1.0 - 4.0 * shared**2)) / (2.0 * shared) if shared else 0.0
        white = rng.standard_normal((blocks + 1, k)) / np.sqrt(blocks * (1.0 + weight**2))
        scores = white[1:] + weight * white[:-1]
        information = np.tile(np.eye(k) / blocks, (blocks, 1, 1))
        solution = solve(NormalEquations(np.eye(k), scores.sum(axis=0)))
        clustered = cluster_covariance(information, scores, solution)
        assert clustered.blocks.count == blocks // 2
        assert np.trace(clustered.covariance) / k == pytest.approx(1.0 + 2.0 * shared, rel=0.05)

    def test_blocks_grow_with_the_correlation_of_the_scores(self):
        white = np.random.default_rng(5).standard_normal((400, 30))
        slow = lfilter([1.0], [1.0, -0.8], white, axis=0)
        assert block_length(white) == 2
        assert 4 <= block_length(slow) <= 20
        assert block_length(white[:25]) == 1  # enough blocks remain

    @pytest.mark.parametrize(
        ("weights", "freedom"),
        [
            (np.ones(25), 24),  # all alike
            (np.append(np.full(4, 1e6), np.ones(21)), 3),  # four determine it
            # of a block alone the variance is that of the others
            (np.append(1e6, np.ones(24)), 24),
        ],
    )
    def test_interval_factors_count_the_blocks_that_determine_each(self, weights, freedom):
        """Beside one that all blocks determine; whatever the units."""
        information = np.array([np.diag([1.0, weight]) for weight in weights])
        root = np.diag(np.array([len(weights), weights.sum()]) ** -0.5)
        clustered = Clustered(
            covariance=np.eye(2), root=root, scores=np.zeros((25, 2)),
            determined=np.ones(2, dtype=np.bool_), design_effect=1.0, interval_factor=2.0,
            blocks=TimeBlocks(25, 0.25), shares=root @ information @ root,
        )  # fmt: skip
        expected = [student_limit(0.025, 24), student_limit(0.025, freedom)]
        factors = clustered.interval_factors(np.eye(2))
        np.testing.assert_allclose(factors, expected, rtol=1e-3)
        np.testing.assert_allclose(clustered.interval_factors(1e3 * np.eye(2)), factors)

    def test_what_a_prior_determines_is_certain(self):
        """The more of the information is of a prior, the nearer is the factor to that of all."""
        weights = np.append(np.ones(3), np.zeros(22))
        factors = []
        for prior in (0.0, 1.0, 100.0):
            root = np.array([[(weights.sum() + prior) ** -0.5]])
            clustered = Clustered(
                covariance=np.eye(1), root=root, scores=np.zeros((25, 1)),
                determined=np.ones(1, dtype=np.bool_), design_effect=1.0, interval_factor=2.0,
                blocks=TimeBlocks(25, 0.25), shares=weights[:, None, None] * root**2,
            )  # fmt: skip
            factors.append(float(clustered.interval_factors(np.eye(1))[0]))
        assert factors[0] == pytest.approx(student_limit(0.025, 2))
        assert factors[0] > factors[1] > factors[2] == pytest.approx(student_limit(0.025, 24))

    def test_the_interval_factor_is_students_t_of_the_blocks(self):
        motion = a_motion()
        noise = coloured(np.random.default_rng(0), len(motion.time), 5e-3, 0.0)
        result = estimate_repetitions(MODEL, [recording(noise, motion)]).pooled
        assert result.method.blocks == TimeBlocks(40, 0.25)
        assert result.interval_factor == pytest.approx(2.02, abs=0.01)

    def test_independent_repetitions_are_averaged(self):
        motion = a_motion()
        rng = np.random.default_rng(4)
        runs = [recording(coloured(rng, len(motion.time), 5e-3, 0.02), motion) for _ in range(16)]
        result = estimate_repetitions(MODEL, runs)
        assert np.median(result.std / 4.0 / result.pooled.std) == pytest.approx(1.0, abs=0.35)
        assert np.median(result.classical_std / result.pooled.std) < 0.75

    def test_variance_determined_by_few_blocks_is_correct(self):
        """The elbow moves for 0.2 s only, in two blocks with almost no residual."""
        motion = a_motion()
        at = np.clip((motion.time - 5.0) / 0.2, 0.0, 1.0)
        for array, elbow_rate in zip(
            (motion.position, motion.velocity, motion.acceleration),
            (
                0.6 * (10 * at**3 - 15 * at**4 + 6 * at**5),
                3.0 * (30 * at**2 - 60 * at**3 + 30 * at**4),
                15.0 * (60 * at - 180 * at**2 + 120 * at**3),
            ),
            strict=True,
        ):
            array[:, 1] = elbow_rate
        inside = []
        alone = []
        classical = []
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
        weight = loss.weight(np.array([x]))
        further = loss.weight(np.array([1.1 * x]))
        assert 0.0 <= further[0] <= weight[0] <= 1.0
        assert loss.weight(np.array([-x])) == weight
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
        motion = a_motion(5.0)
        rng = np.random.default_rng(seed)
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
        motion = a_motion(2.0)
        rng = np.random.default_rng(3)
        samples = recording(with_outliers(rng, gaussian(rng, motion), 0.05, 15.0), motion)
        result = robust_estimate(MODEL, [samples], loss)
        rows = MODEL.regressor(motion).dense(P)
        scale = result.estimate.noise_std
        usable = samples.usable

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
        minimum = minimize(cost, away, jac=True, method="L-BFGS-B", options={"maxiter": 3000})
        assert best <= minimum.fun + 1e-6 * abs(best)
        middle = [
            np.median(np.abs((samples.torque - rows @ start)[usable[:, j], j])) for j in (0, 1)
        ]
        np.testing.assert_allclose(scale, np.array(middle) / 0.67449, rtol=0.02)

    @pytest.mark.long
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

    def test_exact_data_with_gross_outliers_give_the_true_values(self):
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
        motion = a_motion(3.0)
        rng = np.random.default_rng(7)
        samples = recording(with_outliers(rng, gaussian(rng, motion), 0.05, 30.0), motion)
        result = robust_estimate(MODEL, [samples], most_iterations=1)
        assert not result.converged
        assert result.estimate.method.fit == Reweighted(
            "huber", 1.345, result.iterations, converged=False
        )

    def test_many_outliers_mean_a_wrong_model(self):
        motion = a_motion(5.0)
        rng = np.random.default_rng(11)
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


def prior_of(stated):
    """Prior of the two links with known parameters."""
    return body_prior(MODEL, Factor.of(MODEL, noisy()), stated=stated).gaussian


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
        bounded = combinations[:, np.isfinite(std)]
        endless = combinations[:, np.isinf(std)]
        finite = np.linalg.inv((bounded * std[np.isfinite(std)] ** 2) @ bounded.T)
        seen = finite @ endless
        expected = finite - seen @ np.linalg.inv(endless.T @ seen) @ seen.T
        size = np.abs(finite).max()
        np.testing.assert_allclose(prior.root.T @ prior.root / size, expected / size, atol=1e-9)
        assert len(prior.root) == 4 - flat


class TestPosterior:
    @given(seed=st.integers(0, 999), size=st.floats(1e-3, 1e3))
    def test_it_is_that_of_the_textbook(self, seed, size):
        mean, *rows = np.random.default_rng(seed).standard_normal((P + 1, P))
        covariance = size * (np.transpose(rows) @ rows + 0.1 * np.eye(P))
        weights = 1.0 / NOISE**2
        factor = Factor.of(MODEL, noisy())
        equations = factor.weighted(weights)
        precision = np.linalg.inv(covariance)
        posterior = np.linalg.inv(equations.A + precision)
        expected = posterior @ (equations.b + precision @ mean)
        root = np.linalg.cholesky(covariance)
        prior = GaussianPrior.of_combinations(root, np.linalg.solve(root, mean), np.ones(P))
        for kind in (factor, Factor.of(MODEL, noisy(), "qr")):
            fitted_posterior = with_prior(MODEL, kind, prior, weights)
            np.testing.assert_allclose(
                fitted_posterior.estimate.values, expected, rtol=1e-6, atol=1e-7
            )
            np.testing.assert_allclose(
                fitted_posterior.estimate.std, np.sqrt(np.diag(posterior)), rtol=1e-6
            )
            assert fitted_posterior.estimate.undetermined == ()
            assert (fitted_posterior.ratio < 1.0).all()

    @pytest.mark.parametrize("storage", ["gram", "qr"])
    @pytest.mark.parametrize("std", [1e7, np.inf])
    def test_an_infinite_prior_is_weighted_least_squares(self, storage, std):
        factor = Factor.of(MODEL, noisy(), storage)
        expected = estimate(MODEL, Factor.of(MODEL, noisy()))
        prior = independent(np.full(P, 3.0), np.full(P, std))
        posterior = with_prior(MODEL, factor, prior)
        np.testing.assert_allclose(posterior.estimate.values, expected.values, rtol=1e-8)
        np.testing.assert_allclose(posterior.estimate.std, expected.std, rtol=1e-8)
        np.testing.assert_allclose(posterior.estimate.noise_std, expected.noise_std, rtol=1e-8)
        assert posterior.learned.all()

    @pytest.mark.parametrize("storage", ["gram", "qr"])
    def test_without_data_it_is_the_prior(self, storage):
        nothing = Factor.zero(MODEL, storage=storage)
        prior = prior_of(KNOWN)
        posterior = with_prior(MODEL, nothing, prior)
        np.testing.assert_allclose(posterior.estimate.values, prior.mean)
        np.testing.assert_allclose(posterior.estimate.std, prior.std, rtol=1e-9)
        np.testing.assert_allclose(posterior.ratio, 1.0, rtol=1e-9)
        np.testing.assert_allclose(posterior_values(nothing, prior)[0], prior.mean)
        assert not posterior.learned.any()
        assert posterior.estimate.undetermined == ()

    def test_undetermined_parameters_keep_the_prior(self):
        prior = prior_of(KNOWN)
        posterior = with_prior(MODEL, Factor.of(MODEL, noisy(held_elbow=True)), prior)
        at = {name: index for index, name in enumerate(posterior.estimate.names)}
        for name in ("f0_2", "f1_2"):  # the elbow stands still
            assert posterior.ratio[at[name]] == pytest.approx(1.0, rel=1e-9)
            assert posterior.estimate.values[at[name]] == pytest.approx(FRICTION[name][0], rel=1e-9)
            assert not posterior.learned[at[name]]
        assert posterior.ratio[at["f0_1"]] < 0.2
        assert posterior.learned[at["f0_1"]]
        assert posterior.estimate.undetermined == ()
        assert np.isfinite(posterior.estimate.std).all()
        # No parameter is less certain than before.
        assert (posterior.ratio <= 1.0 + 1e-9).all()

    def test_parameters_without_data_and_prior_stay_at_its_mean(self):
        factor = Factor.of(MODEL, noisy(held_elbow=True))
        unstated = dict.fromkeys(FRICTION, (0.0, np.inf))
        posterior = with_prior(MODEL, factor, prior_of(ROTORS | unstated))
        assert set(posterior.estimate.undetermined) == {"f0_2", "f1_2"}
        unknown = np.array(
            [name in posterior.estimate.undetermined for name in posterior.estimate.names]
        )
        assert np.isinf(posterior.estimate.std[unknown]).all()
        np.testing.assert_array_equal(posterior.ratio[unknown], 1.0)
        np.testing.assert_array_equal(posterior.estimate.values[unknown], 0.0)

    def test_few_rows_require_weights(self):
        chosen = np.arange(len(noisy().torque)) % 200 == 7
        few = Factor.of(MODEL, replace(noisy(), usable=noisy().usable & chosen[:, None]))
        prior = prior_of(KNOWN)
        with pytest.raises(IdentificationError, match="too few"):
            with_prior(MODEL, few, prior)
        assert np.isfinite(with_prior(MODEL, few, prior, 1.0 / NOISE**2).estimate.values).all()
        with pytest.raises(IdentificationError, match="not one usable sample"):
            fit_posterior(MODEL, Factor.zero(MODEL), prior)

    @pytest.mark.long
    @pytest.mark.parametrize("correlation", [0.0, 0.05])
    def test_95_percent_intervals_cover_90_to_99_percent(self, correlation):
        prior = prior_of(KNOWN)
        spread = np.linalg.inv(prior.root)  # no flat direction
        motion = one_sine_each()
        inside = []
        surprise = []
        naive = []
        for seed in range(80):
            rng = np.random.default_rng(seed)
            values = prior.mean + spread @ rng.standard_normal(P)
            samples = simulated(MODEL, values, motion)
            samples.torque[:] += coloured(rng, len(motion.time), 5e-3, correlation)
            result = fit_posterior(MODEL, Factor.by_time(MODEL, samples), prior)
            estimate = result.estimate
            white = with_prior(MODEL, Factor.of(MODEL, samples), prior).estimate
            inside.append(
                np.abs(estimate.values - values) < estimate.interval_factor * estimate.std
            )
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

    @pytest.mark.parametrize("effect", [1.0, 7.0])
    def test_rows_that_count_less_are_less_information(self, effect):
        """At the weights of the joints' own residuals."""
        prior = prior_of(KNOWN)
        factor = Factor.by_time(MODEL, noisy())
        posterior = fit_posterior(MODEL, factor, prior, effect)
        values, weights = posterior_values(factor, prior, effect)
        equations = factor.weighted(weights)
        expected = np.linalg.solve(
            equations.A / effect + prior.information,
            equations.b / effect + prior.information @ prior.mean,
        )
        np.testing.assert_allclose(posterior.estimate.values, expected, rtol=1e-8)
        variance = factor.squared_errors(values) / factor.samples
        np.testing.assert_allclose(weights, 1.0 / variance, rtol=2e-3)  # settled to one in 1000
        assert posterior.design_effect == effect

    @given(seed=st.integers(0, 999))
    @settings(max_examples=10)
    def test_what_the_data_determine_the_prior_does_not_change(self, seed):
        """Noise of a thousandth of a prior's deviation and less."""
        rng = np.random.default_rng(seed)
        motion = a_motion()
        samples = recording(1e-4 * gaussian(rng, motion), motion)
        factor = Factor.by_time(MODEL, samples)
        prior = prior_of(KNOWN)
        far = replace(prior, mean=prior.mean + 2.0 * prior.std * rng.standard_normal(P))
        free = fit_least_squares(MODEL, [samples])
        posterior = fit_posterior(MODEL, factor, far)
        assert posterior.ratio.max() < 1e-3
        assert np.abs((posterior.estimate.values - free.values) / free.std).max() < 0.05
        np.testing.assert_allclose(posterior.estimate.std, free.std, rtol=0.05)

    def test_a_prior_that_the_rows_contradict_makes_no_noise(self):
        """A noise as large as the contradiction is consistent with this prior, and less likely."""
        samples = simulated(MODEL, truth(), one_sine_each(), 0.01 * NOISE)
        factor = Factor.by_time(MODEL, samples)
        prior = prior_of(KNOWN)
        at = MODEL.parameter_names.index("f0_1")
        mean = prior.mean.copy()
        mean[at] += 30.0 * prior.std[at]
        values, weights = posterior_values(factor, replace(prior, mean=mean), 10.0)
        np.testing.assert_allclose(1.0 / np.sqrt(weights), 0.01 * NOISE, rtol=0.1)
        np.testing.assert_allclose(values[at], truth()[at], rtol=1e-3)

    @pytest.mark.parametrize("seed", [11, 12, 19, 39])
    def test_no_joint_is_fitted_at_the_expense_of_others(self, seed):
        """Torques of a scale each fit no bodies; the most probable fit is that of one joint."""
        model = three_axes.model()
        q, torque, _ = three_axes.motion()
        scale = np.exp(0.5 * np.random.default_rng(seed).standard_normal(3))
        recording = Recording(three_axes.TIME, q, three_axes.NAMES, torque * scale)
        samples = prepare(recording, model, options=Preprocessing(14.0, exclude_rows="rests"))
        factor = Factor.by_time(model, samples)
        prior = body_prior(model, factor).gaussian
        sums = TorqueSums.of(factor)
        start = sums.samples / sums.gram[:, -1, -1]
        values, _ = posterior_values(factor, prior, 10.0)
        usual, _ = posterior_values(factor, prior, 10.0, start)
        assert (sums.squared_errors(values) <= 1.21 * sums.squared_errors(usual)).all()

    def test_a_wrong_prior_is_detected(self):
        wrong = KNOWN | {"f0_1": (20.0, 1.0)}
        result = fit_posterior(MODEL, Factor.by_time(MODEL, noisy()), prior_of(wrong))
        at = result.estimate.names.index("f0_1")
        assert result.learned[at]
        assert result.normalized_change[at] < -4.0
        others = np.delete(result.normalized_change, at)
        assert np.nanmax(np.abs(others)) < 4.0


class TestWeightOfBodies:
    """A stronger prior on the described bodies, whose deviations are believed as before."""

    PRIOR = body_prior(MODEL, Factor.of(MODEL, noisy()))

    def test_an_infinite_one_keeps_them(self):
        samples = simulated(MODEL, 1.2 * truth(), a_motion(), NOISE)
        factor = Factor.by_time(MODEL, samples)
        prior = self.PRIOR.with_weight(1e8).gaussian
        values, _ = posterior_values(factor, prior)
        nominal = values_of(MODEL, np.zeros(4))
        bodies = [k for k, name in enumerate(MODEL.parameter_names) if name.startswith("mc")]
        np.testing.assert_allclose(values[bodies], nominal[bodies], rtol=1e-3, atol=1e-4)

    def test_friction_and_rotors_are_as_free_as_before(self):
        stronger = self.PRIOR.with_weight(100.0)
        ratio = stronger.std / self.PRIOR.std
        links = MODEL.layout.links.ravel()
        np.testing.assert_allclose(ratio[links], 0.1)
        np.testing.assert_allclose(np.delete(ratio, links), 1.0)

    def test_intervals_hold_for_bodies_as_uncertain_as_is_believed(self):
        """Arms drawn from the prior, fitted as if their bodies were nearly the described ones."""
        rng = np.random.default_rng(4)
        motion = a_motion(5.0)
        stronger = self.PRIOR.with_weight(100.0).gaussian
        inside = []
        for _ in range(30):
            spread = self.PRIOR.combinations @ (
                self.PRIOR.std * rng.standard_normal(len(self.PRIOR.std))
            )
            values = self.PRIOR.gaussian.mean + spread
            torque = MODEL.torque(values, motion) + gaussian(rng, motion)
            factor = Factor.by_time(MODEL, as_samples(MODEL, motion, torque))
            estimate = fit_posterior(MODEL, factor, stronger).estimate
            half = estimate.interval_factor * estimate.std
            inside.append(np.abs(estimate.values - values) < half)
        assert np.mean(inside) > 0.9

    def test_a_shift_by_chance_hardly_widens_intervals(self):
        """Of an arm that is as described: by less than half of its square, E max(0, z² - 1)."""
        motion = a_motion(5.0)
        torque = MODEL.torque(self.PRIOR.gaussian.mean, motion)
        ratios = []
        whole = []
        for seed in range(12):
            noisy_torque = torque + gaussian(np.random.default_rng(seed), motion)
            factor = Factor.by_time(MODEL, as_samples(MODEL, motion, noisy_torque))
            believed = fit_posterior(MODEL, factor, self.PRIOR.gaussian, 1.0)
            result = fit_posterior(MODEL, factor, self.PRIOR.with_weight(1e6).gaussian, 1.0)
            variance = believed.estimate.std**2
            ratios.append(result.estimate.std**2 / variance)
            whole.append(1.0 + result.shift**2 / variance)
        added, of_the_shift = np.mean(ratios) - 1.0, np.mean(whole) - 1.0
        assert of_the_shift > 0.5
        assert added < 0.5 * of_the_shift


class TestDesignEffect:
    """Rows that count as one."""

    def effects(self, correlation):
        motion = a_motion(20.0)
        prior = prior_of(KNOWN)
        errors = [
            coloured(np.random.default_rng(seed), len(motion.time), 5e-3, correlation)
            for seed in range(8)
        ]
        factors = [Factor.by_time(MODEL, recording(error, motion)) for error in errors]
        return np.array([design_effect_of(factor, prior) for factor in factors])

    def test_white_residuals_all_count(self):
        assert 1.0 <= self.effects(0.0).mean() < 1.2

    @pytest.mark.parametrize("correlation", [0.02, 0.05])
    def test_coloured_ones_count_by_their_power_in_the_motion(self, correlation):
        """That of a first-order process at low frequency is (1 + r) / (1 - r) of white's."""
        r = np.exp(-5e-3 / correlation)
        assert np.median(self.effects(correlation)) == pytest.approx((1.0 + r) / (1.0 - r), rel=0.3)


def other_bodies(pattern, replacement):
    """The two links with another description."""
    text = re.sub(pattern, replacement, URDF)
    assert text != URDF
    return RobotModel.from_urdf(text, friction=FrictionLaw(third=None))


EQUAL = other_bodies(r'<mass value="\d+"/>', '<mass value="1"/>')
BARE = other_bodies(r"(?s)<inertial>.*?</inertial>", "")


class TestBodyPrior:
    # Upper link: to the elbow. Lower link: from its joint to its centre.
    LENGTHS = np.array([0.5, np.hypot(0.01, 0.2)])

    def test_it_is_that_of_sampled_arms(self):
        share = 0.3
        count = 20_000
        factor = Factor.of(MODEL, noisy())
        prior = body_prior(MODEL, factor, share, stated=KNOWN).gaussian
        nominal = MODEL.nominal.reshape(2, 11)
        # Moments of the lower link about its joint: 3 (0.01² + 0.2²) + 0.1 and so on.
        gyration = np.sqrt((0.1 + 0.1 + 0.01) / 2.0 / 3.0 + 0.01**2 + 0.2**2)
        length = np.maximum(self.LENGTHS, [0.0, gyration])
        rng = np.random.default_rng(3)
        sampled = np.repeat(nominal[None], count, axis=0)
        sampled[:, :, 10] = [0.3, 0.1] + np.array([0.2, 0.05]) * rng.standard_normal((count, 2))
        for link, mass in enumerate((6.0, 3.0)):
            for part, power in ((slice(0, 6), 2), (slice(6, 9), 1), (slice(9, 10), 0)):
                size = share * mass * length[link] ** power
                entries = part.stop - part.start
                sampled[:, link, part] += size * rng.standard_normal((count, entries))
        base = sampled.reshape(count, -1) @ MODEL.base.grouping.T
        rank = MODEL.base.rank
        covariance = np.linalg.inv(prior.information)[:rank, :rank]
        scale = np.outer(prior.std[:rank], prior.std[:rank])
        error = 5.0 / np.sqrt(count)  # five standard errors
        off = (base.mean(axis=0) - prior.mean[:rank]) / prior.std[:rank]
        assert np.abs(off).max() < error
        assert np.abs((np.cov(base.T) - covariance) / scale).max() < np.sqrt(2.0) * error
        np.testing.assert_allclose(prior.std[rank:], [2.0, 1.0, 1.0, 0.5])

    def test_rotors_are_of_the_size_of_the_links_outboard(self):
        """Over all angles between them, or of what makes half of the torque."""
        factor = Factor.of(MODEL, noisy())
        prior = body_prior(MODEL, factor)
        rotors = MODEL.layout.rotors
        assert not prior.mean[rotors].any()
        upper, lower = body_lengths(MODEL) ** 2
        assert prior.std[rotors[0]] == pytest.approx(6.0 * upper + 3.0 * (upper + lower))
        assert prior.std[rotors[1]] >= 3.0 * lower
        samples = noisy()
        column = MODEL.parameter_names.index("I2m")
        turning = samples.regressor(MODEL).dense(P)[:, 1, column][samples.usable[:, 1]]
        torque = samples.torque[samples.usable[:, 1], 1]
        alone = 0.5 * np.sqrt(np.mean(torque**2) / np.mean(turning**2))
        assert prior.std[rotors[1]] == pytest.approx(max(prior.std[rotors[1]], alone))

    @pytest.mark.parametrize(("inertia", "is_length"), [("0.01", True), ("100", False)])
    def test_a_placeholder_inertia_is_no_length(self, inertia, is_length):
        """With equal masses of 1 kg: 0.12 m fits into the arm, 12 m is longer than it."""
        text = re.sub(r'mass value="[^"]*"', 'mass value="1"', URDF)
        text = re.sub(r'(ixx|iyy|izz)="[^"]*"', rf'\1="{inertia}"', text)
        text = re.sub(r'<origin xyz="[^"]*"( rpy="[^"]*")?/>\s*<mass', "<mass", text)
        equal = RobotModel.from_urdf(text)
        bare = RobotModel.from_urdf(re.sub(r"<inertial>.*?</inertial>", "", URDF, flags=re.DOTALL))
        gyration = np.sqrt(1.5 * float(inertia))
        longer = np.maximum(body_lengths(bare), gyration if is_length else 0.0)
        np.testing.assert_allclose(body_lengths(equal), longer)

    def test_wide_rotors_alone_make_half_of_the_torque(self):
        """That of the first joint, too, whose column is that of the inertia of its link."""
        samples = noisy()
        wide = body_prior(MODEL, Factor.of(MODEL, samples), wide_rotors=True)
        assert MODEL.layout.rotors[0] not in MODEL.base.pivots
        for joint, rotor in enumerate(MODEL.layout.rotors):
            rows = samples.usable[:, joint]
            acceleration = samples.motion.acceleration[rows, joint]
            torque = samples.torque[rows, joint]
            alone = 0.5 * np.sqrt(np.mean(torque**2) / np.mean(acceleration**2))
            outboard = body_prior(MODEL, Factor.of(MODEL, samples)).std[rotor]
            assert wide.std[rotor] == pytest.approx(max(outboard, alone))

    def test_a_friction_term_alone_makes_half_of_the_torque(self):
        factor = Factor.of(MODEL, noisy())
        prior = body_prior(MODEL, factor)
        samples = noisy()
        columns = samples.regressor(MODEL).dense(P)
        for k, std in enumerate(prior.std[MODEL.layout.size :], MODEL.base.rank):
            joint = int(np.flatnonzero(np.abs(columns[..., k]).max(axis=0))[0])
            rows = samples.usable[:, joint]
            alone = np.sqrt(np.mean((std * columns[rows, joint, k]) ** 2))
            torque = np.sqrt(np.mean(samples.torque[rows, joint] ** 2))
            assert alone == pytest.approx(0.5 * torque, rel=1e-9)

    def test_what_opposes_a_motion_in_one_direction_is_friction(self):
        """Where friction and offset are one column, most of it is not called an offset."""
        law = replace(MODEL.friction.laws[0], offset=True)
        model = RobotModel.from_urdf(URDF, friction=law)
        motion = a_motion()
        drift = 1.1 * np.abs(motion.velocity).max(axis=0)
        motion = replace(
            motion,
            position=motion.position + drift * motion.time[:, None],
            velocity=motion.velocity + drift,
        )
        planted = {"f0": (4.0, 1.5), "f1": (2.0, 0.8), "fo": (0.0, 0.0)}
        friction = [planted[term.symbol][term.owner] for term in model.friction.terms]
        samples = simulated(model, values_of(model, friction, (0.4, 0.1)), motion, NOISE)
        factor = Factor.by_time(model, samples)
        estimate = fit_posterior(model, factor, body_prior(model, factor).gaussian).estimate
        values = dict(zip(model.parameter_names, estimate.values, strict=True))
        for joint in ("1", "2"):
            assert values[f"f0_{joint}"] > 5.0 * abs(values[f"fo_{joint}"])

    @pytest.mark.parametrize(
        ("speed", "share"), [(0.0, 1.0), (1.1, OFFSET_STD_SHARE)], ids=["stands", "moves one way"]
    )
    def test_an_offset_is_as_free_as_its_joint_needs(self, speed, share):
        """A joint that stands shows no friction, and what holds it is its offset."""
        law = replace(MODEL.friction.laws[0], offset=True)
        model = RobotModel.from_urdf(URDF, friction=law)
        motion = a_motion()
        motion.position[:, 1] = 0.3 + speed * motion.time
        motion.velocity[:, 1] = speed
        motion.acceleration[:, 1] = 0.0
        torque = MODEL.torque(truth(), motion) + gaussian(np.random.default_rng(1), motion)
        factor = Factor.of(model, as_samples(model, motion, torque))
        with patch.object(prior_module, "OFFSET_STD_SHARE", 1.0):
            free = body_prior(model, factor)
        offset = model.layout.size + [
            (term.symbol, term.owner) for term in model.friction.terms
        ].index(("fo", 1))
        assert body_prior(model, factor).std[offset] / free.std[offset] == pytest.approx(share)

    def test_shares_of_load_are_those_of_gears(self):
        model = MODEL.with_friction(load=True)
        samples = simulated(model, np.append(truth(), [0.05, 0.05]), a_motion(), NOISE)
        prior = body_prior(model, Factor.of(model, samples.with_load(MODEL, truth())))
        std = dict(zip(model.parameter_names, prior.gaussian.std, strict=True))
        assert (std["fl_1"], std["fl_2"]) == pytest.approx((0.1, 0.1))

    @given(seed=st.integers(0, 999))
    def test_the_most_probable_bodies_are_the_conditional_mean(self, seed):
        rng = np.random.default_rng(seed)
        prior = body_prior(MODEL, Factor.of(MODEL, noisy()))
        spread = prior.combinations * prior.std
        values = prior.combinations @ prior.mean + spread @ rng.standard_normal(len(prior.std))
        bodies = prior.most_probable(values)
        # They have these parameters, and deviate only in directions that these show.
        np.testing.assert_allclose(prior.combinations @ bodies, values, rtol=1e-7, atol=1e-9)
        deviation = (bodies - prior.mean) / prior.std
        shown = np.linalg.lstsq(spread.T, deviation, rcond=None)[0]
        np.testing.assert_allclose(spread.T @ shown, deviation, atol=1e-6)


class TestPlaceholders:
    """Descriptions whose masses say nothing about the torque."""

    def prior(self, model, size=1.0):
        samples = noisy()
        factor = Factor.of(model, replace(samples, torque=size * samples.torque))
        return body_prior(model, factor), factor

    @pytest.mark.parametrize(("model", "fault"), [(EQUAL, MassFault.EQUAL), (BARE, MassFault.NONE)])
    def test_equal_or_missing_masses_are_some(self, model, fault):
        prior, _ = self.prior(model)
        assert prior.placeholder
        assert prior.origin == PriorOrigin(0.3, fault)
        assert not prior.mean[: model.layout.size].any()

    @pytest.mark.parametrize("size", [20.0, 0.05, -1.0])
    def test_masses_with_another_torque_are_some(self, size):
        prior, _ = self.prior(MODEL, size)
        assert prior.placeholder
        assert prior.origin.fault is MassFault.UNRELATED
        assert prior.origin.scale == pytest.approx(size, rel=0.5)
        assert not prior.mean[: MODEL.layout.size].any()

    @pytest.mark.parametrize("size", [0.7, 1.0, 1.5])
    def test_masses_of_about_the_torque_are_none(self, size):
        prior, _ = self.prior(MODEL, size)
        assert not prior.placeholder
        np.testing.assert_array_equal(prior.mean[: MODEL.layout.size], MODEL.nominal)

    def test_the_ratio_is_that_of_the_bodies(self):
        motion = a_motion()
        values = values_of(MODEL, [4.0, 2.0, 1.5, 0.8], (0.4, 0.1))
        rigid = MODEL.base.grouping @ MODEL.nominal
        values[: MODEL.base.rank] += 0.3 * rigid
        for noise in (0.0, NOISE):
            factor = Factor.of(MODEL, simulated(MODEL, values, motion, noise))
            ratio, std = nominal_ratio(MODEL, factor)
            assert abs(ratio - 1.3) < 3.0 * std + 1e-9
        assert std < 0.1
        assert nominal_ratio(MODEL, Factor.zero(MODEL)) == pytest.approx(
            (np.nan, np.inf), nan_ok=True
        )

    @pytest.mark.parametrize("model", [EQUAL, BARE], ids=["equal", "bare"])
    @pytest.mark.parametrize("unit", [1e-3, -1.0, 1e3])
    def test_the_estimate_has_the_unit_of_the_torque(self, model, unit):
        (prior, factor) = self.prior(model)
        (other, scaled) = self.prior(model, unit)
        np.testing.assert_allclose(other.std, abs(unit) * prior.std, rtol=1e-9)
        posterior = fit_posterior(model, factor, prior.gaussian, 3.0)
        same = fit_posterior(model, scaled, other.gaussian, 3.0)
        size = np.abs(posterior.estimate.std)
        off = same.estimate.values / unit - posterior.estimate.values
        assert np.abs(off / size).max() < 1e-6
        np.testing.assert_allclose(same.estimate.std, abs(unit) * size, rtol=1e-6)


def with_friction(*friction):
    """Return the true parameters of the two links with other friction."""
    return np.concatenate([truth()[: MODEL.base.rank], friction])


def five_sines(model, seed, samples=2000):
    """Return five sines per joint, similar for all seeds."""
    rng = np.random.default_rng(seed)
    shape = (5, model.n_joints)
    time = np.arange(samples) * 4e-3
    size = np.linspace(1.0, 0.2, 5)[:, None]
    pace = np.linspace(0.5, 4.0, 5)[:, None] * rng.uniform(0.9, 1.1, shape)
    return sine_motion(time, size, pace, rng.uniform(0.0, 6.0, shape))


def measured(model, motion, values, noise, seed):
    """Return torque with noise, a share of each joint's RMS."""
    rms = np.sqrt((model.torque(values, motion) ** 2).mean(axis=0))
    return simulated(model, values, motion, noise * rms, seed).torque


def fitted(model, motion, torque, **options):
    return consistent_estimate(model, Factor.from_samples(model, motion, torque), **options)


def fit_of(values, noise, seed, *, model=MODEL, samples=2000):
    """Return the estimate of an arm with these parameters."""
    motion = five_sines(model, seed, samples)
    return fitted(model, motion, measured(model, motion, values, noise, seed))


def error_rise(consistent):
    """Return the rise of the relative error on the fitted rows."""
    return consistent.relative_error - consistent.unconstrained_relative_error


def assert_consistent(model, consistent):
    """Check the definition of consistency by eigenvalues."""
    rows = consistent.standard.reshape(model.n_joints, -1)
    for xx, xy, xz, yy, yz, zz, hx, hy, hz, m, *rotor in rows:
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        h = np.array([hx, hy, hz])
        about_centre = tensor - (h @ h * np.eye(3) - np.outer(h, h)) / m
        moments = np.linalg.eigvalsh(about_centre)
        assert m > 0.0
        assert moments[0] > 0.0
        assert moments[0] + moments[1] > moments[2]
        assert all(r >= 0.0 for r in rotor)
    for name, value in zip(consistent.estimate.names, consistent.estimate.values, strict=True):
        assert value >= 0.0 or not name.startswith(("f0", "f1"))


LARGE = 1e2  # times the nominal bodies, kg m² of rotor, or N·m of friction


def largest_gain(gradient, at, nominal):
    """Return a bound on how much consistent parameters can decrease a convex function.

    The function stays above its tangent. The gradient of a link is a matrix Z with <Z, J(x)> =
    gradient x, not negative if Z is positive semidefinite. Small violations are multiplied by
    LARGE.
    """
    upper = np.triu_indices(4)
    basis = np.zeros((10, 4, 4))
    basis[np.arange(10), upper[0], upper[1]] += 0.5
    basis[np.arange(10), upper[1], upper[0]] += 0.5
    products = pseudo_inertia(np.eye(10)).reshape(10, 16) @ basis.reshape(10, 16).T
    missing = 0.0
    n = len(nominal)
    others = np.delete(gradient, [i for f in range(n) for i in range(11 * f, 11 * f + 10)])
    missing += float(np.maximum(-others, 0.0).sum())
    for link, inertial in enumerate(nominal):
        entries = np.linalg.solve(products, gradient[11 * link : 11 * link + 10])
        dual = np.tensordot(entries, basis, axes=1)
        frame = np.linalg.cholesky(pseudo_inertia(inertial))
        missing += max(-float(np.linalg.eigvalsh(frame.T @ dual @ frame)[0]), 0.0)
    return float(gradient @ at) + LARGE * missing


class TestConsistentEstimate:
    @pytest.mark.parametrize(("noise", "samples"), [(0.5, 150), (0.3, 300), (0.02, 2000)])
    def test_base_parameters_follow_from_standard_ones(self, noise, samples):
        """These are consistent with poor data; good data are hardly changed."""
        consistent = fit_of(truth(), noise, 1, samples=samples)
        rank = MODEL.base.rank
        assert_consistent(MODEL, consistent)
        assert consistent.fits and np.all(consistent.margin > 0.0)
        expected = MODEL.base.grouping @ consistent.standard
        np.testing.assert_allclose(consistent.estimate.values[:rank], expected, atol=1e-12)
        np.testing.assert_array_equal(consistent.estimate.values[rank:], consistent.friction)
        if noise == 0.02:
            assert np.abs(consistent.shift).max() < 0.1 and error_rise(consistent) < 1e-5

    def test_exact_nominal_data_return_all_parameters(self):
        """Parameters without effect on the torque are nominal."""
        values = values_of(MODEL, [4.0, 2.0, 1.5, 0.8])
        np.testing.assert_allclose(fit_of(values, 0.0, 3).standard, MODEL.nominal, atol=1e-4)

    def test_negative_friction_becomes_zero(self):
        consistent = fit_of(with_friction(-1.0, 2.0, 1.5, -0.3), 0.01, 4)
        for name in ("f0_1", "f1_2"):
            assert consistent.unconstrained.value(name) < 0.0
            assert consistent.estimate.value(name) == pytest.approx(0.0, abs=1e-3)
        assert_consistent(MODEL, consistent)

    @pytest.mark.parametrize("effect", [1.0, 30.0])
    def test_no_other_consistent_parameters_are_more_probable(self, effect):
        values = with_friction(-1.0, 2.0, 1.5, 0.8)
        values[MODEL.parameter_names.index("I2yy")] = -0.1  # active constraints
        motion = five_sines(MODEL, 6)
        torque = measured(MODEL, motion, values, 0.4, 6)
        factor = Factor.from_samples(MODEL, motion, torque)
        prior = body_prior(MODEL, factor)
        consistent = fitted(MODEL, motion, torque, prior=prior, design_effect=effect)
        # The same objective from the samples, and its gradient.
        weights = joint_weights(factor)
        root, target = rows_of(factor.weighted(weights))
        excess = float(np.sum((root @ consistent.estimate.values - target) ** 2))
        assert excess > 100.0
        rank = MODEL.base.rank
        s = len(MODEL.layout.names)
        mapping = np.zeros((MODEL.n_parameters, s + 4))
        mapping[:rank, :s] = MODEL.base.grouping
        mapping[rank:, s:] = np.eye(4)
        rows = MODEL.regressor(motion).dense(MODEL.n_parameters) @ mapping
        x = np.concatenate([consistent.standard, consistent.friction])
        error = rows @ x - torque
        gradient = 2.0 * np.einsum("tj,j,tjk->k", error, weights / effect, rows)
        gradient += 2.0 * (x - prior.mean) / prior.std**2
        value = float(np.sum(weights * error**2)) / effect
        value += float(np.sum(((x - prior.mean) / prior.std) ** 2))
        # The cones leave out a millionth of the reference, which costs a share of that order.
        assert largest_gain(gradient, x, MODEL.chain.inertial) < 1e-5 * value

    @pytest.mark.parametrize("noise", [0.1, 0.01, 0.0])
    def test_inconsistent_data_give_the_closest_parameters(self, noise):
        """As after a wrong sign of one torque, for any noise."""
        values = with_friction(-1.0, 2.0, 1.5, 0.8)
        values[MODEL.parameter_names.index("I2yy")] = -0.3
        consistent = fit_of(values, noise, 6)
        assert_consistent(MODEL, consistent)
        assert not consistent.fits
        assert error_rise(consistent) > 0.02

    def test_a_solver_that_stalls_takes_shorter_steps(self, monkeypatch):
        """As for a drawn arm of the KR 300, whose equations span eight orders of magnitude."""
        usual = fit_of(truth(), 0.01, 6)
        solver = clarabel.DefaultSolver

        def stalling(*problem):
            if problem[-1].max_step_fraction < 0.99:
                return solver(*problem)
            return SimpleNamespace(solve=lambda: SimpleNamespace(status="InsufficientProgress"))

        monkeypatch.setattr(clarabel, "DefaultSolver", stalling)
        np.testing.assert_allclose(fit_of(truth(), 0.01, 6).standard, usual.standard, rtol=1e-5)

    def test_errors_and_covariance_are_correct(self):
        motion = five_sines(MODEL, 7, samples=300)
        torque = measured(MODEL, motion, truth(), 0.3, 7)
        consistent = fitted(MODEL, motion, torque)
        error = MODEL.torque(consistent.estimate.values, motion) - torque
        rms = np.sqrt((error**2).mean(axis=0))
        np.testing.assert_allclose(consistent.estimate.noise_std, rms, rtol=1e-6)
        relative = np.linalg.norm(error) / np.linalg.norm(torque)
        assert consistent.relative_error == pytest.approx(relative, rel=1e-6)
        assert consistent.estimate.method == EstimationMethod(LeastSquares(), is_consistent=True)
        np.testing.assert_array_equal(
            consistent.estimate.covariance, consistent.unconstrained.covariance
        )

    @pytest.mark.parametrize(
        "path", ["ur_description/urdf/ur10_robot.urdf", "panda_description/urdf/panda.urdf"]
    )
    def test_other_robots_with_inconsistent_nominal_parameters(self, path):
        model = RobotModel.from_urdf(robot_text(path))
        values = values_of(model, np.repeat([2.0, 1.0, 0.0], model.n_joints), 0.5)
        motion = five_sines(model, 1)
        torque = measured(model, motion, values, 0.1, 1)
        factor = Factor.from_samples(model, motion, torque)
        prior = body_prior(model, factor)
        free, weights = posterior_values(factor, prior.gaussian)
        consistent = consistent_estimate(model, factor, weights=weights, prior=prior)
        assert_consistent(model, consistent)
        # The constraints cost next to nothing beside the prior.
        assert consistent.relative_error - factor.relative_error(free) < 1e-3

    def test_missing_nominal_bodies_are_assumed(self):
        bare = re.sub(r"<inertial>.*?</inertial>", "", URDF, flags=re.DOTALL)
        empty = RobotModel.from_urdf(bare, friction=FrictionLaw(third=None))
        motion = five_sines(MODEL, 12)
        consistent = fitted(empty, motion, measured(MODEL, motion, truth(), 0.02, 12))
        assert all(origin.startswith("assumed") for origin in consistent.reference)
        assert_consistent(empty, consistent)
        assert error_rise(consistent) < 1e-3

    def test_a_resting_joint_keeps_its_nominal_link(self):
        law = FrictionLaw(third=None)
        model = RobotModel.from_urdf(URDF, friction=law, gravity=(0, 0, 0))
        motion = five_sines(model, 10)
        for array in (motion.position, motion.velocity, motion.acceleration):
            array[:, 1] = 0.0
        values = values_of(model, [4.0, 2.0, 1.5, 0.8])
        torque = measured(model, motion, values, 0.01, 10)
        mask = np.zeros(torque.shape, dtype=np.bool_)
        mask[:, 0] = True
        consistent = consistent_estimate(model, Factor.from_samples(model, motion, torque, mask))
        assert_consistent(model, consistent)
        assert {"f0_2", "f1_2"} <= set(consistent.estimate.undetermined)
        assert np.all(np.isfinite(consistent.standard))
        np.testing.assert_allclose(consistent.standard[20], model.nominal[20], rtol=0.5)  # m2


class TestDrives:
    """Coupled drives, and friction of more than three terms."""

    TURNS = np.array([[1.0, 0.0], [0.5, 1.0]])

    def coupled(self, inertia):
        law = FrictionLaw(third=None)
        model = RobotModel.from_urdf(URDF, friction=law, coupling=Coupling(self.TURNS))
        standard = model.nominal
        standard[model.layout.rotors] = 0.4, 0.1
        standard[model.layout.couplings] = inertia
        return model, standard

    @pytest.mark.parametrize("inertia", [0.12, 0.6, -0.6])
    def test_the_rotor_matrix_is_positive(self, inertia):
        """At no cost if the true one is."""
        model, standard = self.coupled(inertia)
        friction = np.full(len(model.friction.terms), 0.8)
        values = np.concatenate([model.base.grouping @ standard, friction])
        consistent = fit_of(values, 0.01, 1, model=model)
        assert np.linalg.eigvalsh(model.layout.rotor_matrix(consistent.standard))[0] > 0.0
        assert np.all(consistent.margin > 0.0)
        assert (error_rise(consistent) < 1e-4) == (inertia == 0.12)

    def test_inconsistent_coupling_inertias_raise(self):
        model, standard = self.coupled(0.3)
        with pytest.raises(NotConsistentError, match="coupling"):
            write_urdf(URDF, model, standard)

    def test_all_friction_terms_dissipate(self):
        """True friction: larger viscous difference than viscosity, smaller friction at rest."""
        law = FrictionLaw(third=None, asymmetric=True, stribeck=0.3)
        model = RobotModel.from_urdf(URDF, friction=law)
        terms = {"f0": 1.0, "f1": 0.3, "fd": 0.6, "fs": -2.0, "fo": 0.2}
        symbols = [term.symbol for term in model.friction.terms]
        values = values_of(model, [terms[symbol] for symbol in symbols])
        consistent = fit_of(values, 0.01, 1, model=model)
        for joint_terms in model.friction.table(consistent.friction):
            assert joint_terms["f0"] >= 0.0
            assert joint_terms["f0"] + joint_terms["fs"] >= -1e-12
            assert abs(joint_terms["fd"]) <= joint_terms["f1"] + 1e-12
        # Consistent parameters are recovered.
        friction = [(terms | {"f1": 0.9, "fs": 0.7})[symbol] for symbol in symbols]
        consistent = fit_of(values_of(model, friction), 0.0, 1, model=model)
        np.testing.assert_allclose(consistent.friction, friction, rtol=0.02)


class TestConsistentValues:
    """A posterior's parameters, or the most probable possible ones."""

    def posterior(self, values):
        motion = five_sines(MODEL, 2)
        factor = Factor.by_time(MODEL, simulated(MODEL, values, motion, NOISE))
        prior = body_prior(MODEL, factor)
        return factor, prior, *posterior_values(factor, prior.gaussian, 2.0)

    def test_possible_ones_stay(self):
        factor, prior, values, weights = self.posterior(truth())
        assert is_consistent(MODEL, prior.most_probable(values))
        same = consistent_values(MODEL, factor, weights, values, prior, 2.0)
        np.testing.assert_array_equal(same, values)

    def test_impossible_ones_are_replaced_by_those_of_the_program(self):
        factor, prior, values, weights = self.posterior(with_friction(-3.0, 2.0, 1.5, 0.8))
        assert not is_consistent(MODEL, prior.most_probable(values))
        changed = consistent_values(MODEL, factor, weights, values, prior, 2.0)
        consistent = consistent_estimate(
            MODEL, factor, weights=weights, prior=prior, design_effect=2.0
        ).estimate
        np.testing.assert_allclose(changed, consistent.values, rtol=1e-12)
        assert changed[MODEL.parameter_names.index("f0_1")] == pytest.approx(0.0, abs=1e-3)

    @pytest.mark.parametrize("effect", [1.0, 10.0])
    def test_the_program_is_the_posterior_where_no_constraint_acts(self, effect):
        factor, prior, values, weights = self.posterior(truth())
        values, weights = posterior_values(factor, prior.gaussian, effect)
        consistent = consistent_estimate(
            MODEL, factor, weights=weights, prior=prior, design_effect=effect
        )
        std = fit_posterior(MODEL, factor, prior.gaussian, effect).estimate.std
        assert np.abs((consistent.estimate.values - values) / std).max() < 1e-3
        bodies = np.concatenate([consistent.standard, consistent.friction])
        expected = prior.most_probable(values)
        with_prior_std = prior.std > 0.0
        assert np.abs((bodies - expected) / prior.std)[with_prior_std].max() < 1e-3

    def test_bodies_without_prior_and_effect_are_possible(self):
        """The mass of the first link, which only turns about its axis."""
        factor, _, _, weights = self.posterior(truth())
        name = next(name for name in MODEL.layout.names if name.startswith("m"))
        prior = body_prior(MODEL, factor, stated={name: (0.0, np.inf)})
        consistent = consistent_estimate(MODEL, factor, weights=weights, prior=prior)
        assert_consistent(MODEL, consistent)
        values, _ = posterior_values(factor, prior.gaussian)
        std = fit_posterior(MODEL, factor, prior.gaussian, 1.0).estimate.std
        assert np.abs((consistent.estimate.values - values) / std).max() < 0.1

    def test_rows_that_hardly_count_leave_the_prior(self):
        factor, prior, _, weights = self.posterior(truth())
        consistent = consistent_estimate(
            MODEL, factor, weights=weights, prior=prior, design_effect=1e12
        )
        bodies = np.concatenate([consistent.standard, consistent.friction])
        assert np.abs((bodies - prior.mean) / prior.std).max() < 1e-3
        assert_consistent(MODEL, consistent)


TRUTH = truth()
STEP = 1e-3
UNEVEN = np.cumsum(STEP * np.random.default_rng(5).uniform(0.4, 1.6, 6000))
CARRYING = RobotModel.from_urdf(
    URDF, friction=FrictionLaw(third=None), payload=Payload(mass=60.0, centre=(0.3, 0.1, 0.0))
)


def delayed(
    delays, *, model=MODEL, seed=0, speed=1.0, torque_noise=1.0, position_noise=2e-5, time=None
):
    """Simulate two links whose torque is logged `delays` [s] after the position."""
    if time is None:
        time = np.arange(6000) * STEP
    rng = np.random.default_rng(seed)
    late = [four_sines(time - delay, speed) for delay in np.broadcast_to(delays, 2)]
    torque = np.column_stack(
        [
            (model.torque(TRUTH, motion) + model.load_torque(motion))[:, j]
            for j, motion in enumerate(late)
        ]
    )
    shape = torque.shape
    return Recording(
        time=time,
        position=four_sines(time, speed).position + position_noise * rng.standard_normal(shape),
        joint_names=model.joint_names,
        torque=torque + torque_noise * np.array([1.0, 0.2]) * rng.standard_normal(shape),
    )


class TestDelay:
    @pytest.mark.parametrize(
        ("planted", "near", "options"),
        [
            (3.7e-4, 5e-6, {"torque_noise": 0.0, "position_noise": 1e-8}),
            (3.7e-4, 1e-4, {"time": UNEVEN, "torque_noise": 0.3}),
            # Of many cycles.
            *((planted, 3e-4, {}) for planted in (-0.043, 0.01, 0.048)),
            # The known torque of a payload, subtracted with another delay.
            (0.01, 1e-4, {"model": CARRYING, "torque_noise": 0.1}),
        ],
    )
    def test_it_is_found(self, planted, near, options):
        options = {"model": MODEL} | options
        estimate = estimate_delay(delayed(delays=planted, **options), options["model"])
        assert estimate.delay == pytest.approx(planted, abs=near)
        assert estimate.applied == estimate.delay

    def test_it_is_found_in_a_filtered_torque(self):
        time = np.arange(0.0, 8.0, 0.004)
        recording = delayed(delays=0.003, time=time, torque_noise=0.3)
        filtered = replace(recording, torque=low_pass(time, recording.torque, 8.0))
        estimate = estimate_delay(filtered, MODEL, options=Preprocessing(torque_bandwidth=8.0))
        assert estimate.delay == pytest.approx(0.003, abs=4e-4)

    @pytest.mark.long
    def test_noise_does_not_bias_it_and_the_interval_covers(self):
        """Mean within its standard error, scatter over seeds as estimated."""
        estimates = [estimate_delay(delayed(1.6e-3, seed=seed), MODEL) for seed in range(12)]
        error = np.array([estimate.delay - 1.6e-3 for estimate in estimates])
        claimed = np.sqrt(np.mean([estimate.std**2 for estimate in estimates]))
        scatter = error.std(ddof=1)
        assert abs(error.mean()) < 3.0 * scatter / np.sqrt(len(estimates)) + 5e-6
        # The standard deviation of 12 samples has an error of 21 %.
        assert abs(np.log(claimed / scatter)) < 3 * 0.21
        assert all(estimate.significant for estimate in estimates)

    def test_motion_above_its_bandwidth_does_not_spoil_it(self):
        """Fast moves have accelerations at 12 and 17 Hz; the torque has them as well."""
        time = np.arange(6000) * STEP

        def moved(at):
            slow = four_sines(at)
            q, qd, qdd = slow.position, slow.velocity, slow.acceleration
            for rate, size in ((12.0, 2e-3), (17.0, 1e-3)):
                w = 2.0 * np.pi * rate
                phase = w * at[:, None] + np.arange(2)
                q = q + size * np.sin(phase)
                qd = qd + size * w * np.cos(phase)
                qdd = qdd - size * w**2 * np.sin(phase)
            return Motion(at, q, qd, qdd)

        noise = np.random.default_rng(0).standard_normal((2, 6000, 2))
        recording = Recording(
            time=time,
            position=moved(time).position + 1e-7 * noise[0],
            joint_names=MODEL.joint_names,
            torque=MODEL.torque(TRUTH, moved(time - 7e-4)) + 0.1 * noise[1],
        )
        estimate = estimate_delay(recording, MODEL)
        assert estimate.delay == pytest.approx(7e-4, abs=3e-5)
        assert estimate.half_interval < 3e-5

    @pytest.mark.long
    def test_the_scale_of_torques_does_not_bias_it(self):
        """An error of some per cent for one joint follows the motion, as the delay does."""
        errors = []
        for seed in range(6):
            recording = delayed(1.6e-3, seed=seed, torque_noise=0.3)
            scaled = replace(recording, torque=recording.torque * [1.05, 0.95])
            estimate = estimate_delay(scaled, MODEL)
            errors.append((estimate.delay - 1.6e-3) / estimate.half_interval)
            exact = estimate_delay(recording, MODEL)
            assert estimate.half_interval < 1.2 * exact.half_interval
        assert np.abs(errors).max() < 1.5

    def test_friction_that_grows_with_load_does_not_bias_it(self):
        """A tenth of the transmitted torque, whether or not the law has the term."""
        recording = delayed(1.6e-3, torque_noise=0.3)
        motion = four_sines(recording.time - 1.6e-3)
        grown = 0.1 * np.abs(MODEL.gear_torque(TRUTH, motion)) * np.sign(motion.velocity)
        loaded = replace(recording, torque=recording.torque + grown)
        without, beside = (
            estimate_delay(loaded, MODEL.with_friction(load=load)) for load in (False, True)
        )
        for found in (without, beside):
            assert found.delay == pytest.approx(1.6e-3, abs=found.half_interval)
            assert found.half_interval < 2e-4

    def test_recordings_in_succession_determine_it_better(self):
        recordings = [delayed(1.6e-3, seed=seed) for seed in range(4)]
        single = estimate_delay(recordings[0], MODEL)
        every = estimate_delay(in_succession(recordings), MODEL)
        assert every.delay == pytest.approx(1.6e-3, abs=1.5 * every.half_interval)
        assert every.half_interval < 0.7 * single.half_interval

    def test_it_is_combined_with_a_stated_delay_by_their_certainty(self):
        """Between the two, significant or not; a stated one that is impossible does not count."""
        estimate = DelayEstimate(
            delay=3e-4, std=1e-9, assumed=0.0, cycle=1e-3, interval_factor=2.0, reason=None,
            significant=False,
        )  # fmt: skip
        certain = estimate.combined(0.0, 1e-3)
        assert certain.mean == pytest.approx(3e-4)
        assert certain.mean_square_error(0.0) == pytest.approx(3e-4**2)
        assert certain.mean_square_error(3e-4) < 1e-17
        believed = 1e-3**2 / 3.0
        for equal in (
            replace(estimate, std=np.sqrt(believed)).combined(0.0, 1e-3),
            estimate.combined(0.0, 1e-3, bias=np.sqrt(believed)),
        ):
            assert equal.mean == pytest.approx(1.5e-4, rel=0.05)
            assert equal.mean_square_error(0.0) == pytest.approx(
                1.5e-4**2 + believed / 2.0, rel=0.06
            )
        far = replace(estimate, delay=5e-3, std=1e-4).combined(0.0, 1e-3)
        assert far.mean == pytest.approx(5e-3, abs=1e-5)
        assert far.variance == pytest.approx(1e-4**2, rel=0.01)
        for std, reason in (
            (np.inf, UndeterminedDelay.INSEPARABLE), (1e-4, UndeterminedDelay.AT_LIMIT),
        ):  # fmt: skip
            unknown = replace(estimate, std=std, reason=reason).combined(0.0, 1e-3)
            assert unknown.mean == 0.0
            assert unknown.variance == pytest.approx(believed)

    def test_a_delay_beyond_the_range_is_undetermined(self):
        estimate = estimate_delay(delayed(0.06), MODEL)
        assert estimate.reason is UndeterminedDelay.AT_LIMIT
        assert estimate.applied == 0.0

    def test_it_is_found_beside_an_assumed_delay(self):
        recording = delayed(0.004)
        estimate = estimate_delay(recording, MODEL, options=Preprocessing(torque_delay=0.003))
        assert estimate.delay == pytest.approx(0.004, abs=3e-4)
        assert estimate.significant
        right = estimate_delay(recording, MODEL, options=Preprocessing(torque_delay=0.004))
        assert not right.significant
        assert right.applied == 0.004

    @pytest.mark.long
    def test_encoder_noise_in_a_servo_loop_biases_it_little(self):
        """Simulated cell in closed loop: within 0.05 ms of the true 0.2 ms."""
        t = np.arange(6001) * STEP
        window = np.clip(np.minimum(t, t[-1] - t), 0.0, 1.0)
        soft = window**3 * (10.0 - 15.0 * window + 6.0 * window**2)
        angle = np.array([4.1, 4.7, 5.5, 7.3, 8.1, 9.0]) * t[:, None] + np.arange(6)
        swing = soft[:, None] * (np.sin(angle) + 0.4 * np.sin(2.3 * angle))
        position = np.radians([10.0, -100.0, 170.0, -30.0, 60.0, 20.0])
        position = position + np.radians([12.0, 8.0, 10.0, 22.0, 20.0, 25.0]) * swing
        cell = Cell.load(CELL_PATH)
        train = cell.drive_train
        noise = cell.simulation
        controller = SimulatedController(
            urdf_text(), DRIVE, PLANT,
            ControllerSettings(
                current_noise=noise.current_noise, current_resolution=noise.current_resolution
            ),
            seed=3, initial_position=position[0],
        )  # fmt: skip
        deltas = train.motor_revolutions_per_cycle(np.gradient(position, STEP, axis=0), STEP)
        axes = MinimalPC(controller, train.motor_revolutions(position), deltas).run(settle=50).axes
        law = FrictionLaw(third=None, standstill=0.1)
        model = RobotModel.from_urdf(urdf_text(), friction=law)
        recorded = Recording(
            time=np.arange(len(axes)) * STEP,
            position=train.joint_position(axes["d"][:, :, 2].astype(float)),
            joint_names=model.joint_names,
            torque=train.joint_torque(axes["d"][:, :, 4].astype(float)),
        )
        planted = controller.current_delay_cycles * STEP
        assert estimate_delay(recorded, model).delay == pytest.approx(planted, abs=5e-5)

    def test_a_resting_axis_does_not_matter(self):
        late = four_sines(np.arange(6000) * STEP - 7e-4).converted(lambda part: part * [1.0, 0.0])
        noise = np.random.default_rng(1).standard_normal((2, 6000, 2))
        still = delayed(0.0)
        still = replace(
            still,
            position=four_sines(still.time).position * [1.0, 0.0] + 1e-6 * noise[0],
            torque=MODEL.torque(TRUTH, late) + 0.1 * noise[1],
        )
        assert estimate_delay(still, MODEL).applied == pytest.approx(7e-4, abs=1e-4)

    def test_presliding_friction_is_read_at_the_same_time(self):
        law = FrictionLaw(third=None, presliding=1e-3)
        model = RobotModel.from_urdf(URDF, friction=law)
        time = np.arange(6000) * STEP
        late = replace(four_sines(time - 0.005), time=time)
        late = replace(late, direction=model.friction.direction(late))
        recording = replace(delayed(0.0, model=model), torque=model.torque(TRUTH, late))
        assert estimate_delay(recording, model).delay == pytest.approx(0.005, abs=5e-5)


class TestUndeterminedDelay:
    def test_a_slow_motion_does_not_determine_it(self):
        slow = estimate_delay(delayed(0.0, speed=0.05), MODEL)
        assert not slow.determined
        assert slow.applied == 0.0
        assert slow.reason is UndeterminedDelay.WIDE_INTERVAL
        assert undetermined_words(slow).startswith("± ")
        unknown = replace(slow, std=np.inf)
        assert unknown.variance == pytest.approx(MAX_ESTIMATED_DELAY**2 / 3.0)
        assert replace(slow, std=1e-4).variance == pytest.approx(1e-8)

    def test_an_uncertain_significant_delay_is_applied(self):
        estimate = estimate_delay(delayed(0.045, speed=0.3, seed=2), MODEL)
        assert estimate.reason is not None and estimate.significant
        assert estimate.applied == estimate.delay

    def test_a_recording_without_motion_raises(self):
        still = delayed(0.0, speed=0.0)
        with pytest.raises(IdentificationError, match="not one usable sample"):
            estimate_delay(still, MODEL)


class TestDelayUncertainty:
    def fit(self, model, samples):
        return estimate(model, Factor.of(model, samples), np.array([1.0, 25.0]))

    def test_the_sensitivity_is_the_derivative_of_the_estimate(self):
        """Compared with fits at delays half a millisecond shorter and longer."""
        recording = delayed(0.004, torque_noise=0.0, position_noise=1e-8)

        def samples(delay):
            options = Preprocessing(torque_delay=delay, exclude_rows="slow", rigid_bandwidth=40.0)
            return prepare(recording, MODEL, options=options)

        middle = samples(0.004)
        fitted = self.fit(MODEL, middle)
        products = rate_products(MODEL, middle)
        fitted = replace(fitted, noise_std=np.array([1.0, 0.2]))  # as weighted
        wider = with_uncertain_delay(fitted, Factor.of(MODEL, middle), products, 0.25)
        ends = [self.fit(MODEL, samples(0.004 + side)).values for side in (-5e-4, 5e-4)]
        slope = (ends[1] - ends[0]) / 1e-3
        sensitivity = delay_sensitivity(fitted, Factor.of(MODEL, middle), products)
        np.testing.assert_allclose(sensitivity, slope, rtol=0.03, atol=1e-3)
        added = wider.covariance - fitted.covariance
        np.testing.assert_allclose(added, 0.25 * np.outer(slope, slope), rtol=0.06, atol=1e-6)
        np.testing.assert_array_equal(wider.values, fitted.values)
        # An undetermined parameter stays undetermined.
        covariance = fitted.covariance.copy()
        covariance[0, :] = covariance[:, 0] = 0.0
        covariance[0, 0] = np.inf
        unknown = replace(fitted, covariance=covariance)
        wider = with_uncertain_delay(unknown, Factor.of(MODEL, middle), products, 1.0)
        assert np.isinf(wider.covariance[0, 0])
        np.testing.assert_array_equal(wider.covariance[0, 1:], 0.0)
