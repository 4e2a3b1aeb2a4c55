"""Arms and axes in any slots: each axis gets its own reply, as the oracle expects it.

Random conversations (`tests.fuzz.targets.session`) have other arms and orders of slots as well.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from dataclasses import field as dataclass_field

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from drivers import CycleRing, Guard, InitPacket, InitReceived, RequestError, Session, State
from tests.drivers import oracle
from tests.drivers.rig import PERIOD, Table, limits, train_of
from tests.messages import AXIS_NOT_OPEN

pytestmark = pytest.mark.safety

OPEN = 4
CLOSED = 0
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
    open_axes_map: np.ndarray | None = None
    events: list = dataclass_field(default_factory=list)

    def __post_init__(self) -> None:
        train = train_of(self.n)
        self.ring = CycleRing(self.n)
        self.session = Session(
            train,
            Guard(limits(self.n), PERIOD),
            self.ring,
            arm=self.arm,
            other_axes={(arm, axis + 1) for arm, axis in self.slots},
        )
        self.arms = tuple(arm for arm, _ in self.slots)
        where = {axis: slot for slot, (arm, axis) in enumerate(self.slots) if arm == self.arm}
        self.missing = [joint + 1 for joint in range(self.n) if joint not in where]
        self.joint_slots = [where[joint] for joint in range(self.n) if joint in where]
        self.q = np.linspace(-0.5, 0.5, self.n)
        # Other arms stand anywhere.
        self.d1 = np.float32(np.random.default_rng(1).uniform(-50, 50, len(self.slots)))
        if not self.missing:
            self.d1[self.joint_slots] = train.motor_revolutions(self.q)
        self.status = [ON if a + 1 in self.arms else 0 for a in range(4)]
        self.modes = [CLOSED] * len(self.slots)
        self.number = 10
        self.send(self.init(train).encode())

    def init(self, train) -> InitPacket:
        table = np.full((4, 10), 0xFF)
        for slot, (arm, axis) in enumerate(self.slots):
            table[arm - 1, axis] = slot
        rows = {name: np.zeros((4, 10)) for name in ("gear_ratio", "calibration")}
        for name, values in rows.items():
            values[self.arm - 1, : self.n] = getattr(train, name)
        influence = np.zeros((4, 10))
        influence[self.arm - 1, 3:6] = train.k54, train.k64, train.k65
        init = InitPacket.build(
            1,
            round(1000 * PERIOD),
            {},
            open_axes_map=table if self.open_axes_map is None else self.open_axes_map,
            kinematic_influence=influence,
            following_error=FOLLOWING_ERROR,
            current_limit=CURRENT_LIMIT,
            **rows,
        )
        init.record["n_axes"] = len(self.slots)
        return init

    def send(self, packet: bytes) -> bytes | None:
        reply = self.session.reply(packet, PERIOD * self.number)
        self.events += self.session.events()
        return reply

    def cycle(self) -> tuple[oracle.Packet, oracle.Packet]:
        """A packet, and the answer to it."""
        self.number = oracle.answer_number(self.number)
        axes = []
        for target, mode in zip(self.d1, self.modes, strict=True):
            values = [target, 0.0, target, 0.0, 0.5, 0.25, 0.125, 0.0]
            axes.append(oracle.Axis(mode, tuple(struct.pack("<f", w) for w in values)))
        received = oracle.Packet(self.number, bytes(self.status), bytes([1, 2, 3, 4]), tuple(axes))
        reply = self.send(oracle.build(received))
        assert len(reply) == oracle.length(len(self.slots))
        return received, oracle.parse(reply, len(self.slots))

    def open(self) -> tuple[oracle.Packet, oracle.Packet]:
        """The arm's axes are open; a packet, and the answer to it."""
        self.cycle()
        for slot in self.joint_slots:
            self.modes[slot] = OPEN
        exchanged = self.cycle()
        assert self.session.state is State.OPEN
        return exchanged

    def safe(self, received: oracle.Packet) -> oracle.Packet:
        return oracle.safe_answer(received, self.arms)

    @property
    def unusable(self) -> str | None:
        (init,) = (event for event in self.events if isinstance(event, InitReceived))
        return init.unusable


@st.composite
def lacking(draw):
    """(slots, arm, n): the wanted arm lacks one of the cell's joints."""
    arms = draw(st.lists(st.integers(1, 4), min_size=1, max_size=4, unique=True))
    n = draw(st.integers(1, 10))
    axes = [(arms[0], axis) for axis in range(n)]
    axes.pop(draw(st.integers(0, n - 1)))
    axes += [(arms[0], axis) for axis in range(n, 10) if draw(st.booleans())]
    for arm in arms[1:]:
        chosen = draw(st.lists(st.integers(0, 9), min_size=1, max_size=10, unique=True))
        axes += [(arm, axis) for axis in chosen]
    assume(axes)
    return tuple(draw(st.permutations(axes[:20]))), arms[0], n


TWO_ARMS = tuple((arm, axis) for axis in range(3) for arm in (2, 1))


@pytest.mark.parametrize("arm", [1, 2])
def test_guard_has_the_narrower_limits_of_its_arm(arm):
    guard = Bench(TWO_ARMS, arm, 3).session._guard
    np.testing.assert_array_equal(guard.following_error, np.float32(FOLLOWING_ERROR[arm - 1, :3]))
    np.testing.assert_array_equal(guard.current, np.float32(CURRENT_LIMIT[arm - 1, :3]))


@pytest.mark.parametrize(("arm", "state"), [(1, State.DRIVE_OFF), (2, State.OPEN)])
def test_drive_of_one_arm_goes_off(arm, state):
    bench = Bench(TWO_ARMS, 1, 3)
    bench.open()
    bench.status[arm - 1] = 0
    received, answer = bench.cycle()
    assert bench.session.state is state
    assert oracle.differences(answer, bench.safe(received)) == []


@settings(max_examples=30)
@given(lacking())
def test_arm_without_all_its_joints_is_not_moved(layout):
    bench = Bench(*layout)
    for joint in bench.missing:
        assert f"axis {joint} of arm {layout[1]} {AXIS_NOT_OPEN}" in bench.unusable
    for mode in (CLOSED, OPEN, 5, 501, CLOSED):
        bench.modes = [mode] * len(bench.slots)
        received, answer = bench.cycle()
        for ours, theirs in zip(answer.axes, bench.safe(received).axes, strict=True):
            assert ours.mode in (theirs.mode, oracle.DRIVE_OFF_REQUEST)
            assert ours.d == theirs.d
    with pytest.raises(RequestError, match="open"):
        bench.session.request(Table(np.tile(bench.q, (2, 1))))
    assert np.isnan(bench.ring.last(100)["commanded_position"]).all()


@pytest.mark.parametrize("mode", [5, 7, 9])
def test_no_echo_to_open_axes_without_a_valid_map(mode):
    """The arm of the axis is unknown; an echoed position would be an offset in mode 7."""
    slots = tuple((1, axis) for axis in range(6))
    bench = Bench(slots, 1, 6, open_axes_map=np.full((4, 10), 1))
    bench.status = [0, ON, 0, 0]
    bench.modes = [mode] * 6
    received, answer = bench.cycle()
    for ours, theirs in zip(answer.axes, received.axes, strict=True):
        assert ours.mode in (mode, oracle.DRIVE_OFF_REQUEST)
        assert ours.d == oracle.safe_axis(theirs, drive_on=True).d


@settings(max_examples=60)
@given(st.lists(st.integers(-3, 25) | st.just(255), min_size=40, max_size=40), st.integers(1, 20))
def test_arm_moves_only_if_the_map_is_a_bijection(table, n_axes):
    slots = tuple((1 + k // 10, k % 10) for k in range(n_axes))
    bench = Bench(slots, 1, 1, open_axes_map=np.array(table).reshape(4, 10))
    given_slots = sorted(slot for slot in table if slot not in (255, -1))
    valid = given_slots == list(range(n_axes)) and table[0] not in (255, -1)
    assert (bench.unusable is None) == valid
    received, answer = bench.cycle()
    if not valid:
        assert oracle.differences(answer, oracle.safe_answer(received, (1,) * n_axes)) == []
