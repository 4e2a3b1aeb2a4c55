"""Independent check of a session by its packets, replies and records.

`Conduct` checks the contents of replies; `oracle.Reception` predicts which packets get one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers import CycleRing, DriveTrain, GuardLimits, InitReceived, MotionEnded, Session, State
from tests.drivers import oracle
from tests.drivers.oracle import Reception, number_of
from tests.drivers.set_points import EPS, SetPointLaws

REFUSALS = (oracle.DRIVE_OFF_REQUEST, oracle.FOLLOWING_ERROR)
MODE_FIELDS = {1: (1, 2, 4, 5), 2: (4, 5), 4: (1, 2), 5: (1, 2), 7: (1,), 8: (4,), 9: (5,)}
"""Fields of an answer in open mode (facts, section 6); every other one is zero."""
POSITION_MODES = (1, 4, 5)
LOSS_WINDOW = 100
"""Cycles in which more than `max_gap` replies that were not accepted stop a motion."""


@dataclass
class Conduct(SetPointLaws):
    """Allowed contents of the replies to cyclic packets, after an init packet.

    Args:
        limits: of the guard.
        train: in force.
        mode: open mode wanted.
        arm: wanted, from 1.
        slots: slot of each joint.
        arms: arm of each slot, from 1.
        threshold: (n,) following error in force, motor revolutions.
        current: (n,) A, in force.
        max_gap: so many packets or answers may be lost in a row without a stop.

    Attributes:
        usable: whether this session may move the arm at all.
        entitled: a motion was requested and accepted, and has not ended.
        stopping: a stop was asked for (or a long gap was, or too many replies were not accepted) in
            this interval.
        held: a hold, or its end, was asked for in this interval; the bounds are those of a stop.
        overridden: a change of override was accepted in this interval.
        tally: how often each law was applied.
    """

    limits: GuardLimits
    train: DriveTrain
    mode: int
    arm: int
    slots: tuple[int, ...]
    arms: tuple[int, ...]
    threshold: np.ndarray
    current: np.ndarray
    period: float = 0.002
    usable: bool = True
    entitled: bool = False
    stopping: bool = False
    held: bool = False
    overridden: bool = False
    barrier: bool = True
    sent: list[np.ndarray] = field(default_factory=list)
    motor: np.ndarray | None = None
    motors: list[np.ndarray] = field(default_factory=list)
    max_gap: int = 2
    lag: int = 0
    repeats: int = 0
    arm_share: float = 1.0
    answered: np.ndarray | None = None
    cycle: int = 0
    lost: list[tuple[int, int]] = field(default_factory=list)
    exiting: bool = False
    missed: int = 0
    at_most: int = 0
    without_jerk_bound: int = 0
    continuing: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    tally: dict[str, int] = field(default_factory=dict)

    def all_open(self, packet: bytes) -> bool:
        """Whether every joint is in the mode wanted and the drive is on."""
        received = oracle.parse(packet, len(self.arms))
        on = received.status[self.arm - 1] == oracle.DRIVE_ON
        return on and all(received.axes[slot].mode == self.mode for slot in self.slots)

    def interrupted(self) -> None:
        """After an init packet or a silence, axes have to be closed first."""
        self.barrier = True
        self.sent = []
        self.motor = None
        self.exiting = False

    def judge(
        self, packet: bytes, reply: bytes, record: np.void, missed: int, at_most: int = 0
    ) -> None:
        """Check the reply to one new cyclic packet, after `missed` packets without a reply.

        The session may count them as `at_most`, if that is more.
        """
        n = len(self.arms)
        received = oracle.parse(packet, n)
        answer = oracle.parse(reply, n)
        assert len(reply) == oracle.length(n)
        assert answer.number == oracle.answer_number(received.number), "another number"
        assert answer.functionality == oracle.ZERO, "function bytes"
        safe = oracle.safe_answer(received, self.arms)
        on = received.status[self.arm - 1] == oracle.DRIVE_ON
        modes = [received.axes[slot].mode for slot in self.slots]
        is_open = on and any(mode in oracle.OPEN for mode in modes)
        self._status(answer, safe, in_open_mode=is_open)
        lost_target = oracle.lost_target(received, self.arms)
        if lost_target:
            assert oracle.drive_off(answer), "held at what is no number"
            self._count("no target")
        if not self.usable:
            self._unusable(received, answer, safe, record)
            return
        ready = [on and mode == self.mode for mode in modes]
        commanded = record["commanded_position"], record["commanded_velocity"]
        paused = on and any(mode in (500, 502) for mode in modes)
        if not is_open and not paused:
            self._note(on, modes)
        if (is_open or lost_target) and self._refused(answer):
            self._refusal(answer, safe)
            assert np.isnan(commanded).all(), "a refused set-point was recorded as sent"
            self.interrupted()
            self._count("refused")
            return
        if paused:
            assert answer == safe, "a pause: not the safe answer"
            assert np.isnan(commanded).all()
            self._over("paused")
            return
        if is_open:
            assert not self.barrier, "a set-point although closed axes were not seen before"
        for slot in range(n):
            if slot not in self.slots or not ready[self.slots.index(slot)]:
                assert answer.axes[slot] == safe.axes[slot], f"slot {slot}: not the safe answer"
        self.stopping = self.stopping or max(missed, at_most) > self.max_gap
        self.cycle = int(record["cycle"])
        self.missed = missed
        self.at_most = max(missed, at_most)
        # The record's word counts for nothing but this: set-points end with the exit.
        leaving = self.exiting
        self.exiting = bool(record["state"] == State.EXITING)
        if all(ready) and not leaving:
            self._open(received, answer, record)
            self.continuing = np.ones(len(ready), bool)
        elif any(ready) and self.motor is not None:
            self._leaving(answer, safe, ready)
        elif any(ready):
            for slot, up in zip(self.slots, ready, strict=True):
                assert not up or answer.axes[slot] == safe.axes[slot], "opening: not held"
            self._count("opening")
        else:
            held = [mode in oracle.HOLDS_A_POSITION and on for mode in modes]
            assert np.isnan(np.asarray(commanded)[:, ~np.array(held)]).all()
            self._over("safe")

    def _unusable(
        self, received: oracle.Packet, answer: oracle.Packet, safe: oracle.Packet, record: np.void
    ) -> None:
        """Check drive-off of open axes of an unusable arm, and the safe reply of others."""
        axes = [a for a, arm in zip(received.axes, self.arms, strict=True) if arm == self.arm]
        on = received.status[self.arm - 1] == oracle.DRIVE_ON
        if answer != safe:
            is_open = on and any(axis.mode in oracle.OPEN for axis in axes)
            assert is_open or oracle.lost_target(received, self.arms)
            self._refusal(answer, safe)
        assert np.isnan(record["commanded_position"]).all()
        self.interrupted()
        self._count("unusable")

    def _over(self, what: str) -> None:
        """End the interval in open mode, if there is one."""
        self.sent = []
        self.motor = None
        self.exiting = False
        self.stopping = self.held = self.overridden = False
        self._count(what)

    def _status(self, answer: oracle.Packet, safe: oracle.Packet, in_open_mode: bool) -> None:
        expected = bytearray(safe.status)
        if answer.status != safe.status:
            expected[self.arm - 1] = 1
            assert in_open_mode, "the end of open mode was asked for outside of it"
            self._count("exit asked")
        assert answer.status == bytes(expected), "status bytes"

    def _note(self, on: bool, modes: list[int]) -> None:
        """Closed axes end the barrier; a drive that is off, or an unknown mode, begins it."""
        if on and all(mode in (0, 10, 501) for mode in modes):
            self.barrier = False
        else:
            self.barrier = True

    def _refused(self, answer: oracle.Packet) -> bool:
        return any(answer.axes[slot].mode in REFUSALS for slot in self.slots)

    def _refusal(self, answer: oracle.Packet, safe: oracle.Packet) -> None:
        modes = [axis.mode for axis in answer.axes]
        drive_off = oracle.drive_off(answer)
        echoed = [axis.mode for axis in safe.axes]  # of a drive that is off: whatever it was
        reported = [k for k, mode in enumerate(modes) if mode in REFUSALS and mode != echoed[k]]
        one_508 = [modes[k] for k in reported] == [oracle.FOLLOWING_ERROR]
        assert drive_off or (one_508 and reported[0] in self.slots), modes
        for slot, (ours, theirs) in enumerate(zip(answer.axes, safe.axes, strict=True)):
            assert ours.mode == theirs.mode or slot in reported
            for word, wanted in zip(ours.d, theirs.d, strict=True):
                finite = np.isfinite(np.frombuffer(wanted, np.float32)[0])
                assert word == (wanted if finite else oracle.ZERO), "a target with a refusal"

    def _leaving(self, answer: oracle.Packet, safe: oracle.Packet, ready: list[bool]) -> None:
        for joint, (slot, up) in enumerate(zip(self.slots, ready, strict=True)):
            self.continuing[joint] &= up
            if not up:
                continue
            axis = answer.axes[slot]
            # An axis that was closed and is open again has its target, as when opening.
            if self.mode in POSITION_MODES and self.continuing[joint]:
                assert axis.floats[0] == np.float32(self.motor[joint]), "leaving: not held"
                assert axis.keep(1) == axis
            else:
                assert axis == safe.axes[slot]
        # Coming to rest must not be a jump.
        if self.mode in POSITION_MODES:
            self._advance(self.sent[-1], 1, 0.0)
        self._count("leaving")

    def _open(self, received: oracle.Packet, answer: oracle.Packet, record: np.void) -> None:
        r = np.array([received.axes[slot].floats for slot in self.slots]).T
        a = np.array([answer.axes[slot].floats for slot in self.slots]).T
        fields = MODE_FIELDS[self.mode]
        for slot in self.slots:
            axis = answer.axes[slot]
            assert axis.mode == self.mode, "another mode"
            assert axis == axis.keep(*fields), "a field that this mode has no use for"
        assert np.isfinite(a).all(), "not finite, and sent"
        assert (np.abs(r[2] - r[0]) <= self.threshold * (1 + 2e-6)).all(), "following error"
        assert (np.abs(r[4]) <= self.current * (1 + 2e-6)).all(), "current"
        first = self.motor is None
        if first:
            self._first(r)
        self._position(received, answer, a, r, record)
        self._count("first" if first else "set-point")

    def _first(self, r: np.ndarray) -> None:
        assert (np.abs(r[0] - r[2]) <= 0.1 * self.threshold).all(), "first set-point elsewhere"
        assert (np.abs(r[[1, 3]]) <= self.limits.standstill).all(), "first set-point in motion"

    def _position(
        self,
        received: oracle.Packet,
        answer: oracle.Packet,
        a: np.ndarray,
        r: np.ndarray,
        record: np.void,
    ) -> None:
        q = record["commanded_position"].copy()
        motor = self.train.motor_revolutions(q)
        rounding = 8 * EPS * np.maximum(1.0, np.abs(motor))
        if self.motor is None:
            for slot in self.slots:
                assert answer.axes[slot] == received.axes[slot].keep(1), "first: target, at rest"
            self.sent = [q, q, q, q]
            self.motors = []
            self.lag = 0
            self.lost = []
            self.repeats = 0
        else:
            rounding_of_target = 0.0
            if self.at_most > self.max_gap:
                self._resume_from_target(a, r)
                rounding_of_target = np.spacing(np.float32(np.abs(r[0])))
            assert (np.abs(r[2] - self.motor) <= self.threshold * (1 + 2e-6)).all(), "not there"
            near = np.concatenate((self.motors[-self.max_gap - 1 :], self._extrapolated()))
            nearest = np.abs(near - r[0]).min(axis=0)
            assert (nearest <= 0.1 * self.threshold * (1 + 1e-6)).all(), "a leap after losses"
            low = np.float32(motor - rounding)
            high = np.float32(motor + rounding)
            assert ((low <= a[0]) & (a[0] <= high)).all(), "sent and recorded differ"
            if np.array_equal(a, self.answered) and a[1].any():
                assert np.array_equal(q, self.sent[-1]), "sent again, and recorded otherwise"
                self._again(r[0], r[3])
                return
            if self.repeats:
                self._note_arm(r[3])
            if self.stopping and self.arm_share < 1.0:
                self._slow_down()
            step = motor - self.motor
            # Positions are compared in float64; both carry the rounding of their making.
            slack = 3 * rounding + np.spacing(np.float32(np.abs(a[1]))) + rounding_of_target
            assert (np.abs(a[1] - step) <= slack).all(), "D2 is not the step"
            self.sent.append(q)
        self._within(q)
        if self.motor is not None:
            self._count_lost(r[0])
        self.repeats = 0
        self.answered = a
        self.arm_share = 1.0
        self.motors = [*self.motors, motor][-(self.max_gap + 2) :]
        self.motor = motor
        del self.sent[:-3]

    def _resume_from_target(self, a: np.ndarray, r: np.ndarray) -> None:
        """After a long gap in which the controller led the motion, its target counts as sent.

        It carried the motion on, as fast as before or a little slower, or brought it to rest. A
        target that is the set-point sent last, but for rounding, does not say which.

        Args:
            a: (5, n) D1 to D5 of the answer.
            r: (5, n) the same of the packet.
        """
        begun = a[0] - a[1]  # where the step begins, by its own account
        off_target = np.abs(begun - r[0]).max()
        off_before = np.abs(begun - self.motor).max()
        rounding = np.spacing(np.float32(np.abs(a[0]).max()))
        step = self._last_step()
        standstill = self.limits.standstill
        again = self.answered is not None and np.array_equal(a, self.answered) and a[1].any()
        if again or not step.any() or off_target > off_before + rounding:
            return
        self.without_jerk_bound = min(2 * self.missed, round(0.03 / self.period)) + 2
        held = off_target <= rounding and not r[1].any()
        if off_target >= off_before and not held:
            return
        ahead = self.motor + np.arange(self.missed + 1)[:, None] * step
        off = np.abs(r[0] - ahead).max(axis=1)
        assert (np.abs(r[0] - ahead[off.argmin()]) <= 0.1 * self.threshold).all(), "off its way"
        slower = np.abs(r[1] - step) <= np.maximum(0.5 * np.abs(step), standstill) * (1 + 1e-6)
        assert slower.all() or (np.abs(r[1]) <= standstill).all(), "continues at another speed"
        self.motors = [r[0] - k * r[1] for k in (3, 2, 1, 0)]
        self.sent = [self.train.joint_position(row) for row in self.motors]
        self.motor = r[0]
        self._count("resumed from the target")

    def _extrapolated(self) -> np.ndarray:
        """(k, n) of a controller that extrapolates over missed packets, motor revolutions."""
        ahead = np.arange(1, min(self.missed, self.max_gap) + 1)[:, np.newaxis]
        return self.motor + ahead * self._last_step()

    def _last_step(self) -> np.ndarray:
        """(n,) of the set-points sent last, motor revolutions."""
        if len(self.motors) < 2:
            return np.zeros_like(self.motor)
        return self.motors[-1] - self.motors[-2]

    def _lag(self, target: np.ndarray) -> int:
        back = np.abs(np.array(self.motors[::-1]) - target)
        ahead = np.abs(self._extrapolated() - target).min(axis=0, initial=np.inf)
        # Where a joint turned, a target ahead may be near an older set-point.
        behind = (back[0] > self.limits.standstill) & (back.min(axis=0) <= ahead)
        return int(back.argmin(axis=0)[behind].max(initial=0))

    def _note_arm(self, velocity: np.ndarray) -> None:
        """Note the share of the last step at which the joint that slowed down least moves (D4)."""
        step = self._last_step()
        shares = [
            moved / sent
            for moved, sent in zip(velocity, step, strict=True)
            if abs(sent) > 4.0 * self.limits.standstill
        ]
        if shares and np.isfinite(shares).all():
            self.arm_share = min(self.arm_share, max(0.0, *shares))

    def _slow_down(self) -> None:
        """A stop after lost replies begins at the set-point sent last, no faster than the arm."""
        last = self.sent[-1]
        step = last - self.sent[-2]
        self.sent = [last - k * self.arm_share * step for k in (3, 2, 1, 0)]
        self.without_jerk_bound = max(self.without_jerk_bound, 2)
        self._count("slowed down")

    def _again(self, target: np.ndarray, velocity: np.ndarray) -> None:
        """Check a set-point sent again because it was not accepted: the motion waits."""
        lag = self._lag(target)
        assert lag > self.lag, "sent again although it was accepted"
        self._lose(1 if self.repeats else lag - self.lag)
        self._note_arm(velocity)
        self.repeats += 1
        self._count("again")

    def _count_lost(self, target: np.ndarray) -> None:
        """Count replies not accepted.

        The motion continues with a target further behind only in small steps or while stopping.
        """
        lag = self._lag(target)
        slow = np.abs(self._last_step()).max() <= 4.0 * self.limits.standstill * (1 + 1e-6)
        assert lag <= self.lag or slow or self.stopping or self.held, "a leap after lost answers"
        self._lose(max(0, lag - self.lag))
        self.lag = self.lag if self.repeats and not lag else lag

    def _lose(self, count: int) -> None:
        """Count replies not accepted: more than `max_gap` in `LOSS_WINDOW` cycles are a stop."""
        self.lost.append((self.cycle, count))
        self.lost = [loss for loss in self.lost if loss[0] > self.cycle - LOSS_WINDOW]
        self.stopping = self.stopping or sum(number for _, number in self.lost) > self.max_gap


SILENCE = 301.0
"""s: longer than any silence may last."""


class Judged:
    """A random conversation with a session: `set_up` once, then `deliver` each packet.

    Attributes:
        last: the packet answered afresh last, and its answer.
        now: s, when the packet delivered last arrived.
        source: requested last; counts in `asked` how often it was asked for a set-point.
    """

    source: Any = None

    def set_up(
        self,
        session: Session,
        ring: CycleRing,
        conduct: Conduct,
        *,
        n_axes: int,
        max_gap: int,
        silence: float,
        period: float,
        inits: Mapping[bytes, bool],
    ) -> None:
        """Start; `inits` are init packets, and whether the arm may be moved with them."""
        self.session = session
        self.ring = ring
        self.conduct = conduct
        self.reception = Reception(silence)
        self.max_gap = max_gap
        self._n_axes = n_axes
        self._period = period
        self._inits = inits
        self.now = 0.0
        self.last: tuple[bytes, bytes] | None = None
        self.unanswered = 0

    def deliver(self, packet: bytes, elapsed: float | None = None) -> bytes | None:
        """Deliver one packet and check its reply.

        Raises:
            AssertionError: a law is broken.
        """
        elapsed = self._period if elapsed is None else elapsed
        self.now += elapsed
        if elapsed > SILENCE:
            self.record_silence()
        before = self.ring.slot
        last = self.reception.last
        kind = self.reception.expect(packet)
        asked = self.source.asked if self.source is not None else 0
        reply = self.session.reply(packet, self.now)
        if self.source is not None and self.source.asked > asked:
            assert self.source.asked == asked + 1, "asked twice for one packet"
            assert kind == "cyclic" and self.conduct.all_open(packet), "asked with an axis closed"
        self.read_events()
        rows = self.ring.slot - before
        assert rows == (kind == "cyclic") or (kind == "cyclic" and rows < 0), "records"
        if kind == "nothing":
            assert reply is None, "an answer to what gets none"
            self.unanswered += 1
            return None
        assert reply is not None, f"no answer to {kind}"
        if kind == "again":
            assert self.last is not None and reply == self.last[1], "a duplicate answered otherwise"
            return reply
        self.last = packet, reply
        if kind == "cyclic":
            self._cyclic(packet, reply, last)
            return reply
        assert reply == oracle.echo(packet), "not an echo"
        self.conduct.interrupted()
        return reply

    def _cyclic(self, packet: bytes, reply: bytes, last: int) -> None:
        assert len(reply) == oracle.length(self._n_axes), "length"
        record = self.ring.last(1)[0]
        conduct = self.conduct
        # Packets that got no answer are gaps to the controller; numbers show most of them.
        conduct.judge(packet, reply, record, max(int(record["gap"]), self.unanswered))
        self.unanswered = 0
        missed = (number_of(packet) - last) % 0x7FFF - 1
        assert record["gap"] in (missed, 0), "the gap recorded"
        if all(axis.mode == 504 for axis in oracle.parse(packet, self._n_axes).axes):
            self.reception.ended = True

    def record_silence(self) -> None:
        """Record a silence longer than allowed."""
        if not self.reception.ended:
            self.reception.silent = self.reception.n_axes is not None
            self.conduct.interrupted()

    def read_events(self) -> None:
        """Read from events which motions ended and whether the arm can be moved."""
        for event in self.session.events():
            if isinstance(event, MotionEnded):
                self.conduct.entitled = False
                self.conduct.stopping = self.conduct.overridden = False
            if isinstance(event, InitReceived):
                self.conduct.usable = event.unusable is None
                fits = self._inits.get(event.init.encode())
                assert fits in (None, self.conduct.usable), "which arms are moved"
