"""Captured packets of controllers, replied to by the session.

Each reply is compared, field by field, with the documented reply (`oracle`) and with that of the
captured PC program. Where these two differ, the difference is in `DIFFERENT_ON_PURPOSE`, and it
must occur.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from drivers import (
    CycleRing,
    CyclicPacket,
    DriveTrain,
    Guard,
    GuardLimits,
    InitPacket,
    MotionEnded,
    Refused,
    Session,
    State,
)
from drivers.c4g_packets import INIT_LENGTH, MAX_AXES, cyclic_length, is_init
from drivers.errors import Check
from tests.drivers import oracle
from tests.drivers.rig import Rig, Table

CAPTURES = (
    "a_505",
    "a_508",
    "a_exit",
    "a_mode4",
    "a_mode5",
    "a_restart506",
    "a_stagger",
    "a_wrap",
    "b_ufmg_fast",
    "b_ufmg_literal",
    "b_ufmg_mode4",
    "s_TestMode4_movement_7ax_stagger",
)
"""The letter is that of the programs: `a_*` a model of the controller and one laboratory's PC
program, `b_*` one laboratory's controller and another's PC program, `s_*` the tail of a session."""
ETHERNET = 1


def capture_path(shared_data: Path, name: str) -> Path:
    """Where a capture lies; skips the test if that one is not there."""
    path = shared_data / "c4g_captures" / f"{name}.pcap"
    if not path.is_file():
        pytest.skip(f"the capture {name} is not in {path.parent.name} beside this checkout")
    return path


def read_datagrams(path: Path) -> list[tuple[bool, bytes]]:
    """All datagrams in order, and whether the controller sent them: the end that sends first."""
    data = path.read_bytes()
    magic, _, _, _, _, _, link_type = struct.unpack_from("<IHHiIII", data)
    assert magic == 0xA1B2C3D4
    assert link_type == ETHERNET
    datagrams = []
    controller = None
    offset = 24
    while offset < len(data):
        _, _, captured, length = struct.unpack_from("<IIII", data, offset)
        assert captured == length
        frame = data[offset + 16 : offset + 16 + captured]
        offset += 16 + captured
        assert frame[12:14] == b"\x08\x00"
        ip = frame[14:]
        udp = ip[4 * (ip[0] & 0x0F) :]
        port, _, udp_length = struct.unpack_from(">HHH", udp)
        sender = (ip[12:16], port)
        controller = controller or sender
        datagrams.append((sender == controller, udp[8:udp_length]))
    return datagrams


def conversation(shared_data: Path, name: str) -> list[tuple[bytes, bytes | None]]:
    """Each packet of the controller with the answer it got, if any."""
    pairs: list[tuple[bytes, bytes | None]] = []
    for from_controller, payload in read_datagrams(capture_path(shared_data, name)):
        if from_controller:
            pairs.append((payload, None))
        else:
            packet, earlier = pairs[-1]
            assert earlier is None, f"{name}: two answers to one packet"
            pairs[-1] = (packet, payload)
    return pairs


SEVEN_AXES = "s_TestMode4_movement_7ax_stagger"
IMPOSSIBLE_MAP = "b_ufmg_literal"
MOVED = tuple(name for name in CAPTURES if name not in (SEVEN_AXES, IMPOSSIBLE_MAP))

DIFFERENT_ON_PURPOSE = {
    # The facts' safest answer to a drive that is off is the whole packet, echoed; theirs is zeros.
    "off": {"D1", "D2", "D3", "D4", "D5", "extra1", "extra2"},
    # Target position and velocity given back, as a second independent program did; theirs zeros.
    "driving on": {"D1", "D2"},
    "closed": {"D1", "D2"},
    # Axes open one after the other: theirs sets a target on a closed axis, its library objects
    # and asks for drive-off; ours answers each axis by its own mode.
    "opening": {"mode", "D1"},
    # Theirs takes the step between float32 positions, ours in float64.
    "open": {"D2"},
    # Theirs asks for drive-off because the test wants it; ours has come to the end of its motion.
    "their 505": {"mode", "D2"},
    # Theirs steps by 5 revolutions, detects the following error afterwards, replies 508
    # on the first axis and a target of zero on the others. Ours never sends such a step.
    "their 508": {"mode", "D1"},
}


N = 6


def limits() -> GuardLimits:
    # Wide: a foreign motion of float32 positions has noise for second and third differences.
    far = np.full(N, 100.0)
    each = np.ones(N)
    return GuardLimits(-far, far, 5.0 * each, 1e7 * each, 1e10 * each, 2.0 * each, 10.0 * each)


def train_of(init: InitPacket) -> DriveTrain:
    """Return the arm of the init packet."""
    each = np.ones(N)
    ratio = init.gear_ratio[0, :N]
    calibration = init.calibration[0, :N]
    return DriveTrain(
        ratio, calibration, each, 0.0 * each, each, 10.0 * each, *init.wrist_coupling()
    )


def their_targets(pairs: list[tuple[bytes, bytes | None]]) -> np.ndarray:
    """The set-points (m, n) in motor revolutions that the foreign program sent."""
    rows: list[list[float]] = []
    for packet, reply in pairs:
        if len(packet) == INIT_LENGTH or reply is None:
            continue
        received = oracle.parse(packet, N)
        answer = oracle.parse(reply, N)
        if all(axis.mode in oracle.OPEN for axis in received.axes):
            row = [axis.floats[0] for axis in answer.axes]
            # Its 508 packet has a target in the first slot only.
            refused = any(axis.mode == oracle.FOLLOWING_ERROR for axis in answer.axes)
            rows.append([row[0], *rows[-1][1:]] if refused else row)
    return np.array(rows)


@dataclass
class Replay:
    """A session that receives the packets of a capture, with motion and clock."""

    pairs: list[tuple[bytes, bytes | None]]
    mode: int
    settle_cycles: int
    session: Session = field(init=False)
    now: float = 0.0
    events: list[object] = field(default_factory=list)
    requested: bool = False
    next_number: int | None = None

    def __post_init__(self) -> None:
        init = next(InitPacket.decode(p) for p, _ in self.pairs if len(p) == INIT_LENGTH)
        self.train = train_of(init)
        self.ring = CycleRing(N)
        self.session = Session(
            self.train,
            Guard(limits(), 0.002),
            self.ring,
            mode=self.mode,
            settle_cycles=self.settle_cycles,
        )
        self.targets = their_targets(self.pairs)

    def feed(self, packet: bytes) -> bytes | None:
        number = struct.unpack_from("<i", packet)[0]
        # One capture skips thousands of numbers; only a silence can explain that.
        self.now += 0.002 if self.next_number in (None, number) else 60.0
        self.next_number = oracle.answer_number(number)
        reply = self.session.reply(packet, self.now)
        self.events += self.session.events()
        if self.session.state is State.CLOSED and not self.requested:
            self.session.request(Table(self.train.joint_position(self.targets)))
            self.requested = True
        return reply

    def seen(self, kind: type) -> list:
        return [event for event in self.events if isinstance(event, kind)]


def situation(received: oracle.Packet, theirs: oracle.Packet | None) -> str:
    modes = [axis.mode for axis in received.axes]
    if all(mode == 504 for mode in modes):
        return "end"
    if received.status[0] != oracle.DRIVE_ON:
        return "off"
    if all(mode in oracle.OPEN for mode in modes):
        answered = [axis.mode for axis in theirs.axes] if theirs else []
        for code in (oracle.DRIVE_OFF_REQUEST, oracle.FOLLOWING_ERROR):
            if code in answered:
                return f"their {code}"
        return "open"
    if any(mode in oracle.OPEN for mode in modes):
        return "opening"
    return {501: "driving on", 0: "closed"}[modes[0]]


def expected_open(
    received: oracle.Packet, target: np.ndarray, before: np.ndarray, exit_asked: bool
) -> oracle.Packet:
    """Target and step of an open position mode, nothing else set (facts, section 6)."""
    axes = []
    for axis, now, then in zip(received.axes, target, before, strict=True):
        words = (struct.pack("<f", now), struct.pack("<f", now - then), *(oracle.ZERO,) * 6)
        axes.append(oracle.Axis(axis.mode, words))
    status = bytes([1 if exit_asked else 0, 0, 0, 0])
    return oracle.Packet(oracle.answer_number(received.number), status, oracle.ZERO, tuple(axes))


def fields(names: list[str]) -> set[str]:
    return {name.split("[")[0] for name in names}


def assert_equal(ours: oracle.Packet, expected: oracle.Packet, positions: np.ndarray) -> None:
    """Bit for bit, but for D2 of a moving axis: as exact as the subtraction that makes it."""
    different = oracle.differences(ours, expected)
    assert fields(different) <= {"D2"}, different
    for axis, wanted, position in zip(ours.axes, expected.axes, positions, strict=True):
        exact = 8.0 * np.spacing(max(1.0, abs(position)))
        resolution = np.spacing(np.float32(abs(wanted.floats[1])))
        assert abs(axis.floats[1] - wanted.floats[1]) <= exact + resolution


@pytest.mark.parametrize("name", MOVED)
def test_replies_are_the_documented_ones(shared_data: Path, name: str):
    # Their program asks for the end of open mode with its last set-point.
    settle_cycles = 0 if name == "a_exit" else 5
    mode = 5 if name == "a_mode5" else 4
    replay = Replay(conversation(shared_data, name), mode, settle_cycles)
    arms = (1,) * N
    seen: dict[str, set[str]] = {}
    row = 0
    before = replay.targets[0]
    for packet, reply in replay.pairs:
        ours_raw = replay.feed(packet)
        assert ours_raw is not None
        if len(packet) == INIT_LENGTH or replay.session.state in (State.SYNC, State.INIT):
            assert ours_raw == oracle.echo(packet) == reply
            continue
        assert len(ours_raw) == oracle.length(N)
        received = oracle.parse(packet, N)
        ours = oracle.parse(ours_raw, N)
        theirs = oracle.parse(reply, N) if reply is not None else None
        what = situation(received, theirs)
        if what in ("open", "their 505"):
            target = replay.targets[row]
            leaves = name == "a_exit" and row == len(replay.targets) - 1
            expected = expected_open(received, target, before, leaves)
            assert_equal(ours, expected, target)
            row = row + 1
            before = target
        else:
            expected = oracle.safe_answer(received, arms)
            if what == "their 508":
                axes = tuple(axis._replace(mode=505) for axis in expected.axes)
                expected = expected._replace(axes=axes)
            assert oracle.differences(ours, expected) == [], (what, received.number)
        if theirs is None:
            assert what == "end"
        else:
            seen.setdefault(what, set()).update(fields(oracle.differences(ours, theirs)))
    assert replay.session.state is State.ENDED
    assert replay.session.counters.malformed == replay.session.counters.stale == 0
    for what, differing in seen.items():
        assert differing <= DIFFERENT_ON_PURPOSE[what], (what, differing)
        assert differing or what == "open", f"{what}: nothing differs any more"
    assert {"driving on", "closed"} <= set(seen)
    assert ("opening" in seen) == (name == "a_stagger")
    (ended,) = replay.seen(MotionEnded)
    # In the others the drive went off, or open mode was closed, with the last set-point.
    assert ended.outcome == {"a_508": "refused", "a_exit": "completed"}.get(name, "lost")
    refused = [(event.error.check, event.error.joint) for event in replay.seen(Refused)]
    assert refused == ([(Check.VELOCITY, 0)] if name == "a_508" else [])


def test_controller_with_an_invalid_axis_map_is_not_moved(shared_data: Path):
    """Five axes that all claim slot 1, a cycle of 1500: the foreign driver moved one of them."""
    rig = Rig()
    n = 5
    moved_by_them = 0
    for packet, reply in conversation(shared_data, IMPOSSIBLE_MAP):
        ours_raw = rig.send(packet)
        if len(packet) == INIT_LENGTH:
            assert ours_raw == oracle.echo(packet) == reply
            continue
        received = oracle.parse(packet, n)
        ours = oracle.parse(ours_raw, n)
        expected = oracle.safe_answer(received, (1,) * n)
        if situation(received, None) == "open":
            axes = tuple(axis._replace(mode=oracle.DRIVE_OFF_REQUEST) for axis in expected.axes)
            expected = expected._replace(axes=axes)
        assert oracle.differences(ours, expected) == []
        if reply is not None:
            theirs = oracle.parse(reply, n)
            # It fills the one slot that the map names and leaves -1 as the mode of the others.
            assert [axis.mode for axis in theirs.axes] == [-1, received.axes[1].mode, -1, -1, -1]
            moved_by_them += theirs.axes[1].floats[1] != 0.0
    assert (moved_by_them, rig.state) == (1, State.ENDED)
    assert np.isnan(rig.records["commanded_position"]).all()


def test_session_that_begins_at_speed_gets_no_reply(shared_data: Path):
    """Before an init packet, with a drive on: an echo would be set-points."""
    rig = Rig()
    pairs = conversation(shared_data, SEVEN_AXES)
    for packet, _ in pairs:
        assert rig.send(packet) == (None if packet[4] == oracle.DRIVE_ON else oracle.echo(packet))
    assert rig.session.counters.malformed == sum(packet[4] == 5 for packet, _ in pairs) > 50
    assert rig.state is State.SYNC


def open_axes(pairs: list[tuple[bytes, bytes | None]], name: str) -> int:
    inits = [packet for packet, _ in pairs if len(packet) == INIT_LENGTH]
    # One capture begins after the init packet; its name has the number of axes.
    return 7 if name == SEVEN_AXES else struct.unpack_from("<i", inits[0], 12)[0]


@pytest.mark.parametrize("name", CAPTURES)
def test_packets_decode_and_encode_unchanged(shared_data: Path, name: str):
    datagrams = read_datagrams(capture_path(shared_data, name))
    n = open_axes(conversation(shared_data, name), name)
    kinds = dict.fromkeys(("init", "whole", "long"), 0)
    for from_controller, data in datagrams:
        if len(data) == INIT_LENGTH:
            kinds["init"] += 1
            if from_controller:
                assert is_init(data)
                assert InitPacket.decode(data).encode() == data
            continue
        packet = CyclicPacket.decode(data, n)
        length = cyclic_length(n)
        assert packet.encode() == data[:length]
        kinds["whole" if len(data) == length else "long"] += 1
        if len(data) == cyclic_length(MAX_AXES):
            # Sync packets, and a controller that always sends room for all axes.
            assert CyclicPacket.decode(data, MAX_AXES).encode() == data
        expected = oracle.parse(data, n)
        assert (packet.number, packet.status, packet.functionality) == expected[:3]
        for axis, their in zip(packet.axes, expected.axes, strict=True):
            assert axis["mode"] == their.mode
            assert axis["d"].tobytes() + axis["extra"].tobytes() == b"".join(their.d)
    assert kinds["whole"] > 0, kinds
    assert kinds["init"] == (0 if name == SEVEN_AXES else 2), kinds
    assert (kinds["long"] > 0) == (name not in (SEVEN_AXES, "a_restart506")), kinds
