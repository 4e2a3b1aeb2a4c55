"""The answer to each cyclic packet of one session, once the state it leads to is known."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.announced import compare
from drivers.arm_wire import Ages, ArmWire
from drivers.correction_mode import CorrectionMode
from drivers.drive_train import DriveTrain
from drivers.errors import ExitNotGranted, FollowingError, PacketError, RefusalError
from drivers.guard import Guard
from drivers.machine import Machine
from drivers.open_mode import OpenMode, PositionMode
from drivers.packets import EXIT_FROM_OPEN, InitPacket
from drivers.reading import Reader, Reading
from drivers.record import CycleRing
from drivers.replies import ReplyFrame, Words
from drivers.states import CORRECTION_MODES, HAS_SET_POINTS, Input, State

Array = NDArray[np.float64]

EXIT_RETRY_CYCLES: Final = 100
"""Cycles after which the end of open mode is asked for again."""
EXIT_TIMEOUT: Final = 10.0
"""s that a controller has to open the last axis, and to leave open mode once asked."""


class Answers:
    """Set up anew from each init packet, which it matches to the arm.

    The guard is narrowed to the controller's own limits on following error and current.

    Attributes:
        init: the init packet.
        reader: reads status and modes of its packets.
        wire: the joints in a packet; None if the packet cannot be matched to them, or is of an arm
            with other gears, calibration or coupling.
        announced: the init packet against the cell, and the drive train in force.
        unusable: why this arm cannot be moved in this session, or None.

    Args:
        init: the init packet.
        drive_train: the cell's.
        guard: of the arm.
        arm: its number, from 1.
        mode: the open mode wanted.
        accept: adopt the controller's gear ratios, calibration and coupling where they differ.
    """

    def __init__(
        self,
        init: InitPacket,
        drive_train: DriveTrain,
        guard: Guard,
        arm: int,
        mode: int,
        accept: bool = False,
    ) -> None:
        self.init = init
        self.announced = compare(drive_train, guard.period, init, arm, accept)
        self.unusable = self.announced.unusable
        self.wire: ArmWire | None = None
        self._arm = arm
        self._frame = ReplyFrame(init.n_axes)
        self._open_mode: OpenMode | None = None
        self._asked_at = -1
        self._exit_cycles = round(EXIT_TIMEOUT / guard.period)
        if self.unusable is not None:
            self.reader = _reader_without_joints(init, arm, mode)
            return
        self.wire = ArmWire(self.announced.drive_train, init, arm)
        arms = tuple(axis.arm for axis in init.open_axes())
        self.reader = Reader(self.wire.joint_slots, arms, arm, mode)
        kind = CorrectionMode if mode in CORRECTION_MODES else PositionMode
        self._open_mode = kind(guard, self.wire, self._frame, mode)
        axes = slice(0, drive_train.n_joints)
        guard.narrow(
            init.following_error[arm - 1, axes].astype(np.float64),
            np.fmin(init.current_limit[arm - 1, axes], drive_train.current_limit),
        )

    def answer(
        self, machine: Machine, reading: Reading, words: Words, measured: Array, commanded: Array
    ) -> bytes:
        """Fill the frame for the machine's state.

        Args:
            machine: already in the state that the packet leads to.
            reading: the packet, understood.
            words: (n_axes, 9) its axis blocks.
            measured: (8, n) the same in SI, joint side.
            commanded: (2, n) NaN, to be filled where set-points are sent.

        Returns:
            The 4 status bytes.

        Raises:
            RefusalError: no set-point may be sent.
        """
        state = machine.state
        if state is State.FAULTED and reading.powered:
            return self.refusal(machine.offending, reading, words)
        self._frame.safe(reading.answer, words)
        status = reading.answer.status
        if state not in HAS_SET_POINTS:
            return status
        if self._open_mode is None:
            raise RefusalError(f"this arm cannot be moved: {self.unusable}", machine.cycle)
        if state is State.EXITING:
            # Left before the last axis opened, no axis has had a set-point but its own target.
            answer = self._open_mode.leaving if machine.in_interval else self._open_mode.opening
            answer(reading, measured, commanded, machine.cycle)
            return self._asking_for_exit(status) if self._exit_due(machine) else status
        if state is State.OPENING:
            self._open_mode.opening(reading, measured, commanded, machine.cycle)
            done = self._given_up(machine)
        else:
            done = self._open(self._open_mode, machine, measured, commanded)
        if not done:
            return status
        machine.take(Input.EXIT)
        self._asked_at = machine.cycle
        return self._asking_for_exit(status)

    def _given_up(self, machine: Machine) -> bool:
        """Whether nobody waits any longer for the last axis to open."""
        if machine.execution is not None:
            if machine.cycle - machine.entered_at < self._exit_cycles:
                return False
            machine.stop(f"some axes did not open within {EXIT_TIMEOUT:g} s")
        return machine.stop_reason is not None

    def _exit_due(self, machine: Machine) -> bool:
        """Whether the end of open mode is to be asked for once more.

        Raises:
            ExitNotGranted: it was asked for, or the controller began it, too long ago.
        """
        leaving = machine.cycle - machine.entered_at
        if leaving >= self._exit_cycles:
            raise ExitNotGranted(leaving, machine.cycle)
        due = machine.cycle - max(self._asked_at, machine.entered_at) >= EXIT_RETRY_CYCLES
        if due:
            self._asked_at = machine.cycle
        return due

    def _open(
        self, open_mode: OpenMode, machine: Machine, measured: Array, commanded: Array
    ) -> bool:
        """The next set-point; says whether it was the last one."""
        execution, cycle = machine.execution, machine.cycle
        moving = execution is not None and execution.started
        if machine.entering:
            machine.entering = False
            open_mode.enter(measured, commanded, cycle)
        else:
            if execution is not None and moving and machine.stop_reason is not None:
                execution.stop(machine.stop_reason, cycle)
            elif execution is not None and not moving:
                open_mode.require_start(cycle)
            open_mode.next(execution if moving else None, measured, commanded, cycle)
        if execution is None:
            return machine.stop_reason is not None
        if not moving:
            machine.begin_motion(open_mode.held)
        execution.leaving = execution.settled
        return execution.leaving

    def record(
        self, ring: CycleRing, row: int, reading: Reading, words: Words, ages: Ages | None
    ) -> None:
        """Put what a packet says into its record; nothing was commanded yet.

        Args:
            ring: keeps the record.
            row: its row there.
            reading: the packet, understood.
            words: (n_axes, 9) its axis blocks.
            ages: (n_axes, 8) cycles since their values were sent; None if with this packet.
        """
        ring.status[row] = reading.status
        ring.commanded[row] = math.nan
        if self.wire is None:
            ring.mode[row] = -1
            ring.measured[row] = math.nan
            ring.age[row] = 0 if ages is None else ages.max(axis=0)
            return
        ring.mode[row] = reading.modes
        ring.age[row] = 0 if ages is None else ages[self.wire.joint_slots].max(axis=0)
        self.wire.read(words.view(np.float32), ring.measured[row], ages)

    def require_carried_on(self, machine: Machine) -> None:
        """After a long gap: a motion under way goes on only where the controller carried it on.

        Raises:
            NotFinite, MotionNotCarriedOn, MotionHeld: it did not.
        """
        execution = machine.execution
        under_way = machine.state is State.OPEN and not machine.entering
        if self._open_mode is not None and under_way and execution is not None:
            self._open_mode.require_carried_on(machine.cycle)

    def refusal(self, offending: int | None, reading: Reading, words: Words) -> bytes:
        """Fill the frame with 508 for the offending joint, or with 505 for all."""
        if offending is None or self.wire is None:
            self._frame.drive_off(reading.answer, words)
        else:
            slots = self.wire.joint_slots[offending : offending + 1]
            self._frame.following_error(reading.answer, words, slots)
        return reading.answer.status

    def refuse(
        self, machine: Machine, error: RefusalError, reading: Reading, words: Words
    ) -> bytes:
        """Go to the faulted state and fill the frame accordingly; returns the status bytes."""
        machine.take(Input.REFUSAL)
        machine.offending = error.joint if isinstance(error, FollowingError) else None
        return self.refusal(machine.offending, reading, words)

    def finish(self, number: int, status: bytes) -> bytes:
        """The bytes of the answer to packet `number`."""
        return self._frame.finish(number, status)

    def _asking_for_exit(self, status: bytes) -> bytes:
        asking = bytearray(status)
        asking[self._arm - 1] = EXIT_FROM_OPEN
        return bytes(asking)


def _reader_without_joints(init: InitPacket, arm: int, mode: int) -> Reader:
    """For an arm that cannot be moved: whatever it has of open axes, or all if nobody can tell."""
    try:
        axes = init.open_axes()
    except PacketError:
        return Reader(np.arange(init.n_axes), None, arm, mode)
    slots = np.array([axis.slot for axis in axes if axis.arm == arm], np.intp)
    return Reader(slots, tuple(axis.arm for axis in axes), arm, mode)
