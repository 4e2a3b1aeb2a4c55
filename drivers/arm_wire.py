"""Where the joints of one arm stand in a packet, and the conversion of a whole packet at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import TURN, DriveTrain
from drivers.errors import PacketError
from drivers.packets import InitPacket
from drivers.replies import D1, Floats

Ages = NDArray[np.uint16]

Array = NDArray[np.float64]


class ArmWire:
    """Joint side and wire side of the joints of one arm.

    Attributes:
        joint_slots: (n,) slot of each joint.
        opened: (n,) joints that are to be open; only these are written into a frame.
        raw: (8, n) D1..D5, extra1..3 of the packet read last, in wire units.
        age: (8, n) cycles since each of them was sent; None where all came with this packet.
        n_axes: slots in a packet.

    Raises:
        PacketError: the init packet's axis map is impossible or lacks one of the joints.
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
        self.n_axes = init.n_axes
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
        self._scale = np.array([[1.0], [per_second], [1.0], [per_second]])
        zero = np.zeros(n)
        at_zero = -self._motor_offset @ self._to_joint
        self._offset = np.array([at_zero, zero, at_zero, zero])
        self.raw = np.zeros((8, n))
        self.age: Ages | None = None

    def read(self, received: Floats, measured: Array, ages: Ages | None = None) -> None:
        """Take a packet's axis blocks (n_axes, 9) into `raw`, and (8, n) into `measured` in SI.

        `ages` (n_axes, 8) go with the blocks; None if nothing is older than the packet.
        """
        raw = self.raw
        self.age = None if ages is None else ages[self._pick].T
        raw[...] = received[self._pick, D1:].T
        kinematics = measured[:4]
        np.matmul(raw[:4], self._to_joint, out=kinematics)
        kinematics *= self._scale
        kinematics += self._offset
        measured[4:] = raw[4:]

    def motor(self, q: Array) -> Array:
        """Joint positions (n,) to motor revolutions (n,)."""
        motor: Array = np.dot(q, self._to_motor)
        motor += self._motor_offset
        return motor

    def motor_difference(self, dq: Array) -> Array:
        """Differences of joint positions (n,) rad to motor revolutions (n,)."""
        difference: Array = np.dot(dq, self._to_motor)
        return difference

    def joint_difference(self, motor: Array) -> Array:
        """Differences of motor revolutions (n,) to those of joint positions (n,) rad."""
        difference: Array = np.dot(motor, self._to_joint)
        return difference

    def joint_rounding(self, motor: Array) -> Array:
        """What float32 may make, in rad, of a step between two targets (n,) like these."""
        rounding: Array = np.spacing(np.abs(motor).astype(np.float32)) @ np.abs(self._to_joint)
        return rounding

    def put(self, frame: Floats, column: int, values: Array) -> None:
        """Put values (n,) into one column of a frame."""
        frame[self._slots, column] = values[self._written]

    def write(self, frame: Floats, position: Array, step: Array) -> None:
        """Put set-points (n,) in motor revolutions, per cycle, into a frame's D1 and D2."""
        self.put(frame, D1, position)
        self.put(frame, D1 + 1, step)
