"""Frames of a controller as cycle records, with the arm's state in them."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from drivers.arrays import Array
from drivers.c4g_packets import DRIVE_ON
from drivers.cycle_records import ARM_STATE, cycle_dtype
from drivers.drive_train import DriveTrain
from drivers.states import State
from drivers.ur.arm_state import STATE_DTYPE, state_columns
from drivers.ur.outputs import N_JOINTS, POWER_MODES, ROBOT_RUNNING
from drivers.ur.reader import OutputFrames
from drivers.ur.rtde import RtdeError

MAX_GRID_DEVIATION: Final = 0.25
"""Of a time stamp, in cycles."""


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

    def records(self, frames: OutputFrames) -> NDArray[np.void]:
        """Return the records (k,) of frames, in their order.

        Raises:
            RtdeError: time stamps that do not increase by whole cycles.
        """
        steps = self._steps(frames.values["timestamp"])
        values = frames.values[: len(steps)]
        cycle = self._cycle + np.cumsum(steps)
        if len(cycle):
            self._cycle = int(cycle[-1])
        records = np.zeros(len(values), cycle_dtype(N_JOINTS, STATE_DTYPE))
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
        states = np.empty(len(values), STATE_DTYPE)
        columns = state_columns(values.dtype, self._sign)
        columns.write(structured_to_unstructured(values, np.float64), states)
        records[ARM_STATE] = states
        return records

    def _steps(self, stamps: Array) -> NDArray[np.int64]:
        """Return the cycles since the previous frame, up to a fault; 1 for the first."""
        if self._fault is not None:
            raise self._fault
        if not len(stamps):
            return np.zeros(0, np.int64)
        before = stamps[0] - self._period if self._newest is None else self._newest
        cycles = np.diff(stamps, prepend=before) / self._period
        steps = np.rint(cycles)
        wrong = np.flatnonzero(~((steps >= 1) & (np.abs(cycles - steps) <= MAX_GRID_DEVIATION)))
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
        if not cycles >= 1 - MAX_GRID_DEVIATION:
            return RtdeError("the controller's time stamps go back: it was started again")
        problem = f"the controller's time stamps are not {1e3 * self._period:g} ms apart"
        return RtdeError(f"{problem}: correct controller.cycle_ms")


def _states(robot_mode: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return the state of the session for each mode of the robot: nothing is commanded in any."""
    off = np.where(np.isin(robot_mode, POWER_MODES), State.DRIVING_ON, State.DRIVE_OFF)
    return np.where(robot_mode == ROBOT_RUNNING, State.CLOSED, off).astype(np.uint8)
