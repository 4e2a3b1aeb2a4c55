from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification import Factor, Motion, RobotModel
from identification.excitation.criteria import (
    condition_number,
    correlation,
    coupling_index,
    coupling_index_max,
    fitness_eq7,
    information,
    log10_det,
)
from sim_fixtures.ns16 import urdf_text

SINGULAR = {
    "a parameter without excitation": np.diag([1.0, 0.0, 2.0]),
    "two equal columns": np.array([[4.0, 2.0, 2.0], [2.0, 1.0, 1.0], [2.0, 1.0, 1.0]]),
    "not a number": np.full((3, 3), np.nan),
}


def random_columns(seed: int, rows: int = 40, p: int = 5) -> np.ndarray:
    random = np.random.default_rng(seed)
    return random.normal(size=(rows, p)) @ random.normal(size=(p, p))


def test_the_determinant_of_a_small_case_by_hand() -> None:
    gram = np.array([[2.0, 1.0], [1.0, 3.0]])  # det = 5
    assert log10_det(gram, 10) == pytest.approx(math.log10(5.0 / 10.0**2), abs=1e-14)


def test_the_coupling_index_of_a_small_case_by_hand() -> None:
    # inverse of [[2, 1], [1, 3]] is [[3, -1], [-1, 2]] / 5: |psi_12| / sqrt(psi_11 psi_22)
    gram = np.array([[2.0, 1.0], [1.0, 3.0]])
    assert coupling_index(gram) == pytest.approx(1.0 / math.sqrt(6.0), abs=1e-14)


@given(seed=st.integers(0, 999))
def test_both_agree_with_the_formulas_spelled_out(seed: int) -> None:
    columns = random_columns(seed)
    gram = columns.T @ columns
    psi = np.linalg.inv(gram)
    spelled = sum(
        abs(psi[i, j]) / math.sqrt(psi[i, i] * psi[j, j]) for i in range(5) for j in range(i + 1, 5)
    )
    assert coupling_index(gram) == pytest.approx(spelled, rel=1e-6)
    assert log10_det(gram, 40) == pytest.approx(math.log10(np.linalg.det(gram) / 40.0**5), abs=1e-7)


@given(seed=st.integers(0, 99), exponents=st.lists(st.integers(-9, 9), min_size=5, max_size=5))
def test_the_coupling_index_is_free_of_units(seed: int, exponents: list[int]) -> None:
    columns = random_columns(seed)
    scaled = columns * 10.0 ** np.array(exponents)
    index = coupling_index(columns.T @ columns)
    assert coupling_index(scaled.T @ scaled) == pytest.approx(index, rel=1e-6)
    # ... the determinant is not: each unit adds twice its exponent.
    shift = log10_det(scaled.T @ scaled, 40) - log10_det(columns.T @ columns, 40)
    assert shift == pytest.approx(2 * sum(exponents), abs=1e-6)


@given(seed=st.integers(0, 99), k=st.integers(1, 50))
def test_the_scaled_determinant_does_not_feel_resampling(seed: int, k: int) -> None:
    columns = random_columns(seed)
    dense = np.repeat(columns, k, axis=0)  # section 3.2: every point becomes k points
    assert log10_det(dense.T @ dense, 40 * k) == pytest.approx(
        log10_det(columns.T @ columns, 40), abs=1e-9
    )


def test_a_determinant_beyond_the_range_of_floats_has_a_logarithm() -> None:
    gram = np.diag(np.full(58, 1e9))
    with np.errstate(over="ignore"):
        assert np.linalg.det(gram) == np.inf
    assert log10_det(gram, 1) == pytest.approx(9.0 * 58)


@pytest.mark.parametrize("case", SINGULAR)
def test_a_singular_matrix_ranks_last_and_raises_nothing(case: str) -> None:
    gram = SINGULAR[case]
    assert log10_det(gram, 10) == -np.inf
    assert coupling_index(gram) == np.inf
    assert fitness_eq7(gram, 10) == -np.inf
    assert np.isnan(correlation(gram)).all()
    assert condition_number(gram, scaled=True) == np.inf
    assert condition_number(gram, scaled=False) == np.inf


def test_orthogonal_columns_are_not_coupled() -> None:
    gram = np.diag([1.0, 4.0, 9.0])
    assert coupling_index(gram) == 0.0
    assert condition_number(gram, scaled=True) == pytest.approx(1.0)
    assert condition_number(gram, scaled=False) == pytest.approx(3.0)
    assert fitness_eq7(gram, 10) == np.inf


def test_the_largest_coupling_index_of_58_parameters() -> None:
    assert coupling_index_max(58) == 1653.0


@given(seed=st.integers(0, 99))
def test_the_correlation_matrix_has_the_coupling_index_as_its_upper_sum(seed: int) -> None:
    columns = random_columns(seed)
    matrix = correlation(columns.T @ columns)
    assert np.array_equal(matrix, matrix.T)
    assert np.array_equal(np.diag(matrix), np.ones(5))
    assert np.abs(matrix).max() <= 1.0
    index = np.abs(np.triu(matrix, 1)).sum()
    assert coupling_index(columns.T @ columns) == pytest.approx(index, rel=1e-14)
    assert index <= coupling_index_max(5)


def test_the_fitness_is_equation_7_as_printed() -> None:
    gram = np.array([[2.0, 1.0], [1.0, 3.0]])
    expected = 0.7 * math.log10(5.0 / 100.0) + 0.3 * 1.0 * math.sqrt(6.0)
    assert fitness_eq7(gram, 10) == pytest.approx(expected, rel=1e-13)
    assert fitness_eq7(gram, 10, weights=(1.0, 0.0)) == pytest.approx(log10_det(gram, 10))


def test_the_condition_number_is_that_of_the_regressor() -> None:
    columns = random_columns(4)
    assert condition_number(columns.T @ columns, scaled=False) == pytest.approx(
        np.linalg.cond(columns), rel=1e-6
    )
    unit = columns / np.linalg.norm(columns, axis=0)
    assert condition_number(columns.T @ columns, scaled=True) == pytest.approx(
        np.linalg.cond(unit), rel=1e-6
    )


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(urdf_text())


def test_information_is_the_gram_of_the_stacked_regressor(model: RobotModel) -> None:
    q, qd, qdd = np.random.default_rng(0).uniform(-2.0, 2.0, (3, 300, 6))
    factor = Factor.from_samples(model, Motion(np.arange(300.0), q, qd, qdd), np.ones((300, 6)))
    stacked = model.regressor(q, qd, qdd).dense(58).reshape(-1, 58)
    gram = information(factor)
    assert np.allclose(gram, stacked.T @ stacked, rtol=1e-11, atol=1e-9)
    sign, log = np.linalg.slogdet(gram)
    assert sign == 1.0
    assert log10_det(gram, 300) == pytest.approx(log / math.log(10) - 58 * math.log10(300))


def test_a_joint_at_rest_leaves_its_friction_undetermined(model: RobotModel) -> None:
    q, qd, qdd = np.random.default_rng(0).uniform(-2.0, 2.0, (3, 300, 6))
    q[:, 5], qd[:, 5], qdd[:, 5] = 0.3, 0.0, 0.0
    factor = Factor.from_samples(model, Motion(np.arange(300.0), q, qd, qdd), np.zeros((300, 6)))
    assert log10_det(information(factor), 300) == -np.inf
    assert coupling_index(information(factor)) == np.inf
