"""Joint side and motor side of an arm: gears, wrist coupling, calibration, torque constants.

With the controller's angle ``theta = joint_sign * q + joint_offset`` of joint angle q, the wire's
motor revolutions are (facts on the C4G Open wire, section 8)

    p_i = kr_i theta_i / 2 pi + cal_i                                          i = 1..4
    p_5 = kr_5 (theta_5 - k54 theta_4) / 2 pi + cal_5
    p_6 = kr_6 (theta_6 - k65 theta_5 + (k65 k54 - k64) theta_4) / 2 pi + cal_6

or, with K = diag(kr), C the unit triangular coupling and S = diag(joint_sign),

    2 pi (p - cal) = K C (S q + joint_offset),      M = K C S  (`motor_from_joint`).

Power is the same on both sides, so torques transform with the transpose: tau = M^T (Kt i).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from drivers.arrays import Array
from drivers.errors import DriveTrainError

TURN: Final = 2.0 * np.pi
WRIST_AXES: Final = 6


@dataclass(frozen=True, eq=False)
class DriveTrain:
    """Transmission between joints and motors of one arm with n rotary joints.

    Attributes:
        gear_ratio: (n,) signed motor revolutions per joint revolution.
        calibration: (n,) motor revolutions where the controller's angle is zero.
        joint_sign: (n,) +1 or -1, of the controller's angle against the joint angle.
        joint_offset: (n,) rad, controller's angle where the joint angle is zero.
        torque_constant: (n,) N·m/A on the motor side.
        current_limit: (n,) A.
        k54, k64, k65: influence of axis 4 on axis 5, 4 on 6, 5 on 6; zero without a coupled wrist.
        motor_from_joint: (n, n) motor rad per joint rad, gears, coupling and signs included.
        joint_from_motor: (n, n) its inverse.
        motor_offset: (n,) motor revolutions where the joint angles are zero.

    Raises:
        DriveTrainError: shapes differ, a value is not finite, a gear ratio is zero, a sign is not
            +1 or -1, a torque constant or current limit is not positive, or there is wrist
            coupling with fewer than six joints.
    """

    gear_ratio: Array
    calibration: Array
    joint_sign: Array
    joint_offset: Array
    torque_constant: Array
    current_limit: Array
    k54: float = 0.0
    k64: float = 0.0
    k65: float = 0.0
    motor_from_joint: Array = field(init=False, repr=False)
    joint_from_motor: Array = field(init=False, repr=False)
    motor_offset: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n = np.size(self.gear_ratio)
        for name in _PER_JOINT:
            object.__setattr__(self, name, _checked(name, getattr(self, name), n))
        geared = self.gear_ratio[:, None] * self._coupling(n)
        forward = geared * self.joint_sign
        inverse = np.asarray(np.linalg.inv(forward), dtype=np.float64)
        object.__setattr__(self, "motor_from_joint", _frozen(forward))
        object.__setattr__(self, "joint_from_motor", _frozen(inverse))
        object.__setattr__(
            self, "motor_offset", _frozen(self.calibration + geared @ self.joint_offset / TURN)
        )

    def _coupling(self, n: int) -> Array:
        coupling = np.eye(n)
        factors = (self.k54, self.k64, self.k65)
        if not np.all(np.isfinite(factors)):
            raise DriveTrainError("k54, k64, k65", factors, "finite numbers")
        if any(factors):
            if n < WRIST_AXES:
                raise DriveTrainError("k54, k64, k65", factors, f"zero for an arm of {n} joints")
            coupling[4, 3] = -self.k54
            coupling[5, 4] = -self.k65
            coupling[5, 3] = self.k65 * self.k54 - self.k64
        return coupling

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.gear_ratio)

    def motor_revolutions(self, q: ArrayLike) -> Array:
        """Convert joint positions (..., n) rad to motor revolutions on the wire."""
        return np.asarray(q) @ self.motor_from_joint.T / TURN + self.motor_offset

    def joint_position(self, motor_revolutions: ArrayLike) -> Array:
        """Convert motor revolutions (..., n) on the wire to joint positions, rad."""
        shifted = np.asarray(motor_revolutions, dtype=np.float64) - self.motor_offset
        return TURN * shifted @ self.joint_from_motor.T

    def motor_revolutions_per_cycle(self, qd: ArrayLike, period: float) -> Array:
        """Convert joint velocities (..., n) rad/s to motor revolutions per cycle of `period` s."""
        return np.asarray(qd) @ self.motor_from_joint.T * (period / TURN)

    def joint_velocity(self, motor_revolutions_per_cycle: ArrayLike, period: float) -> Array:
        """Convert motor revolutions per cycle (..., n) to joint velocities, rad/s."""
        per_cycle = np.asarray(motor_revolutions_per_cycle, dtype=np.float64)
        return (TURN / period) * per_cycle @ self.joint_from_motor.T

    def joint_torque(self, current: ArrayLike) -> Array:
        """Convert motor currents (..., n) A to joint torques, N·m."""
        return (np.asarray(current) * self.torque_constant) @ self.motor_from_joint

    def motor_current(self, torque: ArrayLike) -> Array:
        """Convert joint torques (..., n) N·m to motor currents, A."""
        return np.asarray(torque) @ self.joint_from_motor / self.torque_constant


_PER_JOINT: Final = (
    "gear_ratio",
    "calibration",
    "joint_sign",
    "joint_offset",
    "torque_constant",
    "current_limit",
)


def _frozen(array: Array) -> Array:
    array.setflags(write=False)
    return array


def _checked(name: str, value: ArrayLike, n: int) -> Array:
    array = np.array(value, dtype=np.float64)
    if array.shape != (n,):
        raise DriveTrainError(name, array.shape, f"shape ({n},) like gear_ratio")
    if not np.all(np.isfinite(array)):
        raise DriveTrainError(name, array.tolist(), "finite numbers")
    if name == "gear_ratio" and not np.all(array):
        raise DriveTrainError(name, array.tolist(), "no zero")
    if name == "joint_sign" and not np.all(np.abs(array) == 1.0):
        raise DriveTrainError(name, array.tolist(), "+1 or -1")
    if name in ("torque_constant", "current_limit") and not np.all(array > 0.0):
        raise DriveTrainError(name, array.tolist(), "positive numbers")
    return _frozen(array)


class MotorSide:
    """An arm on the motor side: conversions, and the values read last.

    Attributes:
        raw: (8, n) target position and velocity, position and velocity [motor revolutions, and per
            cycle], current [A], and three values that are recorded only.
    """

    def __init__(self, drive_train: DriveTrain, period: float) -> None:
        n = drive_train.n_joints
        self._to_joint = TURN * drive_train.joint_from_motor.T
        self._to_motor = drive_train.motor_from_joint.T / TURN
        self._motor_offset = drive_train.motor_offset
        per_second = 1.0 / period
        # As large as what it scales: numpy takes three times as long where it repeats columns.
        self._scale = np.tile([[1.0], [per_second], [1.0], [per_second]], n)
        zero = np.zeros(n)
        at_zero = -self._motor_offset @ self._to_joint
        self._offset = np.array([at_zero, zero, at_zero, zero])
        self.raw = np.zeros((8, n))
        self._kinematics = self.raw[:4]

    def to_joints(self, measured: Array) -> None:
        """Convert `raw` to joint side in SI (8, n)."""
        kinematics = measured[:4]
        self._kinematics.dot(self._to_joint, kinematics)
        kinematics *= self._scale
        kinematics += self._offset
        measured[4:] = self.raw[4:]

    def motor(self, q: Array) -> Array:
        """Convert joint positions (n,) to motor revolutions (n,)."""
        motor: Array = q.dot(self._to_motor)
        motor += self._motor_offset
        return motor

    def joint_difference(self, motor: Array) -> Array:
        """Convert changes (n,) of motor revolutions to changes of joint position [rad]."""
        difference: Array = np.dot(motor, self._to_joint)
        return difference
