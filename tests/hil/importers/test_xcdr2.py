"""Messages in version 2 of CDR are read as those in version 1."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.base.errors import SourceError
from hil.cli import app
from hil.importers.imported_robot import Robot
from hil.importers.ros_messages import typestore_of
from hil.importers.rosbag2 import import_rosbag2
from hil.importers.xcdr2 import in_version_1
from tests.hil.importers.bags import DEFINITION, STATE, mcap
from tests.hil.importers.moving_log import COUNT, JOINTS, POSITION, TIME, TORQUE, URDF
from tests.near import near

START = 1_700_000_000 * 10**9


class Message:
    """Bytes as the standard describes them: padded to 4, lists of texts below their size."""

    def __init__(self, order: str) -> None:
        self.order = order
        self.data = b""

    def add(self, kind: str, *values: float) -> Message:
        self.data += bytes(-len(self.data) % min(4, struct.calcsize(kind)))
        self.data += struct.pack(f"{self.order}{len(values)}{kind}", *values)
        return self

    def text(self, value: str) -> Message:
        self.add("I", len(value) + 1)
        self.data += value.encode() + b"\0"
        return self

    def below_its_size(self, part: Message) -> Message:
        self.add("I", len(part.data))
        self.data += part.data
        return self

    def numbers(self, values: Sequence[float]) -> Message:
        return self.add("I", len(values)).add("d", *values)


def encoded(row: int, head: int) -> bytes:
    """A joint state, its structures below their sizes where the encapsulation says so."""
    order = "<" if head & 1 else ">"
    stamp = START + round(1e9 * TIME[row])

    def new() -> Message:
        return Message(order)

    def add(whole: Message, part: Message) -> Message:
        if head >= 8:
            return whole.below_its_size(part)
        whole.data += part.data
        return whole

    time = new().add("i", stamp // 10**9).add("I", stamp % 10**9)
    header = add(new(), time).text("ba")  # an odd length: what follows is padded
    texts = new().add("I", len(JOINTS))
    for name in JOINTS:
        texts.text(name)
    state = add(new(), header).below_its_size(texts)
    state.numbers(POSITION[row]).numbers([]).numbers(TORQUE[row])
    message = add(new(), state).data
    return bytes((0, head, 0, 0)) + message


@pytest.mark.parametrize("head", [6, 7, 8, 9])
def test_joint_states_are_read(tmp_path: Path, head: int) -> None:
    """Plain or with sizes, of either order of bytes."""
    urdf = tmp_path / "three.urdf"
    urdf.write_text(URDF)
    messages = [(START + round(1e9 * t), encoded(row, head)) for row, t in enumerate(TIME)]
    source = mcap(tmp_path / "log.mcap", {"/js": (STATE, DEFINITION, "cdr", messages)})
    output = tmp_path / "out.mcap"
    columns = open_archive(import_rosbag2(source, output, robot=Robot.from_urdf(urdf))).columns
    assert np.array_equal(columns["position"], POSITION)
    assert np.array_equal(columns["torque"], TORQUE)


def test_arrays_of_structures_are_below_their_size() -> None:
    """Of a message with two structures of one byte and two doubles, after a text."""
    definition = (
        "string firmware\nvendor_msgs/Drive[2] drives\nint16[3] codes\n"
        + 80 * "="
        + "\nMSG: vendor_msgs/Drive\nint8 mode\nfloat64 angle\nfloat64 current\n"
    )
    kind = "vendor_msgs/msg/State"
    store = typestore_of(kind, definition, "ros2msg")
    drives = Message("<").add("b", 1).add("d", 0.5, 2.0).add("b", 2).add("d", 1.5, 3.0)
    message = Message("<").text("v1").below_its_size(drives).add("h", 7, 8, 9)
    data = in_version_1(b"\0\x07\0\0" + message.data, kind, store)
    read = store.deserialize_cdr(data, kind)
    assert read.firmware == "v1"
    assert [(drive.mode, drive.angle, drive.current) for drive in read.drives] == [
        (1, 0.5, 2.0),
        (2, 1.5, 3.0),
    ]
    assert read.codes.tolist() == [7, 8, 9]


@pytest.mark.parametrize("cut", [5, 20, 60, 100])
def test_a_message_that_is_cut_off_is_named(tmp_path: Path, cut: int) -> None:
    urdf = tmp_path / "three.urdf"
    urdf.write_text(URDF)
    messages = [(START + k, encoded(k, 7)[: None if k != 3 else cut]) for k in range(9)]
    source = mcap(tmp_path / "log.mcap", {"/js": (STATE, DEFINITION, "cdr", messages)})
    with pytest.raises(SourceError, match="message 3 cannot be decoded"):
        import_rosbag2(source, tmp_path / "out.mcap", robot=Robot.from_urdf(urdf))


def test_the_recording_of_a_public_report(shared_data: Path, tmp_path: Path) -> None:
    cases = shared_data.parent / "cases" / "diagnosis"
    if not cases.is_dir():
        pytest.skip("the cases (../shared/cases/diagnosis) are not beside this checkout")
    output = tmp_path / "out.mcap"
    line = ["import", "rosbag2", cases / "13-containers" / "xcdr2.mcap", "--urdf"]
    line += [cases / "arm.urdf", "-o", output]
    assert CliRunner().invoke(app, [*map(str, line)]).exit_code == 0
    columns = open_archive(output).columns
    table = np.loadtxt(cases / "11-urdf-units" / "log.csv", delimiter=",", skiprows=1)
    some = table[: len(columns["position"])]
    assert len(some) > COUNT
    assert columns["position"] == near(some[:, 1:7], rel=1e-7)  # of eight digits
    assert columns["torque"] == near(some[:, 7:], rel=1e-6)
