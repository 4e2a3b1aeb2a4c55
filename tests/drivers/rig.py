"""Test bench of a session: a controller sending given packets, and motions to request."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers import (
    CycleRing,
    CyclicPacket,
    DriveTrain,
    Guard,
    GuardLimits,
    InitPacket,
    Mode,
    MotionEnded,
    Refused,
    Session,
    State,
    StateChanged,
)
from drivers.c4g_packets import DRIVE_ON, cyclic_length, next_number
from drivers.errors import Check, GuardError
from drivers.states import POSITION_MODES

N = 6
PERIOD_MS = 2
PERIOD = 0.002
START = np.array([0.1, -0.2, 0.3, -0.4, 0.5, -0.6])
MOVE = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])
NOT_SET_POINTS = (Mode.DRIVE_OFF_REQUEST, Mode.FOLLOWING_ERROR)


def drive_train() -> DriveTrain:
    return DriveTrain(
        gear_ratio=np.array([-120.0, 150.0, -110.0, 90.0, 80.0, -60.0]),
        calibration=np.array([0.5, -1.25, 2.0, 0.0, 0.25, -0.75]),
        joint_sign=np.array([-1.0, 1.0, -1.0, -1.0, 1.0, -1.0]),
        joint_offset=np.array([0.0, 0.0, -1.5, 0.0, 1.5, 0.0]),
        torque_constant=np.full(N, 0.5),
        current_limit=np.full(N, 20.0),
        k54=0.01,
        k64=0.002,
        k65=0.03,
    )


def train_of(n: int) -> DriveTrain:
    """Return the drive train of an arm with n different joints."""
    return DriveTrain(
        gear_ratio=np.where(np.arange(n) % 3, 1.0, -1.0) * np.linspace(120.0, 60.0, n),
        calibration=np.linspace(-1.0, 2.0, n),
        joint_sign=np.where(np.arange(n) % 2, 1.0, -1.0),
        joint_offset=np.linspace(0.3, -0.2, n),
        torque_constant=np.ones(n),
        current_limit=np.full(n, 20.0),
        k54=0.01 if n >= 6 else 0.0,
        k64=0.002 if n >= 6 else 0.0,
        k65=0.03 if n >= 6 else 0.0,
    )


def limits(n: int = N, **changes) -> GuardLimits:
    standard = GuardLimits(
        lower=np.full(n, -2.0),
        upper=np.full(n, 2.0),
        velocity=np.full(n, 2.0),
        acceleration=np.full(n, 8.0),
        jerk=np.full(n, 100.0),
        following_error=np.full(n, 2.0),
        current=np.full(n, 20.0),
    )
    return replace(standard, **changes)


def init_packet(**changes) -> InitPacket:
    arm_1 = {
        "gear_ratio": drive_train().gear_ratio,
        "calibration": drive_train().calibration,
        "kinematic_influence": [0.0, 0.0, 0.0, 0.01, 0.002, 0.03],
        "following_error": np.full(N, 2.0),
        "current_limit": np.full(N, 20.0),
        **changes.pop("arm_1", {}),
    }
    n_axes = changes.pop("n_axes", N)
    return InitPacket.build(n_axes, changes.pop("sample_time", PERIOD_MS), arm_1, **changes)


class Cruise:
    """Joint 1 accelerates, moves at constant speed and stops on request; the others rest."""

    RAMP = 0.4
    SPEED = 0.3

    def __init__(self, start=START):
        self.start = np.array(start)
        self.finished = False
        self.bounds = "plan"
        self.begun_at = None
        self.advances = 0
        self.stops = 0
        self._velocity = self._time = 0.0
        self._target = self.SPEED
        self._from = 0.0
        self._origin = 0.0

    def begin(self, position):
        self.begun_at = np.array(position)
        self._position = np.array(position)

    def advance(self):
        self.advances += 1
        self._time = min(self._time + PERIOD, self.RAMP) if self._ramping else self._time
        if self._ramping or self._velocity:
            self._move()
        return self._position, np.array([self._velocity, 0, 0, 0, 0, 0])

    @property
    def _ramping(self):
        return self._time < self.RAMP

    def _move(self):
        share = 0.5 * (1.0 - np.cos(np.pi * self._time / self.RAMP))
        velocity = self._from + (self._target - self._from) * share
        self._position = self._position + PERIOD * 0.5 * (
            np.array([self._velocity + velocity, 0, 0, 0, 0, 0])
        )
        self._velocity = velocity
        self.finished = self.stops > 0 and not self._ramping

    def stop(self):
        self.stops += 1
        self.bounds = "stop"
        self._from = self._velocity
        self._target = 0.0
        self._time = 0.0


class Table:
    """Plays rows of positions (m, n); the velocity is their step unless it is given."""

    def __init__(self, positions, velocities=None, bounds="plan"):
        self.positions = np.asarray(positions, dtype=float)
        if velocities is None:
            velocities = np.diff(self.positions, axis=0, prepend=self.positions[:1]) / PERIOD
        self.velocities = np.asarray(velocities, dtype=float)
        self.start = self.positions[0]
        self.bounds = bounds
        self.index = 0

    @property
    def finished(self):
        return self.index + 1 >= len(self.positions)

    def begin(self, position):
        # Float32 rounding of the wire would be a jump.
        self.positions = self.positions + (position - self.start)

    def advance(self):
        self.index += 1
        return self.positions[self.index], self.velocities[self.index]

    def stop(self):
        self.positions = self.positions[: self.index + 1]


class Unstopped(Table):
    """A table executed to its end, with the bounds of a stop from `stop` on."""

    def stop(self):
        self.bounds = "stop"


def still(rows: int, position=START) -> Table:
    return Table(np.tile(position, (rows, 1)))


def smooth_move(distance, cycles: int, start=START) -> Table:
    """From start by `distance` (n,) along a polynomial with zero jerk at both ends."""
    s = np.linspace(0.0, 1.0, cycles + 1)[:, None]
    share = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
    return Table(np.asarray(start) + share * np.asarray(distance))


def accelerating(acceleration: float, cycles: int = 40) -> np.ndarray:
    """Joint 2 leaves with a jump in acceleration; limits on jerk have to be wide."""
    t = np.arange(cycles)[:, None] * PERIOD
    return START + 0.5 * acceleration * t**2 * np.eye(N)[1]


class Unspeakable(BaseException):
    """An exception whose `__str__` raises."""

    def __str__(self):
        raise KeyboardInterrupt


class Rig:
    """Session and controller. The arm is where the last reply commands it."""

    def __init__(
        self,
        *,
        guard_limits=None,
        init=None,
        slots=None,
        ring_capacity=4096,
        period=PERIOD,
        **options,
    ):
        self.train = drive_train()
        self.ring = CycleRing(N, ring_capacity)
        self.period = period
        self.guard = Guard(guard_limits or limits(), period)
        options = {"settle_cycles": 5, **options}
        self.mode = options.get("mode", Mode.POSITION)
        self.session = Session(self.train, self.guard, self.ring, **options)
        self.init = init or init_packet(sample_time=round(1000 * period))
        self.now = 0.0
        self.number = 0
        self.status = DRIVE_ON
        self.axes = CyclicPacket.zeros(1, self.init.n_axes).axes
        self.slots = np.arange(min(N, self.init.n_axes)) if slots is None else slots
        self.put_arm_at(START)
        self.events = []
        self.transcript = []
        self.exits_asked = 0

    def put_arm_at(self, q) -> None:
        motor = self.train.motor_revolutions(q)[: len(self.slots)]
        self.axes["d"][self.slots, 0] = self.axes["d"][self.slots, 2] = motor

    @property
    def state(self):
        return self.session.state

    @property
    def modes(self):
        return self.axes["mode"]

    @modes.setter
    def modes(self, mode):
        self.axes["mode"] = mode

    def send(self, packet: bytes) -> bytes | None:
        """Deliver any bytes, one cycle later; return the reply."""
        self.now += self.period
        reply = self.session.reply(packet, self.now)
        self.events += self.session.events()
        self.transcript.append((packet, reply))
        return reply

    def start(self, *, cold: bool = False) -> None:
        """Exchange sync and init packets."""
        if cold:
            for number in range(1, 10):
                self.sync(number)
        self.send(self.init.encode())
        self.number = 10
        if cold:
            self.number = 12
            for number in (11, 12):
                self.sync(number)

    def sync(self, number: int, length: int = 732) -> bytes | None:
        return self.send(number.to_bytes(4, "little") + bytes(length - 4))

    def packet(self) -> bytes:
        """The next packet of the controller."""
        self.number = next_number(self.number)
        status = bytes([self.status, 0, 0, 0])
        return CyclicPacket(self.number, status, bytes(4), self.axes.copy()).encode()

    def miss(self, cycles: int) -> None:
        """Packets that never arrive."""
        for _ in range(cycles):
            self.packet()
            self.now += self.period

    def cycle(self, count: int = 1, *, mode=None, status=None) -> CyclicPacket | None:
        """Run cycles, in this mode and status from now on; return the last reply."""
        self.modes = self.modes if mode is None else mode
        self.status = self.status if status is None else status
        answer = None
        for _ in range(count):
            reply = self.send(self.packet())
            answer = None
            if reply is not None:
                assert len(reply) == cyclic_length(self.init.n_axes)
                answer = CyclicPacket.decode(reply, self.init.n_axes)
                assert answer.number == next_number(self.number)
                self._follow(answer)
        return answer

    def _follow(self, answer: CyclicPacket) -> None:
        self.exits_asked += answer.status[0] == 1
        commanded = answer.axes
        if np.isin(commanded["mode"], NOT_SET_POINTS).any():
            return
        moved = np.isin(commanded["mode"], (*POSITION_MODES,))
        for target, field in ((0, 0), (2, 0), (1, 1), (3, 1)):
            self.axes["d"][moved, target] = commanded["d"][moved, field]

    def close(self) -> CyclicPacket | None:
        """To closed axes, drive on."""
        if self.number < 10:
            self.start()
        return self.cycle(mode=Mode.CLOSED)

    def open(self) -> CyclicPacket | None:
        """Through closed into open mode, all axes at once."""
        self.close()
        return self.cycle(mode=self.mode)

    def run(self, cycles: int = 2000) -> None:
        """Follow replies until the session asks for the end of open mode, then leave it."""
        for _ in range(cycles):
            self.cycle()
            if self.exits_asked:
                self.cycle(mode=Mode.CLOSED)
                return
        raise AssertionError(f"no end of open mode asked for in {cycles} cycles")

    def run_to(self, outcome: str) -> None:
        """To the end of open mode, and that outcome of the motion."""
        self.run()
        assert self.ended.outcome == outcome
        assert outcome != "completed" or self.ended.reason == "the motion is complete"

    def seen(self, kind):
        return [event for event in self.events if isinstance(event, kind)]

    @property
    def ended(self) -> MotionEnded | None:
        ends = self.seen(MotionEnded)
        return ends[-1] if ends else None

    @property
    def refusal(self):
        """Error of the last refused set-point."""
        return self.seen(Refused)[-1].error

    @property
    def path(self):
        """States entered so far."""
        return [event.after for event in self.seen(StateChanged)]

    @property
    def records(self):
        return self.ring.last(self.ring.capacity)


def started(**options) -> Rig:
    """After the hand-shake."""
    rig = Rig(**options)
    rig.start()
    return rig


def closed(**options) -> Rig:
    """With closed axes and the drive on."""
    rig = Rig(**options)
    rig.close()
    return rig


def opened(cycles: int = 0, **options) -> Rig:
    """In open mode without a motion, after this number of cycles."""
    rig = Rig(**options)
    rig.open()
    rig.cycle(cycles)
    return rig


def running(source, cycles: int = 0, **options) -> Rig:
    """In open mode, this number of cycles after the first set-point of a motion."""
    rig = Rig(**options)
    rig.session.request(source)
    rig.open()
    rig.cycle(cycles)
    return rig


def moving(cycles: int = 300, **options) -> tuple[Rig, Cruise]:
    source = Cruise()
    rig = running(source, cycles, **options)
    assert rig.state is State.OPEN
    return rig, source


def resumptions(rig: Rig) -> list:
    """Position, velocity and cycles of each resumption of a motion, from now on."""
    source = rig.session.execution._source
    resumed = []

    def resume_from(*arguments):
        resumed.append(arguments)
        source._position = arguments[0]

    source.resume_from = resume_from
    return resumed


def exiting(**options) -> Rig:
    """A short motion is over, and the end of open mode was asked for."""
    rig = running(still(2), 6, **options)
    assert rig.state is State.EXITING
    return rig


def all_drive_off(answer: CyclicPacket) -> bool:
    return bool((answer.axes["mode"] == Mode.DRIVE_OFF_REQUEST).all())


def kind_of(error: Exception) -> object:
    """Return the check of a guard's error, the class of any other."""
    return error.check if isinstance(error, GuardError) else type(error)


def assert_refused(rig: Rig, answer: CyclicPacket, kind: object) -> Exception:
    assert all_drive_off(answer)
    assert answer.status == bytes(4)
    assert rig.state is State.FAULTED
    assert rig.ended.outcome == "refused"
    assert np.isnan(rig.records[-1]["commanded_position"]).all()
    error = rig.refusal
    assert kind_of(error) is kind
    assert error.cycle == rig.records[-1]["cycle"]
    return error


REST = np.zeros(N)
WIDE = 1e9
JUST_BELOW = 1.0 + 5e-7
JUST_ABOVE = 1.0 + 2e-6
"""Of a bound, which has a relative tolerance of 1e-6."""
FACTORS = {"plan": (1.0, 1.0), "override": (1.3, 1.7), "stop": (2.0, 3.0)}
"""On acceleration and jerk, of each set of bounds."""

joints = pytest.mark.parametrize("joint", [0, N - 1])
signs = pytest.mark.parametrize("sign", [-1.0, 1.0])


def at(joint: int, value: float) -> np.ndarray:
    """Zero but for one joint."""
    return value * np.eye(N)[joint]


def only(**bounds: float) -> GuardLimits:
    """Limits that are wide for every rate but those given."""
    wide = dict.fromkeys(("velocity", "acceleration", "jerk"), WIDE)
    return limits(**{name: np.full(N, bound) for name, bound in (wide | bounds).items()})


def refused(kind: Check, check: Callable[..., object], *args: Any, **named: Any) -> GuardError:
    """Return the error that a check raises, which must be of this kind."""
    with pytest.raises(GuardError) as caught:
        check(*args, **named)
    assert caught.value.check is kind
    return caught.value
