"""Factors of samples, Gram matrices or triangles, and least squares on them."""

import tracemalloc
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.errors import IdentificationError
from identification.estimators.covariance import with_block_covariance
from identification.estimators.least_squares import fit_least_squares
from identification.estimators.robust import robust_estimate
from identification.factor.estimate import estimate, joint_weights, residual_variance
from identification.factor.estimation_method import LeastSquares
from identification.factor.factor import MAX_GRAM_CONDITION, Factor, reduced, total_factor
from identification.factor.normal_equations import solve, solve_rows
from identification.factor.rows import augmented_rows
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from sim_fixtures.ns16 import urdf_text
from tests.identification import two_link
from tests.identification.two_link import (
    MODEL,
    NOISE,
    URDF,
    P,
    coloured,
    one_sine,
    recording,
    truth,
)

both = pytest.mark.parametrize("storage", ["gram", "qr"])


def some_samples(m):
    """Return the NS 16, random motion of it, and random torque."""
    q, qd, qdd, torque = np.random.default_rng(0).uniform(-3.0, 3.0, (4, m, 6))
    motion = Motion(np.arange(m) * 1e-3, q, qd, qdd)
    return RobotModel.from_urdf(urdf_text()), motion, 100.0 * torque


def a_motion(samples=3000, *, step=0.002, held_elbow=False):
    time = np.arange(samples) * step
    return one_sine(time, centre=np.array([0.0, 0.4]), held_elbow=held_elbow)


def ill():
    """Motion of scaled condition 1e7: the elbow turns one way at nearly constant speed."""
    time = np.arange(400) * 2e-3
    motion = one_sine(time, (0.9, 1e-5))
    motion.position[:, 1] += time
    motion.velocity[:, 1] += 1.0
    return recording(np.zeros((400, 2)), motion)


def noisy(motion, noise=0.0, seed=0):
    error = noise * np.random.default_rng(seed).standard_normal((len(motion.time), 2))
    return recording(error, motion)


def summed(storage, parts):
    factors = (Factor.of(MODEL, part, storage) for part in parts)
    return sum(factors, Factor.zero(MODEL, storage=storage))


def exact_solution(samples):
    """Solve least squares in rational arithmetic from the float rows."""
    blocks = MODEL.regressor(samples.motion).dense(P)
    table = np.concatenate([blocks, samples.torque[:, :, None]], axis=2)[samples.usable]
    rows = [[Fraction(float(x)) for x in row] for row in table]
    gram = [[sum(r[i] * r[j] for r in rows) for j in range(P + 1)] for i in range(P)]
    for i in range(P):
        for k in range(i + 1, P):
            share = gram[k][i] / gram[i][i]
            gram[k] = [a - share * b for a, b in zip(gram[k], gram[i], strict=True)]
    values = [Fraction(0)] * P
    for i in reversed(range(P)):
        remainder = gram[i][P] - sum(gram[i][j] * values[j] for j in range(i + 1, P))
        values[i] = remainder / gram[i][i]
    return np.array([float(v) for v in values])


class TestFactor:
    def test_the_gram_is_that_of_the_usable_rows(self):
        """Masked rows may hold any values; input arrays are unchanged."""
        model, motion, torque = some_samples(200)
        mask = np.ones((200, 6), dtype=bool)
        mask[40:80, 2] = False
        torque[40:80, 2] = np.nan
        before = {name: array.copy() for name, array in motion.columns().items()}
        of_torque = torque.copy()
        factor = Factor.from_samples(model, motion, torque, mask)
        for name, array in motion.columns().items():
            np.testing.assert_array_equal(array, before[name])
        np.testing.assert_array_equal(torque, of_torque)
        dense = model.regressor(motion).dense(58)
        for joint in range(6):
            rows = np.column_stack([dense[:, joint], torque[:, joint]])[mask[:, joint]]
            np.testing.assert_allclose(factor.gram[joint], rows.T @ rows, rtol=1e-12, atol=1e-9)
        assert factor.samples.tolist() == [200, 200, 160, 200, 200, 200]
        assert (factor.n_joints, factor.n_parameters) == (6, 58)

    @both
    @given(pieces=st.integers(1, 300), seed=st.integers(0, 2**16))
    @settings(max_examples=6)
    def test_that_of_a_union_is_the_sum(self, storage, pieces, seed):
        """Gram matrices and triangles agree to nine digits, with any weights of joints."""
        samples = noisy(a_motion(1500), NOISE, seed)
        random = np.random.default_rng(seed)
        edges = random.integers(0, 1501, pieces - 1)
        weights = random.uniform(0.1, 20.0, 2)
        edges = np.unique([0, *edges, 1500]).tolist()
        many = summed(storage, [samples.between(*part) for part in pairwise(edges)])
        whole = Factor.of(MODEL, samples, "qr")
        size = np.abs(whole.gram).max(axis=(1, 2), keepdims=True)
        assert np.abs((many.gram - whole.gram) / size).max() < 1e-13
        np.testing.assert_array_equal(many.samples, whole.samples)
        np.testing.assert_allclose(joint_weights(many), joint_weights(whole), rtol=1e-9)
        for joint_weights_or_none in (None, weights):
            of_sum = estimate(MODEL, many, joint_weights_or_none)
            other = estimate(MODEL, whole, joint_weights_or_none)
            for name in ("values", "std", "noise_std", "condition"):
                np.testing.assert_allclose(getattr(of_sum, name), getattr(other, name), rtol=1e-9)
            scale = np.outer(of_sum.std, of_sum.std)
            assert np.abs((of_sum.covariance - other.covariance) / scale).max() < 1e-9
            assert of_sum.method.fit.by_qr == (storage == "qr")

    def test_the_dense_regressor_is_not_allocated(self):
        model, motion, torque = some_samples(30_000)
        tracemalloc.start()
        Factor.from_samples(model, motion, torque)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 0.2 * 30_000 * 6 * 58 * 8

    def test_factors_of_other_models_or_storage_raise(self):
        other = RobotModel.from_urdf(URDF, rotor_inertia=False)
        for factor in (Factor.zero(other), Factor.zero(MODEL, storage="qr")):
            with pytest.raises(IdentificationError, match="cannot be added"):
                _ = Factor.of(MODEL, noisy(a_motion(50))) + factor

    @pytest.mark.parametrize("bandwidth", [None, np.array([60.0, 80.0])])
    def test_rows_are_regressor_and_torque(self, bandwidth):
        samples = replace(noisy(a_motion(3000), NOISE), torque_bandwidth=bandwidth)
        samples.torque[~samples.usable] = np.nan
        blocks, columns = samples.regressor(MODEL)
        chunks = [(part, [b.copy() for b in rows]) for part, rows in augmented_rows(MODEL, samples)]
        assert len(chunks) > 1
        for joint in range(2):
            table = np.concatenate([rows[joint] for _, rows in chunks], axis=1).T
            expected = np.column_stack([blocks[joint], samples.torque[:, joint]])
            expected[~samples.usable[:, joint]] = 0.0
            np.testing.assert_allclose(table, expected, rtol=1e-12, atol=1e-12)
            np.testing.assert_array_equal(MODEL.plan.columns[joint], columns[joint])
        assert (chunks[0][0].start, chunks[-1][0].stop) == (0, 3000)


class TestConditioning:
    def test_qr_is_more_accurate_than_gram(self):
        samples = ill()
        ordinary = np.ones(2)
        exact = exact_solution(samples)
        solution = Factor.of(MODEL, samples, "qr").solve(ordinary)
        assert 3e6 < solution.condition < 1e8
        assert solution.determined.all()
        np.testing.assert_allclose(solution.values, exact, rtol=1e-7)
        equations = Factor.of(MODEL, samples).weighted(ordinary)
        assert np.abs(np.linalg.solve(equations.A, equations.b) / exact - 1.0).max() > 1e-2
        # The estimate on Gram matrices reports this.
        assert not solve(equations).determined.all()

    def test_qr_resolves_small_residuals(self):
        """A residual of 1e-9 of the torque, below the resolution of a Gram matrix."""
        samples = noisy(a_motion(), 1e-9 * NOISE)
        ordinary = np.ones(2)
        errors = []
        for storage in ("qr", "gram"):
            factor = Factor.of(MODEL, samples, storage)
            solution = factor.solve(ordinary)
            variance = residual_variance(factor, solution.values, solution.root, ordinary)
            errors.append(np.abs(np.sqrt(variance) / (1e-9 * NOISE) - 1.0).max())
        assert errors[0] < 0.05
        assert errors[1] > 1.0

    def test_the_condition_selects_gram_or_qr(self):
        good = noisy(a_motion(), NOISE)
        bad = ill()
        assert reduced(MODEL, [good], Factor.of(MODEL, good)).storage == "gram"
        factor = reduced(MODEL, [bad, bad], summed("gram", [bad, bad]))
        assert factor.storage == "qr"
        assert factor.solve(np.ones(2)).condition > MAX_GRAM_CONDITION
        np.testing.assert_array_equal(factor.samples, 2 * np.count_nonzero(bad.usable, axis=0))
        estimated = fit_least_squares(MODEL, [bad])
        assert estimated.method.fit.by_qr
        np.testing.assert_allclose(estimated.values, truth(), rtol=1e-4)
        assert robust_estimate(MODEL, [bad]).estimate.method.fit.by_qr

    @both
    def test_undetermined_parameters_are_named(self, storage):
        motion = a_motion(held_elbow=True)
        samples = replace(noisy(motion), usable=np.ones((3000, 2), dtype=bool))
        result = estimate(MODEL, Factor.of(MODEL, samples, storage))
        # The elbow rests: no friction column, no own acceleration.
        assert {"f0_2", "f1_2", "I2m"} <= set(result.undetermined)
        assert {"f0_1", "f1_1"}.isdisjoint(result.undetermined)
        determined = np.array([name not in result.undetermined for name in result.names])
        assert np.isinf(result.std[~determined]).all()
        assert np.isfinite(result.std[determined]).all()
        np.testing.assert_allclose(result.values[determined], truth()[determined], rtol=1e-3)
        # It still predicts the fitted motion.
        predicted = MODEL.torque(result.values, motion)
        np.testing.assert_allclose(predicted, samples.torque, atol=1e-4)

    def test_dependent_parameters_are_both_named_in_any_units(self):
        """Viscous friction proportional to Coulomb friction, as at one speed."""
        factor = Factor.of(MODEL, noisy(a_motion(), NOISE))
        first = estimate(MODEL, factor)

        def moved(columns):
            gram = columns.T @ factor.gram @ columns
            return estimate(MODEL, Factor.of_gram(gram, factor.samples, factor.parameter_names))

        scale = np.append(np.logspace(-3, 3, P), 1.0)
        scaled = moved(np.diag(scale))
        assert scaled.condition == pytest.approx(first.condition, rel=1e-6)
        np.testing.assert_allclose(scaled.values, first.values / scale[:-1], rtol=1e-6)
        i, j = (MODEL.parameter_names.index(name) for name in ("f0_1", "f1_1"))
        dependent = np.eye(P + 1)
        dependent[:, j] = 2.0 * dependent[:, i]
        result = moved(dependent)
        assert set(result.undetermined) == {"f0_1", "f1_1"}
        assert result.condition > 1e6

    @both
    def test_joints_without_rows_have_no_noise_and_no_weight(self, storage):
        samples = noisy(a_motion(), NOISE)
        samples.usable[:, 1] = False
        factor = Factor.of(MODEL, samples, storage)
        assert joint_weights(factor)[1] == 0.0
        result = estimate(MODEL, factor)
        assert np.isnan(result.noise_std[1])
        assert "f0_2" in result.undetermined
        with pytest.raises(IdentificationError, match="not one usable sample"):
            estimate(MODEL, Factor.zero(MODEL, storage=storage))

    @given(k=st.integers(1, 12), p=st.integers(1, 8), seed=st.integers(0, 999))
    def test_rows_are_solved_as_by_the_pseudo_inverse(self, k, p, seed):
        random = np.random.default_rng(seed)
        rows = random.standard_normal((k, p))
        target = random.standard_normal(k)
        scale = np.linalg.norm(rows, axis=0)
        solution = solve_rows(rows, target)
        expected = np.linalg.pinv(rows / scale) @ target / scale
        np.testing.assert_allclose(solution.values, expected, rtol=1e-6, atol=1e-8)
        inverse = np.linalg.pinv((rows / scale).T @ (rows / scale)) / np.outer(scale, scale)
        atol = 1e-6 * np.abs(inverse).max()
        np.testing.assert_allclose(solution.inverse, inverse, rtol=1e-5, atol=atol)
        assert solution.determined.all() == (k >= p)


class TestEstimate:
    def trial(self, seed, noise=NOISE):
        return Factor.of(MODEL, noisy(a_motion(), noise, seed))

    def test_values_noise_and_weights_are_the_true_ones(self):
        exact = estimate(MODEL, self.trial(0, np.zeros(2)))
        factor = self.trial(1)
        np.testing.assert_allclose(exact.values, truth(), rtol=1e-6, atol=1e-7)
        assert exact.undetermined == ()
        assert exact.value("f0_2") == pytest.approx(2.0, rel=1e-6)
        np.testing.assert_allclose(estimate(MODEL, factor).noise_std, NOISE, rtol=0.05)
        np.testing.assert_allclose(joint_weights(factor), 1.0 / NOISE**2, rtol=0.2)

    @pytest.mark.parametrize("weights", [np.ones(2), np.array([0.3, 20.0])])
    def test_it_solves_the_stacked_weighted_rows(self, weights):
        samples = noisy(a_motion(400), NOISE, 2)
        rows = MODEL.regressor(samples.motion).dense(P) * np.sqrt(weights)[:, None]
        right = samples.torque * np.sqrt(weights)
        some = samples.usable
        expected, *_ = np.linalg.lstsq(rows[some], right[some], rcond=None)
        result = estimate(MODEL, Factor.of(MODEL, samples), weights)
        np.testing.assert_allclose(result.values, expected, rtol=1e-7, atol=1e-9)
        if np.all(weights == 1.0):
            ordinary = fit_least_squares(MODEL, [samples], "ordinary")
            np.testing.assert_allclose(ordinary.values, expected, rtol=1e-8)

    def test_parameters_reduce_degrees_of_freedom(self):
        """With half as many parameters as rows."""
        variances = []
        weights = np.ones(2)
        motion = a_motion(11, step=0.4)
        for seed in range(300):
            factor = Factor.from_samples(MODEL, motion, noisy(motion, 1.0, seed).torque)
            solution = factor.solve(weights)
            variances.append(residual_variance(factor, solution.values, solution.root, weights))
        np.testing.assert_allclose(np.mean(variances, axis=0), 1.0, rtol=0.15)

    @pytest.mark.parametrize("weighting", ["ordinary", "weighted"])
    def test_covariance_from_rows_is_that_from_blocks(self, weighting):
        motion = two_link.a_motion()
        rng = np.random.default_rng(9)
        runs = [recording(coloured(rng, len(motion.time), 5e-3, 0.05), motion) for _ in range(3)]
        factor = total_factor(MODEL, runs)
        weights = np.ones(2) if weighting == "ordinary" else joint_weights(factor)
        expected = with_block_covariance(estimate(MODEL, factor, weights), factor, weights)
        fitted = fit_least_squares(MODEL, runs, weighting)
        np.testing.assert_allclose(fitted.values, expected.values, rtol=1e-9)
        np.testing.assert_allclose(fitted.std, expected.std, rtol=1e-6)
        assert fitted.interval_factor == expected.interval_factor
        assert fitted.method == replace(expected.method, fit=LeastSquares(weighting))
