"""The NS 16's planted parameters are the manufacturer's column of the paper's Table 2."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from sim_fixtures import ns16

Array = NDArray[np.float64]
PRINT_PRECISION = 0.0005  # the table prints three decimals
FACTOR_PRECISION = 0.001  # and cuts factors off after three
TENSOR_ORDER = ("xx", "xy", "yy", "xz", "yz", "zz")  # of pinocchio's parameter vector


@pytest.fixture(scope="module")
def model() -> pin.Model:
    return pin.buildModelFromXML(ns16.urdf_text())


def column_names() -> list[str]:
    """Names of the columns of pinocchio's torque regressor, then of the rotors' columns."""
    names = []
    for i in range(1, 7):
        names += [f"m{i}", f"mc{i}x", f"mc{i}y", f"mc{i}z"]
        names += [f"I{i}{key}" for key in TENSOR_ORDER]
    return names + [f"I{i}m" for i in range(1, 7)]


def full_regressor(model: pin.Model, q: Array, qd: Array, qdd: Array) -> Array:
    links = pin.computeJointTorqueRegressor(model, model.createData(), q, qd, qdd)
    return np.hstack([links, np.diag(qdd)])


def base_regressor(model: pin.Model, q: Array, qd: Array, qdd: Array) -> Array:
    """Each base column is the column of the row's pivot, with its sign."""
    names = column_names()
    rows = ns16.TABLE2[: ns16.N_ESSENTIAL]
    columns = [names.index(row.pivot) for row in rows]
    signs = np.array([row.sign for row in rows])
    return full_regressor(model, q, qd, qdd)[:, columns] * signs


def test_there_are_58_rows_in_order() -> None:
    assert [row.id for row in ns16.TABLE2] == list(range(1, 59))
    assert [row.parameter for row in ns16.TABLE2[40:46]] == [
        f"{kind}_{axis}" for axis in (1, 2, 3) for kind in ("f0", "f1")
    ]


def test_the_planted_base_vector_is_column_c_of_all_forty_rows() -> None:
    base = ns16.base_from_standard(ns16.standard_parameters())
    printed = np.array([row.pi_c for row in ns16.TABLE2[: ns16.N_ESSENTIAL]])
    assert base.shape == (40,)
    np.testing.assert_allclose(base, printed, rtol=0.0, atol=PRINT_PRECISION)
    # the planted member of the feasible family fits the printed figures far better than they print
    np.testing.assert_allclose(base, printed, rtol=0.0, atol=1e-6)


def test_the_planted_friction_is_column_c_read_without_the_interleaving() -> None:
    column = {row.parameter: row.pi_c for row in ns16.TABLE2}
    truth = ns16.load_truth()
    assert truth.coulomb == tuple(column[f"f0_{i}"] for i in range(1, 7))
    per_degree = [column[f"f1_{i}"] for i in range(1, 7)]
    np.testing.assert_allclose(np.radians(truth.viscous), per_degree, rtol=1e-14)
    # Coulomb friction falls with the size of the axis, which is how the interleaving shows
    assert truth.coulomb[0] > truth.coulomb[2] > truth.coulomb[3] > truth.coulomb[5]


def test_factors_are_exact_products_of_the_link_lengths() -> None:
    rows = {row.id: row for row in ns16.TABLE2}
    assert rows[29].terms["m5"] == 0.624
    assert rows[30].terms["m6"] == pytest.approx(0.624**2 - 0.185**2, rel=1e-15)
    assert rows[31].terms["mc4y"] == -0.185
    assert rows[23].terms["m4"] == pytest.approx(0.3**2 + 0.7**2 + 0.185**2, rel=1e-15)


@pytest.mark.parametrize("row_id", range(23, 41))
def test_the_print_names_the_same_terms_rounded(row_id: int) -> None:
    row = ns16.TABLE2[row_id - 1]
    printed: dict[str, float] = {}
    factor, sign = 1.0, 1.0
    for word in row.printed_symbol.split():
        if word in "+-":
            sign, factor = (1.0 if word == "+" else -1.0), 1.0
        elif word[0].isdigit():
            factor = float(word)
        else:
            printed[word] = sign * factor
            sign, factor = 1.0, 1.0
    assert printed == pytest.approx(dict(row.terms), abs=FACTOR_PRECISION)


def test_forty_columns_are_independent_and_nothing_else_is(model: pin.Model) -> None:
    rng = np.random.default_rng(1)
    states = [rng.uniform(-2.0, 2.0, (3, 6)) for _ in range(40)]
    full = np.vstack([full_regressor(model, *s) for s in states])
    base = np.vstack([base_regressor(model, *s) for s in states])
    assert np.linalg.matrix_rank(base) == 40
    assert np.linalg.matrix_rank(full, tol=1e-9 * np.linalg.norm(full)) == 40


def test_base_torques_are_the_torques_of_the_rigid_bodies_and_rotors(model: pin.Model) -> None:
    rng = np.random.default_rng(2)
    base = ns16.base_from_standard(ns16.standard_parameters())
    rotors = np.array(ns16.load_truth().rotor_inertia)
    data = model.createData()
    for _ in range(50):
        q, qd, qdd = rng.uniform(-3.0, 3.0, (3, 6))
        expected = pin.rnea(model, data, q, qd, qdd) + rotors * qdd
        torque = base_regressor(model, q, qd, qdd) @ base
        np.testing.assert_allclose(torque, expected, rtol=0.0, atol=1e-9)
