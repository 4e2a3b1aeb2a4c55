"""The answer to each cyclic packet of one session, once the state it leads to is known."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.announced import contradiction
from drivers.arm_wire import ArmWire
from drivers.drive_train import DriveTrain
from drivers.errors import FollowingError, PacketError, RefusalError
from drivers.guard import Guard
from drivers.machine import Machine
from drivers.open_mode import OpenMode
from drivers.packets import EXIT_FROM_OPEN, InitPacket
from drivers.reading import Reader, Reading
from drivers.replies import ReplyFrame, Words
from drivers.states import HAS_SET_POINTS, Input, State

Array = NDArray[np.float64]

EXIT_RETRY_CYCLES: Final = 100
"""Cycles after which the end of open mode is asked for again."""


class Answers:
    """Set up anew from each init packet, which it matches to the arm.

    The guard is narrowed to the controller's own limits on following error and current.

    Attributes:
        init: the init packet.
        reader: reads status and modes of its packets.
        wire: the joints in a packet; None if the packet cannot be matched to them, or is of an arm
            with other gears, calibration or coupling.
        unusable: why this arm cannot be moved in this session, or None.
    """

    def __init__(
        self, init: InitPacket, drive_train: DriveTrain, guard: Guard, arm: int, mode: int
    ) -> None:
        self.init = init
        self.unusable: str | None = None
        self.wire: ArmWire | None = None
        self._arm = arm
        self._frame = ReplyFrame(init.n_axes)
        self._open_mode: OpenMode | None = None
        self._cycles_leaving = 0
        if not math.isclose(init.period, guard.period, rel_tol=1e-9):
            self.unusable = (
                f"the controller's cycle is {init.sample_time} ms, the guard was built for "
                f"{1e3 * guard.period:g} ms"
            )
        else:
            try:
                wire = ArmWire(drive_train, init, arm)
            except PacketError as error:
                self.unusable = str(error)
            else:
                self.unusable = contradiction(drive_train, init, arm)
                self.wire = wire if self.unusable is None else None
        if self.wire is None:
            self.reader = Reader(np.arange(init.n_axes), (arm,) * init.n_axes, arm, mode)
            return
        arms = tuple(axis.arm for axis in init.open_axes())
        self.reader = Reader(self.wire.joint_slots, arms, arm, mode)
        self._open_mode = OpenMode(guard, self.wire, self._frame)
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
        if state is State.OPENING:
            self._open_mode.opening(reading, measured, commanded, machine.cycle)
            return status
        if state is State.EXITING:
            self._open_mode.leaving(reading, commanded)
            self._cycles_leaving += 1
            retry = self._cycles_leaving % EXIT_RETRY_CYCLES == 0
            return self._asking_for_exit(status) if retry else status
        if not self._open(self._open_mode, machine, measured, commanded):
            return status
        machine.take(Input.EXIT)
        self._cycles_leaving = 0
        return self._asking_for_exit(status)

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
            open_mode.next(execution if moving else None, commanded, cycle)
        if execution is None:
            return machine.stop_reason is not None
        if not moving:
            machine.begin_motion(open_mode.held)
        execution.leaving = execution.settled
        return execution.leaving

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
