"""Frames of a controller as cycle records, and as states that other controllers do not send."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.arrays import Array
from drivers.cycle_records import cycle_dtype
from drivers.drive_train import DriveTrain
from drivers.packets import DRIVE_ON
from drivers.states import State
from drivers.ur.outputs import N_JOINTS, POWER_MODES, ROBOT_RUNNING
from drivers.ur.reader import OutputFrames
from drivers.ur.rtde import RtdeError

UNKNOWN: Final = -1
"""Of integers that the controller does not send; other numbers are NaN."""
_JOINT: Final = (N_JOINTS,)
STATE_DTYPE: Final = np.dtype(
    [
        ("controller_time", "f8"),
        ("target_acceleration", "f8", _JOINT),
        ("target_moment", "f8", _JOINT),
        ("control_current", "f8", _JOINT),
        ("current_as_torque", "f8", _JOINT),
        ("joint_temperature", "f8", _JOINT),
        ("speed_scaling", "f8"),
        ("speed_fraction", "f8"),
        ("position_deviation_ratio", "f8"),
        ("collision_ratio", "f8"),
        ("payload_mass", "f8"),
        ("payload_centre", "f8", (3,)),
        ("payload_inertia", "f8", (6,)),
        ("robot_mode", "i4"),
        ("safety_mode", "i4"),
        ("runtime_state", "i4"),
        ("robot_status", "i4"),
        ("safety_status", "i4"),
    ]
)
"""State of a controller in one cycle.

``controller_time`` s since its start; joint arrays in the sense of the URDF, ``target_moment`` N·m
of its rigid-body model (payload and gravity included, no friction), currents A; temperatures °C;
``payload_*`` as set at the controller, in the frame of its flange, inertia xx, xy, xz, yy, yz, zz;
``*_status`` are bits.
"""
_OUTPUT_OF: Final = {
    "controller_time": "timestamp",
    "target_acceleration": "target_qdd",
    "target_moment": "target_moment",
    "control_current": "joint_control_output",
    "current_as_torque": "actual_current_as_torque",
    "joint_temperature": "joint_temperatures",
    "speed_scaling": "speed_scaling",
    "speed_fraction": "target_speed_fraction",
    "position_deviation_ratio": "joint_position_deviation_ratio",
    "collision_ratio": "collision_detection_ratio",
    "payload_mass": "payload",
    "payload_centre": "payload_cog",
    "payload_inertia": "payload_inertia",
    "robot_mode": "robot_mode",
    "safety_mode": "safety_mode",
    "runtime_state": "runtime_state",
    "robot_status": "robot_status_bits",
    "safety_status": "safety_status_bits",
}
_SIGNED: Final = ("target_acceleration", "target_moment", "control_current", "current_as_torque")
_INERTIA_ORDER: Final = [0, 3, 4, 1, 5, 2]
"""xx, xy, xz, yy, yz, zz in the controller's xx, yy, zz, xy, xz, yz."""
_MOST_OFF_GRID: Final = 0.25
"""Of a time stamp, in cycles."""


class CycleFrames(NamedTuple):
    """Records (k,) of `drivers.cycle_dtype`, and states (k,) of `STATE_DTYPE`."""

    records: NDArray[np.void]
    states: NDArray[np.void]


class CycleCounter:
    """Makes records of frames, and counts cycles by the controller's time stamps alone.

    OutputFrames that did not arrive are a gap in the cycles, and never a shift.

    Args:
        drive_train: signs and offsets of the joints.
        period: of the controller [s].
    """

    def __init__(self, drive_train: DriveTrain, period: float) -> None:
        self._sign: Array = drive_train.joint_sign
        self._offset: Array = drive_train.joint_offset
        self._period = period
        self._newest: float | None = None
        self._cycle = -1
        self._fault: RtdeError | None = None

    def records(self, frames: OutputFrames) -> CycleFrames:
        """Return records and states of frames, in their order.

        Raises:
            RtdeError: time stamps that do not increase by whole cycles.
        """
        steps = self._steps(frames.values["timestamp"])
        values = frames.values[: len(steps)]
        cycle = self._cycle + np.cumsum(steps)
        if len(cycle):
            self._cycle = int(cycle[-1])
        records = np.zeros(len(values), cycle_dtype(N_JOINTS))
        records["cycle"] = cycle
        records["number"] = cycle % (1 << 31)
        records["gap"] = steps - 1
        records["arrival"] = frames.arrival[: len(steps)]
        records["interval"] = -1
        records["state"] = _states(values["robot_mode"])
        records["status"] = np.where(values["robot_mode"] == ROBOT_RUNNING, DRIVE_ON, 0)
        records["mode"] = values["joint_mode"]
        for name, output in (("target_position", "target_q"), ("position", "actual_q")):
            records[name] = (values[output] - self._offset) * self._sign
        for name, output in (("target_velocity", "target_qd"), ("velocity", "actual_qd")):
            records[name] = values[output] * self._sign
        # The sign of the joint is in the drive train's ratios, which make torques of currents.
        records["target_current"] = values["actual_current"]
        records["model_current"] = values["target_current"]
        for name in ("diagonal_inertia", "extra3", "commanded_position", "commanded_velocity"):
            records[name] = np.nan
        return CycleFrames(records, self._arm_states(values))

    def _steps(self, stamps: Array) -> NDArray[np.int64]:
        """Return the cycles since the frame before, of those before a fault; 1 for the first."""
        if self._fault is not None:
            raise self._fault
        if not len(stamps):
            return np.zeros(0, np.int64)
        before = stamps[0] - self._period if self._newest is None else self._newest
        cycles = np.diff(stamps, prepend=before) / self._period
        steps = np.rint(cycles)
        wrong = np.flatnonzero(~((steps >= 1) & (np.abs(cycles - steps) <= _MOST_OFF_GRID)))
        if wrong.size:
            first = int(wrong[0])
            self._fault = self._fault_of(cycles[first])
            if first == 0:
                raise self._fault
            stamps, steps = stamps[:first], steps[:first]
        self._newest = float(stamps[-1])
        return steps.astype(np.int64)

    def _fault_of(self, cycles: float) -> RtdeError:
        """Return why a time stamp cannot follow so many cycles after another."""
        if not cycles >= 1 - _MOST_OFF_GRID:
            return RtdeError("the controller's time stamps go back: it was started again")
        problem = f"the controller's time stamps are not {1e3 * self._period:g} ms apart"
        return RtdeError(f"{problem}: correct controller.cycle_ms")

    def _arm_states(self, values: NDArray[np.void]) -> NDArray[np.void]:
        states = np.zeros(len(values), STATE_DTYPE)
        sent = values.dtype.names or ()
        for name, output in _OUTPUT_OF.items():
            if output in sent:
                states[name] = values[output]
            else:
                states[name] = UNKNOWN if STATE_DTYPE[name].kind == "i" else np.nan
        for name in _SIGNED:
            states[name] *= self._sign
        states["payload_inertia"] = states["payload_inertia"][:, _INERTIA_ORDER]
        return states


def _states(robot_mode: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return the state of the session for each mode of the robot: nothing is commanded in any."""
    off = np.where(np.isin(robot_mode, POWER_MODES), State.DRIVING_ON, State.DRIVE_OFF)
    return np.where(robot_mode == ROBOT_RUNNING, State.CLOSED, off).astype(np.uint8)
