"""The simulated robot's gears, against matrices written from the controller's formulas."""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim_fixtures import SettingError, SimulatedDrive

Array = NDArray[np.float64]
angles = st.lists(st.floats(-7.0, 7.0), min_size=6, max_size=6)
numbers = st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=6)


@given(q=angles)
def test_motor_positions_follow_the_formulas(
    drive: SimulatedDrive, motor_matrix: Callable[[SimulatedDrive], Array], q: list[float]
) -> None:
    controller = np.array(q) * drive.joint_sign + drive.joint_offset
    expected = motor_matrix(drive) @ controller + drive.calibration
    np.testing.assert_allclose(drive.motor_revolutions(q), expected, rtol=1e-12, atol=1e-11)


@given(q=angles)
def test_motor_to_joint_undoes_joint_to_motor(drive: SimulatedDrive, q: list[float]) -> None:
    np.testing.assert_allclose(drive.joint_angles(drive.motor_revolutions(q)), q, atol=1e-12)
    np.testing.assert_allclose(drive.joint_speeds(drive.motor_speeds(q)), q, atol=1e-12)


@given(qd=angles, currents=numbers)
def test_power_at_the_motors_is_power_at_the_joints(
    drive: SimulatedDrive, qd: list[float], currents: list[float]
) -> None:
    motor_torque = np.array(currents) * drive.torque_constant
    motor_speed = 2.0 * pi * np.array(drive.motor_speeds(qd))
    joint_power = np.dot(drive.joint_torques(currents), qd)
    assert joint_power == pytest.approx(motor_torque @ motor_speed, rel=1e-10, abs=1e-6)


@given(torques=numbers)
def test_currents_give_the_torques_asked_for(drive: SimulatedDrive, torques: list[float]) -> None:
    np.testing.assert_allclose(
        drive.joint_torques(drive.currents(torques)), torques, rtol=1e-12, atol=1e-10
    )


def test_coupling_acts_on_4_and_5_and_nowhere_else(
    drive: SimulatedDrive, make_drive: Callable[..., SimulatedDrive]
) -> None:
    plain = make_drive(k54=0.0, k64=0.0, k65=0.0)
    one_ampere = [1.0] * 6
    difference = np.subtract(drive.joint_torques(one_ampere), plain.joint_torques(one_ampere))
    np.testing.assert_allclose(difference[[0, 1, 2, 5]], 0.0, atol=0.0)
    assert np.all(np.abs(difference[[3, 4]]) > 0.1)


def test_encoders_read_whole_counts(drive: SimulatedDrive) -> None:
    positions = [0.1, -2.34567, 57.0000001, 3.0, -0.00001, 12.5]
    read = np.array(drive.encoder(positions, [0.0] * 6))
    counts = read * drive.encoder_counts
    np.testing.assert_array_equal(counts, np.round(counts))
    assert np.abs(read - positions).max() <= 0.5 / drive.encoder_counts
    shifted = np.array(drive.encoder(positions, [2.0] * 6))
    np.testing.assert_allclose((shifted - read) * drive.encoder_counts, 2.0, atol=1e-6)


def test_an_arm_without_a_wrist_needs_no_coupling() -> None:
    two = [1.0, 1.0]
    drive = SimulatedDrive([100.0, -50.0], [0.5, 0.0], two, [0.0, 0.1], two, two, two, 4096)
    np.testing.assert_allclose(drive.joint_angles(drive.motor_revolutions([0.3, 0.4])), [0.3, 0.4])


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"gear_ratio": [100.0] * 5 + [0.0]}, "gear_ratio"),
        ({"calibration": [0.0] * 5}, "calibration"),
        ({"joint_sign": [2.0] * 6}, "joint_sign"),
        ({"torque_constant": [-1.0] * 6}, "torque_constant"),
        ({"current_limit": [float("nan")] * 6}, "current_limit"),
        ({"k54": float("inf")}, "k54"),
        ({"encoder_counts": 0}, "encoder_counts"),
    ],
)
def test_impossible_figures_are_refused_by_name(
    make_drive: Callable[..., SimulatedDrive], change: dict[str, Any], name: str
) -> None:
    with pytest.raises(SettingError, match=name):
        make_drive(**change)


def test_coupling_without_a_wrist_is_refused() -> None:
    two = [1.0, 1.0]
    with pytest.raises(SettingError, match="below six axes"):
        SimulatedDrive(two, two, two, two, two, two, two, 4096, k54=0.1)
