from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from identification import Factor, Motion, RobotModel
from identification.excitation.constraints import midpoints
from identification.excitation.criteria import (
    Criteria,
    condition_number,
    correlation,
    coupling_index,
    coupling_index_max,
    fitness_eq7,
    information,
    log10_det,
    log10_det_and_coupling,
)
from identification.excitation.objective import Objective
from planner import JointLimits, PiecewiseCubic, plan
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
    gram = (phi.T @ phi).tolist()
    assume(np.linalg.matrix_rank(phi) == p)
    determinant, psi = exact_inverse(gram)
    expected = math.log10(determinant / Fraction(n) ** p)
    index = sum(
        math.sqrt(psi[i][j] ** 2 / (psi[i][i] * psi[j][j])) for j in range(p) for i in range(j)
    )
    # Entries up to 9 leave the scaled condition number of Phi far below 1e6, its square lost.
    found = np.array(gram, dtype=np.float64)
    assert log10_det(found, n) == pytest.approx(expected, abs=1e-6)
    assert coupling_index(found) == pytest.approx(index, rel=1e-6, abs=1e-9)
    assert log10_det_and_coupling(found, n) == (log10_det(found, n), coupling_index(found))
    if index > 1e-6:
        fitness = 0.7 * expected + 0.3 * (p * (p - 1) / 2) / index
        assert fitness_eq7(found, n) == pytest.approx(fitness, rel=1e-5, abs=1e-6)


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


@pytest.mark.parametrize("p", [2, 5, 12])
def test_estimates_that_err_together_reach_the_largest_coupling_index(p: int) -> None:
    together = np.linspace(1.0, 2.0, p) * (-1.0) ** np.arange(p)
    apart = 1e-7
    # the inverse of (t t' + e 1) by Sherman and Morrison
    gram = np.eye(p) - np.outer(together, together) / (apart + together @ together)
    assert coupling_index(gram) == pytest.approx(coupling_index_max(p), rel=1e-5)
    assert coupling_index(gram) <= coupling_index_max(p)


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


def test_criteria_are_each_of_the_measures() -> None:
    columns = random_columns(5)
    gram = columns.T @ columns
    assert Criteria.of_gram(gram, 40) == Criteria(
        log10_det=log10_det(gram, 40),
        coupling_index=coupling_index(gram),
        fitness=fitness_eq7(gram, 40),
        n_samples=40,
        condition=condition_number(gram, scaled=False),
        scaled_condition=condition_number(gram, scaled=True),
    )


def test_criteria_stored_before_condition_numbers_still_load() -> None:
    old = {"log10_det": 90.5, "coupling_index": 127.9, "fitness": 67.2, "n_samples": 2000}
    assert Criteria(**old).condition is None
    assert Criteria(**old).scaled_condition is None


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


def test_a_planned_motion_is_judged_alike_at_8_ms_and_at_1_ms(
    model: RobotModel, motion: PiecewiseCubic
) -> None:
    coarse, fine = (Objective(model).criteria(motion, period) for period in (0.008, 0.001))
    assert fine.n_samples == pytest.approx(8 * coarse.n_samples, rel=0.01)
    # From one random motion to the next they spread by 12 and by 9: a thousandth, a fiftieth.
    assert coarse.log10_det == pytest.approx(fine.log10_det, abs=0.012)
    assert coarse.coupling_index == pytest.approx(fine.coupling_index, abs=0.18)


def test_without_the_scaling_by_n_a_finer_sampling_would_seem_to_excite_more(
    model: RobotModel, motion: PiecewiseCubic
) -> None:
    coarse, fine = (Objective(model).criteria(motion, period) for period in (0.008, 0.001))
    raw = [c.log10_det + 58 * math.log10(c.n_samples) for c in (coarse, fine)]
    assert raw[1] - raw[0] == pytest.approx(58 * math.log10(8), abs=0.1)


@pytest.mark.parametrize("k", [2, 8])
def test_every_sample_k_times_over_changes_nothing(
    model: RobotModel, motion: PiecewiseCubic, k: int
) -> None:
    once = midpoints(motion, 0.008)
    often = Motion(*(np.repeat(series, k, axis=0) for series in once[:4]))
    expected, found = Objective(model).measures(once), Objective(model).measures(often)
    assert found.log10_det == pytest.approx(expected.log10_det, abs=1e-7)
    assert found.coupling_index == pytest.approx(expected.coupling_index, rel=1e-8)


def test_friction_in_degrees_shifts_the_determinant_by_what_degrees_are(
    model: RobotModel, motion: PiecewiseCubic
) -> None:
    samples = midpoints(motion, 0.008)
    factor = Factor.from_samples(model, samples, np.zeros_like(samples.position))
    gram = information(factor)
    degree = math.degrees(1.0)
    scale = np.array(
        [{"f1": degree, "f2": degree**2}.get(n[:2], 1.0) for n in model.parameter_names]
    )
    found = gram * scale * scale[:, None]
    # Six columns in deg/s and six in (deg/s)², each counted twice: 63.3, as others report.
    shift = log10_det(found, 1) - log10_det(gram, 1)
    assert shift == pytest.approx(36 * math.log10(degree), abs=1e-9)
    assert coupling_index(found) == pytest.approx(coupling_index(gram), rel=1e-9)
    assert condition_number(found, scaled=True) == pytest.approx(
        condition_number(gram, scaled=True), rel=1e-6
    )
    assert condition_number(found, scaled=False) > 10.0 * condition_number(gram, scaled=False)


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
