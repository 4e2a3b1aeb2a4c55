"""Import of rosbag2 recordings and MCAP files: joint states, other messages, untrusted files."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from time import monotonic
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

from hil.archive import Archive, open_archive, verified_records
from hil.archive.cdr import ENCAPSULATION
from hil.archive.recording_of_archive import open_recording
from hil.base.errors import InputError, SourceError
from hil.cell import Cell
from hil.importers import bags, mcap_messages
from hil.importers.array_files import read_mcap
from hil.importers.column_map import ColumnMap
from hil.importers.imported_robot import Robot
from hil.importers.log import import_log
from hil.importers.ros_messages import MessageError, decoded, typestore_of
from hil.importers.rosbag2 import import_rosbag2, recorded_joints
from identification import FrictionLaw
from tests.hil import mcap_bytes
from tests.hil.importers.bags import (
    COUNT,
    DEFINITION,
    EFFORT,
    POSITION,
    STAMPS,
    STATE,
    STORE,
    URDF,
    VELOCITY,
    Messages,
    bag,
    drives,
    many,
    mcap,
    state,
    states,
)

TOPIC = "/joint_states"


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    path = tmp_path / "two.urdf"
    path.write_text(URDF)
    return Robot.from_urdf(path, friction=FrictionLaw(third=None, offset=True))


@pytest.fixture
def imported(tmp_path: Path, robot: Robot) -> Callable[..., Archive]:
    """Return a function that imports a bag of messages."""

    def run(messages: Messages, **options: Any) -> Archive:
        for name in ("b.db3", "a.mcap"):
            (tmp_path / name).unlink(missing_ok=True)
        file = bag(tmp_path / "b.db3", {"/js": (STATE, messages)})
        return open_archive(import_rosbag2(file, tmp_path / "a.mcap", robot=robot, **options))

    return run


class TestRobot:
    def test_from_cell_file(self, tmp_path, robot):
        (tmp_path / "robot.urdf").write_text(robot.urdf)
        (tmp_path / "cell.toml").write_text(robot.cell)
        again = Robot.from_cell(tmp_path / "cell.toml")
        assert (again.cell, again.urdf) == (robot.cell, robot.urdf)
        turned = Robot.from_cell(tmp_path / "cell.toml", gravity=(0, 0, 1.62))
        cell = Cell.from_texts(turned.cell, turned.urdf, Path("cell.toml"))
        assert cell.model.gravity.tolist() == [0, 0, 1.62]
        assert cell.joint_names == ("hip", "ankle")

    def test_joints_that_were_not_recorded_are_locked(self, tmp_path):
        """At the given position, or at zero, or in the middle of a range without zero."""
        more = "".join(
            f"<link name='{name}'/><joint name='{name}' type='{kind}'><parent link='lower'/>"
            f"<child link='{name}'/><axis xyz='0 0 1'/>"
            f"<limit lower='{low}' upper='{high}' effort='1' velocity='1'/></joint>"
            for name, kind, low, high in [
                ("turns", "revolute", -1, 2), ("slides", "prismatic", 0.1, 0.3),
                ("bends", "revolute", -3, -1), ("rolls", "continuous", 0, 0),
            ]
        )  # fmt: skip
        path = tmp_path / "more.urdf"
        path.write_text(URDF.replace("</robot>", more + "</robot>"))
        robot = Robot.from_urdf(path, locked={"turns": 0.5}, recorded=["hip", "ankle", "unknown"])
        assert robot.joint_names == ("hip", "ankle")
        assert robot.locked == {
            "turns": 0.5, "slides": pytest.approx(0.2), "bends": -2.0, "rolls": 0.0
        }  # fmt: skip
        (tmp_path / "robot.urdf").write_text(robot.urdf)
        (tmp_path / "cell.toml").write_text(robot.cell)
        less = Robot.from_cell(tmp_path / "cell.toml", recorded=["hip"])
        assert less.locked == {**robot.locked, "ankle": 0.0}
        with pytest.raises(InputError, match=r"none of its joints hip.* recorded are a, b"):
            Robot.from_urdf(path, recorded=["a", "b"])

    def test_locked_joints_are_not_in_the_model(self, tmp_path):
        """Also if a transmission has the name of the joint."""
        path = tmp_path / "two.urdf"
        for more in ("", '<transmission name="t"><joint name="ankle"/></transmission>'):
            path.write_text(URDF.replace("</robot>", f"{more}</robot>"))
            assert Robot.from_urdf(path, locked={"ankle": 0.0}).joint_names == ("hip",)
        with pytest.raises(InputError, match=r"'knee'.*hip, ankle"):
            Robot.from_urdf(path, locked={"knee": 0.0})
        path.write_text("<robot")
        with pytest.raises(InputError, match=r"two\.urdf: the robot description .* is not XML"):
            Robot.from_urdf(path)
        with pytest.raises(InputError, match=r"none\.urdf.*cannot be read"):
            Robot.from_urdf(tmp_path / "none.urdf")


class TestImport:
    def test_joints_by_name_and_stamps_of_the_headers(self, imported):
        archive = imported(states())
        assert archive.columns["position"].tolist() == [[-i, 0.1 * i] for i in range(5)]
        assert archive.columns["torque"].tolist() == [[20.0 + i, 10.0 + i] for i in range(5)]
        start = 1_700_000_000 * 10**9 + 123
        assert archive.columns["stamp"].tolist() == [start + 8_000_001 * i for i in range(5)]
        assert archive.header.entries["clock"] == "header"
        expected = [8.000001e-3 * i for i in range(5)]
        assert open_recording(archive.path).time.tolist() == pytest.approx(expected, abs=1e-15)
        archive = imported([(5 + 8 * i, state(0, [i, i])[1]) for i in range(3)])
        assert archive.columns["stamp"].tolist() == [5, 13, 21]
        assert archive.header.entries["clock"] == "bag"

    @pytest.mark.parametrize("velocity", [(), (np.nan, np.nan)])
    def test_nan_and_empty_quantities_are_left_out(self, imported, velocity):
        """ros2_control publishes NaN for what the hardware does not measure."""
        archive = imported([state(8_000_000 * i, [1, i], velocity=velocity) for i in range(3)])
        assert set(archive.columns) == {"stamp", "position"}
        assert open_recording(archive.path).torque is None

    def test_messages_without_these_joints_are_ignored(self, imported, tmp_path):
        messages = [state(5, [0.01], names=["finger"]), *states(3)]
        assert imported(messages).n_samples == 3
        assert recorded_joints(tmp_path / "b.db3") == ("finger", "ankle", "hip")
        renamed = recorded_joints(tmp_path / "b.db3", joint_names={"hip": "h"})
        assert renamed == ("finger", "ankle", "h")
        empty = bag(tmp_path / "e.db3", {"/js": (STATE, [])})
        with pytest.raises(SourceError, match="has no message with joints"):
            recorded_joints(empty)

    def test_options_effort_joint_names_and_held_joints(self, tmp_path, imported):
        names = {"j1": "hip", "j2": "ankle"}
        held = ["hip"]
        messages = states(names=["j2", "j1"])
        archive = imported(messages, effort="motor_current", joint_names=names, held_joints=held)
        assert "torque" not in archive.columns
        assert archive.columns["motor_current"][0].tolist() == [20.0, 10.0]
        assert archive.columns["position"][3].tolist() == [-3, pytest.approx(0.3)]
        recording = open_recording(archive.path)
        assert recording.held_joints == ("hip",)
        expected = {"kind": "imported", "importer": "rosbag2", "topic": "/js", "archive": "a.mcap"}
        assert expected.items() <= recording.provenance.items()
        assert {path.suffix for path in tmp_path.iterdir()} == {".db3", ".mcap", ".urdf"}


BADLY_PACKED = [
    (zstandard.compress(bytes(100))[:-5], "cannot be decompressed"),
    (zstandard.compress(bytes(1 << 27)), "has a message of 134217728 bytes"),
]
REFUSED: list[tuple[Any, dict[str, Any], str]] = [
    ({"/a": (STATE, []), "/b": (STATE, [])}, {}, r"2 topics carry .*/a \(sensor_m.*/b"),
    ({"/a": (STATE, [])}, {"topic": "/joints"}, "topic: /joints is not a topic of .*: --topic /a"),
    ({"/a": (STATE, [])}, {}, "hip, ankle was recorded; recorded are none"),
    (states(), {"held_joints": ["knee"]}, "no joint is called 'knee'"),
    ([state(1, [1.0], names=["hip"])], {}, "ankle was not .*recorded are hip.*--lock-others"),
    ([state(1, [1.0], names=["x"])], {}, "none of the joints hip, ankle .* recorded are x"),
    ([state(1, [1.0])], {}, "position: message 0 has 1 values for 2 joints"),
    ([*states(2), state(9, [1, 2])], {}, "effort: only 2 of 3 messages have it"),
    ([(3, b"\x00\x01\x00\x00rubbish")], {}, "message 0 cannot be decoded"),
    *(([(1, data)], {}, sentence) for data, sentence in BADLY_PACKED),
]


@pytest.mark.parametrize(("topics", "options", "sentence"), REFUSED)
def test_unusable_messages_are_refused(tmp_path, robot, topics, options, sentence):
    content = topics if isinstance(topics, dict) else {TOPIC: (STATE, topics)}
    refused(bag(tmp_path / "b.db3", content), robot, sentence, **options)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("x.db3", r"x\.db3: is not a rosbag2 in sqlite3 storage"),
        ("y.db3", "No such file"),
        ("empty", r"has no \.db3, no \.mcap and no \.bag file"),
    ],
)
def test_files_other_than_bags_are_refused(tmp_path, robot, name, sentence):
    (tmp_path / "x.db3").write_text("time,q1")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / name, robot, sentence)


def test_real_franka_with_other_names_and_locked_gripper(tmp_path, shared_data):
    share = Path(np.__file__).parents[1] / "cmeel.prefix/share/example-robot-data/robots"
    fingers = {"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0}
    robot = Robot.from_urdf(share / "panda_description/urdf/panda.urdf", locked=fingers)
    source = shared_data / "ur10_unisa" / "fer_exciting_trajectory.db3"
    names = {f"fer_joint{i}": f"panda_joint{i}" for i in range(1, 8)}
    path = import_rosbag2(source, tmp_path / "fer.mcap", robot=robot, joint_names=names)
    recording = open_recording(path).checked(robot.joint_names)
    assert recording.position.shape == (727, 7)
    assert recording.time[1] == pytest.approx(0.033382177, abs=1e-12)


def joint_states(path: Path, **options: Any) -> Path:
    return mcap(path, {"/joint_states": (STATE, DEFINITION, "cdr", many())}, **options)


def assert_imported(path: Path) -> None:
    archive = open_archive(path)
    assert archive.complete, archive.missing
    columns = archive.columns
    assert columns["stamp"].tolist() == STAMPS.tolist()
    assert columns["position"].tobytes() == POSITION.tobytes()
    assert columns["velocity"].tobytes() == VELOCITY.tobytes()
    assert columns["torque"].tobytes() == EFFORT.tobytes()


BARE = ("enable_crcs", "use_statistics", "repeat_schemas", "repeat_channels")
"""What a file without index or checksums lacks."""


OPTIONS: list[dict[str, Any]] = [
    *({"compression": compression, "chunk_size": 20_000} for compression in CompressionType),
    {"use_chunking": False, "use_summary_offsets": False},
    dict.fromkeys(("enable_crcs", "use_statistics", "repeat_schemas", "repeat_channels"), False),
]


@pytest.mark.parametrize("options", OPTIONS)
def test_joint_states_of_any_mcap_file(tmp_path, robot, options):
    source = joint_states(tmp_path / "x.mcap", **options)
    assert_imported(import_rosbag2(source, tmp_path / "out.mcap", robot=robot))


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("mode", ["none", "file", "message"])
def test_bags_of_either_storage_compressed_or_not(tmp_path, robot, storage, mode):
    writer = BagWriter(tmp_path / "bag", version=9, storage_plugin=storage)
    if mode != "none":
        writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/joint_states", STATE, typestore=STORE)
        for time, data in many():
            writer.write(connection, time, data)
    first = import_rosbag2(tmp_path / "bag", tmp_path / "out.mcap", robot=robot)
    assert_imported(first)
    # An archive of ours is a bag as well.
    assert_imported(import_rosbag2(first, tmp_path / "again.mcap", robot=robot))


def test_parts_of_a_split_bag_are_ordered_by_number(tmp_path, robot):
    folder = tmp_path / "bag"
    folder.mkdir()
    everything = many()
    for part in range(12):
        some = everything[part * 25 : (part + 1) * 25]
        mcap(folder / f"bag_{part}.mcap", {"/joint_states": (STATE, DEFINITION, "cdr", some)})
    # A part without joint states.
    note = ("std_msgs/msg/String", "string data", "cdr", [(1, b"")])
    mcap(folder / "bag_12.mcap", {"/note": note})
    packed = zstandard.compress((folder / "bag_3.mcap").read_bytes())
    (folder / "bag_3.mcap.zstd").write_bytes(packed)
    (folder / "bag_3.mcap").unlink()
    assert_imported(import_rosbag2(folder, tmp_path / "out.mcap", robot=robot))


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_other_encodings_are_refused(tmp_path, robot, encoding):
    topics = {"/joints": ("foxglove.JointStates", "", encoding, [(1, b"{}")])}
    source = mcap(tmp_path / "x.mcap", topics)
    with pytest.raises(SourceError, match=f"/joints \\(foxglove.JointStates in {encoding}\\)"):
        import_rosbag2(source, tmp_path / "out.mcap", robot=robot)
    reason = {"protobuf": "cannot be decoded", "json": "have no number"}[encoding]
    with pytest.raises(SourceError, match=f"can be read as columns \\(/joints: {reason}"):
        import_log(source, tmp_path / "out.mcap", robot=robot, columns=by_map())


@pytest.mark.parametrize("length", [0, 5000, -1, None])
def test_truncated_files_are_refused(tmp_path, robot, length):
    source = joint_states(tmp_path / "x.mcap", compression=CompressionType.NONE)
    data = bytearray(source.read_bytes())
    if length is None:
        data[data.index(POSITION[150, ::-1].tobytes())] ^= 1
    source.write_bytes(data[:length])
    with pytest.raises(SourceError, match="not an MCAP file, or truncated"):
        import_rosbag2(source, tmp_path / "out.mcap", robot=robot)


def by_map(**more: Any) -> ColumnMap:
    drives = [f"/drives/drives/{i}" for i in range(2)]
    entries = {
        "time": {"column": "/drives/stamp", "unit": "ns"},
        "joints": ["hip", "ankle"],
        "position": {"columns": [f"{d}/angle" for d in drives], "unit": "deg", "side": "motor"},
        "motor_current": {"columns": [f"{d}/current" for d in drives]},
        "drive": {"gear_ratio": [100.0, -50.0]},
    }
    return ColumnMap.model_validate({**entries, **more})


def test_messages_of_any_type_are_imported_with_a_map(tmp_path, robot):
    source = drives(tmp_path / "x.mcap")
    out = import_log(source, tmp_path / "out.mcap", robot=robot, columns=by_map())
    stored = open_archive(out).columns
    assert stored["stamp"].tolist() == STAMPS.tolist()
    np.testing.assert_allclose(stored["position"], POSITION, rtol=0, atol=1e-12)
    assert stored["motor_current"].tobytes() == EFFORT.tobytes()
    columns = by_map(
        position={"columns": "/joint_states/position"},
        time={"column": "/joint_states/stamp", "unit": "ns"},
        joints=["ankle", "hip"],
    )
    source = drives(tmp_path / "y.mcap", with_states=True)
    archive = open_archive(import_log(source, tmp_path / "o.mcap", robot=robot, columns=columns))
    assert archive.columns["position"].tobytes() == POSITION.tobytes()
    assert archive.columns["motor_current"].tobytes() == EFFORT[:, ::-1].tobytes()


def test_numbers_of_messages_are_arrays_by_path(tmp_path: Path) -> None:
    arrays = read_mcap(drives(tmp_path / "x.mcap"))
    assert set(arrays) == {
        "/drives/stamp", "/drives/enabled", "/drives/temperature",
        *(f"/drives/drives/{i}/{name}" for i in range(2) for name in ("mode", "angle", "current")),
    }  # fmt: skip
    assert arrays["/drives/temperature"].shape == (COUNT, 3)
    assert arrays["/drives/temperature"].dtype == np.float32
    assert arrays["/drives/temperature"][7].tolist() == [40.0, 48.0, 42.0]
    assert set(arrays["/drives/drives/1/mode"].tolist()) == {4}


@pytest.mark.parametrize("firmware", ["2.2", "2.10-beta"])
def test_a_text_that_changes_is_no_column(tmp_path, robot, firmware):
    source = drives(tmp_path / "x.mcap", firmware=firmware)
    out = import_log(source, tmp_path / "o.mcap", robot=robot, columns=by_map())
    assert open_archive(out).columns["motor_current"].tobytes() == EFFORT.tobytes()


@pytest.mark.parametrize(
    ("names", "position", "reason"),
    [
        (("hip", "ankle"), (1.0, 2.0), "differ in name: ankle, hip"),
        (("ankle", "hip"), (1.0,), "differ in lengths of arrays: position"),
        (("ankle", "hip"), (), "differ in lengths of arrays"),
    ],
)
def test_topics_of_other_names_or_lengths_are_refused(tmp_path, robot, names, position, reason):
    """Names say whose a column is."""
    others = {"velocity": (0.0, 0.0), "effort": (0.0, 0.0)}
    messages = [*many(), state(int(STAMPS[-1]) + 1, position, names=names, **others)]
    topics = {"/joint_states": (STATE, DEFINITION, "cdr", messages)}
    source = mcap(tmp_path / "x.mcap", topics)
    columns = by_map(
        position={"columns": "/joint_states/position"}, time={"column": "/joint_states/stamp"},
        motor_current=None,
    )  # fmt: skip
    with pytest.raises(SourceError, match=f"/joint_states: its messages {reason}"):
        import_log(source, tmp_path / "o.mcap", robot=robot, columns=columns)


def refused(source: Path, robot: Robot, match: str, **options: Any) -> None:
    with pytest.raises(SourceError, match=match):
        import_rosbag2(source, source.with_name("out.mcap"), robot=robot, **options)
    assert not source.with_name("out.mcap").exists()


LOOSE = (
    "CREATE TABLE loose AS SELECT * FROM messages",
    "DROP TABLE messages",
    "ALTER TABLE loose RENAME TO messages",
)
ENDLESS = (
    "DROP TABLE messages",
    "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1"
    " FROM n) SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n",
)


@pytest.mark.parametrize(
    ("statements", "sentence"),
    [
        ([*LOOSE, "UPDATE messages SET timestamp = NULL"], "message . has no time or no data"),
        ([*LOOSE, "UPDATE messages SET data = NULL WHERE id = 3"], "has no time or no data"),
        (ENDLESS, "missing tables"),
        ((), "damaged"),
    ],
)
def test_damaged_databases_are_refused(tmp_path, robot, statements, sentence):
    path = bag(tmp_path / "x.db3", {TOPIC: (STATE, states(400))})
    with closing(sqlite3.connect(path)) as database:
        for statement in statements:
            database.execute(statement)
        database.commit()
    if not statements:
        data = path.read_bytes()
        path.write_bytes(data[: 4 * 4096] + b"\xa5" * (len(data) - 4 * 4096))
    refused(path, robot, sentence)


def test_huge_packed_files_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(bags, "_BLOCK_BYTES", 1000)
    path = tmp_path / "x.db3.zstd"
    path.write_bytes(zstandard.compress(bytes(1 << 26)))
    with pytest.raises(SourceError, match="1000 times"), bags.open_bag(path):
        pass


class TestDefinitions:
    @pytest.mark.parametrize(
        "definition",
        [
            "pkg/A again",
            "pkg/Empty[] many\n===\nMSG: pkg/Empty\n",
            "pkg/Empty[4294967296] many\n===\nMSG: pkg/Empty\n",
            "string[4294967296] many",
            "float64 x) or 1",
            "\n".join(["pkg/T0 x", *(f"===\nMSG: pkg/T{i}\npkg/T{i + 1} a\npkg/T{i + 1} b"
                                     for i in range(30)), "===\nMSG: pkg/T30\n"]),
        ],
    )  # fmt: skip
    def test_recursive_huge_and_invalid_types_are_refused(self, definition: str) -> None:
        """In short time and little memory."""
        message = ENCAPSULATION + b"\xff\xff\xff\xff" * 100
        begin = monotonic()
        with pytest.raises(MessageError):
            decoded(
                typestore_of("pkg/A", definition.replace("===", "=" * 80), ""), "pkg/A", message
            )
        assert monotonic() - begin < 5.0

    def test_other_topics_of_the_file_are_read(self, tmp_path: Path) -> None:
        message = [(1, ENCAPSULATION + struct.pack("<d", 2.5))]
        texts = {"/recursive": "pkg/A again", "/good": "float64 x"}
        topics = {topic: ("pkg/A", text, "cdr", message) for topic, text in texts.items()}
        assert read_mcap(mcap(tmp_path / "x.mcap", topics))["/good/x"].tolist() == [2.5]


def chunked(path: Path) -> Path:
    numbers = [(stamp, ENCAPSULATION + struct.pack("<d", stamp)) for stamp in range(100)]
    topics = {"/a": ("pkg/A", "float64 x", "cdr", numbers)}
    return mcap(path, topics, compression=CompressionType.ZSTD)


def with_chunk(path: Path, body: bytes) -> None:
    """Put another chunk before the first one; the index is invalid then."""
    data = path.read_bytes()
    first, _ = mcap_bytes.chunks(data)[0]
    path.write_bytes(data[:first] + mcap_bytes.record(verified_records.CHUNK, body) + data[first:])


class TestChunks:
    @pytest.mark.parametrize(
        ("name", "packed", "claimed"),
        [
            ("zstd", zstandard.compress(bytes(1 << 26)), 1 << 26),
            ("zstd", zstandard.compress(bytes(1 << 26)), 1000),
            ("lz4", lz4.frame.compress(bytes(1 << 24)), 1000),
            ("", bytes(10), 4 << 30),
        ],
    )
    def test_wrong_sizes_are_refused(self, name, packed, claimed, tmp_path):
        path = chunked(tmp_path / "x.mcap")
        head = struct.pack("<QQQI", 0, 0, claimed, 0) + mcap_bytes.text(name)
        with_chunk(path, head + struct.pack("<Q", len(packed)) + packed)
        with pytest.raises(SourceError, match=r"claims|cannot be decompressed"):
            read_mcap(path)

    def test_size_is_limited(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(mcap_messages, "MAX_TOTAL_BYTES", 600)
        path = chunked(tmp_path / "x.mcap")
        with pytest.raises(SourceError, match="too large for one reading"):
            read_mcap(path)
