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

The state table is `drivers.states.TRANSITIONS`. Open mode is entered only from driving on, closed
or opening: after an init packet, a drive-off, a pause or a fault the controller has to report
closed axes first, and a new motion has to be requested.

Each new valid packet gets exactly one reply, a duplicate (the same bytes) the same reply again;
stale and malformed packets get none and are counted. Motion advances one period per packet replied
to, however many were missed, and waits where a reply was not accepted. More than `max_gap` packets
missed in a row, stale ones included, stop it on its path. A packet that arrives more than
`PAUSE_CYCLES` later than its number accounts for gets a further set-point only if the arm moves as
commanded. The other checks in open mode are described in `drivers.reply_policy`.

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

from drivers.drive_train import Ages, DriveTrain
from drivers.errors import ModeRefused, PacketError, RefusalError, as_refusal
from drivers.events import Event, LinkLost, PacketRejected, Refused
from drivers.execution import execution_of
from drivers.guard import Guard
from drivers.motion_source import CorrectionSource, MotionSource
from drivers.packets import (
    DRIVE_ON,
    INIT_LENGTH,
    INIT_NUMBER,
    LAST_NUMBER,
    N_ARMS,
    CyclicPacket,
    InitPacket,
    Mode,
    echo,
    is_init,
    packet_number,
)
from drivers.record import CycleRing
from drivers.replies import MODE, words_of
from drivers.reply_policy import ReplyPolicy
from drivers.state_machine import StateMachine
from drivers.states import CORRECTION_MODES, POSITION_MODES, Input, State


class PacketSequence:
    """Follows the controller's packet numbers (1..0x7FFF, then 1 again).

    A number at most `window` ahead of the last is new. The window is what can be missed before
    silence ends the session, so a number further ahead cannot belong to the same session.

    Attributes:
        last: number of the last packet replied to.
        cycle: the controller's cycles since its init packet, missed ones included.
        broken: a silence ended the sequence: the next number, whichever it is, is new.
    """

    def __init__(self) -> None:
        self.last = 0
        self.cycle = 0
        self.broken = False
        self._window = LAST_NUMBER // 2

    def restart(self, number: int, window: float) -> None:
        """Count from this number on, accepting at most `window` cycles ahead."""
        self.last = number
        self.cycle = 0
        self.broken = False
        # Beyond half of all numbers, ahead could not be distinguished from behind.
        self._window = max(1, min(int(window), LAST_NUMBER // 2))

    def distance(self, number: int) -> int:
        """Return the cycles from the last packet replied to to this one, 0..0x7FFE."""
        return (number - self.last) % LAST_NUMBER

    def is_duplicate(self, number: int) -> bool:
        """Whether this is the number of the last packet."""
        return number == self.last and not self.broken

    def is_stale(self, number: int) -> bool:
        """Whether this cannot be a later packet of the same session."""
        return not self.broken and not 1 <= self.distance(number) <= self._window

    def leads_to(self, number: int, missed: int) -> bool:
        """Whether this number follows the last with at most `missed` in between, or is first."""
        return self.broken or self.last == 0 or self.distance(number) <= missed + 1

    def accept(self, number: int) -> int:
        """Advance to this number; return how many packets were missed before it."""
        ahead = self.distance(number)
        if not 1 <= ahead <= self._window:
            ahead = 1  # after a silence, whose length the numbers do not give
        self.last = number
        self.cycle += ahead
        self.broken = False
        return ahead - 1


FLIGHT_RECORDER: Final = 50
"""Records attached to a refusal."""
STOP_TIMEOUT: Final = 10.0
"""Largest time from the request of a stop to rest, s; then drive-off is requested."""
MAX_GAP: Final = 100
"""Largest `max_gap`."""
SERVED_MODES: Final = tuple(sorted(POSITION_MODES | CORRECTION_MODES))
"""Open modes in which a motion can run."""
PAUSE_CYCLES: Final = 2.0
"""Cycles by which a packet may arrive later than its number and `max_gap` account for."""
_SYNC_AFTER_INIT: Final = (INIT_NUMBER + 1, INIT_NUMBER + 2)


class Session(StateMachine):
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

    Commands and further attributes are those of `StateMachine`.
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
        if only_axis is not None and not (mode in POSITION_MODES and 1 <= only_axis <= n):
            raise ValueError(f"only axis {only_axis} of {n} is not served in mode {mode}")
        super().__init__(max_gap)
        self.deadline = math.inf
        self._drive_train = drive_train
        self._guard = guard
        self._ring = ring
        self._mode = mode
        self._settle_cycles = settle_cycles
        self._init_timeout = init_timeout
        self._silence_timeout = silence_timeout
        self._make_policy = partial(
            ReplyPolicy,
            drive_train=drive_train,
            guard=guard,
            arm=arm,
            mode=mode,
            other_axes=frozenset(other_axes),
            max_gap=max_gap,
            only_axis=only_axis,
        )
        self._sequence = PacketSequence()
        self._policy: ReplyPolicy | None = None
        self._cold_start = False
        self._silent_since: float | None = None
        self._arrived_at = -math.inf
        self._last_packet = b""
        self._last_reply = b""
        self._without_reply = 0
        self._sync_packets = 0  # of a controller that restarted, since the last reply
        # Number and last reason of packets without a reply, by kind, since the last drain.
        self._unreported: dict[str, tuple[int, str]] = {}

    @property
    def init(self) -> InitPacket | None:
        """The controller's init packet, None before it."""
        return None if self._policy is None else self._policy.init

    @property
    def period(self) -> float:
        """The controller's cycle, s; before its init packet the guard's."""
        return self._guard.period if self._policy is None else self._policy.init.period

    @property
    def drive_train(self) -> DriveTrain:
        """Drive train of the cell."""
        return self._drive_train

    def events(self) -> list[Event]:
        """Return the events since the last call, in order; rejected packets last, by kind."""
        events, self._events = self._events, []
        events.extend(PacketRejected(kind, *found) for kind, found in self._unreported.items())
        self._unreported.clear()
        return events

    def request(self, source: MotionSource | CorrectionSource) -> None:
        """Run a motion as soon as every wanted axis is open, then leave open mode.

        Raises:
            RequestError: the state does not allow one, or the source is not of the kind that the
                open mode needs (see `drivers.motion_source`).
        """
        n, stop_cycles = self._drive_train.n_joints, round(STOP_TIMEOUT / self._guard.period)
        execution = execution_of(source, self._mode, n, self._settle_cycles, stop_cycles)
        if isinstance(execution, str):
            raise self._request_error(execution)
        self._accept(execution, self._policy.unusable if self._policy else None)

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
        self._events.append(LinkLost(silence, self.state, self._without_reply))
        self.deadline = math.inf
        self._sequence.broken = True
        self.apply(Input.SILENCE, self._cause_of_silence())

    def _cause_of_silence(self) -> str:
        """Return what came instead of packets that get a reply; "" if nothing did."""
        if self._sync_packets:
            return "the controller restarted: it sent sync packets"
        if self._without_reply:
            return f"only packets that do not follow the last one came ({self._without_reply})"
        return ""

    def reply(self, packet: bytes, now: float, ages: Ages | None = None) -> bytes | None:
        """Return the reply to a packet, or None if it gets none.

        Args:
            packet: its bytes.
            now: when it arrived, s on any monotonic clock.
            ages: (n_axes, 8) cycles since D1..D5, extra1..3 of each slot were sent by the
                controller; None if all were sent with this packet.
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
                    self._sync_packets += 1
                return self._cyclic(packet, number, now, ages)
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
        if syncing and not self._sequence.leads_to(INIT_NUMBER, self._max_gap):
            self.end("lost", "the controller restarted: sync packets are missing")
        self.apply(Input.INIT)
        self._policy = policy = self._make_policy(init)
        self._sequence.restart(INIT_NUMBER, self._silence_timeout / max(init.period, 1e-3))
        self.cycle = 0
        self._events.append(policy.received)
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
        self.apply(Input.SYNC)
        if self.state is State.SYNC:
            self._policy = None
        self._sequence.accept(number)
        return self._finish(packet, echo(packet), now)

    def _cyclic(self, packet: bytes, number: int, now: float, ages: Ages | None) -> bytes | None:
        """Run one cycle: decode, record, change state, reply; an error becomes drive-off or 508."""
        policy, ring = self._policy, self._ring
        assert policy is not None
        decoded = CyclicPacket.decode(packet, policy.init.n_axes)
        if self._sequence.is_duplicate(number) and packet == self._last_packet:
            self.counters.duplicates += 1
            return self._last_reply
        if self._sequence.is_stale(number):
            self._without_reply += 1
            self.counters.stale += 1
            self._report("stale", 1, f"number {number} does not follow {self._sequence.last}")
            return None
        missed = self._sequence.accept(number)
        self.cycle = self._sequence.cycle
        late = (now - self._arrived_at) / self._guard.period - max(missed, self._max_gap)
        words = words_of(decoded)
        # After a corrupted number the controller's own numbers are stale for a while.
        without_reply, self._without_reply = missed + self._without_reply, 0
        reading = policy.reader.read(decoded.status, words[:, MODE])
        row = ring.slot
        ring.arrival[row] = now
        ring.number[row] = number
        ring.gap[row] = missed
        ring.cycle[row] = self.cycle
        refusal: RefusalError | None = None
        try:
            policy.record(ring, row, reading, words, ages)
            self.record_gap(missed, without_reply)
            self.require_axes(reading, self._mode)
            before = self.state
            self.apply(reading.input)
            if self.state is State.FAULTED and before is not State.FAULTED:
                refusal = ModeRefused(reading.fault, self.cycle)
            record = ring.measured[row], ring.commanded[row]
            status = policy.fill(self, reading, words, *record, without_reply, late > PAUSE_CYCLES)
        except BaseException as error:
            # Any error becomes a reply in this cycle that asks the controller to stop.
            refusal = as_refusal(error, self.cycle)
            ring.commanded[row] = math.nan
            self.apply(Input.REFUSAL)
            status = policy.refuse(self, refusal, reading, words)
        self.in_interval = self.in_interval and reading.any_open
        ring.interval[row] = self.interval if self.in_interval else -1
        ring.state[row] = self.state
        ring.commit()
        if refusal is not None:
            self.counters.refused += 1
            self._events.append(Refused(refusal, ring.last(FLIGHT_RECORDER)))
            self.end("refused", str(refusal))
        return self._finish(packet, policy.frame.finish(number, status), now)

    def _finish(self, packet: bytes, reply: bytes, now: float) -> bytes:
        self.counters.replied += 1
        self._sync_packets = 0
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
