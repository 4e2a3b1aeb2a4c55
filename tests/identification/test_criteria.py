from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from identification import RobotModel
from identification.excitation import (
    CRITERIA,
    Criteria,
    Objective,
    correlation,
    coupling_index,
    coupling_index_max,
    log10_det,
)
from identification.excitation.criteria import fitness_eq7
from planner import JointLimits, PiecewiseCubic, plan
from sim_fixtures.ns16 import urdf_text

HAND = np.array([[2.0, 1.0], [1.0, 3.0]])  # det = 5, inverse [[3, -1], [-1, 2]] / 5


def random_columns(seed: int, rows: int = 40, p: int = 5) -> np.ndarray:
    random = np.random.default_rng(seed)
    return random.normal(size=(rows, p)) @ random.normal(size=(p, p))


def gram_of(columns: np.ndarray) -> np.ndarray:
    return columns.T @ columns


def test_a_small_case_by_hand() -> None:
    found = Criteria.of_gram(HAND, 10)
    assert found.log10_det == pytest.approx(math.log10(5.0 / 10.0**2), abs=1e-14)
    assert found.coupling_index == pytest.approx(1.0 / math.sqrt(6.0), abs=1e-14)
    equation_7 = 0.7 * math.log10(5.0 / 100.0) + 0.3 * 1.0 * math.sqrt(6.0)
    assert found.fitness == pytest.approx(equation_7, rel=1e-13)
    assert fitness_eq7(*found.measures, 2, (1.0, 0.0)) == pytest.approx(found.log10_det)
    assert found.measures == (log10_det(HAND, 10), coupling_index(HAND))
    assert tuple(CRITERIA) == ("log10_det", "coupling_index")


def exact_inverse(gram: list[list[int]]) -> tuple[Fraction, list[list[Fraction]]]:
    """Determinant and inverse in exact fractions, by elimination without a thought for speed."""
    p = len(gram)
    rows = [
        [Fraction(x) for x in row] + [Fraction(i == j) for j in range(p)]
        for i, row in enumerate(gram)
    ]
    determinant = Fraction(1)
    for k in range(p):  # positive definite: no pivot is zero
        determinant *= rows[k][k]
        rows[k] = [x / rows[k][k] for x in rows[k]]
        for i in range(p):
            if i != k:
                rows[i] = [x - rows[i][k] * y for x, y in zip(rows[i], rows[k], strict=True)]
    return determinant, [row[p:] for row in rows]


@given(
    columns=st.integers(2, 5).flatmap(
        lambda p: st.lists(st.lists(st.integers(-9, 9), min_size=p, max_size=p), min_size=p)
    )
)
@settings(deadline=None)
def test_all_agree_with_exact_fractions(columns: list[list[int]]) -> None:
    phi = np.array(columns)
    n, p = phi.shape
    assume(np.linalg.matrix_rank(phi) == p)
    determinant, psi = exact_inverse(gram_of(phi).tolist())
    expected = math.log10(determinant / Fraction(n) ** p)
    index = sum(
        math.sqrt(psi[i][j] ** 2 / (psi[i][i] * psi[j][j])) for j in range(p) for i in range(j)
    )
    # Entries up to 9 leave the scaled condition number of Phi far below 1e6, its square lost.
    found = Criteria.of_gram(gram_of(phi).astype(float), n)
    assert found.log10_det == pytest.approx(expected, abs=1e-6)
    assert found.coupling_index == pytest.approx(index, rel=1e-6, abs=1e-9)
    if index > 1e-6:
        fitness = 0.7 * expected + 0.3 * (p * (p - 1) / 2) / index
        assert found.fitness == pytest.approx(fitness, rel=1e-5, abs=1e-6)


@given(seed=st.integers(0, 99), exponents=st.lists(st.integers(-9, 9), min_size=5, max_size=5))
def test_units_shift_the_determinant_alone(seed: int, exponents: list[int]) -> None:
    columns = random_columns(seed)
    scaled = columns * 10.0 ** np.array(exponents)
    index = coupling_index(gram_of(columns))
    assert coupling_index(gram_of(scaled)) == pytest.approx(index, rel=1e-6)
    shift = log10_det(gram_of(scaled), 40) - log10_det(gram_of(columns), 40)
    assert shift == pytest.approx(2 * sum(exponents), abs=1e-6)


@given(seed=st.integers(0, 99), k=st.integers(1, 50))
def test_resampling_changes_no_scaled_determinant(seed: int, k: int) -> None:
    columns = random_columns(seed)
    dense = np.repeat(columns, k, axis=0)  # section 3.2: every point becomes k points
    assert log10_det(gram_of(dense), 40 * k) == pytest.approx(
        log10_det(gram_of(columns), 40), abs=1e-9
    )


def test_a_determinant_beyond_floats_has_a_logarithm() -> None:
    gram = np.diag(np.full(58, 1e9))
    with np.errstate(over="ignore"):
        assert np.linalg.det(gram) == np.inf
    assert log10_det(gram, 1) == pytest.approx(9.0 * 58)


@pytest.mark.parametrize(
    "gram",
    [
        np.diag([1.0, 0.0, 2.0]),  # a parameter without excitation
        np.array([[4.0, 2.0, 2.0], [2.0, 1.0, 1.0], [2.0, 1.0, 1.0]]),  # two equal columns
        np.full((3, 3), np.nan),
    ],
)
def test_a_singular_matrix_ranks_last(gram: np.ndarray) -> None:
    expected = Criteria(-np.inf, np.inf, -np.inf, 10, np.inf, np.inf)
    assert Criteria.of_gram(gram, 10) == expected
    assert np.isnan(correlation(gram)).all()


def test_orthogonal_columns_are_not_coupled() -> None:
    found = Criteria.of_gram(np.diag([1.0, 4.0, 9.0]), 10)
    assert (found.coupling_index, found.fitness) == (0.0, np.inf)
    assert found.scaled_condition == pytest.approx(1.0)
    assert found.condition == pytest.approx(3.0)


@pytest.mark.parametrize("p", [2, 5, 12])
def test_errors_in_step_reach_the_largest_coupling(p: int) -> None:
    assert coupling_index_max(58) == 1653.0
    together = np.linspace(1.0, 2.0, p) * (-1.0) ** np.arange(p)
    apart = 1e-7
    # the inverse of (t t' + e 1) by Sherman and Morrison
    gram = np.eye(p) - np.outer(together, together) / (apart + together @ together)
    assert coupling_index(gram) == pytest.approx(coupling_index_max(p), rel=1e-5)
    assert coupling_index(gram) <= coupling_index_max(p)


@given(seed=st.integers(0, 99))
def test_the_coupling_index_sums_the_correlations(seed: int) -> None:
    gram = gram_of(random_columns(seed))
    matrix = correlation(gram)
    assert np.array_equal(matrix, matrix.T)
    assert np.array_equal(np.diag(matrix), np.ones(5))
    assert np.abs(matrix).max() <= 1.0
    index = np.abs(np.triu(matrix, 1)).sum()
    assert coupling_index(gram) == pytest.approx(index, rel=1e-14)
    assert index <= coupling_index_max(5)


def test_condition_numbers_are_those_of_the_regressor() -> None:
    columns = random_columns(4)
    unit = columns / np.linalg.norm(columns, axis=0)
    found = Criteria.of_gram(gram_of(columns), 40)
    assert found.condition == pytest.approx(np.linalg.cond(columns), rel=1e-6)
    assert found.scaled_condition == pytest.approx(np.linalg.cond(unit), rel=1e-6)


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(urdf_text())


@pytest.fixture(scope="module", params=range(3))
def motion(request: pytest.FixtureRequest) -> PiecewiseCubic:
    """A motion of six joints through eight points, as the interpolator runs it."""
    velocity = np.radians([155.0, 155.0, 170.0, 360.0, 350.0, 550.0])
    limits = JointLimits([-2.8] * 6, [2.8] * 6, velocity, velocity / 0.3, velocity / 0.3 / 0.1)
    via = np.random.default_rng(request.param).uniform(-2.7, 2.7, (8, 6))
    return plan(via, limits, speed=0.5, fly=0.5)


# Section 3.2 on planned motions.


def test_a_motion_is_judged_alike_at_8_ms_and_at_1_ms(
    model: RobotModel, motion: PiecewiseCubic
) -> None:
    coarse, fine = (Objective(model).criteria(motion, period) for period in (0.008, 0.001))
    assert fine.n_samples == pytest.approx(8 * coarse.n_samples, rel=0.01)
    # From one random motion to the next they spread by 12 and by 9: a thousandth, a fiftieth.
    assert coarse.log10_det == pytest.approx(fine.log10_det, abs=0.012)
    assert coarse.coupling_index == pytest.approx(fine.coupling_index, abs=0.18)
    raw = [c.log10_det + 58 * math.log10(c.n_samples) for c in (coarse, fine)]
    assert raw[1] - raw[0] == pytest.approx(58 * math.log10(8), abs=0.1)  # without the scaling
