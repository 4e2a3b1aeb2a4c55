"""The answer to each cyclic packet of one session, once the state it leads to is known.

In open mode the first set-point is the target received in the packet in which the last wanted axis
opened, at zero velocity, held against actual position and standstill. D2 is the step of the motor
from one sent set-point to the next, formed in float64; which of D1..D5 an open mode has is the
table `drivers.packets.MODE_FIELDS`. A motion requested while the axes are open already begins under
the same conditions, from the set-point held. While axes are open, moving or not, following error
and current are watched, and that the controller takes the set-points: the target received (D1) is
within 10 % of the following-error threshold of one of the last `max_gap` + 1 sent, or of the last
carried on by as many steps as packets were missed, and within 25 % of the last. An older one than
the last is an answer lost, which is counted and reported; the last set-point is sent again until it
was taken, and more than `max_gap` of them in 100 cycles bring a motion to rest on its path.

Unanswered, a controller may hold the last target and so stop the arm, or carry it on, or leave open
mode, move the arm and come back; one set-point further at full speed would then be a jump. Hence,
after a gap longer than `max_gap`, open mode goes on only if D1 is within those 10 % of the
set-point sent last, or of some steps more, and its velocity (D2) within half the velocity sent last
or what counts as standstill, or at rest; an arm that itself stands (D4) is held against both. A
motion comes to rest on its path from D1 and D2, which count as sent. Where packets came late
by the clock although none is missing, the velocity of the arm (D4) is held against that sent last.
Corrections of targets that the controller generates (modes 2, 7, 8, 9) are refused after such a gap
unless they were zero. A link may say how old each value is: one that is needed for such a decision,
for the first set-point, or to be given back to an open axis, and was not sent in this very packet
counts as unknown and refuses.

After the motion the end is held for `settle_cycles`; the next answer asks for the end of open mode
(status byte 1), and asks again every `EXIT_RETRY_CYCLES` in case that answer was lost; after
`EXIT_TIMEOUT` that is a fault. The end is asked for as well where a motion waits that long for the
last axis to open. Without a requested motion the first set-point is held.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import Ages, ArmWire, DriveTrain
from drivers.errors import (
    ExitTimeout,
    FollowingError,
    GuardError,
    PacketError,
    RefusalError,
    TargetNotFinite,
)
from drivers.guard import Guard
from drivers.init_check import compare
from drivers.open_mode import CorrectionMode, OpenMode, PositionMode
from drivers.packets import EXIT_FROM_OPEN, InitPacket
from drivers.record import CycleRing
from drivers.replies import D1, Reader, Reading, ReplyFrame, Words
from drivers.state_machine import StateMachine
from drivers.states import CORRECTION_MODES, HAS_SET_POINTS, Input, State

Array = NDArray[np.float64]

EXIT_RETRY_CYCLES: Final = 100
"""Cycles after which the end of open mode is asked for again."""
EXIT_TIMEOUT: Final = 10.0
"""s that a controller has to open the last axis, and to leave open mode once asked."""


class ReplyPolicy:
    """Set up anew from each init packet, which it matches to the arm.

    The guard is narrowed to the controller's own limits on following error and current.

    Attributes:
        init: the init packet.
        reader: reads status and modes of its packets.
        wire: the joints in a packet; None if the packet cannot be matched to them, or is of an arm
            with other gears, calibration or coupling.
        init_check: the init packet against the cell, and the drive train in force.
        unusable: why this arm cannot be moved in this session, or None.

    Args:
        init: the init packet.
        drive_train: the cell's.
        guard: of the arm.
        arm: its number, from 1.
        mode: the open mode wanted.
        accept: adopt the controller's gear ratios, calibration and coupling where they differ.
        other_axes: (arm, axis), from 1, that may be open although they are no joints.
        max_gap: of the set-points sent last the target received may be any of one more.
        only_axis: the only joint, from 1, that is to be open; None for all.
    """

    def __init__(
        self,
        init: InitPacket,
        drive_train: DriveTrain,
        guard: Guard,
        arm: int,
        mode: int,
        accept: bool,
        other_axes: frozenset[tuple[int, int]],
        max_gap: int,
        only_axis: int | None = None,
    ) -> None:
        self.init = init
        self.init_check = compare(drive_train, guard.period, init, arm, accept, other_axes)
        self.unusable = self.init_check.unusable
        self.wire: ArmWire | None = None
        self._arm = arm
        self._max_gap = max_gap
        self._frame = ReplyFrame(init.n_axes)
        self._open_mode: OpenMode | None = None
        self._asked_at = -1
        self._reported = False
        self._exit_cycles = round(EXIT_TIMEOUT / guard.period)
        self._axis_of = _axes_by_slot(init)
        if self.unusable is not None:
            self.reader = _reader_without_joints(init, arm, mode)
            return
        self.wire = wire = ArmWire(self.init_check.drive_train, init, arm, only_axis)
        arms = tuple(axis.arm for axis in init.open_axes())
        self.reader = Reader(wire.joint_slots, arms, arm, mode, wire.opened)
        kind = CorrectionMode if mode in CORRECTION_MODES else PositionMode
        self._open_mode = kind(guard, self.wire, self._frame, mode, max_gap)
        axes = slice(0, drive_train.n_joints)
        guard.narrow(
            init.following_error[arm - 1, axes].astype(np.float64),
            np.fmin(init.current_limit[arm - 1, axes], drive_train.current_limit),
        )

    def answer(
        self,
        machine: StateMachine,
        reading: Reading,
        words: Words,
        measured: Array,
        commanded: Array,
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
            self._hold_where_nothing_moves(machine, reading, words)
            return status
        if self._open_mode is None:
            raise RefusalError(f"this arm cannot be moved: {self.unusable}", machine.cycle)
        self._require_targets(reading.others, machine.cycle)
        if state is State.EXITING:
            # Left before the last axis opened, no axis has had a set-point but its own target.
            answer = self._open_mode.leaving if machine.in_interval else self._open_mode.opening
            answer(reading, measured, commanded, machine.cycle)
            self._require_targets(reading.answer.held, machine.cycle)
            machine.note_lost(self._open_mode.lost, self._max_gap)
            return self._asking_for_exit(status) if self._exit_due(machine) else status
        if state is State.OPENING:
            self._open_mode.opening(reading, measured, commanded, machine.cycle)
            self._require_targets(reading.answer.held, machine.cycle)
            done = self._given_up(machine, reading)
        else:
            done = self._open(self._open_mode, machine, measured, commanded)
        if not done:
            return status
        machine.take(Input.EXIT)
        self._asked_at = machine.cycle
        return self._asking_for_exit(status)

    def _hold_where_nothing_moves(
        self, machine: StateMachine, reading: Reading, words: Words
    ) -> None:
        """Axes that are open are answered their target if that can be, else drive-off is asked for.

        Raises:
            GuardError: they cannot be held there; raised once, not in each cycle.
        """
        try:
            self._require_targets(reading.answer.held, machine.cycle)
            if machine.state is State.FREEZING and self._open_mode is not None:
                self._open_mode.require_holdable(reading.held, reading.held, machine.cycle)
        except GuardError as error:
            if not self._reported:
                self._reported = True
                raise
            self.refusal(_offending(error), reading, words)
        else:
            self._reported = False

    def _require_targets(self, slots: Sequence[int], cycle: int) -> None:
        """What is given back in an open mode has to be a number, whosever axis it is."""
        if not slots:
            return
        values = self._frame.floats[list(slots), D1]
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            arm, axis = self._axis_of.get(slots[bad[0]], (self._arm, slots[bad[0]]))
            raise TargetNotFinite(arm, axis, float(values[bad[0]]), cycle)

    def _given_up(self, machine: StateMachine, reading: Reading) -> bool:
        """Whether nobody waits any longer for the last axis to open."""
        if machine.execution is not None:
            if machine.cycle - machine.entered_at < self._exit_cycles:
                return False
            axes = np.flatnonzero(reading.held) + 1
            alone = (
                f": if axis {axes[0]} alone is to open, use --only-axis" if len(axes) == 1 else ""
            )
            machine.stop(f"some axes did not open within {EXIT_TIMEOUT:g} s{alone}")
        return machine.stop_reason is not None

    def _exit_due(self, machine: StateMachine) -> bool:
        """Whether the end of open mode is to be asked for once more.

        Raises:
            ExitTimeout: it was asked for, or the controller began it, too long ago.
        """
        leaving = machine.cycle - machine.entered_at
        if leaving >= self._exit_cycles:
            raise ExitTimeout(leaving, machine.cycle)
        due = machine.cycle - max(self._asked_at, machine.entered_at) >= EXIT_RETRY_CYCLES
        if due:
            self._asked_at = machine.cycle
        return due

    def _open(
        self, open_mode: OpenMode, machine: StateMachine, measured: Array, commanded: Array
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
            machine.note_lost(open_mode.lost, self._max_gap)
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

    def check_gap(
        self, unanswered: int, paused: bool, machine: StateMachine, reading: Reading
    ) -> None:
        """So many packets before this one were not answered, or it came late by the clock.

        After a long gap open mode goes on only where the controller carried it on, moving, at
        rest or on the way out: meanwhile it may have left, moved the arm, come back. After a pause
        the arm has to move as it was commanded to.

        Raises:
            NotFinite, SetPointNotAccepted, VelocityAfterGap, VelocityAfterPause: it did not.
        """
        open_mode = self._open_mode
        if open_mode is None:
            return
        open_mode.missed = unanswered
        in_open = machine.state in (State.OPEN, State.EXITING) and machine.in_interval
        if not in_open or machine.entering:
            return
        if unanswered > self._max_gap:
            open_mode.require_carried_on(machine.execution, reading, machine.cycle)
        elif paused:
            open_mode.require_no_pause(reading, machine.cycle)

    def refusal(self, offending: int | None, reading: Reading, words: Words) -> bytes:
        """Fill the frame with 508 for the offending joint, or with 505 for all.

        Open axes keep their target with a 508, so each needs one that is a number.
        """
        held = list(reading.answer.held)
        lost = not np.isfinite(words.view(np.float32)[held, D1]).all()
        if offending is None or self.wire is None or lost:
            self._frame.drive_off(reading.answer, words)
        else:
            slots = self.wire.joint_slots[offending : offending + 1]
            self._frame.following_error(reading.answer, words, slots)
        return reading.answer.status

    def refuse(
        self, machine: StateMachine, error: RefusalError, reading: Reading, words: Words
    ) -> bytes:
        """Go to the faulted state and fill the frame accordingly; returns the status bytes."""
        machine.take(Input.REFUSAL)
        machine.offending = _offending(error)
        return self.refusal(machine.offending, reading, words)

    def finish(self, number: int, status: bytes) -> bytes:
        """The bytes of the answer to packet `number`."""
        return self._frame.finish(number, status)

    def _asking_for_exit(self, status: bytes) -> bytes:
        asking = bytearray(status)
        asking[self._arm - 1] = EXIT_FROM_OPEN
        return bytes(asking)


def _axes_by_slot(init: InitPacket) -> dict[int, tuple[int, int]]:
    """Arm, from 1, and axis, from 0, of each slot; empty where the map is impossible."""
    try:
        return {axis.slot: (axis.arm, axis.axis) for axis in init.open_axes()}
    except PacketError:
        return {}


def _offending(error: RefusalError) -> int | None:
    return error.joint if isinstance(error, FollowingError) else None


def _reader_without_joints(init: InitPacket, arm: int, mode: int) -> Reader:
    """For an arm that cannot be moved: whatever it has of open axes, or all if nobody can tell."""
    try:
        axes = init.open_axes()
    except PacketError:
        return Reader(np.arange(init.n_axes), None, arm, mode)
    slots = np.array([axis.slot for axis in axes if axis.arm == arm], np.intp)
    return Reader(slots, tuple(axis.arm for axis in axes), arm, mode)
