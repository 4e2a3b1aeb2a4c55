from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.factor.factor import (
    Factor,
    estimate,
    joint_weights,
    residual_variance,
    solve,
    total,
)
from identification.model.friction import FrictionLaw
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from tests.identification.two_link import sine_motion

Array = NDArray[np.float64]

URDF = (Path(__file__).parent / "two_link.urdf").read_text()
NOISE = np.array([3.0, 0.2])  # N·m, very different per joint


def a_motion(samples: int = 3000, *, step: float = 2e-3, held_elbow: bool = False) -> Motion:
    time = np.arange(samples) * step
    amplitude, rate = np.array([0.9, 0.0 if held_elbow else 1.2]), np.array([2.1, 3.7])
    return sine_motion(time, amplitude, rate, np.array([0.3, 1.1]), np.array([0.0, 0.4]))


def noisy_factor(model: RobotModel, truth: Array, seed: int, noise: Array = NOISE) -> Factor:
    motion = a_motion()
    torque = model.torque(truth, *motion[1:])
    torque += noise * np.random.default_rng(seed).standard_normal(torque.shape)
    return Factor.from_samples(model, motion, torque, model.moving(motion.velocity))


def test_without_noise_the_truth_comes_back(model: RobotModel, truth: Array) -> None:
    result = estimate(model, noisy_factor(model, truth, 0, noise=np.zeros(2)))
    np.testing.assert_allclose(result.values, truth, rtol=1e-6, atol=1e-7)
    assert result.undetermined == ()
    assert result.names == model.parameter_names
    assert result.value("f0_2") == pytest.approx(2.0, rel=1e-6)


def test_the_residual_of_each_joint_is_the_noise_of_each_joint(
    model: RobotModel, truth: Array
) -> None:
    result = estimate(model, noisy_factor(model, truth, 1))
    np.testing.assert_allclose(result.noise_std, NOISE, rtol=0.05)


def test_it_is_the_least_squares_solution_of_the_stacked_weighted_rows(
    model: RobotModel, truth: Array
) -> None:
    motion = a_motion(400)
    torque = model.torque(truth, *motion[1:])
    torque += NOISE * np.random.default_rng(2).standard_normal(torque.shape)
    weights = np.array([0.3, 20.0])
    rows = model.regressor(*motion[1:]).dense(model.n_parameters) * np.sqrt(weights)[:, None]
    expected = np.linalg.lstsq(
        rows.reshape(-1, model.n_parameters), (torque * np.sqrt(weights)).ravel(), rcond=None
    )[0]
    result = estimate(model, Factor.from_samples(model, motion, torque), weights)
    np.testing.assert_allclose(result.values, expected, rtol=1e-7, atol=1e-9)


def test_weights_are_the_inverse_residual_variances_of_a_first_pass(
    model: RobotModel, truth: Array
) -> None:
    np.testing.assert_allclose(
        joint_weights(noisy_factor(model, truth, 3)), 1.0 / NOISE**2, rtol=0.2
    )


def test_weighting_pays_when_joints_differ_in_noise(model: RobotModel, truth: Array) -> None:
    factors = [noisy_factor(model, truth, seed) for seed in range(30)]
    plain = np.array([solve(f.weighted(np.ones(2))).values for f in factors]) - truth
    weighted = np.array([estimate(model, f).values for f in factors]) - truth
    elbow = [model.parameter_names.index(name) for name in ("f0_2", "f1_2")]
    assert np.sqrt(np.mean(weighted[:, elbow] ** 2)) < np.sqrt(np.mean(plain[:, elbow] ** 2))


def test_with_white_noise_the_classical_covariance_is_that_of_many_trials(
    model: RobotModel, truth: Array
) -> None:
    trials = [estimate(model, noisy_factor(model, truth, seed)) for seed in range(150)]
    scatter = np.std([trial.values for trial in trials], axis=0)
    np.testing.assert_allclose(trials[0].std, scatter, rtol=0.25)


@given(st.integers(2, 12), st.integers(0, 2**16))
def test_pooling_is_the_estimate_from_all_samples_at_once(pieces: int, seed: int) -> None:
    model = RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))
    rng = np.random.default_rng(seed)
    motion = a_motion(600)
    torque = rng.standard_normal((600, 2))
    whole = Factor.from_samples(model, motion, torque)
    edges = np.linspace(0, 600, pieces + 1).astype(int)
    parts = [
        Factor.from_samples(model, motion.rows(slice(a, b)), torque[a:b])
        for a, b in pairwise(edges)
    ]
    np.testing.assert_allclose(
        estimate(model, total(parts)).values, estimate(model, whole).values, rtol=1e-7, atol=1e-9
    )


def test_what_the_motion_does_not_determine_is_named_and_has_no_finite_variance(
    model: RobotModel, truth: Array
) -> None:
    motion = a_motion(held_elbow=True)
    torque = model.torque(truth, *motion[1:])
    result = estimate(model, Factor.from_samples(model, motion, torque))
    # The elbow stands: its friction has no column, its inertia no acceleration of its own.
    assert {"f0_2", "f1_2", "I2m"} <= set(result.undetermined)
    assert {"f0_1", "f1_1"}.isdisjoint(result.undetermined)
    known = np.array([name not in result.undetermined for name in result.names])
    assert np.isinf(result.std[~known]).all()
    assert np.isfinite(result.std[known]).all()
    np.testing.assert_allclose(result.values[known], truth[known], rtol=1e-3)
    # Even so it predicts what it was fitted to.
    np.testing.assert_allclose(model.torque(result.values, *motion[1:]), torque, atol=1e-4)


def test_parameters_that_always_move_together_are_both_named(
    model: RobotModel, truth: Array
) -> None:
    factor = noisy_factor(model, truth, 4)
    # Viscous friction made a multiple of Coulomb's, as if the joint had one speed only.
    i, j = (model.parameter_names.index(name) for name in ("f0_1", "f1_1"))
    gram = factor.gram.copy()
    gram[:, j, :] = 2.0 * gram[:, i, :]
    gram[:, :, j] = 2.0 * gram[:, :, i]
    gram[:, j, j] = 4.0 * factor.gram[:, i, i]
    result = estimate(model, replace(factor, matrices=gram))
    assert set(result.undetermined) == {"f0_1", "f1_1"}
    assert np.isinf(result.condition) or result.condition > 1e6


def test_the_condition_does_not_depend_on_units(model: RobotModel, truth: Array) -> None:
    factor = noisy_factor(model, truth, 5)
    scale = np.append(np.logspace(-3, 3, model.n_parameters), 1.0)
    scaled = replace(factor, matrices=factor.gram * np.outer(scale, scale))
    first, second = (estimate(model, f) for f in (factor, scaled))
    assert second.condition == pytest.approx(first.condition, rel=1e-6)
    np.testing.assert_allclose(second.values, first.values / scale[:-1], rtol=1e-6)


def test_parameters_take_degrees_of_freedom_from_the_residual(
    model: RobotModel, truth: Array
) -> None:
    # So few rows that the parameters take half of them: the plain mean would be biased low.
    found = []
    for seed in range(300):
        motion = a_motion(11, step=0.4)
        torque = model.torque(truth, *motion[1:])
        torque += np.random.default_rng(seed).standard_normal(torque.shape)
        factor = Factor.from_samples(model, motion, torque)
        weights = np.ones(2)
        solution = solve(factor.weighted(weights))
        found.append(residual_variance(factor, solution.values, solution.root, weights))
    np.testing.assert_allclose(np.mean(found, axis=0), 1.0, rtol=0.15)


def test_a_recording_without_a_usable_row_is_an_error(model: RobotModel) -> None:
    with pytest.raises(IdentificationError, match="not one usable sample"):
        estimate(model, Factor.zero(model))


def test_a_joint_without_rows_has_no_noise_and_no_weight(model: RobotModel, truth: Array) -> None:
    motion = a_motion()
    torque = model.torque(truth, *motion[1:])
    mask = np.ones(torque.shape, dtype=bool)
    mask[:, 1] = False
    result = estimate(model, Factor.from_samples(model, motion, torque, mask))
    assert np.isnan(result.noise_std[1])
    assert "f0_2" in result.undetermined
