"""Laws that hold in every run, whatever the fault: judged by bytes and records, not the guard."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers import (
    Counters,
    CycleRing,
    CyclicPacket,
    DriveTrain,
    GapSeen,
    Guard,
    GuardLimits,
    LinkLost,
    MotionEnded,
    Refused,
    RequestError,
    Session,
    SimulatedTransport,
    State,
    StateChanged,
    exchange,
)
from drivers.packets import DRIVE_ON, Mode, cyclic_length, is_init, next_number, packet_number
from planner import JointLimits, TrajectoryPlayer, plan
from sim_fixtures import Phase, SimulatedController
from sim_fixtures.faults import parse_fault, split_faults
from tests.fault_matrix import small_cell

Array = NDArray[np.float64]
Exchanged = Sequence[Sequence[Any]]  # Packets received, each with its answer or None

N: Final = small_cell.N
PERIOD: Final = 0.001
LIMITS: Final = JointLimits(
    lower=np.full(N, -2.0),
    upper=np.full(N, 2.0),
    velocity=np.array(small_cell.SPEED),
    acceleration=np.full(N, 30.0),
    jerk=np.full(N, 3000.0),
)
TOLERATED: Final = 4
"""Answers missing in a row that the controller puts up with; the next one ends open mode."""
MAX_GAP: Final = 2  # Of the session, by default
SESSION_THRESHOLD: Final = 0.6 * small_cell.FOLLOWING_ERROR
"""Narrower than the controller's own, so that the session is the first to notice."""
_ALLOWANCE: Final = 0.1 * SESSION_THRESHOLD
_STOP_FACTORS: Final = (1.0, 2.0, 3.0)
_ASKS: Final = {Mode.DRIVE_OFF_REQUEST, Mode.FOLLOWING_ERROR}
_OPEN: Final = [Mode.POSITION] * N
_FASTEST: Final = max(
    abs(ratio) * speed * PERIOD / (2.0 * np.pi)
    for ratio, speed in zip(small_cell.TABLE["gear_ratio"], small_cell.SPEED, strict=True)
)


def broken_on_the_wire(exchanged: Exchanged, fates: Counters) -> Iterator[str]:
    """Answers: one for each that gets one; set-points only for open axes with the drive on."""
    answered = sum(reply is not None for _, reply in exchanged)
    if answered != fates.answered + fates.duplicates:
        yield f"{answered} answers for {fates}"
    silent = len(exchanged) - answered
    if silent != fates.stale + fates.malformed + fates.ended:
        yield f"{silent} packets unanswered, but {fates}"
    for packet, reply in exchanged:
        if reply is None:
            continue
        if packet_number(reply) != next_number(packet_number(packet)):
            yield f"number {packet_number(reply)} in the answer to {packet_number(packet)}"
        if not is_init(packet) and len(packet) == cyclic_length(N):
            yield from _broken_in_answer(packet, reply)


def _broken_in_answer(packet: bytes, reply: bytes) -> Iterator[str]:
    received = CyclicPacket.decode(packet, N)
    answer = CyclicPacket.decode(reply, N)
    modes = received.axes["mode"].tolist()
    powered = received.status[0] == DRIVE_ON
    if _ASKS & set(answer.axes["mode"].tolist()):
        return
    ours, theirs = answer.axes["d"], received.axes["d"]
    if powered and modes == _OPEN:
        ahead = float(np.abs(ours[:, 0] - theirs[:, 0]).max())
        # Every target is one of the last MAX_GAP + 1 set-points, give or take a tenth of the
        # threshold, and the answer is the next of them.
        if not ahead <= (MAX_GAP + 1) * 1.01 * _FASTEST + _ALLOWANCE:
            yield f"a set-point {ahead} motor revolutions from the controller's target"
        return
    for axis in range(N):
        is_open = powered and modes[axis] == Mode.POSITION
        same = ours[axis].view(np.int32) == theirs[axis].view(np.int32)
        if not is_open and not np.all(same | (ours[axis] == 0.0)):
            yield f"set-point {ours[axis]} for closed axis {axis + 1}, not {theirs[axis]}"


def broken_in_records(records: NDArray[np.void], still: slice | None) -> Iterator[str]:
    """Records (m,) keep the bounds; none moves in `still`, between a loss and the next request."""
    sent = np.isfinite(records["commanded_position"]).all(axis=1)
    may = (records["mode"] == Mode.POSITION).all(axis=1) & (records["status"] == DRIVE_ON)
    if np.any(sent & ~may):
        yield f"set-points in {int(np.sum(sent & ~may))} cycles without open mode"
    if still is not None and np.any(np.nan_to_num(records["commanded_velocity"][still])):
        yield "set-points that move after the motion was lost or refused"
    for first, last in _stretches(sent & (records["state"] != State.OPENING)):
        rows = records[first:last]
        v = rows["commanded_velocity"]
        # After a long gap a motion goes on from the controller's target, and at its velocity.
        carried = np.flatnonzero((rows["gap"][1:] > MAX_GAP) & v[:-1].any(axis=1)) + 1
        for number, part in enumerate(np.split(rows, carried)):
            yield from _broken_bounds(part, int(part["gap"][0]) if number else 0)


def _broken_bounds(rows: NDArray[np.void], carried: int) -> Iterator[str]:
    """Of a motion from rest, or from where the controller carried it by so many steps."""
    q, v = rows["commanded_position"], rows["commanded_velocity"]
    if np.any(q < LIMITS.lower) or np.any(q > LIMITS.upper):
        yield "a set-point outside the joints' range"
    same = (np.diff(q, axis=0, prepend=np.nan) == 0.0).all(axis=1)
    # What the controller did not take is sent again, with its velocity: no step of the motion.
    q = q[~(same & v.any(axis=1))]
    before = np.tile(q[:1], (3, 1))
    if carried:
        step = PERIOD * rows["target_velocity"][0]
        before = rows["target_position"][0] - np.arange(2.0, -1.0, -1.0)[:, None] * step
    q = np.vstack((before, q))
    bounds = (LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk)
    for order, (bound, factor) in enumerate(zip(bounds, _STOP_FACTORS, strict=True), start=1):
        rates = np.abs(np.diff(q, order, axis=0)) / PERIOD**order
        # The controller's own steps have no acceleration: it comes back in a few cycles.
        free = min(2 * carried, round(0.03 / PERIOD)) + 2 if carried and order == 3 else 0
        rate = rates[free:].max(axis=0, initial=0.0)
        if np.any(rate > bound * factor * (1.0 + 1e-5)):
            yield f"derivative {order} of the set-points is {rate}, allowed is {bound * factor}"


def _stretches(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(int)))
    yield from zip(edges[::2], edges[1::2], strict=True)


SILENCE: Final = 0.1
AT_REST: Final = 1e-3
"""rad/s below which the arm stands: 1/2000 of its full speed, while integral parts unwind."""
WAY: Final = np.array([0.3, 0.375])

FAULTS: Final[Mapping[str, str]] = {
    "packet lost": "lose@{c}",
    "3 packets lost": "lose@{c}x3",
    "5 packets lost": "lose@{c}x5",
    "link dead for 0.2 s": "lose@{c}x200",
    "answer lost": "lose@{c}:to_controller",
    "3 answers lost": "lose@{c}x3:to_controller",
    "5 answers lost": "lose@{c}x5:to_controller",
    "packet late": "delay@{c}:0.5cycles",
    "packet past its cycle": "delay@{c}:1.5cycles",
    "answer late": "delay@{c}:0.5cycles:to_controller",
    "answer past its cycle": "delay@{c}:1.5cycles:to_controller",
    "packet doubled": "duplicate@{c}",
    "answer doubled": "duplicate@{c}:to_controller",
    "packets swapped": "reorder@{c}",
    "answers swapped": "reorder@{c}:to_controller",
    "number a little ahead": "corrupt@{c}:offset=0:mask={ahead}",
    "number far ahead": "corrupt@{c}:offset=1:mask=0x10",
    "status corrupted": "corrupt@{c}:offset=4",
    "mode corrupted": "corrupt@{c}:offset=12",
    "target corrupted": "corrupt@{c}:offset=19:mask=0x40",
    "position corrupted": "corrupt@{c}:offset=27:mask=0x40",
    "answer's number corrupted": "corrupt@{c}:offset=0:mask=0x40:to_controller",
    "answer's status corrupted": "corrupt@{c}:offset=4:mask=0x01:to_controller",
    "answer's mode corrupted": "corrupt@{c}:offset=12:to_controller",
    "answer's target corrupted": "corrupt@{c}:offset=19:mask=0x40:to_controller",
    "cold restart": "restart@{c}:cold",
    "warm restart": "restart@{c}:warm",
    "drive drop": "drive-drop@{c}",
    "emergency stop": "e-stop@{c}",
    "axis leaves open mode": "axis-leaves@{c}:axis=2",
    "axis jams": "following-error@{c}x300:axis=1",
    "encoder slips": "following-error@{c}x100:axis=2:slip",
    "current near its limit": "saturate@{c}x100:axis=1",
    "pause 502": "pause@{c}x20:502",
    "pause 500": "pause@{c}x20:500",
}  # Each fault as the command line takes it, {c} for the cycle

SITUATIONS: Final = (
    *("sync", "init packet", "init", "drive off", "driving on"),
    *("closed", "opening", "open at rest", "moving", "exiting"),
)
ANSWER_MISSING: Final = frozenset(
    name for name in FAULTS if "lost" in name or "past" in name or "swap" in name or "dead" in name
) | {"number a little ahead", "answer's number corrupted"}
"""Faults after which the controller is without an answer, so that what it does then matters."""
BEHAVIOURS: Final = ("hold", "continue", "drive_off")
"""What the controller may do while it is without an answer."""
HAS_OPEN_AXES: Final = ("opening", "open at rest", "moving", "exiting")


_SHORT: Final[Mapping[str, str]] = {
    "the controller started over": "restart",
    "the controller started anew": "restart",
    "the drive went off": "drive off",
    "the drive was switched on again": "drive off",
    "the controller closed open mode": "closed",
    "the controller paused the exchange": "pause",
    "the controller reports a mode that is not known here": "mode",
    "nothing was heard from the controller": "silence",
}


def motion(start: Array, way: Array, share: float = 1.0) -> TrajectoryPlayer:
    limits = replace(LIMITS, velocity=share * LIMITS.velocity)
    path = plan(np.vstack((start, start + way)), limits, fly=0.0)
    return TrajectoryPlayer(path, PERIOD, LIMITS, start_tolerance=5e-3)


def session(
    current_share: float = 1.0,
    following_error: float = SESSION_THRESHOLD,
    period: float = PERIOD,
    **options: Any,
) -> Session:
    table: dict[str, Any] = {name: np.array(value) for name, value in small_cell.TABLE.items()}
    limits = GuardLimits(
        LIMITS.lower, LIMITS.upper, LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk,
        np.full(N, following_error), current_share * table["current_limit"],
    )  # fmt: skip
    ring = CycleRing(N, 8192)
    return Session(DriveTrain(**table), Guard(limits, period), ring, settle_cycles=10, **options)


class Watched:
    """A transport that remembers what went over it."""

    def __init__(self, transport: SimulatedTransport) -> None:
        self._transport = transport
        self.exchanged: list[list[Any]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def receive(self, timeout: float) -> bytes | None:
        packet = self._transport.receive(timeout)
        if packet is not None:
            self.exchanged.append([packet, None])
        return packet

    def send(self, packet: bytes) -> None:
        assert self.exchanged[-1][1] is None, "answered twice"
        self.exchanged[-1][1] = packet
        self._transport.send(packet)


@dataclass
class Run:
    """One session with one fault.

    Attributes:
        outcome: what came of the motion requested before the fault, or of open mode without one.
    """

    controller: SimulatedController
    requested_first: bool
    current_share: float = 1.0
    speed: float = 1.0  # share of full speed that the first motion is planned with
    moving: float = 0.75
    outcome: str = ""
    recovery: str = ""  # what came of a motion requested after it, once the drive was on again
    broken: list[str] = field(default_factory=list)  # laws that were broken, in words
    cycles: dict[str, int] = field(default_factory=dict)  # first cycle of each situation

    def __post_init__(self) -> None:
        self.session = session(self.current_share, max_gap=MAX_GAP, silence_timeout=SILENCE)
        self.events: list[Any] = []
        self._still_from: int | None = None
        self._still_until: int | None = None

    def play(self, faults: tuple[Any, ...], fault_cycle: int = 0, over: int = 0) -> None:
        """The whole run: the first motion, the fault, what follows, a motion afterwards."""
        self._over = over
        self.transport = SimulatedTransport(self.controller, faults)
        self.link = Watched(self.transport)
        if self.requested_first:
            self.session.request(motion(np.array(small_cell.HOME), WAY, self.speed))
        patience = fault_cycle + 150
        self._go_on(lambda: self.transport.cycle > patience and self._calm(), 1500)
        self.outcome = self._describe()
        self._check_calm()
        if self.session.state is not State.ENDED and self.controller.phase is not Phase.ENDED:
            self.recovery = self._recover()
        self.broken += broken_on_the_wire(self.link.exchanged, self.session.counters)
        still = None if self._still_from is None else slice(self._still_from, self._still_until)
        self.broken += broken_in_records(self.session._ring.last(8192), still)

    def _go_on(self, until: Callable[[], bool], limit: int) -> None:
        end = self.transport.cycle + limit

        def done() -> bool:
            self._note_events()
            if not self._over:
                self._note_situation()
            return until() or self.transport.cycle >= end

        exchange(self.link, self.session, until=done)
        self._note_events()

    @property
    def _written(self) -> int:
        return self.session._ring._written

    def _note_events(self) -> None:
        fresh = self.session.events()
        self.events += fresh
        for event in fresh:
            if isinstance(event, MotionEnded) and event.outcome in ("lost", "refused"):
                self._still_from = self._still_from or self.session._ring._written

    def _note_situation(self) -> None:
        state = self.session.state
        name = state.name.lower().replace("_", " ")
        if state is State.OPEN:
            if self.session.requested:
                speed = np.abs(self.session._ring.last(1)["commanded_velocity"][0])
                name = "moving" if np.all(speed > self.moving * LIMITS.velocity) else "under way"
            else:
                name = "open at rest"
        self.cycles.setdefault(name, self.transport.cycle)

    def _calm(self) -> bool:
        """The motion, if one was requested, has ended or cannot begin by itself."""
        waiting = self.session.state in (State.DRIVE_OFF, State.SYNC)
        return waiting or not self.session.requested

    def _describe(self) -> str:
        if self.controller.phase is Phase.ENDED:
            return "no start"
        gaps = sum(event.missed for event in self.events if isinstance(event, GapSeen))
        note = "" if not gaps else f" ({gaps})" if gaps <= TOLERATED + 1 else " (many)"
        return self._fate() + note

    def _fate(self) -> str:
        """The first thing that came of it."""
        for event in self.events:
            if isinstance(event, Refused):
                return f"{self._asked_for()} {type(event.error).__name__}"
            if isinstance(event, MotionEnded):
                lost = event.outcome == "lost"
                return f"lost: {_SHORT[event.reason]}" if lost else event.outcome
            if not self.requested_first and isinstance(event, LinkLost):
                return "silence"
            if not self.requested_first and _leaves_open(event):
                return "closed"
        return "waits" if self.session.requested else "open"

    def _asked_for(self) -> str:
        """What the first answer asks for that is no set-point: 505 on all axes, or 508 on one."""
        for _, reply in self.link.exchanged:
            if reply is not None and len(reply) == cyclic_length(N):
                modes = CyclicPacket.decode(reply, N).axes["mode"].tolist()
                if modes == [Mode.DRIVE_OFF_REQUEST] * N:
                    return "505"
                if modes.count(Mode.FOLLOWING_ERROR) == 1:
                    return "508"
        return "nothing asked for"

    def _recover(self) -> str:
        """Somebody presses the button, and a new motion is asked for if none is waiting."""
        self._go_on(lambda: self.transport.cycle >= self._over + 50, 500)
        self.controller.drive_on()
        before = len(self.events)
        if self.session.requested and self.session.state is State.OPENING:
            self.session.stop("somebody lost patience")
            self._go_on(lambda: self.session.state is State.CLOSED, 200)
        if not self.session.requested:
            self._go_on(self._ready, 1500)
            self._still_until = self._written
            try:
                self.session.request(motion(self.controller.plant.position.copy(), -0.4 * WAY))
            except RequestError as error:
                return f"no: {error}"
        self._go_on(lambda: not self.session.requested, 2500)
        ends = [event for event in self.events[before:] if isinstance(event, MotionEnded)]
        return f"{ends[-1].outcome}: {ends[-1].reason}" if ends else self.session.state.name

    def _ready(self) -> bool:
        ready = (State.CLOSED, State.OPENING, State.OPEN)
        return self.session.state in ready and self._speed() < AT_REST

    def _speed(self) -> float:
        return float(np.abs(self.controller.plant.velocity).max())

    def _check_calm(self) -> None:
        """After the outcome the arm comes to rest, and stays there."""
        rested = 0

        def long_at_rest() -> bool:
            nonlocal rested
            rested = rested + 1 if self._speed() < AT_REST else 0
            return rested >= 60

        if self.session.state is not State.ENDED and self.controller.phase is not Phase.ENDED:
            self._go_on(long_at_rest, 900)
            if not self.session.requested and rested < 60:
                self.broken.append(f"the arm does not come to rest: {self._speed():.4f} rad/s")
        elif self._speed() >= AT_REST:
            self.broken.append(f"the session ended on a moving arm: {self._speed():.4f} rad/s")


def _leaves_open(event: Any) -> bool:
    by_itself = isinstance(event, StateChanged) and event.after is not State.FAULTED
    return by_itself and event.before is State.OPEN


def controller(
    while_silent: str, tolerated: int = TOLERATED, **changes: Any
) -> SimulatedController:
    return small_cell.controller(
        missed_replies=tolerated + 1,
        while_silent=while_silent,
        ramp_time=0.1,
        boot_time=1.5 * SILENCE,
        driving_on_cycles=8,
        drive_off_cycles=8,
        closed_cycles=8,
        **changes,
    )


@cache
def cycles_without_a_fault(requested_first: bool) -> Mapping[str, int]:
    """First cycle of each situation."""
    run = Run(controller("hold"), requested_first)
    run.play(())
    expected = "completed" if requested_first else "open"
    assert run.outcome == expected, run.outcome
    assert not run.broken, run.broken
    # packet 9 is the init packet; the others strike in the packet after the first of a situation
    return {**run.cycles, "sync": 2, "init packet": 9}


def play(fault: str, situation: str, while_silent: str = "hold") -> Run:
    """Let a fault strike in a situation."""
    requested_first = situation != "open at rest"
    cycle = cycles_without_a_fault(requested_first)[situation]
    number = cycle + 1
    ahead = next(bit for bit in (8, 16, 32, 64) if not number & bit)
    parsed = parse_fault(FAULTS[fault].format(c=cycle, ahead=ahead))
    of_link, of_controller = split_faults([parsed])
    # the servo never asks for more than the controller's limit; the cell's is narrower here
    share = 0.8 if fault == "current near its limit" else 1.0
    run = Run(controller(while_silent, faults=of_controller), requested_first, share)
    run.play(of_link, cycle, cycle + getattr(parsed, "count", 1))
    return run


def behaviours(fault: str, situation: str) -> tuple[str, ...]:
    """What the controller may do meanwhile, where that makes a difference."""
    matters = fault in ANSWER_MISSING and situation in HAS_OPEN_AXES
    return BEHAVIOURS if matters else BEHAVIOURS[:1]


def cases() -> Iterator[tuple[str, str, str]]:
    for fault in FAULTS:
        for situation in SITUATIONS:
            for behaviour in behaviours(fault, situation):
                yield fault, situation, behaviour


SPEEDS: Final = (0.25, 0.5, 0.8, 1.0)
"""Shares of full speed at which packets and answers are lost in a row."""
FAULTS_AT_SPEED: Final = ("3 packets lost", "5 packets lost", "3 answers lost", "5 answers lost")
PATIENT: Final = 12  # Answers missing in a row that the controller puts up with in these runs


def play_at(fault: str, speed: float, while_silent: str) -> Run:
    """Let packets or answers be lost where the motion has reached a share of full speed."""

    def run(of_link: tuple[Any, ...], cycle: int) -> Run:
        moving = controller(while_silent, PATIENT)
        made = Run(moving, True, speed=speed, moving=0.99 * speed)
        made.play(of_link, cycle, cycle)
        return made

    cycle = run((), 0).cycles["moving"]
    return run(split_faults([parse_fault(FAULTS[fault].format(c=cycle))])[0], cycle)
