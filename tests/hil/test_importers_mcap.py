"""Other people's MCAP files become archives: bags of ROS 2, and any messages by a column map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.cli import app
from hil.errors import SourceError
from hil.importers import ColumnMap, Robot, import_log, import_rosbag2
from hil.importers.arrays import read_mcap
from hil.recordings import open_recording
from identification import FrictionLaw

STATE = "sensor_msgs/msg/JointState"
STORE = get_typestore(Stores.ROS2_HUMBLE)
URDF = """<robot name="two"><link name="base"/>
<link name="upper"><inertial><mass value="1"/><origin xyz="0 0 0.2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="lower"><inertial><mass value="1"/><origin xyz="0 0 0.2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hip" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<joint name="ankle" type="revolute"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
<origin xyz="0 0 0.4"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint></robot>"""
COUNT = 300
EPOCH = 1_700_000_000_000_000_000
STAMPS = EPOCH + 8_000_000 * np.arange(COUNT)
RANDOM = np.random.default_rng(11)
POSITION, VELOCITY, EFFORT = RANDOM.normal(size=(3, COUNT, 2))
DRIVES = """\
# What a vendor's driver says of each drive.
std_msgs/Header header
uint8 OK = 0
bool enabled
Drive[2] drives
float32[] temperature
string firmware
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: vendor_msgs/Drive
int8 mode
float64 angle  # deg, motor side
float64 current
"""


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    path = tmp_path / "two.urdf"
    path.write_text(URDF)
    return Robot.from_urdf(path, friction=FrictionLaw(third=None, offset=True))


def state(row: int, names: Sequence[str] = ("ankle", "hip")) -> Any:
    """A joint state; the joints in another order than the robot's."""
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](
        sec=int(STAMPS[row] // 10**9), nanosec=int(STAMPS[row] % 10**9)
    )
    return types[STATE](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id="arm"),
        name=list(names),
        position=POSITION[row, ::-1].copy(),
        velocity=VELOCITY[row, ::-1].copy(),
        effort=EFFORT[row, ::-1].copy(),
    )


def states() -> list[tuple[int, bytes]]:
    return [
        (int(STAMPS[row]) + 123_456, bytes(STORE.serialize_cdr(state(row), STATE)))
        for row in range(COUNT)
    ]


def mcap(
    path: Path,
    topics: dict[str, tuple[str, str, str, list[tuple[int, bytes]]]],
    **options: Any,
) -> Path:
    """An MCAP file; topics as type, definition, encoding and messages."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2")
        for topic, (kind, definition, encoding, messages) in topics.items():
            schema = writer.register_schema(kind, "ros2msg", definition.encode())
            channel = writer.register_channel(topic, encoding, schema)
            for number, (time, data) in enumerate(messages):
                writer.add_message(channel, time, data, time, number)
        writer.finish()
    return path


def joint_states(path: Path, **options: Any) -> Path:
    definition, _ = STORE.generate_msgdef(STATE, ros_version=2)
    return mcap(path, {"/joint_states": (STATE, definition, "cdr", states())}, **options)


def assert_imported(path: Path, *, torque: bool = True) -> None:
    archive = open_archive(path)
    assert archive.complete, archive.missing
    columns = archive.columns
    assert columns["stamp"].tolist() == STAMPS.tolist()
    assert columns["position"].tobytes() == POSITION.tobytes()
    assert columns["velocity"].tobytes() == VELOCITY.tobytes()
    assert ("torque" in columns) == torque
    effort = columns["torque" if torque else "motor_current"]
    assert effort.tobytes() == EFFORT.tobytes()


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("use_chunking", [True, False])
def test_joint_states_of_any_mcap_file(
    tmp_path: Path, robot: Robot, compression: CompressionType, use_chunking: bool
) -> None:
    source = joint_states(
        tmp_path / "x.mcap",
        compression=compression,
        chunk_size=20_000,
        use_chunking=use_chunking,
        use_summary_offsets=False,
    )
    assert_imported(import_rosbag2(source, tmp_path / "out.mcap", robot=robot))


def test_a_file_without_index_or_checksums_is_read_as_well(tmp_path: Path, robot: Robot) -> None:
    source = joint_states(
        tmp_path / "x.mcap",
        enable_crcs=False,
        use_statistics=False,
        repeat_schemas=False,
        repeat_channels=False,
    )
    assert_imported(import_rosbag2(source, tmp_path / "out.mcap", robot=robot))


def test_efforts_may_be_motor_currents(tmp_path: Path, robot: Robot) -> None:
    source = joint_states(tmp_path / "x.mcap")
    out = import_rosbag2(source, tmp_path / "out.mcap", robot=robot, effort="motor_current")
    assert_imported(out, torque=False)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("mode", ["none", "file", "message"])
def test_bags_of_either_storage_compressed_or_not(
    tmp_path: Path, robot: Robot, storage: StoragePlugin, mode: str
) -> None:
    writer = BagWriter(tmp_path / "bag", version=9, storage_plugin=storage)
    if mode != "none":
        writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/joint_states", STATE, typestore=STORE)
        for time, data in states():
            writer.write(connection, time, data)
    assert_imported(import_rosbag2(tmp_path / "bag", tmp_path / "out.mcap", robot=robot))


def test_the_parts_of_a_split_bag_follow_each_other_by_number(tmp_path: Path, robot: Robot) -> None:
    definition, _ = STORE.generate_msgdef(STATE, ros_version=2)
    bag = tmp_path / "bag"
    bag.mkdir()
    everything = states()
    for part in range(12):
        some = everything[part * 25 : (part + 1) * 25]
        mcap(bag / f"bag_{part}.mcap", {"/joint_states": (STATE, definition, "cdr", some)})
    # A part in which no joint state was recorded.
    mcap(bag / "bag_12.mcap", {"/note": ("std_msgs/msg/String", "string data", "cdr", [(1, b"")])})
    packed = zstandard.compress((bag / "bag_3.mcap").read_bytes())
    (bag / "bag_3.mcap.zstd").write_bytes(packed)
    (bag / "bag_3.mcap").unlink()
    assert_imported(import_rosbag2(bag, tmp_path / "out.mcap", robot=robot))


def test_an_archive_of_ours_can_be_imported_like_any_other(tmp_path: Path, robot: Robot) -> None:
    first = import_rosbag2(joint_states(tmp_path / "x.mcap"), tmp_path / "a.mcap", robot=robot)
    assert_imported(import_rosbag2(first, tmp_path / "b.mcap", robot=robot))


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_joint_states_in_another_encoding_are_refused_by_its_name(
    tmp_path: Path, robot: Robot, encoding: str
) -> None:
    topics = {"/joints": ("foxglove.JointStates", "", encoding, [(1, b"{}")])}
    source = mcap(tmp_path / "x.mcap", topics)
    with pytest.raises(SourceError, match=f"/joints \\(foxglove.JointStates in {encoding}\\)"):
        import_rosbag2(source, tmp_path / "out.mcap", robot=robot)
    with pytest.raises(SourceError, match=f"/joints: foxglove.JointStates in {encoding} is not"):
        import_log(source, tmp_path / "out.mcap", robot=robot, columns=by_map())


@pytest.mark.parametrize("kept", [0, 3, 40, 5000, -1])
def test_files_that_are_cut_off_are_refused_in_a_sentence(
    tmp_path: Path, robot: Robot, kept: int
) -> None:
    source = joint_states(tmp_path / "x.mcap", chunk_size=5000)
    source.write_bytes(source.read_bytes()[:kept])
    with pytest.raises(SourceError, match="no MCAP file, or cut off"):
        import_rosbag2(source, tmp_path / "out.mcap", robot=robot)


def test_a_damaged_chunk_is_noticed(tmp_path: Path, robot: Robot) -> None:
    source = joint_states(tmp_path / "x.mcap", compression=CompressionType.NONE)
    data = bytearray(source.read_bytes())
    data[data.index(POSITION[150, ::-1].tobytes())] ^= 1
    source.write_bytes(data)
    with pytest.raises(SourceError, match="no MCAP file, or cut off"):
        import_rosbag2(source, tmp_path / "out.mcap", robot=robot)


def by_map(**more: Any) -> ColumnMap:
    return ColumnMap.model_validate(
        {
            "time": {"column": "/drives/stamp", "unit": "ns"},
            "joints": ["hip", "ankle"],
            "position": {
                "columns": ["/drives/drives/0/angle", "/drives/drives/1/angle"],
                "unit": "deg",
                "side": "motor",
            },
            "motor_current": {"columns": ["/drives/drives/0/current", "/drives/drives/1/current"]},
            "drive": {"gear_ratio": [100.0, -50.0]},
            **more,
        }
    )


def drives(path: Path, *, firmware: str = "2.1", with_states: bool = False) -> Path:
    """A vendor's own messages, serialised by rosbags."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(DRIVES, "vendor_msgs/msg/Drives"))
    types = store.types
    angle = np.rad2deg(POSITION) * [100.0, -50.0]
    messages = []
    for row, stamp in enumerate(STAMPS.tolist()):
        time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        message = types["vendor_msgs/msg/Drives"](
            header=types["std_msgs/msg/Header"](stamp=time, frame_id=""),
            enabled=True,
            drives=[
                types["vendor_msgs/msg/Drive"](mode=4, angle=angle[row, i], current=EFFORT[row, i])
                for i in range(2)
            ],
            temperature=np.array([40.0, 41.0 + row, 42.0], np.float32),
            firmware=firmware if row == COUNT - 1 else "2.1",
        )
        messages.append((stamp, bytes(store.serialize_cdr(message, "vendor_msgs/msg/Drives"))))
    topics = {"/drives": ("vendor_msgs/msg/Drives", DRIVES, "cdr", messages)}
    if with_states:
        definition, _ = STORE.generate_msgdef(STATE, ros_version=2)
        topics["/joint_states"] = (STATE, definition, "cdr", states())
        topics["/json"] = ("anything", "", "json", [(1, b"{}")])
    return mcap(path, topics, chunk_size=10_000)


def test_messages_of_any_type_are_imported_with_a_column_map(tmp_path: Path, robot: Robot) -> None:
    out = import_log(
        drives(tmp_path / "x.mcap"), tmp_path / "out.mcap", robot=robot, columns=by_map()
    )
    columns = open_archive(out).columns
    assert columns["stamp"].tolist() == STAMPS.tolist()
    np.testing.assert_allclose(columns["position"], POSITION, rtol=0, atol=1e-12)
    assert columns["motor_current"].tobytes() == EFFORT.tobytes()
    recording = open_recording(out)
    assert recording.motor_current is not None


def test_positions_of_one_topic_go_with_currents_of_another(tmp_path: Path, robot: Robot) -> None:
    columns = by_map(
        position={"columns": "/joint_states/position"},
        time={"column": "/joint_states/stamp", "unit": "ns"},
        joints=["ankle", "hip"],
    )
    source = drives(tmp_path / "x.mcap", with_states=True)
    archive = open_archive(import_log(source, tmp_path / "o.mcap", robot=robot, columns=columns))
    assert archive.columns["position"].tobytes() == POSITION.tobytes()
    assert archive.columns["motor_current"].tobytes() == EFFORT[:, ::-1].tobytes()


def test_every_number_of_a_message_is_an_array_named_by_its_path(tmp_path: Path) -> None:
    arrays = read_mcap(drives(tmp_path / "x.mcap"))
    assert set(arrays) == {
        "/drives/stamp", "/drives/enabled", "/drives/temperature",
        *(f"/drives/drives/{i}/{name}" for i in range(2) for name in ("mode", "angle", "current")),
    }  # fmt: skip
    assert arrays["/drives/temperature"].shape == (COUNT, 3)
    assert arrays["/drives/temperature"].dtype == np.float32
    assert arrays["/drives/temperature"][7].tolist() == [40.0, 48.0, 42.0]
    assert set(arrays["/drives/drives/1/mode"].tolist()) == {4}


@pytest.mark.parametrize(
    ("firmware", "why"), [("2.2", "differ in names"), ("2.10-beta", "differ in length")]
)
def test_a_topic_whose_messages_are_not_alike_is_refused_with_the_reason(
    tmp_path: Path, robot: Robot, firmware: str, why: str
) -> None:
    source = drives(tmp_path / "x.mcap", firmware=firmware)
    with pytest.raises(SourceError, match=f"/drives: its messages {why}"):
        import_log(source, tmp_path / "o.mcap", robot=robot, columns=by_map())


def test_an_array_that_is_not_there_is_refused_with_those_that_are(
    tmp_path: Path, robot: Robot
) -> None:
    columns = by_map(position={"columns": "/drives/position"})
    with pytest.raises(SourceError, match=r"no array '/drives/position'.*/drives/temperature"):
        import_log(drives(tmp_path / "x.mcap"), tmp_path / "o.mcap", robot=robot, columns=columns)


def test_on_the_command_line_it_goes_by_the_name_of_the_file_s_kind(tmp_path: Path) -> None:
    (tmp_path / "two.urdf").write_text(URDF)
    source = joint_states(tmp_path / "x.mcap")
    for name in ("mcap", "rosbag2"):
        out = tmp_path / f"{name}.mcap"
        given = ["import", name, str(source), "-o", str(out), "--urdf", str(tmp_path / "two.urdf")]
        done = CliRunner().invoke(app, given)
        assert done.exit_code == 0, done.output
        assert_imported(out)
