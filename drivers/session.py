"""The PC's end of a C4G Open session: packets in, replies and events out. No socket, no clock.

====================  ======================================  =====================================
state                 what the controller reports             reply
====================  ======================================  =====================================
sync                  sync packets, before init               the same bytes, number plus one;
                                                              none if a drive is on
init                  init packet; two more sync after a      the same bytes, number plus one
                      cold start
drive off             drive not on                            everything echoed
driving on            mode 501                                target position and velocity returned
closed                mode 0 (or 10) in every wanted axis     the same
opening               some wanted axes open, not all          open axes: target, zero velocity
                                                              (modes 1, 4, 5), or zeros; the
                                                              others as when closed
open                  all wanted axes open                    guarded set-points, see below
exiting               still open, end of open mode requested  the last set-point, zero velocity
                                                              (modes 1, 4, 5), or zeros
freezing              mode 500 or 502 in a wanted axis        mode 0, zeros; open axes their target,
                                                              at zero velocity; silence may last
faulted               open after a fault, an unknown mode,    505 (508 for a following error) while
                      or nothing                              open and powered; else the safe reply
ended                 mode 504, replied to once               none
====================  ======================================  =====================================

The state table is `drivers.states.TRANSITIONS`. `drivers.states.decide` says what an input does;
only the session changes its state. Open mode is entered only from driving on, closed or opening:
after an init packet, a drive-off, a pause or a fault the controller has to report closed axes
first, and a new motion has to be requested.

Each new valid packet gets exactly one reply, a duplicate (the same bytes) the same reply again;
stale and malformed packets get none and are counted. Motion advances one period per packet replied
to, however many were missed, and waits where a reply was not accepted. More than `max_gap` packets
missed in a row, stale ones included, stop it on its path. A packet that arrives more than
`PAUSE_CYCLES` later than its number accounts for gets a further set-point only if the arm moves as
commanded. The other checks in open mode are described in `drivers.open_mode`.

In every state an axis of any arm that is open with its drive on gets its target back only if that
is finite; otherwise drive-off is requested. In a pause an open wanted axis must also be near its
target.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from functools import partial
from typing import Final

import numpy as np

from drivers.controller_description import Controller, connect
from drivers.cycle_records import CycleRing
from drivers.drive_train import DriveTrain
from drivers.errors import (
    AxisNotInMode,
    Check,
    GuardError,
    ModeRefused,
    PacketError,
    RefusalError,
    RequestError,
    as_refusal,
)
from drivers.events import (
    Counters,
    Event,
    GapSeen,
    HoldChanged,
    LinkLost,
    MotionEnded,
    MotionStarted,
    OverrideChanged,
    PacketRejected,
    Refused,
    RepliesLost,
    StateChanged,
)
from drivers.execution import Execution, execution_of
from drivers.guard import Guard
from drivers.losses import LossTracker
from drivers.motion_source import MotionSource
from drivers.open_mode import Exit, OpenCycle, OpenReply, Refuse, Reply
from drivers.packets import (
    DRIVE_ON,
    INIT_LENGTH,
    INIT_NUMBER,
    N_ARMS,
    CyclicPacket,
    InitPacket,
    Mode,
    PacketSequence,
    echo,
    is_init,
    packet_number,
)
from drivers.safe_reply import MODE, PacketStatus, ReplyBuilder, Words, words_of
from drivers.states import (
    HAS_SET_POINTS,
    POSITION_MODES,
    Axes,
    Decision,
    Input,
    Outcome,
    State,
    decide,
)

FLIGHT_RECORDER: Final = 50
"""Records attached to a refusal."""
STOP_TIMEOUT: Final = 10.0
"""Largest time from the request of a stop to rest, s; then drive-off is requested."""
MAX_GAP: Final = 100
"""Largest `max_gap`."""
SERVED_MODES: Final = tuple(sorted(POSITION_MODES))
"""Open modes in which a motion can run."""
_SYNC_AFTER_INIT: Final = (INIT_NUMBER + 1, INIT_NUMBER + 2)
_NO_MOTION: Final = "no motion was requested"


def _check_arguments(
    drive_train: DriveTrain,
    guard: Guard,
    ring: CycleRing,
    mode: int,
    max_gap: int,
    arm: int,
    only_axis: int | None,
) -> None:
    """Raise ValueError for arguments of a session that are out of range or do not fit together."""
    n = drive_train.n_joints
    if not n == guard.limits.n_joints == ring.n_joints:
        raise ValueError("drive train, guard and ring differ in their number of joints")
    if mode not in SERVED_MODES:
        served = ", ".join(str(int(m)) for m in SERVED_MODES)
        raise ValueError(f"motion in mode {mode} is not served; modes {served} are")
    if not 0 <= max_gap <= MAX_GAP:
        raise ValueError(f"a gap of {max_gap} packets is not one of 0..{MAX_GAP}")
    if not 1 <= arm <= N_ARMS:
        raise ValueError(f"arm {arm} is not one of 1..{N_ARMS}")
    if only_axis is not None and not (1 <= only_axis <= n):
        raise ValueError(f"only axis {only_axis} is not one of 1..{n}")


class Session:
    """One arm's session with one controller; not thread-safe.

    Args:
        drive_train: of the arm.
        guard: checks each set-point; its period must be the controller's cycle.
        ring: receives one record per cyclic packet replied to.
        mode: open mode in which the arm is moved, one of `SERVED_MODES`.
        max_gap: packets that may be missed in a row without stopping a motion, 0..`MAX_GAP`.
        arm: number of the arm, 1..4.
        settle_cycles: cycles for which the end of a motion is held before open mode is left.
        init_timeout: silence allowed before the init packet and in a pause, s.
        silence_timeout: silence allowed otherwise, s.
        other_axes: (arm, axis), both from 1, that may be open although the cell has no such joint.
        only_axis: the only joint, from 1, that the controller opens; the others have to stay
            closed. None where it opens all.

    Attributes:
        deadline: when silence becomes a fault, on the clock of `now`. Each new packet replied to
            moves it; duplicates and rejected packets do not. Infinite until the first `reply` or
            `tick`, after a silence was reported, and in state ended.
        state: current state.
        counters: packets by what became of them.
        losses: packets and replies lost.
        cycle: of the controller since its init packet, up to the packet replied to last.
        entered_at: the cycle in which the state was entered.
        interval: index of the last interval in open mode, -1 before the first.
        in_interval: whether that interval continues.
        execution: the requested motion, or None.
        stop_reason: why open mode is to be left, or None.
    """

    def __init__(
        self,
        drive_train: DriveTrain,
        guard: Guard,
        ring: CycleRing,
        *,
        mode: int = Mode.POSITION,
        max_gap: int = 2,
        arm: int = 1,
        settle_cycles: int = 200,
        init_timeout: float = 300.0,
        silence_timeout: float = 1.0,
        other_axes: Collection[tuple[int, int]] = (),
        only_axis: int | None = None,
    ) -> None:
        _check_arguments(drive_train, guard, ring, mode, max_gap, arm, only_axis)
        self.deadline = math.inf
        self.state = State.SYNC
        self.counters = Counters()
        self.losses = LossTracker(max_gap, guard.period)
        self.cycle = 0
        self.entered_at = 0
        self.interval = -1
        self.in_interval = False
        self.execution: Execution | None = None
        self.stop_reason: str | None = None
        # Open mode was reached and the first set-point is still to be sent.
        self._entering = False
        self._exit_requested_at = 0
        # Joint whose following error was reported, None where drive-off is requested.
        self._offending: int | None = None
        self._first_interval = 0
        self._holds_targets = True  # outside open mode, as far as it was reported
        self._events: list[Event] = []
        self._drive_train = drive_train
        self._guard = guard
        self._ring = ring
        self._mode = mode
        self._settle_cycles = settle_cycles
        self._init_timeout = init_timeout
        self._silence_timeout = silence_timeout
        self._connect = partial(
            connect,
            drive_train=drive_train,
            guard=guard,
            arm=arm,
            mode=mode,
            other_axes=frozenset(other_axes),
            max_gap=max_gap,
            only_axis=only_axis,
        )
        self._sequence = PacketSequence()
        self._controller: Controller | None = None
        self._cold_start = False
        self._silent_since: float | None = None
        self._arrived_at = -math.inf
        self._last_packet = b""
        self._last_reply = b""
        # Number and last reason of packets without a reply, by kind, since the last drain.
        self._unreported: dict[str, tuple[int, str]] = {}

    @property
    def init(self) -> InitPacket | None:
        """The controller's init packet, None before it."""
        return None if self._controller is None else self._controller.init

    @property
    def period(self) -> float:
        """The controller's cycle, s; before its init packet the guard's."""
        init = self.init
        return self._guard.period if init is None else init.period

    @property
    def drive_train(self) -> DriveTrain:
        """Drive train of the cell."""
        return self._drive_train

    @property
    def requested(self) -> bool:
        """Whether a motion was requested and has not ended."""
        return self.execution is not None

    def events(self) -> list[Event]:
        """Return the events since the last call, in order; rejected packets last, by kind."""
        events = self._events
        self._events = []
        events.extend(
            PacketRejected(kind, *rejection) for kind, rejection in self._unreported.items()
        )
        self._unreported.clear()
        return events

    def request(self, source: MotionSource) -> None:
        """Run a motion as soon as every wanted axis is open, then leave open mode.

        Raises:
            RequestError: the state does not allow one, or it is no source of a motion.
        """
        n = self._drive_train.n_joints
        stop_cycles = round(STOP_TIMEOUT / self._guard.period)
        execution = execution_of(source, n, self._settle_cycles, stop_cycles)
        if isinstance(execution, str):
            raise self._request_error(execution)
        reason = None
        if self.execution is not None:
            reason = "another motion was requested before and has not ended"
        elif self.state is State.ENDED:
            reason = "the controller ended the session; make a new one"
        elif self.state is State.FAULTED:
            reason = "the controller has to report its axes closed first"
        elif self.state is State.EXITING or self.stop_reason is not None:
            reason = "open mode is being left; wait for closed axes"
        elif self._controller is not None:
            reason = self._controller.received.unusable
        if reason is not None:
            raise self._request_error(reason)
        self.execution = execution
        # Axes may still be open in the interval of an earlier motion.
        self._first_interval = self.interval + (self.state is not State.OPEN)

    def _request_error(self, reason: str, what: str = "motion") -> RequestError:
        return RequestError(self.state.name.lower(), reason, what)

    def stop(self, reason: str = "a stop was requested") -> None:
        """Bring the motion to rest on its path and leave open mode; drop one not begun yet."""
        if self.execution is not None and not self.execution.started:
            self._end("stopped", reason)
        if self.state in (State.OPENING, State.OPEN):
            self.stop_reason = self.stop_reason or reason

    def override(self, fraction: float) -> None:
        """Run the requested motion at this fraction (0..1) of its speed from now on.

        Raises:
            RequestError: there is none, it is being stopped, or its source has no override.
        """
        execution = self.execution
        before = None if execution is None else execution.fraction
        reason = _NO_MOTION if execution is None else execution.override(fraction)
        if reason is not None:
            raise self._request_error(reason, "change of override")
        if fraction != before:
            self._events.append(OverrideChanged(float(fraction), self.cycle))

    def hold(self) -> None:
        """Rest on the path until `resume`; a motion that cannot is stopped.

        A motion that has not begun will begin at rest and wait there.

        Raises:
            RequestError: there is no motion.
        """
        execution = self.execution
        if execution is None:
            raise self._request_error(_NO_MOTION, "hold")
        if self.stop_reason is not None:
            return
        before = execution.held
        reason = execution.hold(self.cycle)
        if reason is not None:
            self.stop(reason)
        elif execution.held is not before:
            self._events.append(HoldChanged(True, self.cycle))

    def resume(self) -> None:
        """Continue after `hold`.

        Raises:
            RequestError: there is no motion, it is being stopped, or it cannot hold and resume.
        """
        execution = self.execution
        before = execution is not None and execution.held
        reason = _NO_MOTION if execution is None else execution.resume()
        if reason is not None:
            raise self._request_error(reason, "resumption")
        if before:
            self._events.append(HoldChanged(False, self.cycle))

    def discarded(self, kind: str, count: int) -> None:
        """Count and report packets that the link dropped."""
        if count > 0:
            self.counters.discarded[kind] = self.counters.discarded.get(kind, 0) + count
            self._report(kind, count)

    def _report(self, kind: str, count: int, reason: str = "") -> None:
        before, _ = self._unreported.get(kind, (0, ""))
        self._unreported[kind] = before + count, reason

    def tick(self, now: float) -> None:
        """Update the time without a packet; past `deadline` the link counts as lost.

        This ends a motion, and the next packet is new in any case: a controller that only paused
        gets safe replies, and one that restarts is followed.
        """
        if self._silent_since is None:
            self._restart_deadline(now)
        if now < self.deadline or self.state is State.ENDED:
            return
        assert self._silent_since is not None
        silence = now - self._silent_since
        self._events.append(LinkLost(silence, self.state, self.losses.stale))
        self.deadline = math.inf
        self._sequence.broken = True
        self._apply(Input.SILENCE)

    def reply(self, packet: bytes, now: float) -> bytes | None:
        """Return the reply to a packet, or None if it gets none.

        Args:
            packet: its bytes.
            now: when it arrived, s on any monotonic clock.
        """
        if self._silent_since is None or now >= self.deadline:
            self.tick(now)
        if self.state is State.ENDED:
            self.counters.ended += 1
            self._report("ended", 1)
            return None
        try:
            # Values that are not finite are checked by the guard.
            with np.errstate(all="ignore"):
                if is_init(packet):
                    return self._start_over(packet, now)
                number = packet_number(packet)
                powered = DRIVE_ON in packet[4 : 4 + N_ARMS]
                if self._expects_sync(number, powered):
                    return self._sync(packet, number, now, powered)
                if number < INIT_NUMBER and not powered and self._sequence.is_stale(number):
                    # It gets a reply once silence has ended the session before.
                    self.losses.restarting = True
                return self._cyclic(packet, number, now)
        except PacketError as error:
            self.counters.malformed += 1
            self._report("malformed", 1, f"{len(packet)} bytes: {error}")
            return None

    def _start_over(self, packet: bytes, now: float) -> bytes:
        if self.state is State.INIT and packet == self._last_packet:
            self.counters.duplicates += 1
            return self._last_reply
        init = InitPacket.decode(packet)
        syncing = self.state is State.SYNC
        self._cold_start = syncing and self._sequence.last > 0
        if syncing and not self._sequence.leads_to(INIT_NUMBER, self.losses.max_gap):
            self._end("lost", "the controller restarted: sync packets are missing")
        self._apply(Input.INIT)
        self._controller = self._connect(init)
        self._holds_targets = True
        self._sequence.restart(INIT_NUMBER, self._silence_timeout / max(init.period, 1e-3))
        self.cycle = 0
        self._events.append(self._controller.received)
        return self._finish(packet, echo(packet), now)

    def _expects_sync(self, number: int, powered: bool) -> bool:
        if self.state is State.SYNC:
            return True
        if powered:
            return False
        if self.state is State.INIT:
            return self._cold_start and number in _SYNC_AFTER_INIT
        # A controller that was silent and counts from the beginning has restarted.
        sequence = self._sequence
        return sequence.broken and number < INIT_NUMBER and sequence.distance(number) != 1

    def _sync(self, packet: bytes, number: int, now: float, powered: bool) -> bytes:
        if powered:
            # The controller is in mid-session, and an echo would send set-points to open axes.
            # Without replies its own watchdog acts.
            raise PacketError("status", packet[4 : 4 + N_ARMS].hex(), "no drive on before init")
        if len(packet) >= INIT_LENGTH:
            raise PacketError("length", len(packet), f"less than {INIT_LENGTH} bytes")
        self._apply(Input.SYNC)
        if self.state is State.SYNC:
            self._controller = None
        self._sequence.accept(number)
        return self._finish(packet, echo(packet), now)

    def _cyclic(self, packet: bytes, number: int, now: float) -> bytes | None:
        """Run one cycle: decode, record, change state, reply; an error becomes drive-off or 508."""
        controller = self._controller
        ring = self._ring
        assert controller is not None
        decoded = CyclicPacket.decode(packet, controller.init.n_axes)
        if self._sequence.is_duplicate(number) and packet == self._last_packet:
            self.counters.duplicates += 1
            return self._last_reply
        if self._sequence.is_stale(number):
            self.losses.stale += 1
            self.counters.stale += 1
            self._report("stale", 1, f"number {number} does not follow {self._sequence.last}")
            return None
        missed = self._sequence.accept(number)
        self.cycle = self._sequence.cycle
        self.losses.receive(missed, now - self._arrived_at)
        words = words_of(decoded)
        status = controller.classifier.classify(decoded.status, words[:, MODE])
        row = ring.slot
        ring.arrival[row] = now
        ring.number[row] = number
        ring.gap[row] = missed
        ring.cycle[row] = self.cycle
        refusal = self._fill_reply(controller, status, words, row)
        self.in_interval = self.in_interval and status.any_open
        ring.interval[row] = self.interval if self.in_interval else -1
        ring.state[row] = self.state
        ring.commit()
        if refusal is not None:
            self.counters.refused += 1
            self._events.append(Refused(refusal, ring.last(FLIGHT_RECORDER)))
            self._end("refused", str(refusal))
        return self._finish(packet, controller.builder.finish(number), now)

    def _fill_reply(
        self,
        controller: Controller,
        status: PacketStatus,
        words: Words,
        row: int,
    ) -> RefusalError | None:
        """Fill in the reply and row `row` of the ring; return why a set-point was refused."""
        refusal: RefusalError | None = None
        try:
            self._record(controller, status, words, row)
            if self.losses.missed:
                self.counters.missed += self.losses.missed
                self._events.append(GapSeen(self.losses.missed, self.cycle))
            before = self.state
            decision = self._apply(status.input, status)
            if decision.misplaced is not None:
                raise self._axis_error(decision.misplaced, status)
            if self.state is State.FAULTED and before is not State.FAULTED:
                refusal = ModeRefused(status.fault, self.cycle)
            answer = self._reply_in_state(controller, status, words, row)
        except BaseException as error:
            # Any error becomes a reply in this cycle that asks the controller to stop.
            answer = Refuse(as_refusal(error, self.cycle))
        if answer is not None and answer.rejected:
            self._count_rejected(answer.rejected)
        if isinstance(answer, Refuse):
            refusal = answer.error
            self._ring.commanded[row] = math.nan
            self._apply(Input.REFUSAL)
            self._offending = _offending(refusal)
            self._fill_refusal(controller, self._offending, status, words)
        elif answer is not None:
            self._follow(answer, controller.builder)
        return refusal

    def _record(
        self,
        controller: Controller,
        status: PacketStatus,
        words: Words,
        row: int,
    ) -> None:
        """Write the axis blocks of a packet, `words` (n_axes, 9), into a row of the ring.

        Commanded values are NaN.
        """
        ring = self._ring
        wire = controller.wire
        ring.status[row] = status.status
        ring.commanded[row] = math.nan
        if wire is None:
            ring.mode[row] = -1
            ring.measured[row] = math.nan
            return
        ring.mode[row] = status.modes
        wire.read(words.view(np.float32), ring.measured[row])

    def _reply_in_state(
        self, controller: Controller, status: PacketStatus, words: Words, row: int
    ) -> OpenReply | None:
        """Fill in the reply for the state that the packet leads to.

        Returns what open mode did, None outside it. Raises RefusalError if nothing may be sent.
        """
        builder = controller.builder
        state = self.state
        if state is State.FAULTED and status.powered:
            self._fill_refusal(controller, self._offending, status, words)
            return None
        builder.fill_safe(status.reply, words)
        if state not in HAS_SET_POINTS:
            self._hold_without_motion(controller, status, words)
            return None
        if controller.open_mode is None:
            reason = controller.received.unusable
            raise RefusalError(f"this arm cannot be moved: {reason}", self.cycle)
        ring = self._ring
        return controller.open_mode.reply(
            OpenCycle(
                state,
                self.cycle,
                self.entered_at,
                self._exit_requested_at,
                status,
                ring.measured[row],
                ring.commanded[row],
                self.losses,
                self.execution,
                self._entering,
                self.in_interval,
                self.stop_reason,
            )
        )

    def _hold_without_motion(
        self, controller: Controller, status: PacketStatus, words: Words
    ) -> None:
        """Return open axes their target if that is possible, else request drive-off.

        Raises RefusalError in the first cycle of these.
        """
        try:
            controller.builder.require_targets(status.reply.held_slots, self.cycle)
            if self.state is State.FREEZING and controller.open_mode is not None:
                controller.open_mode.hold_in_pause(status, self.cycle)
        except RefusalError as error:
            if self._holds_targets:
                self._holds_targets = False
                raise
            self._fill_refusal(controller, _offending(error), status, words)
        else:
            self._holds_targets = True

    @staticmethod
    def _fill_refusal(
        controller: Controller, offending: int | None, status: PacketStatus, words: Words
    ) -> None:
        """Report a following error of joint `offending`, or request drive-off of all."""
        slot = None
        if offending is not None and controller.wire is not None:
            slot = int(controller.wire.joint_slots[offending])
        controller.builder.fill_refusal(status.reply, words, slot)

    def _axis_error(self, joint: int, status: PacketStatus) -> AxisNotInMode:
        mode = int(status.modes[joint])
        expected = self._mode
        wanted = int(Mode.CLOSED if mode == expected else expected)
        message = f"joint {joint + 1} is in mode {mode}; the motion needs {wanted}"
        return AxisNotInMode(message, self.cycle)

    def _follow(self, answer: Reply, builder: ReplyBuilder) -> None:
        """Apply what open mode did."""
        if self.state is State.OPEN:
            self._entering = False
        if answer.begun:
            self._events.append(MotionStarted(self.interval, self.cycle))
        if not isinstance(answer, Exit):
            return
        if answer.reason is not None:
            self.stop(answer.reason)
        if self.state is State.OPEN and self.execution is not None:
            self.execution.leaving = True
        if self.state is not State.EXITING:
            self._apply(Input.EXIT)
        self._exit_requested_at = self.cycle
        builder.request_exit()

    def _count_rejected(self, count: int) -> None:
        """Count replies that were not used; too many of them stop a motion on its path.

        The controller's target then moves in jumps.
        """
        self.counters.rejected += count
        self._events.append(RepliesLost(count, self.cycle))
        self.losses.reject(count, self.cycle)
        reason = self.losses.reason_to_stop_after_rejection
        if reason is not None and self.state is State.OPEN and self.execution is not None:
            self.stop(reason)

    def _apply(self, cause: Input, axes: Axes | None = None) -> Decision:
        """Change to the state that an input leads to; the only place where states change."""
        decision = decide(self.state, cause, self.losses, self.execution, axes)
        if decision.stop is not None:
            self.stop(decision.stop)
        if decision.state is not self.state:
            self._enter(decision.state)
        if cause in (Input.INIT, Input.SILENCE):
            self.in_interval = False
        if decision.ending is not None:
            self._end(*decision.ending)
        return decision

    def _enter(self, after: State) -> None:
        before = self.state
        self.state = after
        self.entered_at = self._exit_requested_at = self.cycle
        self._events.append(StateChanged(before, after, self.cycle))
        if after is State.OPEN:
            self.losses.forget_rejected()
            self._entering = True
            self.in_interval = True
            self.interval += 1
        if after not in HAS_SET_POINTS:
            self.stop_reason = None
        self._offending = None

    def _end(self, outcome: Outcome, reason: str) -> None:
        """End the requested motion, if there is one."""
        if self.execution is None:
            return
        # A motion refused at its first set-point was in the interval without having begun.
        reached = self.in_interval and self.interval >= self._first_interval
        interval = self.interval if self.execution.started or reached else -1
        self.execution = None
        self._events.append(MotionEnded(outcome, reason, interval, self.cycle))

    def _finish(self, packet: bytes, reply: bytes, now: float) -> bytes:
        self.counters.replied += 1
        self.losses.restarting = False
        self._last_packet = packet
        self._last_reply = reply
        self._arrived_at = now
        self._restart_deadline(now)
        return reply

    def sent(self, now: float) -> None:
        """Record when the last reply was sent: silence counts from there, not from the packet."""
        self._restart_deadline(now)

    def _restart_deadline(self, now: float) -> None:
        self._silent_since = now
        state = self.state
        if state is State.ENDED:
            self.deadline = math.inf
        elif state is State.SYNC or state is State.FREEZING:
            self.deadline = now + self._init_timeout
        else:
            self.deadline = now + self._silence_timeout


def _offending(error: RefusalError) -> int | None:
    """Return the joint with a following error, None for any other refusal."""
    if isinstance(error, GuardError) and error.check is Check.FOLLOWING_ERROR:
        return error.joint
    return None
