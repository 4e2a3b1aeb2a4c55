"""A session under any conversation: nothing raised, nothing past the guard, one answer each."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from drivers import (
    CycleRing,
    DriveTrain,
    Guard,
    GuardLimits,
    InitPacket,
    RequestError,
    Session,
    State,
)
from tests.drivers import oracle
from tests.drivers.judge import POSITION_MODES, Conduct, Judged
from tests.drivers.oracle import number_of
from tests.drivers.rig import limits, train_of
from tests.drivers.sources import (
    FAULTS,
    WILD,
    Breaks,
    ScriptedMotion,
    smooth,
)
from tests.fuzz.draw import Draw, mutate_bytes
from tests.fuzz.targets import Target


class Controller:
    """A controller's side as far as packets show it; its attributes can be set to misbehave.

    Args:
        train: of the arm.
        start: where it stands at first.
        arm: its number, from 1.
        n_axes: slots of a packet.
        slots: slot of each joint.
    """

    def __init__(
        self,
        train: DriveTrain,
        start: NDArray[np.float64],
        *,
        arm: int,
        n_axes: int,
        slots: Sequence[int],
    ) -> None:
        self._train = train
        self._arm = arm
        self._n_axes = n_axes
        self._slots = slots
        self.number = 0
        self.status = [0, 0, 0, 0]
        self.status[arm - 1] = oracle.DRIVE_ON
        self.modes = [0] * n_axes
        self.d = np.zeros((n_axes, 8), np.float32)
        self.put_arm_at(start)
        self.exit_asked = False

    def put_arm_at(self, q: NDArray[np.float64]) -> None:
        motor = self._train.motor_revolutions(q)
        for slot, value in zip(self._slots, motor, strict=True):
            self.d[slot, [0, 2]] = value
            self.d[slot, [1, 3, 4]] = 0.0, 0.0, 0.5

    def wanted(self, mode: int) -> None:
        """All axes of the arm in a mode."""
        for slot in self._slots:
            self.modes[slot] = mode

    def packet(self) -> bytes:
        self.number = oracle.answer_number(self.number)
        axes = tuple(
            oracle.Axis(mode, tuple(bytes(word) for word in row.view("V4")))
            for mode, row in zip(self.modes, self.d, strict=True)
        )
        return oracle.build(oracle.Packet(self.number, bytes(self.status), bytes(4), axes))

    def obey(self, reply: bytes, mode: int) -> None:
        """Follow the reply; close the axes on its request."""
        answer = oracle.parse(reply, self._n_axes)
        refused = any(axis.mode in (505, 508) for axis in answer.axes)
        if refused or answer.status[self._arm - 1] == 1:
            self.wanted(0)
            self.d[:, [1, 3]] = 0.0
        elif mode in POSITION_MODES:
            for slot in self._slots:
                if self.modes[slot] == mode:
                    position, step = answer.axes[slot].floats[:2]
                    self.d[slot, :4] = position, step, position, step


CYCLE_MS = 2
"""Of every arm: the tables of motions are made for it, and would be too fast in a shorter one."""


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm and where its axes stand in a packet."""

    n: int  # joints
    number: int  # of the arm, from 1
    axes: tuple[tuple[int, int], ...]  # (arm from 1, axis from 0) of each slot
    period: float  # of the controller [s]
    train: DriveTrain  # drive train
    limits: GuardLimits  # of the guard
    init: bytes  # the init packet that fits
    other: bytes  # one whose gear ratios are another arm's

    @property
    def middle(self) -> np.ndarray:
        """Joints (n,) [rad] within their range, each elsewhere."""
        return np.linspace(-0.5, 0.5, self.n)

    @property
    def slots(self) -> tuple[int, ...]:
        return tuple(self.axes.index((self.number, joint)) for joint in range(self.n))

    @property
    def arms(self) -> tuple[int, ...]:
        return tuple(arm for arm, _ in self.axes)


@lru_cache(maxsize=64)
def arm_of(n: int, number: int, order: int, foreign: int) -> Arm:
    """An arm of `n` joints among `foreign` axes that are not its own, in a drawn order."""
    arm_axes = [(number, joint) for joint in range(n)]
    others = [(number, 9), (number % 4 + 1, 0), (number % 4 + 1, 3)][:foreign]
    mixed = np.random.default_rng(order).permutation(n + foreign) if order else range(n + foreign)
    axes = tuple((arm_axes + others)[k] for k in mixed)
    train = train_of(n)
    made = [init_of(axes, number, train, n, ratio) for ratio in (1.0, 1.5)]
    return Arm(n, number, axes, CYCLE_MS / 1000, train, limits(n), *made)


def init_of(
    axes: tuple[tuple[int, int], ...], number: int, train: DriveTrain, n: int, ratio: float
) -> bytes:
    """An init packet with these slots; `ratio` is that of its gears to the arm's."""
    table = np.full((4, 10), 0xFF)
    for slot, (arm, axis) in enumerate(axes):
        table[arm - 1, axis] = slot
    rows = {name: np.zeros((4, 10)) for name in ("gear_ratio", "calibration")}
    rows["gear_ratio"][number - 1, :n] = ratio * train.gear_ratio
    rows["calibration"][number - 1, :n] = train.calibration
    influence = np.zeros((4, 10))
    influence[number - 1, 3:6] = train.k54, train.k64, train.k65
    init = InitPacket.build(
        1, CYCLE_MS, {}, open_axes_map=table, kinematic_influence=influence,
        following_error=np.full((4, 10), 2.0), current_limit=np.full((4, 10), 20.0), **rows,
    )  # fmt: skip
    init.record["n_axes"] = len(axes)
    return init.encode()


SILENCE = 1.0  # s that a session bears while no axis is open
STRANGE = (0, 10, 501, 3, 6, 11, 12, 14, 17, 500, 502, 504, 505, 506, 508, -1, 1 << 30, 99)
FREE = ((16, 228), (388, 548), (708, 1040))
"""Bytes of an init packet that may change without another layout or other limits."""
STEPS = 60
CYCLES = 200  # Of one conversation at most


class Conversation(Judged):
    """One session, one controller, one user; `play` lets them act."""

    def __init__(self, draw: Draw) -> None:
        self._draw = draw
        self.arm = arm = arm_of(
            draw.choice((2, 6, 1, 3, 4, 5)), draw.choice((1, 2, 4)), draw.below(4), draw.below(4)
        )
        # Eight, so that stored inputs keep theirs.
        self.mode = draw.choice((4, 4, 5, 4, 5, 4, 5, 4))
        max_gap = draw.choice((2, 0, 5))
        ring = CycleRing(arm.n, 2 * CYCLES)
        session = Session(
            arm.train,
            Guard(arm.limits, arm.period),
            ring,
            mode=self.mode,
            max_gap=max_gap,
            arm=arm.number,
            settle_cycles=draw.choice((0, 3)),
            other_axes={(owner, axis + 1) for owner, axis in arm.axes},
        )
        self.obedient = not draw.chance(64)
        self.controller = Controller(
            arm.train, arm.middle, arm=arm.number, n_axes=len(arm.axes), slots=arm.slots
        )
        conduct = Conduct(
            arm.limits, arm.train, self.mode, arm.number, arm.slots, arm.arms,
            threshold=np.full(arm.n, 2.0), current=np.full(arm.n, 20.0), period=arm.period,
            max_gap=max_gap,
        )  # fmt: skip
        self.set_up(
            session, ring, conduct, n_axes=len(arm.axes), max_gap=max_gap, silence=SILENCE,
            period=arm.period, inits={arm.init: True, arm.other: False},
        )  # fmt: skip
        self.sent = 0

    def deliver(self, packet: bytes, elapsed: float | None = None) -> bytes | None:
        """One packet more, and its answer judged."""
        self.sent += 1
        return super().deliver(packet, elapsed)

    def begin(self) -> None:
        """The start of the session, cold or warm."""
        if self._draw.chance(64):
            for number in range(1, 10):
                self.deliver(number.to_bytes(4, "little") + bytes(728))
        self._init()
        self.run(1)

    def play(self) -> None:
        """Begin, then step by step until the bytes run out; AssertionError if a law is broken."""
        draw = self._draw
        self.begin()
        for _ in range(STEPS):
            if not draw.left or self.sent > CYCLES:
                return
            draw.choice(ACTS)(self)

    def run(self, cycles: int) -> None:
        """Cycles of a controller that continues."""
        for _ in range(cycles):
            reply = self.deliver(self.controller.packet())
            cyclic = reply is not None and len(reply) >= oracle.length(len(self.arm.axes))
            if cyclic and self.obedient and self.reception.n_axes is not None:
                self.controller.obey(reply or b"", self.mode)

    # What the controller does -------------------------------------------------------------

    def _init(self) -> None:
        draw = self._draw
        packet = self.arm.init
        if draw.chance(24):
            packet = self.arm.other
        elif draw.chance(24):
            changed = bytearray(packet)
            first, last = draw.choice(FREE)
            changed[first + draw.below(last - first)] ^= 1 << draw.below(8)
            packet = bytes(changed)
        self.deliver(packet)
        self.controller.number = 10

    def go_on(self) -> None:
        self.run(self._draw.between(1, 30))

    def open_properly(self) -> None:
        draw = self._draw
        self.controller.status[self.arm.number - 1] = oracle.DRIVE_ON
        self.controller.put_arm_at(self.arm.middle)
        self.controller.wanted(0)
        self.run(draw.between(1, 3))
        stagger = draw.chance(64)
        for slot in self.arm.slots:
            self.controller.modes[slot] = self.mode
            if stagger:
                self.run(1)
        self.run(draw.between(1, 40))

    def all_modes(self) -> None:
        draw = self._draw
        mode = draw.integer() if draw.chance(16) else draw.choice((self.mode, *STRANGE))
        self.controller.modes = [mode] * len(self.arm.axes)
        self.run(1)

    def one_mode(self) -> None:
        slot = self._draw.below(len(self.arm.axes))
        self.controller.modes[slot] = self._draw.choice((self.mode, *STRANGE))
        self.run(self._draw.between(1, 2))

    def drive(self) -> None:
        self.controller.status[self._draw.below(4)] = self._draw.choice((5, 0, 1, 4, 255))
        self.run(1)

    def disturb(self) -> None:
        draw = self._draw
        slot = draw.below(len(self.arm.axes))
        column = draw.below(8)
        value = draw.float32() if draw.chance(64) else draw.choice((*WILD, 0.19, 0.21, 1.9, 2.1))
        before = self.controller.d[slot, column]
        with np.errstate(all="ignore"):
            added = before + np.float32(value) if draw.chance(128) else np.float32(value)
            self.controller.d[slot, column] = added
        self.run(draw.between(1, 2))
        self.controller.d[slot, column] = before

    def miss(self) -> None:
        count = self._draw.choice((1, 2, 3, 4, 5, 6, 8, 400))
        for _ in range(count):
            self.controller.packet()
        self.now += count * self.arm.period
        self.run(1)

    def wait(self) -> None:
        self.run(self._draw.between(1, 8))

    # What the line does -------------------------------------------------------------------

    def again(self) -> None:
        if self.last is not None:
            for _ in range(self._draw.between(1, 3)):
                self.deliver(self.last[0])

    def late(self) -> None:
        packet = bytearray(self.controller.packet())
        behind = self._draw.below(0x8000)
        packet[:4] = ((number_of(bytes(packet)) - behind - 1) % 0x7FFF + 1).to_bytes(4, "little")
        self.deliver(bytes(packet))
        self.controller.number = self.reception.last

    def cut(self) -> None:
        packet = self.controller.packet() + self._draw.raw(16) * 80
        self.deliver(packet[: self._draw.below(1300)])
        self.controller.number = self.reception.last

    def corrupt(self) -> None:
        packet = bytearray(self.controller.packet())
        for _ in range(self._draw.between(1, 3)):
            packet[4 + self._draw.below(len(packet) - 4)] ^= self._draw.byte() or 1
        self.deliver(bytes(packet))

    def noise(self) -> None:
        self.deliver(self._draw.raw(self._draw.choice((4, 12, 48, 84, 120, 2))))
        self.controller.number = self.reception.last

    def silence(self) -> None:
        for _ in range(self._draw.below(3)):
            self.now += 400.0
            self.session.tick(self.now)
            self.record_silence()
            self.read_events()
        self.deliver(self.controller.packet(), elapsed=400.0)

    def start_over(self) -> None:
        self._init()
        self.run(1)

    def sync(self) -> None:
        self.deliver(self._draw.between(1, 13).to_bytes(4, "little") + bytes(728))
        self.controller.number = self.reception.last

    # What the user does -------------------------------------------------------------------

    def request(self) -> None:
        self._draw.chance(8)  # a draw of stored inputs that decides nothing any more
        self.ask_for(self._motion())

    def ask_for(self, source: ScriptedMotion) -> None:
        try:
            self.session.request(source)
        except RequestError:
            return
        assert self.conduct.usable or self.session.init is None
        self.conduct.entitled = True
        self.conduct.stopping = self.conduct.overridden = False
        self.source = source

    def _motion(self) -> ScriptedMotion:
        draw = self._draw
        n = self.arm.n
        direction = np.array([draw.choice((1.0, 0.0, -1.0)) for _ in range(n)])
        if draw.chance(128):
            hold = draw.between(1, 45)
            share = draw.choice((1.0, 0.5, 0.99999, 1.00001, 1.1, 2.5))
            rows = _edge(hold, share) * direction
        else:
            rows = smooth(draw.between(1, 250), 0.1 * direction)
        fault = draw.choice(FAULTS) if draw.chance(96) else ""
        value = draw.choice(WILD) if draw.chance(128) else 0.01 * (draw.byte() / 128.0 - 1.0)
        breaks = Breaks(fault, draw.below(31), draw.below(n), value)
        velocity = np.diff(rows, axis=0, prepend=rows[:1]) / self.arm.period
        draw.chance(96)  # likewise
        return ScriptedMotion(rows, velocity, breaks, draw.choice(("plan", "stop")))

    def request_and_open(self) -> None:
        if not self.session.requested:
            self.request()
            self.open_properly()

    def stop(self) -> None:
        self.session.stop()
        self.read_events()
        self.conduct.stopping = self.conduct.entitled
        self.run(1)

    def override(self) -> None:
        fraction = self._draw.choice((0.5, 0.0, 1.0, 1.0001, -0.1, float("nan"), float("inf")))
        try:
            self.session.override(fraction)
        except RequestError:
            return
        assert 0.0 <= fraction <= 1.0
        self.conduct.overridden = True


@lru_cache(maxsize=512)
def _edge(hold: int, share: float) -> np.ndarray:
    """(m, 1) displacement with a jerk of `share` of the bound, +, -, -, +, from rest to rest."""
    jerk = 100.0 * share * np.repeat([1.0, -1.0, -1.0, 1.0], hold)[:, None]
    rows = np.cumsum(np.cumsum(np.cumsum(jerk, axis=0), axis=0), axis=0) * 0.002**3
    return np.vstack([np.zeros((1, 1)), rows, rows[-1:]])


_C = Conversation
ACTS: tuple[Callable[[Conversation], None], ...] = (
    _C.go_on, _C.request_and_open, _C.request, _C.open_properly, _C.stop, _C.override, _C.all_modes,
    _C.one_mode, _C.drive, _C.disturb, _C.miss, _C.wait, _C.again, _C.late, _C.cut, _C.corrupt,
    _C.noise, _C.silence, _C.start_over, _C.sync, _C.go_on, _C.request_and_open,
)  # fmt: skip
"""What may happen next."""


def run(data: bytes) -> bool:
    """One conversation; whether the arm was open in it."""
    talk = Conversation(Draw(data))
    talk.play()
    return bool((talk.ring.rows["state"] == State.OPEN).any())


def seeds() -> list[bytes]:
    """Conversations that begin with a motion in each mode, and continue at random."""
    conversations = []
    # The controller of seed 13 ends the conversation before the arm is open.
    for seed in (*range(13), *range(14, 25)):
        rng = random.Random(seed)
        head = bytes((seed % 6, seed % 3, seed % 4, seed % 4, seed % 8, 0, 0, 0, 0, 0, 0))
        conversations.append(head + bytes((1,)) + rng.randbytes(rng.choice((20, 60, 150))))
    return conversations


TARGET = Target(run, seeds, mutate_bytes, most=400, replayed=60)
