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
from numpy.typing import ArrayLike, NDArray

from drivers.arrays import Array
from drivers.errors import DriveTrainError, PacketError
from drivers.packets import InitPacket
from drivers.safe_reply import D1, Floats

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


class ArmWire:
    """Conversion between joints of one arm and slots of a packet.

    Attributes:
        joint_slots: (n,) slot of each joint.
        opened: (n,) joints that are to be open; only these are written into a frame.
        raw: (8, n) D1..D5, extra1..3 of the packet read last, in wire units.

    Raises:
        PacketError: the init packet's axis map is invalid or lacks one of the joints.
    """

    def __init__(
        self, drive_train: DriveTrain, init: InitPacket, arm: int, only_axis: int | None = None
    ) -> None:
        n = drive_train.n_joints
        slot_of = {axis.axis: axis.slot for axis in init.open_axes() if axis.arm == arm}
        missing = [joint + 1 for joint in range(n) if joint not in slot_of]
        if missing:
            raise PacketError(
                "open_axes_map", init.open_axes_map[arm - 1].tolist(), f"axes {missing} open"
            )
        self.joint_slots = np.array([slot_of[joint] for joint in range(n)], np.intp)
        first = int(self.joint_slots[0])
        contiguous = np.array_equal(self.joint_slots, np.arange(first, first + n))
        # A slice makes a view where an index array would make a copy.
        self._pick: slice | NDArray[np.intp] = (
            slice(first, first + n) if contiguous else self.joint_slots
        )
        self.opened = np.ones(n, dtype=np.bool_)
        self._written: slice | NDArray[np.intp] = slice(None)
        self._slots = self._pick
        if only_axis is not None:
            self._written = np.array([only_axis - 1])
            self.opened[...] = np.arange(n) == self._written
            self._slots = self.joint_slots[self._written]
        self._to_joint = TURN * drive_train.joint_from_motor.T
        self._to_motor = drive_train.motor_from_joint.T / TURN
        self._motor_offset = drive_train.motor_offset
        per_second = 1.0 / init.period
        # As large as what it scales: numpy takes three times as long where it repeats columns.
        self._scale = np.tile([[1.0], [per_second], [1.0], [per_second]], n)
        zero = np.zeros(n)
        at_zero = -self._motor_offset @ self._to_joint
        self._offset = np.array([at_zero, zero, at_zero, zero])
        self.raw = np.zeros((8, n))
        self._kinematics = self.raw[:4]

    def read(self, received: Floats, measured: Array) -> None:
        """Read a packet's axis blocks (n_axes, 9) into `raw`, and (8, n) into `measured` in SI."""
        raw = self.raw
        raw[...] = received[self._pick, D1:].T
        kinematics = measured[:4]
        self._kinematics.dot(self._to_joint, kinematics)
        kinematics *= self._scale
        kinematics += self._offset
        measured[4:] = raw[4:]

    def motor(self, q: Array) -> Array:
        """Convert joint positions (n,) to motor revolutions (n,)."""
        motor: Array = q.dot(self._to_motor)
        motor += self._motor_offset
        return motor

    def motor_difference(self, dq: Array) -> Array:
        """Convert differences of joint positions (n,) rad to motor revolutions (n,)."""
        difference: Array = np.dot(dq, self._to_motor)
        return difference

    def joint_difference(self, motor: Array) -> Array:
        """Convert differences of motor revolutions (n,) to those of joint positions (n,) rad."""
        difference: Array = np.dot(motor, self._to_joint)
        return difference

    def put(self, frame: Floats, column: int, values: Array) -> None:
        """Write values (n,) into one column of a frame."""
        frame[self._slots, column] = values[self._written]

    def write(self, frame: Floats, position: Array, step: Array) -> None:
        """Write set-points (n,), motor revolutions and per cycle, into D1 and D2 of a frame."""
        self.put(frame, D1, position)
        self.put(frame, D1 + 1, step)
