from __future__ import annotations

import tracemalloc
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification import Factor, IdentificationError, Motion, RobotModel, ShapeError
from sim_fixtures.ns16 import urdf_text


@cache
def ns16() -> RobotModel:
    return RobotModel.from_urdf(urdf_text())


def samples(m: int, seed: int = 0) -> tuple[Motion, np.ndarray]:
    random = np.random.default_rng(seed)
    q, qd, qdd, torque = random.uniform(-3.0, 3.0, (4, m, 6))
    return Motion(np.arange(m) * 1e-3, q, qd, qdd), 100.0 * torque


def part(motion: Motion, which: slice) -> Motion:
    return motion.rows(which)


def assert_same(one: Factor, other: Factor) -> None:
    size = np.abs(other.gram).max(axis=(1, 2), keepdims=True) + 1e-300
    assert np.abs((one.gram - other.gram) / size).max() < 1e-14
    assert np.array_equal(one.samples, other.samples)


def test_the_gram_is_that_of_the_dense_regressor_and_the_torque() -> None:
    model, (motion, torque) = ns16(), samples(200)
    factor = Factor.from_samples(model, motion, torque)
    dense = model.regressor(*motion[1:]).dense(58)
    for joint in range(6):
        rows = np.column_stack([dense[:, joint], torque[:, joint]])
        assert np.allclose(factor.gram[joint], rows.T @ rows, rtol=1e-12, atol=1e-9)
    assert factor.samples.tolist() == [200] * 6
    assert (factor.n_joints, factor.n_parameters) == (6, 58)


@given(m=st.integers(2, 3000), share=st.floats(0.0, 1.0), seed=st.integers(0, 99))
def test_the_factor_of_a_union_is_the_sum_of_the_factors(m: int, share: float, seed: int) -> None:
    model, (motion, torque) = ns16(), samples(m, seed)
    mask = np.random.default_rng(seed).random((m, 6)) < 0.7
    cut = round(share * m)
    first, second = slice(0, cut), slice(cut, m)
    halves = [
        Factor.from_samples(model, part(motion, s), torque[s], mask[s]) for s in (first, second)
    ]
    assert_same(halves[0] + halves[1], Factor.from_samples(model, motion, torque, mask))


def test_a_sum_of_many_starts_from_zero() -> None:
    model, (motion, torque) = ns16(), samples(90)
    thirds = [slice(0, 30), slice(30, 60), slice(60, 90)]
    parts = [Factor.from_samples(model, part(motion, s), torque[s]) for s in thirds]
    assert_same(sum(parts, Factor.zero(model)), Factor.from_samples(model, motion, torque))


def test_masked_rows_do_not_count_whatever_they_hold() -> None:
    model, (motion, torque) = ns16(), samples(120)
    mask = np.ones((120, 6), dtype=bool)
    mask[40:80, 2] = False
    spoiled = torque.copy()
    spoiled[40:80, 2] = np.nan
    factor = Factor.from_samples(model, motion, spoiled, mask)
    assert factor.samples.tolist() == [120, 120, 80, 120, 120, 120]
    kept = np.r_[0:40, 80:120]
    dense = model.regressor(*motion[1:]).dense(58)
    rows = np.column_stack([dense[kept, 2], torque[kept, 2]])
    assert np.allclose(factor.gram[2], rows.T @ rows, rtol=1e-12, atol=1e-9)


def test_the_inputs_are_left_alone() -> None:
    model, (motion, torque) = ns16(), samples(50)
    before = [array.copy() for array in (*motion[:4], torque)]
    Factor.from_samples(model, motion, torque, np.zeros((50, 6), dtype=bool))
    for array, copy in zip((*motion[:4], torque), before, strict=True):
        assert np.array_equal(array, copy)


def test_weights_are_applied_joint_by_joint_afterwards() -> None:
    model, (motion, torque) = ns16(), samples(150)
    factor = Factor.from_samples(model, motion, torque)
    weights = np.array([1.0, 0.5, 2.0, 10.0, 0.0, 3.0])
    equations = factor.weighted(weights)
    dense = model.regressor(*motion[1:]).dense(58)
    rows = (dense * np.sqrt(weights)[None, :, None]).reshape(-1, 58)
    right = (torque * np.sqrt(weights)).reshape(-1)
    assert np.allclose(equations.A, rows.T @ rows, rtol=1e-11, atol=1e-8)
    assert np.allclose(equations.b, rows.T @ right, rtol=1e-11, atol=1e-7)
    assert equations.yy == pytest.approx(right @ right, rel=1e-13)
    assert equations.n == 900


def test_the_planted_parameters_come_back() -> None:
    model, (motion, _) = ns16(), samples(400)
    planted = np.random.default_rng(1).uniform(1.0, 2.0, 58)
    factor = Factor.from_samples(model, motion, model.torque(planted, *motion[1:]))
    equations = factor.weighted(np.ones(6))
    assert np.allclose(np.linalg.solve(equations.A, equations.b), planted, rtol=1e-9)


def test_the_dense_regressor_is_never_made() -> None:
    model, (motion, torque) = ns16(), samples(30_000)
    tracemalloc.start()
    Factor.from_samples(model, motion, torque)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 0.2 * 30_000 * 6 * 58 * 8


def test_factors_of_different_models_do_not_add() -> None:
    motion, torque = samples(10)
    one = Factor.from_samples(ns16(), motion, torque)
    other = Factor.from_samples(
        RobotModel.from_urdf(urdf_text(), rotor_inertia=False), motion, torque
    )
    with pytest.raises(IdentificationError, match="cannot be added"):
        _ = one + other


def test_arrays_of_the_wrong_shape_are_refused_by_name() -> None:
    model, (motion, torque) = ns16(), samples(10)
    with pytest.raises(ShapeError, match="torque"):
        Factor.from_samples(model, motion, torque[:9])
    with pytest.raises(ShapeError, match="mask"):
        Factor.from_samples(model, motion, torque, np.ones((10, 5), dtype=bool))
    with pytest.raises(ShapeError, match="weights"):
        Factor.from_samples(model, motion, torque).weighted(np.ones(5))
