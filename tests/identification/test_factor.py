from __future__ import annotations

import tracemalloc
from dataclasses import replace
from fractions import Fraction
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.factor.factor import (
    QR_CONDITION,
    Factor,
    QRFactor,
    augmented_rows,
    estimate,
    joint_weights,
    reduced,
    residual_variance,
    rows_of,
    solve,
    solve_rows,
    total,
)
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from sim_fixtures.ns16 import urdf_text
from tests.identification.two_link import MODEL, NOISE, URDF, P, recording, truth


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


Array = NDArray[np.float64]


def a_motion(samples: int = 3000, speed_ripple: float = 1.0) -> Motion:
    """Sines; with little ripple the elbow only ever turns one way, at nearly one speed."""
    time = np.arange(samples) * 2e-3
    if speed_ripple == 1.0:
        a, w, drift = np.array([0.9, 1.2]), np.array([2.1, 3.7]), np.zeros(2)
    else:
        a, w = np.array([0.9, speed_ripple]), np.array([2.1, 3.7])
        drift = np.array([0.0, 1.0])
    angle = w * time[:, None] + np.array([0.3, 1.1])
    return Motion(
        time,
        a * np.sin(angle) + drift * time[:, None],
        a * w * np.cos(angle) + drift,
        -a * w**2 * np.sin(angle),
    )


def noisy(motion: Motion, noise: Array | float = 0.0, seed: int = 0) -> Samples:
    error = noise * np.random.default_rng(seed).standard_normal((len(motion.time), 2))
    return recording(error, motion)


def cut(samples: Samples, edges: Array) -> list[Samples]:
    parts = [slice(a, b) for a, b in pairwise(edges)]
    return [
        replace(
            samples,
            motion=samples.motion.rows(s),
            torque=samples.torque[s],
            usable=samples.usable[s],
        )
        for s in parts
    ]


def exact_solution(samples: Samples) -> Array:
    """Ordinary least squares in rational arithmetic, from the float rows as they are."""
    blocks = MODEL.regressor(*samples.motion[1:]).dense(P)
    table = np.concatenate([blocks, samples.torque[:, :, None]], axis=2)[samples.usable]
    rows = [[Fraction(float(x)) for x in row] for row in table]
    gram = [[sum(r[i] * r[j] for r in rows) for j in range(P + 1)] for i in range(P)]
    for i in range(P):
        for k in range(i + 1, P):
            share = gram[k][i] / gram[i][i]
            gram[k] = [a - share * b for a, b in zip(gram[k], gram[i], strict=True)]
    values = [Fraction(0)] * P
    for i in reversed(range(P)):
        rest = gram[i][P] - sum(gram[i][j] * values[j] for j in range(i + 1, P))
        values[i] = rest / gram[i][i]
    return np.array([float(v) for v in values])


# The rows themselves ------------------------------------------------------------------------


@pytest.mark.parametrize("bandwidth", [None, np.array([60.0, 80.0])])
def test_rows_are_the_regressor_and_the_torque_of_what_is_usable(bandwidth: Array | None) -> None:
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
    assert chunks[0][0].start == 0
    assert chunks[-1][0].stop == 3000


def test_rows_of_the_wrong_shape_are_refused_by_name() -> None:
    samples = noisy(a_motion(100))
    with pytest.raises(ShapeError, match="torque"):
        list(augmented_rows(MODEL, replace(samples, torque=samples.torque[:99])))
    with pytest.raises(ShapeError, match="usable"):
        list(augmented_rows(MODEL, replace(samples, usable=samples.usable[:, :1])))


# The factor ---------------------------------------------------------------------------------


def test_the_triangles_are_triangular_and_their_squares_are_the_gram_matrices() -> None:
    samples = noisy(a_motion(), NOISE)
    factor, gram = QRFactor.of(MODEL, samples), Factor.of(MODEL, samples)
    assert np.array_equal(factor.matrices, np.triu(factor.matrices))
    size = np.abs(gram.gram).max(axis=(1, 2), keepdims=True)
    assert np.abs((factor.gram - gram.gram) / size).max() < 1e-13
    np.testing.assert_array_equal(factor.samples, gram.samples)
    assert (factor.n_joints, factor.n_parameters) == (2, P)


@pytest.mark.parametrize("weights", [None, np.array([0.3, 20.0])])
def test_where_gram_matrices_are_good_both_give_the_same_to_nine_digits(
    weights: Array | None,
) -> None:
    samples = noisy(a_motion(), NOISE)
    gram, factor = Factor.of(MODEL, samples), QRFactor.of(MODEL, samples)
    expected, found = estimate(MODEL, gram, weights), estimate(MODEL, factor, weights)
    np.testing.assert_allclose(found.values, expected.values, rtol=1e-9)
    scale = np.outer(expected.std, expected.std)
    assert np.abs((found.covariance - expected.covariance) / scale).max() < 1e-9
    np.testing.assert_allclose(found.noise_std, expected.noise_std, rtol=1e-9)
    assert found.condition == pytest.approx(expected.condition, rel=1e-9)
    assert found.names == expected.names
    assert "QR" in found.method
    assert found.undetermined == ()
    np.testing.assert_allclose(joint_weights(factor), joint_weights(gram), rtol=1e-9)


@given(pieces=st.integers(1, 1000), seed=st.integers(0, 2**16))
@settings(max_examples=6)
def test_one_chunk_or_a_thousand_give_the_same_to_nine_digits(pieces: int, seed: int) -> None:
    samples = noisy(a_motion(1500), NOISE, seed)
    inner = np.random.default_rng(seed).integers(0, 1501, pieces - 1)
    edges = np.sort(np.concatenate([[0], inner, [1500]]))
    parts = cut(samples, np.unique(edges))
    whole = estimate(MODEL, QRFactor.of(MODEL, samples))
    summed = sum(
        (QRFactor.of(MODEL, part) for part in parts[1:]),
        QRFactor.of(MODEL, parts[0]),
    )
    many = estimate(MODEL, summed)
    np.testing.assert_allclose(many.values, whole.values, rtol=1e-9)
    np.testing.assert_allclose(many.std, whole.std, rtol=1e-9)
    gram = estimate(MODEL, total([Factor.of(MODEL, part) for part in parts]))
    np.testing.assert_allclose(gram.values, whole.values, rtol=1e-9)


def test_a_sum_may_start_from_zero() -> None:
    samples = noisy(a_motion(200))
    one = QRFactor.of(MODEL, samples)
    again = QRFactor.zero(MODEL) + one
    np.testing.assert_allclose(again.gram, one.gram, rtol=1e-12, atol=1e-12)


def test_factors_of_different_models_do_not_add_and_weights_are_one_per_joint() -> None:
    one = QRFactor.of(MODEL, noisy(a_motion(50)))
    other = QRFactor.zero(RobotModel.from_urdf(URDF, rotor_inertia=False))
    with pytest.raises(IdentificationError, match="cannot be added"):
        _ = one + other
    with pytest.raises(ShapeError, match="weights"):
        one.rows(np.ones(3))


# Ill-conditioned problems -------------------------------------------------------------------


def ill() -> Samples:
    """A scaled condition of some 1e7: the elbow turns one way, at very nearly one speed."""
    return noisy(a_motion(400, speed_ripple=1e-5))


def test_triangles_keep_digits_where_gram_matrices_have_lost_them() -> None:
    samples = ill()
    factor = QRFactor.of(MODEL, samples)
    ordinary = np.ones(2)
    exact = exact_solution(samples)
    found = factor.solve(ordinary)
    assert 3e6 < found.condition < 1e8
    assert found.determined.all()
    np.testing.assert_allclose(found.values, exact, rtol=1e-7)
    equations = Factor.of(MODEL, samples).weighted(ordinary)
    by_gram = np.linalg.solve(equations.A, equations.b)
    assert np.abs(by_gram / exact - 1.0).max() > 1e-2
    # And the estimate on Gram matrices says so instead of printing those.
    assert not solve(equations).determined.all()


def test_the_residual_does_not_drown_in_the_torque() -> None:
    # A residual 1e-9 of the torque: its square is below what a Gram matrix can hold.
    samples = noisy(a_motion(), 1e-9 * NOISE)
    factor, ordinary = QRFactor.of(MODEL, samples), np.ones(2)
    solution = factor.solve(ordinary)
    variance = residual_variance(factor, solution.values, solution.root, ordinary)
    np.testing.assert_allclose(np.sqrt(variance), 1e-9 * NOISE, rtol=0.05)
    gram = Factor.of(MODEL, samples)
    solution = solve(gram.weighted(ordinary))
    by_gram = residual_variance(gram, solution.values, solution.root, ordinary)
    assert np.abs(np.sqrt(by_gram) / (1e-9 * NOISE) - 1.0).max() > 1.0


def test_the_condition_decides_which_kind_of_factor_is_made() -> None:
    good, bad = noisy(a_motion(), NOISE), ill()
    assert not isinstance(reduced(MODEL, [good]), QRFactor)
    factor = reduced(MODEL, [bad, bad])
    assert isinstance(factor, QRFactor)
    assert factor.solve(np.ones(2)).condition > QR_CONDITION
    np.testing.assert_array_equal(factor.samples, 2 * np.count_nonzero(bad.usable, axis=0))


def test_recordings_that_can_be_read_once_only_are_refused() -> None:
    with pytest.raises(IdentificationError, match="twice"):
        reduced(MODEL, (r for r in [ill()]))
    with pytest.raises(IdentificationError, match="no recordings"):
        reduced(MODEL, [])


def test_what_is_dependent_by_construction_is_named() -> None:
    motion = a_motion()
    still = Motion(*(array.copy() for array in motion[:4]))
    still.position[:, 1], still.velocity[:, 1], still.acceleration[:, 1] = 0.4, 0.0, 0.0
    samples = replace(noisy(still), usable=np.ones((3000, 2), dtype=bool))
    gram, qr = Factor.of(MODEL, samples), QRFactor.of(MODEL, samples)
    found, expected = estimate(MODEL, qr), estimate(MODEL, gram)
    assert {"f0_2", "f1_2", "I2m"} <= set(found.undetermined)
    assert set(found.undetermined) == set(expected.undetermined)
    known = np.array([name not in found.undetermined for name in found.names])
    assert np.isinf(found.std[~known]).all()
    np.testing.assert_allclose(found.values[known], truth()[known], rtol=1e-6)
    np.testing.assert_allclose(MODEL.torque(found.values, *still[1:]), samples.torque, atol=1e-6)


def test_no_rows_are_an_error() -> None:
    with pytest.raises(IdentificationError, match="not one usable sample"):
        estimate(MODEL, QRFactor.zero(MODEL))


def test_a_joint_without_rows_has_no_noise_and_no_weight() -> None:
    samples = noisy(a_motion(), NOISE)
    samples.usable[:, 1] = False
    factor = QRFactor.of(MODEL, samples)
    assert joint_weights(factor)[1] == 0.0
    result = estimate(MODEL, factor)
    assert np.isnan(result.noise_std[1])
    assert "f0_2" in result.undetermined


# Rows as normal equations and back ----------------------------------------------------------


@given(k=st.integers(1, 12), p=st.integers(1, 8), seed=st.integers(0, 999))
def test_rows_are_solved_as_by_the_pseudo_inverse(k: int, p: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    rows, target = random.standard_normal((k, p)), random.standard_normal(k)
    scale = np.linalg.norm(rows, axis=0)
    found = solve_rows(rows, target)
    expected = np.linalg.pinv(rows / scale) @ target / scale
    np.testing.assert_allclose(found.values, expected, rtol=1e-6, atol=1e-8)
    inverse = np.linalg.pinv((rows / scale).T @ (rows / scale)) / np.outer(scale, scale)
    np.testing.assert_allclose(found.inverse, inverse, rtol=1e-5, atol=1e-6 * np.abs(inverse).max())
    assert found.determined.all() == (k >= p)


def test_normal_equations_become_rows_with_the_same_squares() -> None:
    equations = Factor.of(MODEL, noisy(a_motion(), NOISE)).weighted(1.0 / NOISE**2)
    rows, target = rows_of(equations)
    scale = np.sqrt(np.diag(equations.A))
    np.testing.assert_allclose(
        rows.T @ rows / np.outer(scale, scale), equations.A / np.outer(scale, scale), atol=1e-12
    )
    np.testing.assert_allclose((rows.T @ target) / scale, equations.b / scale, rtol=1e-9)
