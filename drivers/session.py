"""The PC's end of a C4G Open session: bytes in, bytes and events out. No socket, no clock.

====================  ======================================  =====================================
state                 what the controller reports             what it is answered
====================  ======================================  =====================================
sync                  sync packets, before init               the same bytes, number plus one;
                                                              nothing if a drive is on
init                  init packet; two more sync after a      the same bytes, number plus one
                      cold start
drive off             drive not on                            everything echoed
driving on            mode 501                                target position, velocity given back
closed                mode 0 (or 10) in every wanted axis     the same
opening               some wanted axes open, not all          open axes: target, zero velocity
                                                              (modes 1, 4, 5), or zeros; the
                                                              others as when closed
open                  all wanted axes open                    guarded set-points, see below
exiting               still open, end of open mode asked for  the last set-point, zero velocity
                                                              (modes 1, 4, 5), or zeros
freezing              mode 500 or 502 in a wanted axis        mode 0, zeros; open axes their target,
                                                              at zero velocity; silence may last
faulted               open after a fault, a mode unknown      505 (508 for a following error) while
                      here, or nothing at all                 open and powered; else the safe answer
ended                 mode 504, answered once                 nothing
====================  ======================================  =====================================

Which state follows which is the table `drivers.states.TRANSITIONS`. Open mode is entered only
from driving on, closed or opening, so after an init packet, a drive-off, a pause or a fault the
controller has to report closed axes first, and a new motion has to be requested.

Every fresh, well-formed packet gets exactly one answer, a duplicate (the same bytes) the same
bytes again; stale and malformed ones get none and are counted. Motion advances one period per
answered packet, whatever was missed, and waits where an answer was not taken; more than `max_gap`
missed in a row, stale ones among them, bring it to rest on its path, from where the controller
carried or holds it. A packet that comes `PAUSE_CYCLES` later by the clock than its number
accounts for gets a further set-point only if the arm moves as it was commanded to. What is watched
meanwhile, and when open mode is left, stands at the head of `drivers.reply_policy`.

In every state an axis that is open with its drive on, of whichever arm, is answered by its target
only if that is a number; if it is none, drive-off is asked for. In a pause a wanted axis that is
open also has to be near its target.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Final, Literal

import numpy as np

from drivers.drive_train import Ages, DriveTrain
from drivers.errors import ModeRefused, PacketError, RefusalError, RequestError, as_refusal
from drivers.events import Counters, Event, InitReceived, LinkLost, PacketRejected, Refused
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


class PacketCounts:
    """Counts fates of packets.

    Attributes:
        counters: since the session was made.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self._untold: dict[str, int] = {}
        self._why: dict[str, str] = {}

    def rejected(self, kind: Literal["malformed", "stale", "ended"], why: str = "") -> None:
        """One got no answer: it was no packet, no later one, or came after the end."""
        setattr(self.counters, kind, getattr(self.counters, kind) + 1)
        self._untold[kind] = self._untold.get(kind, 0) + 1
        self._why[kind] = why

    def discarded(self, kind: str, count: int) -> None:
        """The link dropped `count` packets of this kind before the session saw them."""
        if count <= 0:
            return
        self.counters.discarded[kind] = self.counters.discarded.get(kind, 0) + count
        self._untold[kind] = self._untold.get(kind, 0) + count

    def drain(self) -> list[PacketRejected]:
        """One event per kind since the last call."""
        why = self._why
        events = [PacketRejected(kind, n, why.get(kind, "")) for kind, n in self._untold.items()]
        self._untold.clear()
        return events


class PacketSequence:
    """Follows the controller's numbers (1..0x7FFF, then 1 again) from the last one answered.

    A number at most `window` ahead is new; the window is what can be missed before silence ends
    the session, so a number further ahead cannot be a later packet of the same session.

    Attributes:
        last: number of the last packet answered.
        cycle: the controller's cycles since its init packet, missed ones counted in.
        broken: after a silence no number is expected; whatever comes next is new.
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
        """Cycles from the last packet answered to this one, 0..0x7FFE."""
        return (number - self.last) % LAST_NUMBER

    def is_duplicate(self, number: int) -> bool:
        """Whether this is the last packet once more."""
        return number == self.last and not self.broken

    def is_stale(self, number: int) -> bool:
        """Whether this cannot be a later packet of the same session."""
        return not self.broken and not 1 <= self.distance(number) <= self._window

    def leads_to(self, number: int, missed: int) -> bool:
        """Whether this number comes after the last, at most so many missed, or after none."""
        return self.broken or self.last == 0 or self.distance(number) <= missed + 1

    def accept(self, number: int) -> int:
        """Go on to this number; returns how many packets were missed before it."""
        ahead = self.distance(number)
        if not 1 <= ahead <= self._window:
            ahead = 1  # after a silence: how long it was, the numbers cannot tell
        self.last = number
        self.cycle += ahead
        self.broken = False
        return ahead - 1


FLIGHT_RECORDER: Final = 50
"""Records that go with a refusal."""
STOP_TIMEOUT: Final = 10.0
"""s that a motion may take from being asked to stop to rest; drive-off is asked for after that."""
MAX_GAP: Final = 100
"""Largest `max_gap`."""
SERVED_MODES: Final = tuple(sorted(POSITION_MODES | CORRECTION_MODES))
"""Open modes a motion can run in."""
PAUSE_CYCLES: Final = 2.0
"""Cycles that a packet may come later, by the clock, than its number and `max_gap` account for."""
_SYNC_AFTER_INIT: Final = (INIT_NUMBER + 1, INIT_NUMBER + 2)


class Session:
    """One arm's session with one controller. Every method belongs to one thread.

    Args:
        drive_train: of the arm.
        guard: checks each set-point; its period must be the controller's cycle.
        ring: one record per cyclic packet answered goes there.
        mode: open mode in which the arm is moved, one of `SERVED_MODES`.
        max_gap: packets that may be missed in a row without stopping a motion, 0..`MAX_GAP`.
        arm: number of the arm, 1..4.
        settle_cycles: how long the end of a motion is held before open mode is left.
        init_timeout: s of silence allowed before the init packet and in a pause.
        silence_timeout: s of silence allowed otherwise.
        accept_init: adopt the controller's gear ratios, calibration and coupling where they
            differ from the cell's but are not far off, and accept further open axes, instead of
            refusing to move.
        other_axes: (arm, axis), both from 1, that may be open although the cell has no such joint.
        only_axis: the joint, from 1, whose axis alone the controller opens; the others have to
            stay closed. None where it opens all.

    Attributes:
        deadline: when silence becomes a fault, on the clock of `now`. Each packet that is answered
            afresh moves it; duplicates and rejected packets do not. Infinite until the first
            `reply` or `tick`, after a silence was reported, and in state ended.
        counters: fates of packets.
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
        accept_init: bool = False,
        other_axes: Collection[tuple[int, int]] = (),
        only_axis: int | None = None,
    ) -> None:
        n = drive_train.n_joints
        if not n == guard.limits.n_joints == ring.n_joints:
            raise ValueError(
                f"drive train, guard and ring are for {n}, {guard.limits.n_joints} and "
                f"{ring.n_joints} joints"
            )
        if mode not in SERVED_MODES:
            served = ", ".join(str(int(m)) for m in SERVED_MODES)
            raise ValueError(f"motion in mode {mode} is not served; modes {served} are")
        if not 0 <= max_gap <= MAX_GAP:
            raise ValueError(f"a gap of {max_gap} packets is not one of 0..{MAX_GAP}")
        if not 1 <= arm <= N_ARMS:
            raise ValueError(f"arm {arm} is not one of 1..{N_ARMS}")
        if only_axis is not None and not (mode in POSITION_MODES and 1 <= only_axis <= n):
            raise ValueError(
                f"only axis {only_axis} of {n} in mode {mode} is not served: one axis alone is "
                "moved in modes 1, 4 and 5"
            )
        self.deadline = math.inf
        self._tally = PacketCounts()
        self.counters: Counters = self._tally.counters
        self._drive_train = drive_train
        self._guard = guard
        self._ring = ring
        self._mode = mode
        self._max_gap = max_gap
        self._arm = arm
        self._settle_cycles = settle_cycles
        self._init_timeout = init_timeout
        self._silence_timeout = silence_timeout
        self._accept_init = accept_init
        self._other_axes = frozenset(other_axes)
        self._only_axis = only_axis
        self._machine = StateMachine(self.counters)
        self._sequence = PacketSequence()
        self._policy: ReplyPolicy | None = None
        self._cold_start = False
        self._heard_at: float | None = None
        self._arrived_at = -math.inf
        self._last_packet = b""
        self._last_reply = b""
        self._unanswered = 0

    @property
    def state(self) -> State:
        """Where the session stands."""
        return self._machine.state

    @property
    def interval(self) -> int:
        """Index of the last interval in open mode, -1 before the first."""
        return self._machine.interval

    @property
    def cycle(self) -> int:
        """Cycles of the controller since its init packet, up to the packet answered last."""
        return self._machine.cycle

    @property
    def init(self) -> InitPacket | None:
        """The controller's init packet, None before it."""
        return None if self._policy is None else self._policy.init

    @property
    def period(self) -> float:
        """The controller's cycle, s; before its init packet the one the guard was built for."""
        return self._guard.period if self._policy is None else self._policy.init.period

    @property
    def drive_train(self) -> DriveTrain:
        """In force: the cell's, or the one with the controller's values that were adopted."""
        return self._drive_train if self._policy is None else self._policy.init_check.drive_train

    @property
    def requested(self) -> bool:
        """Whether a motion was requested and has not ended."""
        return self._machine.execution is not None

    def events(self) -> list[Event]:
        """What happened since the last call, in order; rejected packets come last, summed up."""
        events, self._machine.events = self._machine.events, []
        events.extend(self._tally.drain())
        return events

    def request(self, source: MotionSource | CorrectionSource) -> None:
        """Run a motion as soon as every wanted axis is open, then leave open mode.

        Raises:
            RequestError: none can be promised now, or the source is not of the kind that the
                open mode needs (see `drivers.motion_source`).
        """
        n, stop_cycles = self._drive_train.n_joints, round(STOP_TIMEOUT / self._guard.period)
        execution = execution_of(source, self._mode, n, self._settle_cycles, stop_cycles)
        if isinstance(execution, str):
            raise RequestError(self.state.name.lower(), execution)
        self._machine.request(execution, self._policy.unusable if self._policy else None)

    def override(self, fraction: float) -> None:
        """Run the requested motion at this fraction (0..1) of its speed from now on.

        Raises:
            RequestError: there is none, it is being stopped, or it knows no override.
        """
        self._machine.override(fraction)

    def hold(self) -> None:
        """Rest on the path until `resume`; a motion that cannot is stopped.

        One that has not begun begins at rest, where the arm stands, and waits there.

        Raises:
            RequestError: there is no motion.
        """
        self._machine.hold()

    def resume(self) -> None:
        """Go on after `hold`.

        Raises:
            RequestError: there is no motion, it is being stopped, or it cannot hold and resume.
        """
        self._machine.resume()

    def discarded(self, kind: str, count: int) -> None:
        """The link dropped `count` packets before the session saw them: counted and reported."""
        self._tally.discarded(kind, count)

    def stop(self, reason: str = "a stop was asked for") -> None:
        """Bring the motion to rest on its path and leave open mode; drop one not begun yet."""
        self._machine.stop(reason)

    def tick(self, now: float) -> None:
        """Say what time it is when nothing came; past `deadline` the link counts as lost.

        Motion is over then, and whatever comes next is taken as a new packet, so that a controller
        that was only paused is answered, safely, and one that starts anew is followed.
        """
        if self._heard_at is None:
            self._heard(now)
        if now < self.deadline or self.state is State.ENDED:
            return
        assert self._heard_at is not None
        self._machine.events.append(LinkLost(now - self._heard_at, self.state, self._unanswered))
        self.deadline = math.inf
        self._sequence.broken = True
        stale = f"only packets that do not follow the last one came ({self._unanswered})"
        self._machine.take(Input.SILENCE, stale if self._unanswered else "")

    def reply(self, packet: bytes, now: float, ages: Ages | None = None) -> bytes | None:
        """The answer to a packet that arrived at `now` (s, any monotonic clock), if it gets one.

        Args:
            packet: its bytes.
            now: when it arrived.
            ages: (n_axes, 8) cycles since D1..D5, extra1..3 of each slot were sent by the
                controller; None if all were sent with this packet.
        """
        if self._heard_at is None or now >= self.deadline:
            self.tick(now)
        if self.state is State.ENDED:
            self._tally.rejected("ended")
            return None
        try:
            # Bytes may hold any number; what is not finite is for the guard, not for numpy.
            with np.errstate(all="ignore"):
                if is_init(packet):
                    return self._start_over(packet, now)
                number = packet_number(packet)
                powered = DRIVE_ON in packet[4 : 4 + N_ARMS]
                if self._expects_sync(number, powered):
                    return self._sync(packet, number, now, powered)
                return self._cyclic(packet, number, now, ages)
        except PacketError as error:
            self._tally.rejected("malformed", f"{len(packet)} bytes: {error}")
            return None

    def _start_over(self, packet: bytes, now: float) -> bytes:
        if self.state is State.INIT and packet == self._last_packet:
            self.counters.duplicates += 1
            return self._last_reply
        init = InitPacket.decode(packet)
        self._cold_start = self.state is State.SYNC and self._sequence.last > 0
        if self.state is State.SYNC and not self._sequence.leads_to(INIT_NUMBER, self._max_gap):
            self._machine.forget_request()
        self._machine.take(Input.INIT)
        arm = (self._drive_train, self._guard, self._arm, self._mode)
        options = (self._accept_init, self._other_axes, self._max_gap, self._only_axis)
        self._policy = policy = ReplyPolicy(init, *arm, *options)
        self._sequence.restart(INIT_NUMBER, self._silence_timeout / max(init.period, 1e-3))
        self._machine.cycle = 0
        check = policy.init_check
        self._machine.events.append(
            InitReceived(init, check.unusable, check.differences, check.adopted)
        )
        return self._answered(packet, echo(packet), now)

    def _expects_sync(self, number: int, powered: bool) -> bool:
        if self.state is State.SYNC:
            return True
        if powered:
            return False
        if self.state is State.INIT:
            return self._cold_start and number in _SYNC_AFTER_INIT
        # A controller that was silent and counts from the beginning was started anew.
        sequence = self._sequence
        return sequence.broken and number < INIT_NUMBER and sequence.distance(number) != 1

    def _sync(self, packet: bytes, number: int, now: float, powered: bool) -> bytes:
        if powered:
            # The controller is in mid-session, and an echo would give open axes set-points.
            # Unanswered, its own watch acts.
            raise PacketError("status", packet[4 : 4 + N_ARMS].hex(), "no drive on before init")
        if len(packet) >= INIT_LENGTH:
            raise PacketError("length", len(packet), f"less than {INIT_LENGTH} bytes")
        self._machine.take(Input.SYNC)
        if self.state is State.SYNC:
            self._policy = None
        self._sequence.accept(number)
        return self._answered(packet, echo(packet), now)

    def _cyclic(self, packet: bytes, number: int, now: float, ages: Ages | None) -> bytes | None:
        policy, machine, ring = self._policy, self._machine, self._ring
        assert policy is not None
        decoded = CyclicPacket.decode(packet, policy.init.n_axes)
        if self._sequence.is_duplicate(number) and packet == self._last_packet:
            self.counters.duplicates += 1
            return self._last_reply
        if self._sequence.is_stale(number):
            self._unanswered += 1
            self._tally.rejected("stale", f"number {number} does not follow {self._sequence.last}")
            return None
        missed = self._sequence.accept(number)
        machine.cycle = self._sequence.cycle
        late = (now - self._arrived_at) / self._guard.period - max(missed, self._max_gap)
        words = words_of(decoded)
        # After a corrupted number the controller's own look stale for a while.
        unanswered, self._unanswered = missed + self._unanswered, 0
        reading = policy.reader.read(decoded.status, words[:, MODE])
        row = ring.slot
        ring.arrival[row] = now
        ring.number[row] = number
        ring.gap[row] = missed
        ring.cycle[row] = machine.cycle
        policy.record(ring, row, reading, words, ages)
        refusal: RefusalError | None = None
        try:
            machine.record_gap(missed, unanswered, self._max_gap)
            machine.require_axes(reading, self._mode)
            before = machine.state
            machine.take(reading.input)
            if machine.state is State.FAULTED and before is not State.FAULTED:
                refusal = ModeRefused(*reading.faulty, machine.cycle)
            measured, commanded = ring.measured[row], ring.commanded[row]
            policy.check_gap(unanswered, late > PAUSE_CYCLES, machine, reading)
            status = policy.answer(machine, reading, words, measured, commanded)
        except BaseException as error:
            # Whatever it was, the controller is asked to stop, by the answer that is due now.
            refusal = as_refusal(error, machine.cycle)
            ring.commanded[row] = math.nan
            status = policy.refuse(machine, refusal, reading, words)
        machine.in_interval = machine.in_interval and reading.any_open
        ring.interval[row] = machine.interval if machine.in_interval else -1
        ring.state[row] = machine.state
        ring.commit()
        if refusal is not None:
            self.counters.refused += 1
            machine.events.append(Refused(refusal, ring.last(FLIGHT_RECORDER)))
            machine.end("refused", str(refusal))
        return self._answered(packet, policy.finish(number, status), now)

    def _answered(self, packet: bytes, reply: bytes, now: float) -> bytes:
        self.counters.answered += 1
        self._last_packet = packet
        self._last_reply = reply
        self._arrived_at = now
        self._heard(now)
        return reply

    def sent(self, now: float) -> None:
        """The answer given last left at `now`: silence counts from there, not from the packet."""
        self._heard(now)

    def _heard(self, now: float) -> None:
        self._heard_at = now
        state = self.state
        if state is State.ENDED:
            self.deadline = math.inf
        elif state is State.SYNC or state is State.FREEZING:
            self.deadline = now + self._init_timeout
        else:
            self.deadline = now + self._silence_timeout
