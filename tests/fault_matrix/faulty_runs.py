"""Every fault in every situation of a session, judged as the session's own tests are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from traceback import extract_tb
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from drivers import (
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
from drivers.c4g_packets import Mode, cyclic_length
from drivers.errors import GuardError
from planner import JointLimits, TrajectoryPlayer, plan
from sim_fixtures import Phase, SimulatedController
from sim_fixtures.faults import split_faults
from tests.drivers.judge import Conduct, Judged
from tests.fault_matrix import small_cell
from tests.faults import parse_script
from tests.laws.evidence import Broken, Evidence, Rest
from tests.laws.table import broken

Array = NDArray[np.float64]

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
"""Replies missing in a row that the controller puts up with; the next one ends open mode."""
MAX_GAP: Final = 2  # Of the session, by default
SESSION_THRESHOLD: Final = 0.6 * small_cell.FOLLOWING_ERROR
"""Narrower than the controller's own, so that the session is the first to notice."""


SILENCE: Final = 0.1
AT_REST: Final = 1e-3
"""rad/s below which the arm stands: 1/2000 of its full speed, while integral parts unwind."""
WAY: Final = np.array([0.3, 0.375])

FAULTS: Final[Mapping[str, str]] = {
    "packet lost": "lose@{c}",
    "3 packets lost": "lose@{c}x3",
    "5 packets lost": "lose@{c}x5",
    "link dead for 0.2 s": "lose@{c}x200",
    "reply lost": "lose@{c}:to_controller",
    "3 replies lost": "lose@{c}x3:to_controller",
    "5 replies lost": "lose@{c}x5:to_controller",
    "packet late": "delay@{c}:0.5cycles",
    "packet past its cycle": "delay@{c}:1.5cycles",
    "reply late": "delay@{c}:0.5cycles:to_controller",
    "reply past its cycle": "delay@{c}:1.5cycles:to_controller",
    "packet doubled": "duplicate@{c}",
    "reply doubled": "duplicate@{c}:to_controller",
    "packets swapped": "reorder@{c}",
    "replies swapped": "reorder@{c}:to_controller",
    "number a little ahead": "corrupt@{c}:offset=0:mask={ahead}",
    "number far ahead": "corrupt@{c}:offset=1:mask=0x10",
    "status corrupted": "corrupt@{c}:offset=4",
    "mode corrupted": "corrupt@{c}:offset=12",
    "target corrupted": "corrupt@{c}:offset=19:mask=0x40",
    "position corrupted": "corrupt@{c}:offset=27:mask=0x40",
    "reply's number corrupted": "corrupt@{c}:offset=0:mask=0x40:to_controller",
    "reply's status corrupted": "corrupt@{c}:offset=4:mask=0x01:to_controller",
    "reply's mode corrupted": "corrupt@{c}:offset=12:to_controller",
    "reply's target corrupted": "corrupt@{c}:offset=19:mask=0x40:to_controller",
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
) | {"number a little ahead", "reply's number corrupted"}
"""Faults after which the controller is without a reply, so that what it does then matters."""
BEHAVIOURS: Final = ("hold", "continue", "drive_off")
"""What the controller may do while it is without a reply."""
HAS_OPEN_AXES: Final = ("opening", "open at rest", "moving", "exiting")


_SHORT: Final[Mapping[str, str]] = {
    "the controller restarted: it sent a sync packet": "restart",
    "the controller restarted: it sent an init packet": "restart",
    "the controller restarted: sync packets are missing": "restart",
    "the drive went off": "drive off",
    "the drive was switched on again": "drive off",
    "the controller closed open mode": "closed",
    "the controller paused the exchange": "pause",
    "the controller reports an unknown mode": "mode",
    "nothing was received from the controller": "silence",
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


class LoggedSession:
    """A session that stores its replies, and returns its events twice."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.replies: list[bytes] = []
        self.pending: list[Any] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def reply(self, packet: bytes, now: float) -> bytes | None:
        reply = self._session.reply(packet, now)
        self.replies.append(reply or b"")
        return reply

    def events(self) -> list[Any]:
        events = self._session.events()
        self.pending += events
        return events


class JudgedSession(Judged):
    """A session whose packets, replies and records are judged; `broken` is the first broken law."""

    def __init__(self, logged: LoggedSession, limits: GuardLimits) -> None:
        conduct = Conduct(
            limits, logged.drive_train, Mode.POSITION, 1, tuple(range(N)), (1,) * N,
            threshold=limits.following_error, current=limits.current, period=PERIOD,
            max_gap=MAX_GAP,
        )  # fmt: skip
        self.set_up(
            logged._session, logged._ring, conduct, n_axes=N, max_gap=MAX_GAP, silence=SILENCE,
            period=PERIOD, inits={},
        )  # fmt: skip
        self.session = self._logged = logged  # type: ignore[assignment]
        self.broken: list[str] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._logged, name)

    def reply(self, packet: bytes, now: float) -> bytes | None:
        if self.broken:
            return self._logged.reply(packet, now)
        self._silent_by(now)
        try:
            self.deliver(packet, now - self.now)
        except AssertionError as error:
            line = extract_tb(error.__traceback__)[-1].line
            self.broken.append(str(error).partition("\n")[0] or str(line))
        return self._logged.replies[-1] or None

    def tick(self, now: float) -> None:
        self._silent_by(now)
        self._logged.tick(now)

    def _silent_by(self, now: float) -> None:
        if now >= self._logged.deadline:
            self.record_silence()

    def events(self) -> list[Any]:
        self.read_events()
        events = self._logged.pending
        self._logged.pending = []
        return events

    def request(self, source: TrajectoryPlayer) -> None:
        self._logged.request(source)
        self.conduct.entitled = True
        self.conduct.stopping = False

    def stop(self, reason: str) -> None:
        self._logged.stop(reason)
        self.read_events()
        self.conduct.stopping = self.conduct.entitled


@dataclass
class Run:
    """One session with one fault.

    `outcome` is of the motion requested before the fault, or of open mode without one; `recovery`
    of a motion requested afterwards with the drive on.
    """

    controller: Any
    requested_first: bool
    current_share: float = 1.0
    speed: float = 1.0  # share of full speed that the first motion is planned with
    moving: float = 0.75
    outcome: str = ""
    recovery: str = ""  # what came of a motion requested after it, once the drive was on again
    rests: list[Rest] = field(default_factory=list)  # when the arm had to be at rest
    cycles: dict[str, int] = field(default_factory=dict)  # first cycle of each situation

    def __post_init__(self) -> None:
        self.session = self._make_session()
        self.events: list[Any] = []

    def _make_session(self) -> Any:
        made = session(self.current_share, max_gap=MAX_GAP, silence_timeout=SILENCE)
        self.logged = LoggedSession(made)
        return JudgedSession(self.logged, made._guard.limits)

    def _first_motion(self) -> TrajectoryPlayer:
        return motion(np.array(small_cell.HOME), WAY, self.speed)

    def _motion_afterwards(self) -> TrajectoryPlayer:
        return motion(self.controller.plant.position.copy(), -0.4 * WAY)

    @property
    def _no_controller(self) -> bool:
        """Whether the controller has ended the session."""
        return self.controller.phase is Phase.ENDED

    def _make_ready(self) -> None:
        """Do what a person does at the cabinet after a fault."""
        self.controller.drive_on()

    def _speed(self) -> float:
        return float(np.abs(self.controller.plant.velocity).max())

    def _is_fast(self, speed: Array) -> bool:
        """Whether the set-points have the speed at which a fault strikes a motion."""
        return bool(np.all(speed > self.moving * LIMITS.velocity))

    def _lost(self, reason: str) -> str:
        """Why a motion was lost, in short."""
        return _SHORT[reason]

    def _operate(self) -> None:
        """Do what an operator does meanwhile."""

    def play(self, faults: tuple[Any, ...], fault_cycle: int = 0, over: int = 0) -> None:
        """The whole run: the first motion, the fault, what follows, a motion afterwards."""
        self._over = over
        self.transport = SimulatedTransport(self.controller, faults)
        if self.requested_first:
            self.session.request(self._first_motion())
        patience = fault_cycle + 150
        self._exchange(lambda: self.transport.cycle > patience and self._calm(), 1500)
        self.outcome = self._describe()
        self._check_calm()
        if self.session.state is not State.ENDED and not self._no_controller:
            self.recovery = self._recover()

    @property
    def broken(self) -> list[Broken]:
        """Laws that were broken."""
        return broken(Evidence(rests=tuple(self.rests), session=tuple(self.session.broken)))

    def _exchange(self, until: Callable[[], bool], limit: int) -> None:
        end = self.transport.cycle + limit

        def done() -> bool:
            self._note_events()
            if not self._over:
                self._note_situation()
            self._operate()
            return until() or self.transport.cycle >= end

        exchange(self.transport, cast(Session, self.session), ends_when=done)
        self._note_events()

    def _note_events(self) -> None:
        self.events += self.session.events()

    def _note_situation(self) -> None:
        state = self.session.state
        name = state.name.lower().replace("_", " ")
        if state is State.OPEN:
            if self.session.requested:
                speed = np.abs(self.session._ring.last(1)["commanded_velocity"][0])
                name = "moving" if self._is_fast(speed) else "under way"
            else:
                name = "open at rest"
        self.cycles.setdefault(name, self.transport.cycle)

    def _calm(self) -> bool:
        """The motion, if one was requested, has ended or cannot begin by itself."""
        waiting = self.session.state in (State.DRIVE_OFF, State.SYNC)
        return waiting or not self.session.requested

    def _describe(self) -> str:
        if self._no_controller:
            return "no start"
        gaps = sum(event.missed for event in self.events if isinstance(event, GapSeen))
        note = "" if not gaps else f" ({gaps})" if gaps <= TOLERATED + 1 else " (many)"
        return self._fate() + note

    def _fate(self) -> str:
        """The first relevant event."""
        for event in self.events:
            if isinstance(event, Refused):
                error = event.error
                kind = error.check.name if isinstance(error, GuardError) else type(error).__name__
                return f"{self._asked_for()} {kind}"
            if isinstance(event, MotionEnded):
                lost = event.outcome == "lost"
                return f"lost: {self._lost(event.reason)}" if lost else event.outcome
            if not self.requested_first and isinstance(event, LinkLost):
                return "silence"
            if not self.requested_first and _leaves_open(event):
                return "closed"
        return "waits" if self.session.requested else "open"

    def _asked_for(self) -> str:
        """The request in the first reply without a set-point: 505 on all axes, or 508 on one."""
        for reply in self.logged.replies:
            if len(reply) == cyclic_length(N):
                modes = CyclicPacket.decode(reply, N).axes["mode"].tolist()
                if modes == [Mode.DRIVE_OFF_REQUEST] * N:
                    return "505"
                if modes.count(Mode.FOLLOWING_ERROR) == 1:
                    return "508"
        return "nothing asked for"

    def _recover(self) -> str:
        """Switch the drive on, request a new motion if none is waiting, and return its outcome."""
        self._exchange(lambda: self.transport.cycle >= self._over + 50, 500)
        self._make_ready()
        before = len(self.events)
        if self.session.requested and self.session.state is State.OPENING:
            self.session.stop("it was not started")
            self._exchange(lambda: self.session.state is State.CLOSED, 200)
        if not self.session.requested:
            self._exchange(self._ready, 1500)
            try:
                self.session.request(self._motion_afterwards())
            except RequestError as error:
                return f"no: {error}"
        self._exchange(lambda: not self.session.requested, 2500)
        ends = [event for event in self.events[before:] if isinstance(event, MotionEnded)]
        return f"{ends[-1].outcome}: {ends[-1].reason}" if ends else self.session.state.name

    def _ready(self) -> bool:
        ready = (State.CLOSED, State.OPENING, State.OPEN)
        return self.session.state in ready and self._speed() < AT_REST

    def _check_calm(self) -> None:
        """After the outcome the arm comes to rest, and stays there."""
        rested = 0

        def long_at_rest() -> bool:
            nonlocal rested
            rested = rested + 1 if self._speed() < AT_REST else 0
            return rested >= 60

        if self.session.state is not State.ENDED and not self._no_controller:
            self._exchange(long_at_rest, 900)
            if not self.session.requested and rested < 60:
                self.rests.append(Rest("900 cycles after its motion", self._speed(), 0.0))
        else:
            self.rests.append(Rest("where the session ended", self._speed(), AT_REST))


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
    ((_, parsed),) = parse_script([FAULTS[fault].format(c=cycle, ahead=ahead)]).faults
    of_link, of_controller = split_faults([parsed])
    # the servo never asks for more than the controller's limit; the cell's is narrower here
    share = 0.8 if fault == "current near its limit" else 1.0
    run = Run(controller(while_silent, faults=of_controller), requested_first, share)
    run.play(of_link, cycle, cycle + getattr(parsed, "count", 1))
    return run


def behaviours(fault: str, situation: str) -> tuple[str, ...]:
    """Reactions of the controller to a missing reply, where they make a difference."""
    matters = fault in ANSWER_MISSING and situation in HAS_OPEN_AXES
    return BEHAVIOURS if matters else BEHAVIOURS[:1]


def cases() -> Iterator[tuple[str, str, str]]:
    for fault in FAULTS:
        for situation in SITUATIONS:
            for behaviour in behaviours(fault, situation):
                yield fault, situation, behaviour


SPEEDS: Final = (0.25, 0.5, 0.8, 1.0)
"""Shares of full speed at which packets and replies are lost in a row."""
FAULTS_AT_SPEED: Final = ("3 packets lost", "5 packets lost", "3 replies lost", "5 replies lost")
PATIENT: Final = 12  # Replies missing in a row that the controller puts up with in these runs


def play_at(fault: str, speed: float, while_silent: str) -> Run:
    """Let packets or replies be lost where the motion has reached a share of full speed."""

    def run(of_link: tuple[Any, ...], cycle: int) -> Run:
        moving = controller(while_silent, PATIENT)
        made = Run(moving, True, speed=speed, moving=0.99 * speed)
        made.play(of_link, cycle, cycle)
        return made

    cycle = run((), 0).cycles["moving"]
    ((_, lost),) = parse_script([FAULTS[fault].format(c=cycle)]).faults
    return run(split_faults([lost])[0], cycle)
