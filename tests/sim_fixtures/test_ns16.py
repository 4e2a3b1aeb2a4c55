"""The NS 16: its URDF, its planted parameters (Table 2 of the paper), its cell file."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from sim_fixtures import ControllerSettings, ns16
from tests.sim_fixtures.bench import CELL, base_from_standard, standard_parameters

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def model() -> pin.Model:
    return pin.buildModelFromXML(ns16.urdf_text())


def dh(controller_deg: list[float]) -> Array:
    """DH angles [rad] of controller angles [deg]."""
    train = CELL["drive_train"]
    angles = np.array(controller_deg) - train["joint_offset_deg"]
    return np.radians(angles * train["joint_sign"])


def test_pinocchio_reads_the_planted_standard_parameters(model: pin.Model) -> None:
    planted = standard_parameters()
    for i in range(1, 7):
        keys = [f"m{i}", *(f"mc{i}{a}" for a in "xyz")]
        keys += [f"I{i}{k}" for k in ("xx", "xy", "yy", "xz", "yz", "zz")]
        read = model.inertias[i].toDynamicParameters()
        np.testing.assert_allclose(read, [planted[k] for k in keys], rtol=1e-12, atol=1e-12)


def test_link_frames_are_the_dh_frames_at_the_previous_origin(model: pin.Model) -> None:
    """Independent of the URDF: multiply the DH matrices."""
    q = np.array([0.3, -0.7, 1.9, 0.4, -1.1, 2.0])
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    before = np.eye(4)
    for i in range(6):
        alpha = (-1, 0, -1, -1, -1, 0)[i] * np.pi / 2
        c = np.cos(q[i])
        s = np.sin(q[i])
        ca = np.cos(alpha)
        sa = np.sin(alpha)
        after = before @ np.array(
            [
                [c, -s * ca, s * sa, ns16.A[i] * c],
                [s, c * ca, -c * sa, ns16.A[i] * s],
                [0.0, sa, ca, ns16.D[i]],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        placement = data.oMi[i + 1]
        np.testing.assert_allclose(placement.rotation, after[:3, :3], atol=1e-14)
        origin = before[:3, 3] + ([0.0, 0.0, 0.6] if i == 0 else 0.0)  # O_0 at joint 2's height
        np.testing.assert_allclose(placement.translation, origin, atol=1e-14)
        before = after


def test_limits_are_the_controllers_mapped_to_dh_angles(model: pin.Model) -> None:
    np.testing.assert_allclose(
        np.degrees(np.column_stack([model.lowerPositionLimit, model.upperPositionLimit])),
        [(-180, 180), (-140, 5), (-20, 260), (-360, 360), (-120, 120), (-360, 360)],
        atol=1e-12,
    )
    ends = np.sort([dh(CELL["limits"][f"{end}_deg"]) for end in ("lower", "upper")], axis=0)
    np.testing.assert_allclose(ends[0], model.lowerPositionLimit, atol=1e-12)
    np.testing.assert_allclose(ends[1], model.upperPositionLimit, atol=1e-12)


TENSOR_ORDER = ("xx", "xy", "yy", "xz", "yz", "zz")  # of pinocchio's parameter vector


def column_names() -> list[str]:
    """Names of the columns of pinocchio's torque regressor, then of the rotors' columns."""
    names = []
    for i in range(1, 7):
        names += [f"m{i}", f"mc{i}x", f"mc{i}y", f"mc{i}z"]
        names += [f"I{i}{key}" for key in TENSOR_ORDER]
    return names + [f"I{i}m" for i in range(1, 7)]


def base_regressor(model: pin.Model, q: Array, qd: Array, qdd: Array) -> Array:
    """Each base column is the column of the row's pivot, with its sign."""
    names = column_names()
    rows = ns16.TABLE2[: ns16.N_ESSENTIAL]
    columns = [names.index(row.pivot) for row in rows]
    signs = np.array([row.sign for row in rows])
    links = pin.computeJointTorqueRegressor(model, model.createData(), q, qd, qdd)
    return np.hstack([links, np.diag(qdd)])[:, columns] * signs


def test_the_planted_base_vector_is_column_c_of_all_forty_rows() -> None:
    base = base_from_standard(standard_parameters())
    printed = np.array([row.pi_c for row in ns16.TABLE2[: ns16.N_ESSENTIAL]])
    np.testing.assert_allclose(base, printed, rtol=0.0, atol=1e-6)


def test_the_friction_is_column_c_without_the_interleaving() -> None:
    column = {row.parameter: row.pi_c for row in ns16.TABLE2}
    truth = ns16.load_truth()
    assert truth.coulomb == tuple(column[f"f0_{i}"] for i in range(1, 7))
    per_degree = [column[f"f1_{i}"] for i in range(1, 7)]
    np.testing.assert_allclose(np.radians(truth.viscous), per_degree, rtol=1e-14)
    # Coulomb friction falls with the size of the axis, which is how the interleaving shows
    assert truth.coulomb[0] > truth.coulomb[2] > truth.coulomb[3] > truth.coulomb[5]


def test_base_torques_are_those_of_rigid_bodies_and_rotors(model: pin.Model) -> None:
    rng = np.random.default_rng(2)
    base = base_from_standard(standard_parameters())
    rotors = np.array(ns16.load_truth().rotor_inertia)
    data = model.createData()
    for _ in range(50):
        q, qd, qdd = rng.uniform(-3.0, 3.0, (3, 6))
        expected = pin.rnea(model, data, q, qd, qdd) + rotors * qdd
        torque = base_regressor(model, q, qd, qdd) @ base
        np.testing.assert_allclose(torque, expected, rtol=0.0, atol=1e-9)


class TestNominal:
    """Values known before the arm moves are 10 to 20 % off the true ones, up and down."""

    @pytest.mark.parametrize("name", ["rotor_inertia", "coulomb", "viscous", "inertia_scale"])
    def test_errors(self, name: str) -> None:
        share = np.divide(CELL.get("nominal", {}).get(name, 1.0), CELL["simulation"][name])
        errors = np.abs(share - 1.0)
        assert np.all((errors > 0.0995) & (errors < 0.2005))  # figures of 4 digits
        assert share.min() < 1.0 < share.max()

    def test_links_of_the_file_are_the_planted_ones_scaled(self) -> None:
        text = ns16.URDF_PATH.read_text(encoding="utf-8")
        assert text == ns16.urdf_text(CELL["simulation"]["inertia_scale"])


def test_the_stated_current_delay_is_that_of_the_default_servo() -> None:
    settings = ControllerSettings()
    assert CELL["controller"]["cycle_ms"] == 1000.0 * settings.period
    delay = 0.5 - settings.servo.current_lag / settings.period
    assert CELL["controller"]["current_delay_cycles"] == delay
