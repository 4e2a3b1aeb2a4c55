"""One to four arms, one to twenty open axes, in any slots: each axis gets its own reply.

Expected replies are those of the oracle.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from dataclasses import field as dataclass_field

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from drivers import (
    CycleRing,
    Guard,
    InitPacket,
    InitReceived,
    RequestError,
    Session,
    State,
)
from tests.drivers import oracle
from tests.drivers.rig import Table, limits, train_of

PERIOD = 0.002
OPEN, CLOSED = 4, 0
ON = 5
FOLLOWING_ERROR = np.linspace(1.0, 1.9, 40).reshape(4, 10)  # of each arm and axis
CURRENT_LIMIT = 10.0 * FOLLOWING_ERROR


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
            Guard(limits(self.n), self.sample_time / 1000),
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
            following_error=FOLLOWING_ERROR,
            current_limit=CURRENT_LIMIT,
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

    def set_joints(self, mode: int) -> None:
        for slot in self.joint_slots:
            self.modes[slot] = mode

    def seen(self, kind: type) -> list:
        return [event for event in self.events if isinstance(event, kind)]


@st.composite
def layouts(draw, *, complete: bool = True, most: int = 20):
    """(slots, arm, n): the wanted arm has at least the cell's joints, or lacks one of them."""
    arms = draw(st.lists(st.integers(1, 4), min_size=1, max_size=4, unique=True))
    wanted = arms[0]
    n = draw(st.integers(1, 10))
    axes = [(wanted, axis) for axis in range(n)]
    if not complete:
        axes.pop(draw(st.integers(0, n - 1)))
    axes += [(wanted, axis) for axis in range(n, 10) if draw(st.booleans())]
    for arm in arms[1:]:
        chosen = draw(st.lists(st.integers(0, 9), min_size=1, max_size=10, unique=True))
        axes += [(arm, axis) for axis in chosen]
    axes = axes[:most]
    assume(axes)
    return tuple(draw(st.permutations(axes))), wanted, n


def opened(slots, arm, n, **options) -> Bench:
    bench = Bench(slots, arm, n, **options)
    bench.start()
    bench.cycle()
    bench.set_joints(OPEN)
    bench.cycle()
    assert bench.session.state is State.OPEN
    return bench


TWO_ARMS = tuple((arm, axis) for axis in range(3) for arm in (2, 1))


@pytest.mark.parametrize("arm", [1, 2])
def test_guard_has_the_narrower_limits_of_its_arm(arm):
    bench = Bench(TWO_ARMS, arm, 3)
    bench.start()
    guard = bench.session._guard
    np.testing.assert_array_equal(guard.following_error, np.float32(FOLLOWING_ERROR[arm - 1, :3]))
    np.testing.assert_array_equal(guard.current, np.float32(CURRENT_LIMIT[arm - 1, :3]))


def test_drive_of_another_arm_off():
    bench = opened(TWO_ARMS, 1, 3)
    bench.status[1] = 0
    received, answer = bench.cycle()
    assert bench.session.state is State.OPEN
    for slot, (arm, _) in enumerate(TWO_ARMS):
        ours, theirs = answer.axes[slot], received.axes[slot]
        assert ours == (theirs if arm == 2 else theirs.keep(1))
    assert answer.status == bytes(4)


def test_drive_of_the_moved_arm_goes_off():
    bench = opened(TWO_ARMS, 1, 3)
    bench.status[0] = 0
    for slot, (arm, _) in enumerate(TWO_ARMS):
        bench.modes[slot] = OPEN if arm == 2 else CLOSED
    received, answer = bench.cycle()
    assert bench.session.state is State.DRIVE_OFF
    assert oracle.differences(answer, oracle.safe_answer(received, bench.arms)) == []


def lacking(arm: int, *axes: int) -> list[str]:
    return [f"axis {axis} of arm {arm} is not open in the controller" for axis in axes]


class TestArmWithoutAllItsJoints:
    def never_moved(self, bench: Bench, texts: list[str]) -> None:
        """Check that no packet gets a set-point and no motion is accepted."""
        bench.start()
        (init,) = bench.seen(InitReceived)
        for part in texts:
            assert part in init.unusable
        for mode in (CLOSED, OPEN, 5, 501, CLOSED):
            bench.modes = [mode] * len(bench.slots)
            received, answer = bench.cycle()
            safe = oracle.safe_answer(received, bench.arms)
            for ours, theirs in zip(answer.axes, safe.axes, strict=True):
                assert ours.mode in (theirs.mode, oracle.DRIVE_OFF_REQUEST)
                assert ours.d == theirs.d
        with pytest.raises(RequestError, match="open"):
            bench.session.request(Table(np.tile(bench.q, (2, 1))))
        assert np.isnan(bench.ring.last(100)["commanded_position"]).all()

    def test_only_axis_6_open(self):
        self.never_moved(Bench(((1, 5),), 1, 6), lacking(1, 1, 2, 3, 4, 5))

    def test_only_another_arm_open(self):
        slots = tuple((2, axis) for axis in range(6))
        self.never_moved(Bench(slots, 1, 6), lacking(1, 1, 2, 3, 4, 5, 6))

    @settings(max_examples=30)
    @given(layouts(complete=False))
    def test_any_joint_that_is_not_open(self, layout):
        slots, arm, n = layout
        bench = Bench(slots, arm, n)
        missing = [j + 1 for j, slot in enumerate(bench.joint_slots) if slot is None]
        self.never_moved(bench, lacking(arm, *missing))


class TestAxisMaps:
    @pytest.mark.parametrize("mode", [5, 7, 9])
    def test_no_echo_to_open_axes_without_a_valid_map(self, mode):
        """The arm of the axis is unknown; an echoed position would be an offset in mode 7."""
        slots = tuple((1, axis) for axis in range(6))
        table = np.full((4, 10), 1)
        bench = Bench(slots, 1, 6, open_axes_map=table)
        bench.start()
        bench.status = [0, ON, 0, 0]
        bench.modes = [mode] * 6
        received, answer = bench.cycle()
        for ours, theirs in zip(answer.axes, received.axes, strict=True):
            assert ours.mode in (mode, oracle.DRIVE_OFF_REQUEST)
            assert ours.d == oracle.safe_axis(theirs, drive_on=True).d

    @settings(max_examples=60)
    @given(st.lists(st.integers(-3, 25) | st.just(255), min_size=40, max_size=40), st.data())
    def test_arm_moves_only_if_the_map_is_a_bijection(self, table, data):
        n_axes = data.draw(st.integers(1, 20))
        slots = tuple((1 + k // 10, k % 10) for k in range(n_axes))
        bench = Bench(slots, 1, 1, open_axes_map=np.array(table).reshape(4, 10))
        bench.start()
        given_slots = sorted(slot for slot in table if slot not in (255, -1))
        valid = given_slots == list(range(n_axes)) and table[0] not in (255, -1)
        assert (bench.seen(InitReceived)[0].unusable is None) == valid
        received, answer = bench.cycle()
        if not valid:
            assert oracle.differences(answer, oracle.safe_answer(received, (1,) * n_axes)) == []


def test_twenty_axes_of_four_arms_at_1_ms():
    axes = [(arm, axis) for arm in (1, 2, 3, 4) for axis in range(5)]
    slots = tuple(axes[(7 * k + 3) % 20] for k in range(20))
    bench = opened(slots, 3, 5, sample_time=1)
    received, answer = bench.cycle()
    assert len(oracle.build(received)) == 732
    assert oracle.differences(answer, oracle.safe_answer(received, bench.arms)) == []
    assert bench.session.period == 0.001
