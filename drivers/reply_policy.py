"""The reply to each cyclic packet of one session, given the state it leads to.

The first set-point is the target received in the packet in which the last wanted axis opened, at
zero velocity, compared with actual position and standstill. D2 is the step of the motor from one
sent set-point to the next, computed in float64; `drivers.packets.MODE_FIELDS` gives the fields of
each open mode. A motion requested while the axes are open begins under the same conditions, from
the set-point held. Without a requested motion the first set-point is held.

While axes are open, following error and current are checked, and that the target received (D1) is
within 10 % of the following-error threshold of one of the last `max_gap` + 1 set-points sent, or of
the last one extrapolated by as many steps as packets were missed, and within 25 % of the last. An
older target is a lost reply: the last set-point is sent again until it is accepted, and more than
`max_gap` lost replies in 100 cycles stop the motion on its path.

Without replies a controller may hold the last target, extrapolate it, or leave open mode, move the
arm and come back; the next set-point at full speed would then be a jump. Hence, after a gap longer
than `max_gap`, open mode continues only if D1 is within 10 % of the threshold of the set-point sent
last, or of some steps more, and its velocity (D2) is zero or within half the velocity sent last or
the standstill threshold; for an arm at rest the same is required of its own velocity (D4). The
motion comes to rest on its path from D1 and D2, which count as sent. Where packets arrive late
although none is missing, D4 is compared with the velocity sent last. Corrections of targets that
the controller generates (modes 2, 7, 8, 9) are refused after such a gap unless they were zero. A
value needed for these decisions, for the first set-point, or to be returned to an open axis is
refused if it was not sent in this packet.

The end is held for `settle_cycles`; the next reply asks for the end of open mode (status byte 1),
and again every `EXIT_RETRY_CYCLES`; after `EXIT_TIMEOUT` that is a fault. The end is requested as
well where a motion waits that long for the last axis to open.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from drivers.drive_train import Ages, ArmWire, DriveTrain
from drivers.errors import Check, ExitTimeout, GuardError, PacketError, RefusalError
from drivers.guard import Array, Guard
from drivers.init_check import compare
from drivers.open_mode import CorrectionMode, OpenMode, PositionMode
from drivers.packets import EXIT_FROM_OPEN, InitPacket, OpenAxis
from drivers.record import CycleRing
from drivers.replies import D1, Reader, Reading, ReplyFrame, Words
from drivers.state_machine import StateMachine
from drivers.states import CORRECTION_MODES, HAS_SET_POINTS, Input, State

EXIT_RETRY_CYCLES: Final = 100
"""Cycles after which the end of open mode is requested again."""
EXIT_TIMEOUT: Final = 10.0
"""Time for a controller to open the last axis, and to leave open mode once asked, s."""


class ReplyPolicy:
    """Replies of one session, from its init packet on.

    The guard is narrowed to the controller's own limits on following error and current.

    Attributes:
        init: the init packet.
        received: comparison of the init packet with the cell.
        unusable: why the arm cannot be moved in this session, or None.
        reader: reads status and modes of the packets.
        frame: buffer of the reply.

    Args:
        init: the init packet.
        others: as of `Session`.
    """

    def __init__(
        self,
        init: InitPacket,
        *,
        drive_train: DriveTrain,
        guard: Guard,
        arm: int,
        mode: int,
        other_axes: frozenset[tuple[int, int]],
        max_gap: int,
        only_axis: int | None,
    ) -> None:
        self.init = init
        self.received = compare(drive_train, guard.period, init, arm, other_axes)
        self.unusable = self.received.unusable
        self.frame = ReplyFrame(init.n_axes)
        self._arm = arm
        self._max_gap = max_gap
        # None if the packet cannot be matched to the joints, or describes another drive train.
        self._wire: ArmWire | None = None
        self._open_mode: OpenMode | None = None
        self._exit_requested_at = -1
        self._reported = False
        self._exit_cycles = round(EXIT_TIMEOUT / guard.period)
        axes: Sequence[OpenAxis] | None
        try:
            axes = init.open_axes()
        except PacketError:
            axes = None
        self._axis_of = {axis.slot: (axis.arm, axis.axis) for axis in axes or ()}
        arms = None if axes is None else tuple(axis.arm for axis in axes)
        if self.unusable is not None:
            # Any axis of the arm that is open; any axis at all if the map is invalid.
            own = range(init.n_axes) if axes is None else [a.slot for a in axes if a.arm == arm]
            self.reader = Reader(np.array(own, np.intp), arms, arm, mode)
            return
        self._wire = wire = ArmWire(drive_train, init, arm, only_axis)
        self.reader = Reader(wire.joint_slots, arms, arm, mode, wire.opened)
        if mode in CORRECTION_MODES:
            self._open_mode = CorrectionMode(guard, wire, self.frame, mode)
        else:
            self._open_mode = PositionMode(guard, wire, self.frame, mode, max_gap)
        joints = slice(0, drive_train.n_joints)
        guard.narrow(
            init.following_error[arm - 1, joints].astype(np.float64),
            np.fmin(init.current_limit[arm - 1, joints], drive_train.current_limit),
        )

    def fill(
        self,
        machine: StateMachine,
        reading: Reading,
        words: Words,
        measured: Array,
        commanded: Array,
        without_reply: int,
        paused: bool,
    ) -> bytes:
        """Fill the frame for the machine's state, which is the one that the packet leads to.

        Returns the 4 status bytes. Raises RefusalError if no set-point may be sent.

        Args:
            machine: state and motion.
            reading: status and modes of the packet.
            words: (n_axes, 9) its axis blocks.
            measured: (8, n) the same in SI, joint side.
            commanded: (2, n) NaN, to be filled where set-points are sent.
            without_reply: packets before this one without a reply.
            paused: this packet arrived late by the clock.
        """
        state, cycle, open_mode = machine.state, machine.cycle, self._open_mode
        if open_mode is not None:
            open_mode.receive(reading, measured, commanded, cycle, without_reply)
        if state is State.FAULTED and reading.powered:
            return self._fill_refusal(machine.offending, reading, words)
        self.frame.safe(reading.reply, words)
        status = reading.reply.status
        if state not in HAS_SET_POINTS:
            self._hold_without_motion(machine, reading, words)
            return status
        if open_mode is None:
            raise RefusalError(f"this arm cannot be moved: {self.unusable}", cycle)
        if machine.in_interval and state is not State.OPENING and not machine.entering:
            # A gap or a pause must allow to continue.
            if without_reply > self._max_gap:
                open_mode.check_after_gap(machine.execution)
            elif paused:
                open_mode.check_after_pause()
        self._require_targets(reading.other_slots, cycle)
        if state is State.OPEN:
            done = self._next(open_mode, machine)
        else:
            # Left before the last axis opened, axes have been sent only their own targets.
            leaving = state is State.EXITING
            if leaving and machine.in_interval:
                open_mode.leaving()
            else:
                open_mode.opening()
            self._require_targets(reading.reply.returned, cycle)
            if leaving:
                machine.record_lost(open_mode.lost)
                return self._request_exit(status) if self._exit_due(machine) else status
            done = self._opening_abandoned(machine, reading)
        if not done:
            return status
        machine.apply(Input.EXIT)
        self._exit_requested_at = cycle
        return self._request_exit(status)

    def _hold_without_motion(self, machine: StateMachine, reading: Reading, words: Words) -> None:
        """Return open axes their target if that is possible, else request drive-off.

        Raises RefusalError in the first cycle of these.
        """
        try:
            self._require_targets(reading.reply.returned, machine.cycle)
            if machine.state is State.FREEZING and self._open_mode is not None:
                self._open_mode.require_holdable(reading.returned, reading.returned)
        except RefusalError as error:
            if not self._reported:
                self._reported = True
                raise
            self._fill_refusal(_offending(error), reading, words)
        else:
            self._reported = False

    def _require_targets(self, slots: Sequence[int], cycle: int) -> None:
        """Require finite targets where they are returned in an open mode, in axes of any arm."""
        if not slots:
            return
        values = self.frame.floats[list(slots), D1]
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            arm, axis = self._axis_of.get(slots[bad[0]], (self._arm, slots[bad[0]]))
            name = f"axis {axis + 1} of arm {arm}"
            message = f"target received of {name}, which is open, is {values[bad[0]]}"
            raise RefusalError(message, cycle)

    def _opening_abandoned(self, machine: StateMachine, reading: Reading) -> bool:
        """Whether to leave open mode although the last axis has not opened."""
        if machine.execution is not None:
            if machine.cycle - machine.entered_at < self._exit_cycles:
                return False
            axes = np.flatnonzero(reading.returned) + 1
            hint = (
                f": if axis {axes[0]} alone is to open, use --only-axis" if len(axes) == 1 else ""
            )
            machine.stop(f"some axes did not open within {EXIT_TIMEOUT:g} s{hint}")
        return machine.stop_reason is not None

    def _exit_due(self, machine: StateMachine) -> bool:
        """Whether to request the end of open mode once more; raises ExitTimeout."""
        leaving = machine.cycle - machine.entered_at
        if leaving >= self._exit_cycles:
            message = f"open mode was asked to end {leaving} cycles ago and axes are still open"
            raise ExitTimeout(message, machine.cycle)
        last = max(self._exit_requested_at, machine.entered_at)
        due = machine.cycle - last >= EXIT_RETRY_CYCLES
        if due:
            self._exit_requested_at = machine.cycle
        return due

    def _next(self, open_mode: OpenMode, machine: StateMachine) -> bool:
        """Fill in the next set-point; return whether it was the last one."""
        execution, cycle = machine.execution, machine.cycle
        moving = execution is not None and execution.started
        if machine.entering:
            machine.entering = False
            open_mode.enter()
        else:
            if execution is not None and moving and machine.stop_reason is not None:
                execution.stop(machine.stop_reason, cycle)
            elif execution is not None and not moving:
                open_mode.require_start()
            open_mode.next(execution if moving else None)
            machine.record_lost(open_mode.lost)
        if execution is None:
            return machine.stop_reason is not None
        if not moving:
            machine.begin_motion(open_mode.set_point)
        execution.leaving = execution.settled
        return execution.leaving

    def record(
        self, ring: CycleRing, row: int, reading: Reading, words: Words, ages: Ages | None
    ) -> None:
        """Write a packet into a row of the ring; commanded values are NaN.

        `words` (n_axes, 9) are its axis blocks, `ages` (n_axes, 8) cycles since its values were
        sent; None if with this packet.
        """
        ring.status[row] = reading.status
        ring.commanded[row] = math.nan
        if self._wire is None:
            ring.mode[row] = -1
            ring.measured[row] = math.nan
            ring.age[row] = 0 if ages is None else ages.max(axis=0)
            return
        ring.mode[row] = reading.modes
        ring.age[row] = 0 if ages is None else ages[self._wire.joint_slots].max(axis=0)
        self._wire.read(words.view(np.float32), ring.measured[row], ages)

    def refuse(
        self, machine: StateMachine, error: RefusalError, reading: Reading, words: Words
    ) -> bytes:
        """Fill the frame for the faulted state; return the status bytes."""
        machine.offending = _offending(error)
        return self._fill_refusal(machine.offending, reading, words)

    def _fill_refusal(self, offending: int | None, reading: Reading, words: Words) -> bytes:
        """Fill the frame with 508 for the offending joint, or with 505 for all.

        With a 508 open axes get their target back, so each must be finite.
        """
        returned = list(reading.reply.returned)
        finite = np.isfinite(words.view(np.float32)[returned, D1]).all()
        if offending is None or self._wire is None or not finite:
            self.frame.drive_off(reading.reply, words)
        else:
            slots = self._wire.joint_slots[offending : offending + 1]
            self.frame.following_error(reading.reply, words, slots)
        return reading.reply.status

    def _request_exit(self, status: bytes) -> bytes:
        requesting = bytearray(status)
        requesting[self._arm - 1] = EXIT_FROM_OPEN
        return bytes(requesting)


def _offending(error: RefusalError) -> int | None:
    if isinstance(error, GuardError) and error.check is Check.FOLLOWING_ERROR:
        return error.joint
    return None
