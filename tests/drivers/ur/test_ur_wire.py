"""Frames of RTDE as a session reads them, made here byte by byte after the maker's guide."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.c4g_packets import DRIVE_ON
from drivers.errors import PacketError
from drivers.states import Input, State
from drivers.ur.description import UrDescription
from drivers.ur.identity import ArmIdentity
from drivers.ur.rtde import ControllerVersion, FrameType, OutputRecipe
from drivers.ur.wire import OPTIONAL, REQUIRED, UrWire, reasons_not_to_move, version_problem
from drivers.wire import ArmSettings, Handshake, MeasuredCycle, Remark, Repeated, Stale
from tests.drivers.ur.ur_bench import PERIOD, ur_cell

pytestmark = pytest.mark.safety

FORMATS = {
    "DOUBLE": "d", "VECTOR6D": "6d", "VECTOR3D": "3d", "INT32": "i", "UINT32": "I",
    "VECTOR6INT32": "6i",
}  # fmt: skip
KINDS = {
    "joint_mode": "VECTOR6INT32", "robot_mode": "INT32", "safety_mode": "INT32",
    "runtime_state": "UINT32", "robot_status_bits": "UINT32", "safety_status_bits": "UINT32",
    "payload_cog": "VECTOR3D",
    **dict.fromkeys(
        (
            "timestamp", "speed_scaling", "target_speed_fraction", "payload",
            "joint_position_deviation_ratio", "collision_detection_ratio",
        ),
        "DOUBLE",
    ),
}  # fmt: skip
NUMBER, STAGE, UNUSED, TOKEN, ENDING = (f"output_int_register_{k}" for k in range(24, 29))
ANGLES = tuple(f"output_double_register_{k}" for k in range(24, 30))
PLAYING, STOPPED = 2, 1
WAITING, STREAMING, STOPPING, ENDED = range(1, 5)
RUNNING, NORMAL = 7, 1


def kind_of(name: str) -> str:
    register = {"output_int": "INT32", "output_double": "DOUBLE"}
    return KINDS.get(name) or register.get(name.partition("_register")[0], "VECTOR6D")


def introduction(
    names: Sequence[str] = REQUIRED,
    identity: ArmIdentity | None = None,
    version: tuple[int, int, int, int] = (5, 11, 0, 0),
    frequency: float = 1.0 / PERIOD,
) -> bytes:
    recipe = OutputRecipe(3, tuple(names), tuple(map(kind_of, names)))
    who = identity or ArmIdentity(remote_control=True)
    return UrDescription(who, ControllerVersion(*version), frequency, recipe, 2).encode()


REST: Mapping[str, object] = {
    "robot_mode": RUNNING, "safety_mode": NORMAL, "runtime_state": STOPPED,
    "speed_scaling": 1.0, "target_speed_fraction": 1.0,
}  # fmt: skip


def frame(stamp: float, names: Sequence[str] = REQUIRED, number: int = 3, **values) -> bytes:
    """A frame of outputs; what is not given is that of an arm at rest, or 0."""
    given = {"timestamp": stamp, **REST, **values}
    body = b""
    for name in names:
        layout = struct.Struct(">" + FORMATS[kind_of(name)])
        count = len(layout.unpack(bytes(layout.size)))
        body += layout.pack(*np.broadcast_to(given.get(name, 0), count).tolist())
    return struct.pack(">HBB", 4 + len(body), FrameType.DATA, number) + body


TRAIN = replace(ur_cell().drive_train, calibration=np.arange(3.0, 9.0))
PER_RAD = TRAIN.gear_ratio / (2.0 * np.pi)


def new_wire(**settings) -> UrWire:
    arm = ArmSettings(
        TRAIN, PERIOD, mode=0, arm=0, other_axes=(), only_axis=None,
        silence_timeout=1.0,
    )  # fmt: skip
    return ur_cell().ur_protocol.wire(replace(arm, **settings))


class Reader:
    """A wire whose controller has introduced itself."""

    def __init__(self, names: Sequence[str] = REQUIRED) -> None:
        self.names = names
        self.wire = new_wire()
        self.state = State.SYNC
        self.read(introduction(names))
        self.state = State.INIT

    def read(self, packet: bytes):
        return self.wire.receive(packet, self.state, None)

    def frame(self, stamp: float, **values):
        return self.read(frame(stamp, self.names, **values))

    def axes(self, **values):
        """The axes as the frame of the first cycle states them."""
        received = self.frame(1.0, **values)
        assert isinstance(received, MeasuredCycle)
        return received.axes

    def recorded(self) -> np.ndarray:
        self.wire.record(np.zeros((8, 6)))
        return self.wire.motors.raw


class TestBytes:
    @given(st.permutations([*REQUIRED, *OPTIONAL]))
    def test_values_are_read_in_any_order(self, names):
        reader = Reader(names)
        q, qd, current = np.arange(6.0), np.arange(10.0, 16.0), np.arange(20.0, 26.0)
        reader.frame(
            1.0, target_q=q, target_qd=qd, actual_q=q + 0.5, actual_qd=qd + 0.5,
            actual_current=current, target_current=current + 0.5,
        )  # fmt: skip
        expected = [
            PER_RAD * q + TRAIN.calibration, PERIOD * PER_RAD * qd,
            PER_RAD * (q + 0.5) + TRAIN.calibration, PERIOD * PER_RAD * (qd + 0.5),
            current, current + 0.5,
        ]  # fmt: skip
        np.testing.assert_allclose(reader.recorded()[:6], expected, rtol=1e-14)
        assert np.isnan(reader.recorded()[6:]).all()
        first = reader.wire.sort(frame(2.0, names))
        assert first == (False, first.kind, round(2.0 / PERIOD))
        codes = {"robot_mode": 3, "safety_mode": 5, "runtime_state": 4, STAGE: 2}
        kinds = {first.kind} | {
            reader.wire.sort(frame(3.0, names, **{name: code})).kind for name, code in codes.items()
        }
        assert len(kinds) == 5 and {len(kind) for kind in kinds} == {16}
        changed = frame(3.0, names, actual_q=q, actual_current=current, **{NUMBER: 7, TOKEN: 9})
        assert reader.wire.sort(changed).kind == first.kind

    @pytest.mark.parametrize(
        ("packet", "message"),
        [
            (b"\0\3", "packet length is 2; expected a frame of RTDE"),
            (struct.pack(">HB", 3, FrameType.START),
             "packet type is 83; expected a frame of outputs, or a text"),
            (frame(1.0)[:-1], "packet length is {less}; expected {length} bytes"),
            (frame(1.0, number=4), "packet recipe is 4; expected 3, the one requested"),
            (introduction(tuple(name for name in REQUIRED if name != "joint_mode")),
             "packet outputs is ['joint_mode']; expected all that a motion needs"),
        ],
    )  # fmt: skip
    def test_what_is_no_frame_is_named(self, packet, message):
        length = len(frame(1.0))
        with pytest.raises(PacketError) as caught:
            Reader().read(packet)
        assert str(caught.value) == message.format(length=length, less=length - 1)

    def test_a_frame_before_the_introduction(self):
        with pytest.raises(PacketError) as caught:
            new_wire().receive(frame(1.0), State.SYNC, None)
        assert str(caught.value) == "packet type is 85; expected an introduction first"

    def test_a_text_without_content(self):
        with pytest.raises(PacketError, match="length of the text"):
            Reader().read(struct.pack(">HB", 3, FrameType.TEXT))

    def test_texts_are_remarks(self):
        text = b"\x05hello\x04RTDE\x01"
        packet = struct.pack(">HB", 3 + len(text), FrameType.TEXT) + text
        assert new_wire().receive(packet, State.SYNC, None) == Remark("RTDE: hello")


class TestIntroduction:
    def test_it_is_answered_by_nothing_and_once(self):
        wire = new_wire()
        received = wire.receive(introduction(), State.SYNC, None)
        assert isinstance(received, Handshake)
        assert (received.cause, received.reply) == (Input.INIT, b"")
        assert received.received.unusable is None and received.received.differences == ()
        assert isinstance(wire.receive(introduction(), State.INIT, None), Repeated)
        assert isinstance(wire.receive(introduction(), State.CLOSED, None), Handshake)
        other = introduction(identity=ArmIdentity(remote_control=True, serial_number="7"))
        assert isinstance(wire.receive(other, State.INIT, None), Handshake)

    def test_all_reasons_not_to_move(self):
        strange = introduction(
            identity=ArmIdentity(remote_control=False), version=(5, 9, 0, 0), frequency=125.0
        )
        found = new_wire().receive(strange, State.SYNC, None).received
        assert found.differences == (
            "its software is 5.9.0.0; motions need 5.10 or newer of PolyScope 5, or 3.11 or newer "
            "of a CB3",
            "cycle is 8 ms in the controller, 2 ms in the cell",
            "it is in local mode: switch it to remote control at the pendant",
        )
        assert found.unusable == "; ".join(found.differences)

    def test_the_oldest_software(self):
        assert [version_problem(ControllerVersion(*v, 0, 0)) for v in ((5, 10), (3, 11))] == [
            "",
            "",
        ]
        assert all(version_problem(ControllerVersion(*v, 0, 0)) for v in ((5, 9), (3, 10), (4, 99)))

    @pytest.mark.parametrize(("off", "reasons"), [(0.9e-9, 0), (1.1e-9, 1)])
    def test_cycles_agree_within_a_nanosecond(self, off, reasons):
        packet = introduction(frequency=1.0 / (0.25 + off))
        found = reasons_not_to_move(
            ur_cell().ur_protocol.expected, UrDescription.decode(packet), 0.25
        )
        assert len(found) == reasons

    def test_four_joints_or_a_single_axis(self):
        with pytest.raises(ValueError) as caught:
            new_wire(only_axis=2)
        message = "a controller of Universal Robots opens all axes or none"
        assert str(caught.value) == message
        four = replace(
            TRAIN,
            **{
                name: getattr(TRAIN, name)[:4]
                for name in (
                    "gear_ratio", "calibration", "joint_sign", "joint_offset", "torque_constant",
                    "current_limit",
                )
            },
        )  # fmt: skip
        with pytest.raises(ValueError) as caught:
            new_wire(drive_train=four)
        assert str(caught.value) == "4 joints; an arm of Universal Robots has 6"


class TestCycles:
    def test_they_are_counted_by_the_time_stamp(self):
        reader = Reader()
        found = [reader.frame(stamp) for stamp in (5.0, 5.002, 5.008)]
        assert [(c.number, c.cycle, c.missed) for c in found] == [(2, 1, 0), (3, 2, 0), (6, 5, 2)]

    def test_the_same_frame_again_is_no_cycle(self):
        reader = Reader()
        reader.frame(5.0)
        assert isinstance(reader.frame(5.0), Repeated)

    @pytest.mark.parametrize(
        ("cycles", "kind"),
        [(0.74, Stale), (0.75, MeasuredCycle), (1.25, MeasuredCycle), (-3.0, Stale),
         (2.75, MeasuredCycle), (float("nan"), Stale)],
    )  # fmt: skip
    def test_stamps_a_quarter_cycle_off(self, cycles, kind):
        reader = Reader()
        reader.frame(0.0)
        assert isinstance(reader.frame(cycles * PERIOD, actual_q=1.0), kind)

    def test_a_stamp_of_the_past_is_named(self):
        reader = Reader()
        reader.frame(5.0)
        assert reader.frame(4.0) == Stale("the time stamp 4.000 s does not follow 5.000 s")

    @pytest.mark.parametrize("cycles", [1.5, 7.4, 2.0**30, float("inf")])
    def test_stamps_between_cycles(self, cycles):
        reader = Reader()
        reader.frame(0.0)
        with pytest.raises(PacketError) as caught:
            reader.frame(cycles * PERIOD)
        found = f"{1e3 * cycles * PERIOD:.3g} ms"
        assert str(caught.value) == (
            f"packet time between two frames is '{found}'; expected 2 ms, the controller's cycle, "
            "or a multiple"
        )

    @pytest.mark.parametrize(("stamp", "cycle"), [(0.5, 2), (5.002, 2), (5.006, 4), (5.0015, 2)])
    def test_a_controller_restarted_in_silence(self, stamp, cycle):
        reader = Reader()
        reader.frame(5.0)
        reader.wire.lost()
        assert reader.frame(stamp).cycle == cycle
        assert isinstance(reader.frame(0.2), Stale)  # the silence is over

    def test_a_new_introduction_counts_anew(self):
        reader = Reader()
        reader.frame(5.0)
        reader.wire.lost()
        reader.state = State.CLOSED
        reader.read(introduction())
        assert reader.frame(1.0).cycle == 1
        assert isinstance(reader.frame(0.5), Stale)


class TestAxes:
    """What one frame says; the program's token is 1 before this session has sent one."""

    @pytest.mark.parametrize(
        ("values", "kind", "cause"),
        [
            ({}, Input.CLOSED, ""),
            ({"robot_mode": 3}, Input.OFF, "the arm is not running: power off"),
            ({"robot_mode": 5}, Input.DRIVING_ON, "the arm is not running: idle"),
            ({"robot_mode": 42}, Input.OFF, "the arm is not running: robot mode 42"),
            ({"safety_mode": 5}, Input.PAUSE, "the arm was stopped: safeguard stop"),
            ({"safety_mode": 3}, Input.UNAVAILABLE, "the arm was stopped: protective stop"),
            ({"safety_mode": 77}, Input.UNAVAILABLE, "the arm was stopped: safety mode 77"),
            ({"safety_mode": 3, "robot_mode": 3}, Input.OFF,
             "the arm was stopped: protective stop"),
            ({"runtime_state": 3}, Input.PAUSE, "the program on the controller was paused"),
            ({"runtime_state": 4, "safety_mode": 3}, Input.UNAVAILABLE,
             "the arm was stopped: protective stop"),
        ],
    )  # fmt: skip
    def test_without_a_program(self, values, kind, cause):
        axes = Reader().axes(**values)
        assert (axes.input, axes.cause) == (kind, cause)
        assert not (axes.powered or axes.any_open or axes.ready.any() or axes.held_joints.any())
        assert axes.status == (DRIVE_ON if values.get("robot_mode", RUNNING) == RUNNING else 0)
        assert axes.unwanted is None
        assert axes.remedy == (
            "look at the arm and at the pendant; when the arm is ready again, run the same command"
        )

    @pytest.mark.parametrize(
        ("stage", "kind"),
        [
            (WAITING, Input.PARTLY_OPEN), (STREAMING, Input.OPEN), (STOPPING, Input.UNAVAILABLE),
            (ENDED, Input.CLOSED), (0, Input.CLOSED),
        ],
    )  # fmt: skip
    def test_with_the_program_of_this_session(self, stage, kind):
        modes = np.arange(255, 249, -1)
        axes = Reader().axes(
            runtime_state=PLAYING, joint_mode=modes, **{TOKEN: 1, STAGE: stage, ENDING: 1}
        )
        assert axes.input is kind
        opened = kind in (Input.OPEN, Input.PARTLY_OPEN)
        assert axes.powered is axes.any_open is opened
        assert axes.held_joints.all() == axes.held_joints.any() == opened
        assert axes.ready.all() == axes.ready.any() == (kind is Input.OPEN)
        np.testing.assert_array_equal(axes.modes, modes)
        assert axes.misplacement(2) == (axes.cause or "joint 3 is in mode 253")

    @pytest.mark.parametrize(
        ("ending", "cause"),
        [
            (0, "the program on the controller was stopped there"),
            (3, "no new set-point reached the controller in time: its program stopped the arm"),
            (99, "the program on the controller was stopped there"),
        ],
    )
    @pytest.mark.parametrize("stage", [STOPPING, ENDED])
    def test_a_program_that_ends_says_why(self, stage, ending, cause):
        axes = Reader().axes(runtime_state=PLAYING, **{TOKEN: 1, STAGE: stage, ENDING: ending})
        assert axes.cause == cause

    @pytest.mark.parametrize("stage", [WAITING, STREAMING])
    @pytest.mark.parametrize(("text", "said"), [(b"", ""), (b"\x05limit\x03ROB\x01", " (limit)")])
    def test_a_program_that_was_stopped(self, stage, text, said):
        """The registers keep what it wrote last."""
        reader = Reader()
        if text:
            reader.read(struct.pack(">HB", 3 + len(text), FrameType.TEXT) + text)
        axes = reader.axes(runtime_state=STOPPED, **{TOKEN: 1, STAGE: stage})
        assert axes.input is Input.CLOSED
        assert axes.cause == "the program on the controller was stopped there" + said

    def test_a_program_of_others_is_none_of_ours(self):
        axes = Reader().axes(runtime_state=PLAYING, **{TOKEN: 2, STAGE: STREAMING, ENDING: 3})
        assert (axes.input, axes.cause) == (Input.CLOSED, "")


class TestUsedSetPoints:
    """While the program streams, what it states to have used is the target."""

    STREAMS: Mapping[str, int] = {"runtime_state": PLAYING, TOKEN: 1, STAGE: STREAMING}

    def frame(self, reader: Reader, stamp: float, angles, **values):
        given = dict(zip(ANGLES, angles, strict=True))
        return reader.frame(stamp, **{**self.STREAMS, **given, **values})

    def test_target_and_its_step(self):
        reader = Reader()
        first, third = np.arange(6.0), np.arange(6.0) + 0.3
        self.frame(reader, 1.0, first, target_q=9.0, target_qd=9.0)
        raw = reader.recorded()
        np.testing.assert_allclose(raw[0], PER_RAD * first + TRAIN.calibration, rtol=1e-14)
        assert not raw[1].any()
        self.frame(reader, 1.0 + 3 * PERIOD, third)  # two frames are lost
        raw = reader.recorded()
        np.testing.assert_allclose(raw[1], PER_RAD * 0.1, rtol=1e-12)
        reader.frame(1.0 + 4 * PERIOD)
        reader.recorded()
        self.frame(reader, 1.0 + 5 * PERIOD, third)
        assert not reader.recorded()[1].any()  # a new program has no step to the one before

    @pytest.mark.parametrize(
        ("counts", "new"), [((4, 4), 0), ((4, 7), 3), ((0, 1), 1), ((7, 2), 0)]
    )
    def test_cycles_without_a_new_set_point(self, counts, new):
        reader = Reader()
        for k, count in enumerate(counts):
            self.frame(reader, 1.0 + k * PERIOD, np.zeros(6), **{UNUSED: count})
        assert reader.wire.not_used() == new

    def test_unused_before_the_motion(self):
        reader = Reader()
        self.frame(reader, 1.0, np.zeros(6), **{UNUSED: 5, STAGE: WAITING})
        assert reader.wire.not_used() == 0
        self.frame(reader, 1.002, np.zeros(6), **{UNUSED: 6})
        assert reader.wire.not_used() == 1
        reader.frame(1.004)
        assert reader.wire.not_used() == 0
        self.frame(reader, 1.006, np.zeros(6), **{UNUSED: 2})
        assert reader.wire.not_used() == 2
