"""A controller with axes of several arms in any slots, and a session for one of the arms."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from dataclasses import field as dataclass_field

import numpy as np

from drivers import CycleRing, DriveTrain, Guard, GuardLimits, InitPacket, Session
from tests.drivers import oracle

PERIOD = 0.002
OPEN, CLOSED = 4, 0
ON = 5


def train_of(n: int) -> DriveTrain:
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


def limits_of(n: int) -> GuardLimits:
    return GuardLimits(
        lower=np.full(n, -3.0),
        upper=np.full(n, 3.0),
        velocity=np.full(n, 2.0),
        acceleration=np.full(n, 20.0),
        jerk=np.full(n, 1e4),
        following_error=np.full(n, 2.0),
        current=np.full(n, 20.0),
    )


@dataclass
class Bench:
    """A controller with its axes laid out as given, and a session for one of its arms.

    Attributes:
        slots: (arm from 1, axis from 0) of each slot.
        arm: the one that the session is for.
        n: joints of the session's cell.
    """

    slots: tuple[tuple[int, int], ...]
    arm: int
    n: int
    none: int = 0xFF
    open_axes_map: np.ndarray | None = None
    settle_cycles: int = 3
    sample_time: int = 2
    events: list = dataclass_field(default_factory=list)

    def __post_init__(self) -> None:
        self.train = train_of(self.n)
        self.ring = CycleRing(self.n)
        self.session = Session(
            self.train,
            Guard(limits_of(self.n), self.sample_time / 1000),
            self.ring,
            arm=self.arm,
            settle_cycles=self.settle_cycles,
            other_axes={(arm, axis + 1) for arm, axis in self.slots},
        )
        rng = np.random.default_rng(len(self.slots))
        self.q = np.linspace(-0.5, 0.5, self.n)
        motor = self.train.motor_revolutions(self.q)
        # Other arms stand anywhere.
        self.d1 = np.float32(rng.uniform(-50, 50, len(self.slots)))
        for joint, slot in enumerate(self.joint_slots):
            if slot is not None:
                self.d1[slot] = np.float32(motor[joint])
        self.status = [ON if a + 1 in self.arms else 0 for a in range(4)]
        self.modes = [CLOSED] * len(self.slots)
        self.error = np.zeros(len(self.slots))
        self.number, self.now = 10, 0.0

    @property
    def arms(self) -> tuple[int, ...]:
        return tuple(arm for arm, _ in self.slots)

    @property
    def joint_slots(self) -> list[int | None]:
        """Slot of each joint of the cell, None if that axis is not open."""
        where = {axis: k for k, (arm, axis) in enumerate(self.slots) if arm == self.arm}
        return [where.get(joint) for joint in range(self.n)]

    def start(self) -> bytes | None:
        table = np.full((4, 10), self.none)
        for slot, (arm, axis) in enumerate(self.slots):
            table[arm - 1, axis] = slot
        per_axis = np.zeros((4, 10))
        rows = {name: per_axis.copy() for name in ("gear_ratio", "calibration")}
        for name, values in rows.items():
            values[self.arm - 1, : self.n] = getattr(self.train, name)
        influence = per_axis.copy()
        influence[self.arm - 1, 3:6] = self.train.k54, self.train.k64, self.train.k65
        init = InitPacket.build(
            1,
            self.sample_time,
            {},
            open_axes_map=table if self.open_axes_map is None else self.open_axes_map,
            kinematic_influence=influence,
            following_error=np.full((4, 10), 2.0),
            current_limit=np.full((4, 10), 20.0),
            **rows,
        )
        init.record["n_axes"] = len(self.slots)
        return self.send(init.encode())

    def send(self, packet: bytes) -> bytes | None:
        self.now += PERIOD
        reply = self.session.reply(packet, self.now)
        self.events += self.session.events()
        return reply

    def cycle(self) -> tuple[oracle.Packet, oracle.Packet]:
        """A packet, and the answer to it."""
        self.number = oracle.answer_number(self.number)
        axes = []
        for slot, mode in enumerate(self.modes):
            actual = self.d1[slot] + self.error[slot]
            words = [self.d1[slot], 0.0, actual, 0.0, 0.5, 0.25, 0.125, 0.0]
            axes.append(oracle.Axis(mode, tuple(struct.pack("<f", w) for w in words)))
        received = oracle.Packet(self.number, bytes(self.status), bytes([1, 2, 3, 4]), tuple(axes))
        reply = self.send(oracle.build(received))
        assert reply is not None
        assert len(reply) == oracle.length(len(self.slots))
        return received, oracle.parse(reply, len(self.slots))

    def obey(self, answer: oracle.Packet) -> None:
        for slot in self.joint_slots:
            self.d1[slot] = answer.axes[slot].floats[0]

    def set_joints(self, mode: int) -> None:
        for slot in self.joint_slots:
            self.modes[slot] = mode

    def seen(self, kind: type) -> list:
        return [event for event in self.events if isinstance(event, kind)]
