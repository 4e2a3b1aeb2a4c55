"""The plain fit finds what was planted, and chooses its cut-off without seeing what it predicts."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from benchmarks import plain_fit
from benchmarks.plain_fit import Measured
from tests.benchmarks.two_joint_log import COULOMB, ROTOR, URDF, VISCOUS, two_joint_log

ROBOT = plain_fit.robot_from_urdf(URDF.read_text())


def planted() -> np.ndarray:
    """Parameters of the two links, their rotors and their friction."""
    links = [ROBOT.inertias[joint].toDynamicParameters() for joint in (1, 2)]
    return np.concatenate([*links, ROTOR, COULOMB, VISCOUS, np.zeros(2)])


def of_the_regressor(cutoff: float, seed: int) -> Measured:
    """A log whose torque is that of the planted parameters after a filter of this cut-off."""
    measured = two_joint_log(seed, noise=0.0).measured._replace(velocity=None)
    rough = 1e-4 * np.random.default_rng(2).standard_normal(measured.position.shape)
    measured = measured._replace(position=measured.position + rough)
    torque = plain_fit.regressor(ROBOT, measured, cutoff) @ planted()
    return measured._replace(torque=torque)


class TestPlainFit:
    @pytest.mark.parametrize("cutoff", [5.0, 12.0])
    def test_noise_free_data_are_predicted_exactly(self, cutoff: float) -> None:
        """A torque that the model can make is predicted to rounding, by the cut-off it has."""
        one, other = (of_the_regressor(cutoff, seed) for seed in (1, 2))
        fitted = plain_fit.fit(ROBOT, one)
        assert fitted.cutoff == cutoff
        for measured in (one, other):
            predicted = fitted.predicted_torque(measured)
            assert plain_fit.relative_error(measured.torque, predicted) < 1e-8

    def test_another_motion_of_the_simulated_arm_is_predicted(self) -> None:
        """Torques of recursive Newton-Euler, with what filter and differences leave of it."""
        one, other = (two_joint_log(seed, noise=0.0).measured for seed in (1, 2))
        predicted = plain_fit.fit(ROBOT, one).predicted_torque(other)
        assert plain_fit.relative_error(other.torque, predicted) < 0.01

    def test_the_torque_to_be_predicted_is_not_looked_at(self) -> None:
        one, other = (two_joint_log(seed).measured for seed in (1, 2))
        fitted = plain_fit.fit(ROBOT, one)
        blind = fitted.predicted_torque(other._replace(torque=np.full_like(other.torque, np.nan)))
        assert np.array_equal(blind, fitted.predicted_torque(other))

    def test_each_joint_is_weighted_by_its_own_residual(self) -> None:
        """A hundred times the noise on one joint hardly moves what the other joint says."""
        random = np.random.default_rng(3)
        measured = two_joint_log(1, noise=0.0).measured
        table = plain_fit.regressor(ROBOT, measured, 20.0)
        noise = random.standard_normal(measured.torque.shape) * [10.0, 0.1]
        found = plain_fit.solve(table, table @ planted() + noise)
        left = (table @ (found - planted())).std(axis=0)
        assert left[1] < 0.03 < left[0]

    def test_gravity_and_locked_joints_are_those_that_are_named(self) -> None:
        locked = plain_fit.robot_from_urdf(URDF.read_text(), (0.0, 9.81, 0.0), {"elbow": 0.5})
        assert locked.nv == 1
        whole = pin.buildModelFromUrdf(str(URDF))
        whole.gravity.linear = np.array([0.0, 9.81, 0.0])
        alone = pin.rnea(locked, locked.createData(), np.ones(1), np.zeros(1), np.zeros(1))
        both = pin.rnea(whole, whole.createData(), np.array([1.0, 0.5]), np.zeros(2), np.zeros(2))
        assert alone[0] == pytest.approx(both[0])
