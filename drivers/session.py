"""The PC's end of a controller's session: packets in, replies and events out. No socket, no clock.

A `drivers.wire.Wire` reads packets and packs replies; with C4G Open:

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
from typing import Final

import numpy as np

from drivers.c4g_packets import Mode
from drivers.c4g_wire import C4gProtocol
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
    ControllerDescription,
    ControllerRemark,
    Counters,
    Event,
    GapSeen,
    HoldChanged,
    InitReceived,
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
from drivers.motion_source import MotionSource
from drivers.open_mode import Exit, OpenCycle, OpenReply, Refuse, Reply, SetPointGenerator
from drivers.packet_losses import LossTracker
from drivers.states import (
    POSITION_MODES,
    STATES_WITH_SET_POINTS,
    AxesReport,
    Decision,
    Input,
    Outcome,
    State,
    decide,
)
from drivers.wire import (
    ArmSettings,
    ControllerProtocol,
    Handshake,
    MeasuredCycle,
    Remark,
    Repeated,
    Stale,
    Wire,
)

FLIGHT_RECORDER_CYCLES: Final = 50
"""Records attached to a refusal."""
STOP_TIMEOUT: Final = 10.0
"""Largest time from the request of a stop to rest, s; then drive-off is requested."""
MAX_GAP: Final = 100
"""Largest `max_gap`."""
SERVED_MODES: Final = tuple(sorted(POSITION_MODES))
"""Open modes in which a motion can run."""
_NO_MOTION: Final = "no motion was requested"


def _check_arguments(
    drive_train: DriveTrain,
    guard: Guard,
    ring: CycleRing,
    mode: int,
    max_gap: int,
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
    if only_axis is not None and not (1 <= only_axis <= n):
        raise ValueError(f"only axis {only_axis} is not one of 1..{n}")


class Session:
    """One arm's session with one controller; not thread-safe.

    Args:
        drive_train: of the arm.
        guard: checks each set-point; its period must be the controller's cycle.
        ring: receives one record per cyclic packet replied to, with the arm's state if it has room
            for that of `protocol`.
        mode: open mode in which the arm is moved, one of `SERVED_MODES`.
        max_gap: packets that may be missed in a row without stopping a motion, 0..`MAX_GAP`.
        arm: number of the arm, 1..4.
        settle_cycles: cycles for which the end of a motion is held before open mode is left.
        init_timeout: silence allowed before the init packet and in a pause, s.
        silence_timeout: silence allowed otherwise, s.
        other_axes: (arm, axis), both from 1, that may be open although the cell has no such joint.
        only_axis: the only joint, from 1, that the controller opens; the others have to stay
            closed. None where it opens all.
        protocol: of the controller.

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
        protocol: ControllerProtocol | None = None,
    ) -> None:
        _check_arguments(drive_train, guard, ring, mode, max_gap, only_axis)
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
        self._settle_cycles = settle_cycles
        self._init_timeout = init_timeout
        self._silence_timeout = silence_timeout
        spoken: ControllerProtocol = C4gProtocol() if protocol is None else protocol
        self.wire: Wire = spoken.wire(
            ArmSettings(
                drive_train, guard.period, mode, arm, other_axes, only_axis, silence_timeout
            )
        )
        self._received: InitReceived | None = None
        self._open_mode: SetPointGenerator | None = None
        self._silent_since: float | None = None
        self._arrived_at = -math.inf
        self._last_reply = b""
        # Number and last reason of packets without a reply, by kind, since the last drain.
        self._unreported: dict[str, tuple[int, str]] = {}

    @property
    def init(self) -> ControllerDescription | None:
        """What the controller stated of itself, with C4G its init packet; None before it."""
        return self.wire.description

    @property
    def period(self) -> float:
        """The controller's cycle, s; before it is known the guard's."""
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
        elif self._received is not None:
            reason = self._received.unusable
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
        self.wire.lost()
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
                match received := self.wire.receive(packet, self.state, self.losses):
                    case MeasuredCycle():
                        return self._cyclic(received, now)
                    case Handshake():
                        return self._shake_hands(received, now)
                    case Repeated():
                        self.counters.duplicates += 1
                        return self._last_reply
                    case Stale(reason):
                        self.losses.stale += 1
                        self.counters.stale += 1
                        self._report("stale", 1, reason)
                        return None
                    case Remark(text):
                        self._events.append(ControllerRemark(text, self.cycle))
                        return None
        except PacketError as error:
            self.counters.malformed += 1
            self._report("malformed", 1, f"{len(packet)} bytes: {error}")
            return None

    def _shake_hands(self, packet: Handshake, now: float) -> bytes:
        """Follow a controller that starts a session."""
        if packet.restarted:
            self._end("lost", "the controller restarted: sync packets are missing")
        self._apply(packet.cause)
        if packet.received is not None:
            self._meet(packet.received)
        elif self.state is State.SYNC:
            self.wire.forget()
            self._received = self._open_mode = None
        return self._finish(packet.reply, now)

    def _meet(self, received: InitReceived) -> None:
        """Prepare for the cycles of a controller; the guard is narrowed to its own limits."""
        self._received = received
        self._open_mode = None
        self._holds_targets = True
        self.cycle = 0
        if self.wire.motors is not None:
            self._open_mode = SetPointGenerator(
                self._guard, self.wire, self.wire.motors, self.losses.max_gap
            )
            self._guard.narrow(*self.wire.limits())
        self._events.append(received)

    def _cyclic(self, packet: MeasuredCycle, now: float) -> bytes:
        """Run one cycle: record, change state, reply; an error becomes drive-off or 508."""
        ring = self._ring
        number, self.cycle, missed, axes = packet
        self.losses.receive(missed, now - self._arrived_at)
        row = ring.slot
        ring.arrival[row] = now
        ring.number[row] = number
        ring.gap[row] = missed
        ring.cycle[row] = self.cycle
        refusal = self._fill_reply(axes, row)
        self.in_interval = self.in_interval and axes.any_open
        ring.interval[row] = self.interval if self.in_interval else -1
        ring.state[row] = self.state
        ring.commit()
        if refusal is not None:
            self.counters.refused += 1
            self._events.append(Refused(refusal, ring.last(FLIGHT_RECORDER_CYCLES)))
            self._end("refused", str(refusal))
        return self._finish(self.wire.finish(), now)

    def _fill_reply(self, axes: AxesReport, row: int) -> RefusalError | None:
        """Fill in the reply and row `row` of the ring; return why a set-point was refused."""
        refusal: RefusalError | None = None
        try:
            self._record(axes, row)
            if self.losses.missed:
                self.counters.missed += self.losses.missed
                self._events.append(GapSeen(self.losses.missed, self.cycle))
            before = self.state
            decision = self._apply(axes.input, axes)
            if decision.misplaced is not None:
                raise AxisNotInMode(axes.misplacement(decision.misplaced), self.cycle)
            if self.state is State.FAULTED and before is not State.FAULTED:
                refusal = ModeRefused(axes.fault, self.cycle)
                refusal.remedy = axes.remedy or refusal.remedy
            answer = self._reply_in_state(axes, row)
        except BaseException as error:
            # Any error becomes a reply in this cycle that asks the controller to stop.
            answer = Refuse(as_refusal(error, self.cycle))
        if answer is not None and answer.rejected:
            self._count_rejected(answer.rejected)
        if isinstance(answer, Refuse):
            refusal = answer.error
            if refusal.is_general and axes.remedy:
                refusal.remedy = axes.remedy
            self._ring.commanded[row] = math.nan
            self._apply(Input.REFUSAL)
            self._offending = _offending(refusal)
            self.wire.fill_refusal(self._offending)
        elif answer is not None:
            self._follow(answer)
        return refusal

    def _record(self, axes: AxesReport, row: int) -> None:
        """Write what a packet says into a row of the ring; commanded values are NaN."""
        ring = self._ring
        ring.status[row] = axes.status
        ring.commanded[row] = math.nan
        if ring.arm_state is not None:
            self.wire.record_state(ring.arm_state[row : row + 1])
        if self._open_mode is None:
            ring.mode[row] = -1
            ring.measured[row] = math.nan
            return
        ring.mode[row] = axes.modes
        self.wire.record(ring.measured[row])

    def _reply_in_state(self, axes: AxesReport, row: int) -> OpenReply | None:
        """Fill in the reply for the state that the packet leads to.

        Returns what open mode did, None outside it. Raises RefusalError if nothing may be sent.
        """
        wire = self.wire
        state = self.state
        if state is State.FAULTED and axes.powered:
            wire.fill_refusal(self._offending)
            return None
        wire.fill_safe(self.execution is not None, self.cycle)
        if state not in STATES_WITH_SET_POINTS:
            self._hold_without_motion(axes)
            return None
        if self._open_mode is None:
            reason = None if self._received is None else self._received.unusable
            raise RefusalError(f"this arm cannot be moved: {reason}", self.cycle)
        ring = self._ring
        return self._open_mode.reply(
            OpenCycle(
                state,
                self.cycle,
                self.entered_at,
                self._exit_requested_at,
                axes,
                ring.measured[row],
                ring.commanded[row],
                self.losses,
                self.execution,
                self._entering,
                self.in_interval,
                self.stop_reason,
            )
        )

    def _hold_without_motion(self, axes: AxesReport) -> None:
        """Return open axes their target if that is possible, else request drive-off.

        Raises RefusalError in the first cycle of these.
        """
        try:
            self.wire.require_targets(self.cycle)
            if self.state is State.FREEZING and self._open_mode is not None:
                self._open_mode.hold_in_pause(axes, self.cycle)
        except RefusalError as error:
            if self._holds_targets:
                self._holds_targets = False
                raise
            self.wire.fill_refusal(_offending(error))
        else:
            self._holds_targets = True

    def _follow(self, answer: Reply) -> None:
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
        self.wire.request_exit()

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

    def _apply(self, cause: Input, axes: AxesReport | None = None) -> Decision:
        """Change to the state that an input leads to; the only place where states change."""
        decision = decide(self.state, cause, self.losses, self.execution, axes)
        if decision.stop is not None:
            self.stop(decision.stop)
        if decision.state is not self.state:
            self._enter(decision.state)
        if cause in (Input.INIT, Input.SILENCE):
            self.in_interval = False
        if decision.ending is not None:
            outcome, reason = decision.ending
            if outcome == "lost" and axes is not None and axes.cause:
                reason = axes.cause
            self._end(outcome, reason)
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
        if after not in STATES_WITH_SET_POINTS:
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

    def _finish(self, reply: bytes, now: float) -> bytes:
        self.counters.replied += 1
        self.losses.restarting = False
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
