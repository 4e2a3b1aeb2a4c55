from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from identification import Factor, FrictionLaw, ModelError, Motion, RobotModel
from identification.factor.factor import estimate
from identification.model.coupling import Coupling
from sim_fixtures.ns16 import N_ESSENTIAL, TABLE2, urdf_text

Array = NDArray[np.float64]

GEARS = np.diag([-120.0, 150.0, -130.0, -80.0, 80.0, -50.0])


def wrist(k54: float = 0.2, k64: float = -0.1, k65: float = 0.3) -> Array:
    """Motors 5 and 6 turn with the axes before them, as on the COMAU wrist."""
    turns = np.eye(6)
    turns[4, 3], turns[5, 4], turns[5, 3] = -k54, -k65, k65 * k54 - k64
    return GEARS @ turns


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(urdf_text(), coupling=Coupling(wrist()))


def states(m: int = 40) -> Array:
    return np.random.default_rng(4).uniform(-3.0, 3.0, (3, m, 6))


def test_the_ns16_has_the_papers_40_rows_and_three_coupling_inertias(model: RobotModel) -> None:
    assert model.base.rank == 43
    assert set(model.base.names) == {row.pivot for row in TABLE2[:N_ESSENTIAL]} | {
        "I45", "I46", "I56",
    }  # fmt: skip
    assert model.base.gap > 1e10
    rows = {row.pivot: row for row in TABLE2[:N_ESSENTIAL]}
    for name, group in zip(model.base.names, model.base.grouping, strict=True):
        expected = np.zeros(len(model.standard_names))
        terms = rows[name].terms if name in rows else {name: 1.0}
        sign = rows[name].sign if name in rows else 1
        for standard, factor in terms.items():
            expected[model.standard_names.index(standard)] = sign * factor
        assert np.abs(group - expected).max() < 1e-10, name


def test_names_and_units_of_what_coupling_adds(model: RobotModel) -> None:
    assert model.parameter_names[40:43] == ("I45", "I46", "I56")
    assert model.parameter_names[-4:] == ("f0_m5", "f0_m6", "f1_m5", "f1_m6")
    assert model.units[40:43] == ("kg m²",) * 3
    assert model.units[-4:] == ("N·m", "N·m", "N·m·s/rad", "N·m·s/rad")
    assert model.friction_columns.tolist() == [False] * 43 + [True] * 22


def test_rotors_and_motor_friction_act_as_the_drive_train_says(model: RobotModel) -> None:
    """tau = K' J K qdd + sum of c_m' f_m(c_m qd), computed from K here."""
    q, qd, qdd = states()
    inertia = np.random.default_rng(1).uniform(1e-4, 1e-3, 6)
    rotors = wrist().T @ np.diag(inertia) @ wrist()
    standard = np.zeros(len(model.standard_names))
    standard[model.layout.rotors] = np.diag(rotors)
    standard[model.layout.couplings] = rotors[3, 4], rotors[3, 5], rotors[4, 5]
    np.testing.assert_allclose(model.layout.rotor_matrix(standard), rotors, atol=1e-12)

    friction = np.zeros(len(model.friction.terms))
    friction[-4:] = 2.0, 3.0, 0.5, 0.7
    values = np.concatenate([model.base.grouping @ standard, friction])
    expected = qdd @ rotors
    for motor, coulomb, viscous in ((4, 2.0, 0.5), (5, 3.0, 0.7)):
        c = wrist()[motor] / wrist()[motor, motor]
        speed = qd @ c
        expected += np.outer(coulomb * np.sign(speed) + viscous * speed, c)
    np.testing.assert_allclose(model.torque(values, q, qd, qdd), expected, atol=1e-9)


def test_planted_couplings_come_back(model: RobotModel) -> None:
    random = np.random.default_rng(3)
    time = np.arange(3000, dtype=np.float64) * 4e-3
    phase = random.uniform(0, 6, (4, 1, 6)) + time[:, None] * random.uniform(1, 7, (4, 1, 6))
    pace = np.gradient(phase, time, axis=1)
    q, qd = np.sin(phase).sum(axis=0), (pace * np.cos(phase)).sum(axis=0)
    motion = Motion(time, q, qd, -(pace**2 * np.sin(phase)).sum(axis=0))
    truth = random.uniform(0.5, 2.0, model.n_parameters)
    torque = model.torque(truth, *motion[1:])
    found = estimate(model, Factor.from_samples(model, motion, torque))
    np.testing.assert_allclose(found.values, truth, rtol=1e-6)
    assert found.undetermined == ()


def test_rows_count_only_while_every_motor_that_acts_on_them_turns(model: RobotModel) -> None:
    qd = np.ones((1, 6))
    # Joint speeds at which motor 5 stands: c_5 qd = 0.
    qd[0, 4] = 0.2
    assert model.moving(qd).tolist() == [[True, True, True, False, False, True]]


def test_either_part_can_be_left_out() -> None:
    inertia = RobotModel.from_urdf(urdf_text(), coupling=Coupling(wrist(), friction=False))
    assert inertia.n_parameters == 43 + 18
    friction = RobotModel.from_urdf(urdf_text(), coupling=Coupling(wrist(), inertia=False))
    assert friction.n_parameters == 40 + 22
    law = FrictionLaw(coulomb=False)
    viscous = RobotModel.from_urdf(urdf_text(), friction=law, coupling=Coupling(wrist()))
    assert viscous.parameter_names[-2:] == ("f1_m5", "f1_m6")


def test_uncoupled_motors_add_nothing() -> None:
    plain = RobotModel.from_urdf(urdf_text())
    with_gears = RobotModel.from_urdf(urdf_text(), coupling=Coupling(GEARS))
    assert with_gears.parameter_names == plain.parameter_names
    for a, b in zip(with_gears.regressor(*states()).blocks, plain.regressor(*states()).blocks,
                    strict=True):  # fmt: skip
        assert np.array_equal(a, b)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.ones((2, 3)), "square"),
        (np.full((2, 2), np.nan), "not finite"),
        (np.array([[0.0, 1.0], [1.0, 0.0]]), "motor 1 .* does not turn with joint 1"),
        (np.array([[1.0, 0.0], [16.0, 1e-308]]), "motor 2 .* does not turn with joint 2"),
        (np.ones((2, 2)), "singular"),
    ],
)
def test_a_matrix_that_is_no_drive_train_is_refused(matrix: Array, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        Coupling(matrix)


def test_a_coupling_of_another_number_of_joints_is_refused() -> None:
    with pytest.raises(ModelError, match="2 joints, the robot has 6"):
        RobotModel.from_urdf(urdf_text(), coupling=Coupling(np.eye(2)))
