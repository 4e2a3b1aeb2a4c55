"""Other people's readers open our archives and see the same values, to the bit; their writer makes
the same bytes of the same calls."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from drivers.record import LONGEST_PACKET, PacketRing, cycle_dtype
from hil.archive import (
    Archive,
    ArchiveWriter,
    Samples,
    mcap_writer,
    open_archive,
    write_samples,
)
from hil.archive import schema as profile
from hil.archive.mcap_writer import McapWriter
from hil.archive.schema import description_messages
from tests.hil.mcap_bytes import Content

JOINTS = ("shoulder", "elbow", "a_joint_with_a_long_name", "wrist")
COUNT = 250
URDF = """<robot name="arm"><link name="base"/><link name="plate"/>
<joint name="mount" type="fixed"><parent link="base"/><child link="plate"/>
<origin xyz="0.1 -0.2 0.3" rpy="0.4 -1.1 2.5"/></joint></robot>"""
STATE = {"position": "position", "velocity": "velocity", "effort": "torque"}


def packets() -> NDArray[np.void]:
    """Two packets for each cycle, of different lengths."""
    rng = np.random.default_rng(6)
    ring = PacketRing(2 * COUNT)
    for cycle in range(COUNT):
        for sent in (False, True):
            data = rng.bytes(int(rng.integers(12, LONGEST_PACKET + 1)))
            ring.put(2_000_000 + cycle, rng.normal(), sent, data)
    return ring.drain()


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(5)
    rows = np.zeros(COUNT, cycle_dtype(len(JOINTS)))
    for name in rows.dtype.names or ():
        if rows[name].dtype.kind == "f":
            rows[name] = rng.normal(size=rows[name].shape)
        else:
            rows[name] = rng.integers(0, 250, rows[name].shape)
    rows["cycle"] = 2_000_000 + np.arange(COUNT)
    rows["commanded_position"][7] = np.nan
    file = tmp_path_factory.mktemp("interop") / "dryrun_000_a1.mcap"
    with ArchiveWriter(
        file,
        joint_names=JOINTS,
        period=0.002,
        metadata={},
        attachments={"cell.toml": b"[cell]", "robot.urdf": URDF.encode()},
        durable=False,
        packets=True,
    ) as archive:
        archive.event(2_000_000, "MotionStarted", "off we go")
        archive.add_packets(packets())
        archive.write(rows, rng.normal(size=(COUNT, len(JOINTS))))
        archive.close("completed")
    return file


@pytest.fixture(scope="module")
def ours(path: Path) -> Archive:
    archive = open_archive(path)
    assert archive.complete
    return archive


def stacked(messages: list[Any], field: str) -> NDArray[Any]:
    values = [getattr(message, field) for message in messages]
    if isinstance(values[0], bytes):  # what some readers make of uint8[]
        values = [np.frombuffer(value, np.uint8) for value in values]
    return np.array(values)


def bits(values: Any, like: NDArray[Any]) -> bytes:
    return np.asarray(values, like.dtype).tobytes()


def assert_same_messages(found: dict[str, list[Any]], ours: Archive) -> None:
    """Decoded messages by topic hold what our reader reads."""
    cycles, measured = found[profile.CYCLE], found[profile.MEASURED]
    for name, column in ours.columns.items():
        if name != "stamp":
            assert bits(stacked(cycles, name), column) == column.tobytes(), name
    for word, column_name in STATE.items():
        column = ours.columns[column_name]
        assert bits(stacked(measured, word), column) == column.tobytes()
    commanded = found[profile.COMMANDED]
    for word in ("position", "velocity"):
        column, inside = (ours.columns[f"{whose}_{word}"] for whose in ("commanded", "target"))
        column = np.where(np.isnan(column), inside, column)
        assert np.isfinite(column).all()
        assert bits(stacked(commanded, word), column) == column.tobytes()
    assert all(len(message.effort) == 0 for message in commanded)
    assert all(tuple(message.name) == JOINTS for message in [*measured, *commanded])
    for messages in (cycles, measured, commanded):
        stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in messages]
        assert stamps == ours.columns["stamp"].tolist()
        assert {message.header.frame_id for message in messages} == {""}
    assert_same_packets(found[profile.PACKETS], ours)
    assert [message.data for message in found[profile.DESCRIPTION]] == [URDF]
    (still,) = found[profile.TRANSFORMS]
    assert_transforms(still.transforms)
    (event,) = found[profile.EVENTS]
    assert (event.name, event.msg, event.level) == ("MotionStarted", "off we go", 20)
    assert event.stamp.sec == 4000


def assert_transforms(found: list[Any]) -> None:
    """The base stands in the world, and a fixed link where pinocchio has it."""
    assert [(one.header.frame_id, one.child_frame_id) for one in found] == [
        ("world", "base"), ("base", "plate"),
    ]  # fmt: skip
    place, turn = found[1].transform.translation, found[1].transform.rotation
    assert (place.x, place.y, place.z) == (0.1, -0.2, 0.3)
    quaternion = pin.Quaternion(turn.w, turn.x, turn.y, turn.z)
    expected = pin.rpy.rpyToMatrix(0.4, -1.1, 2.5)
    np.testing.assert_allclose(quaternion.matrix(), expected, atol=1e-14)


def assert_same_packets(found: list[Any], ours: Archive) -> None:
    columns, written = open_archive(ours.path, topics=[profile.PACKETS]).columns, packets()
    for name in written.dtype.names or ():
        assert columns[name].tobytes() == written[name].tobytes(), name
        assert bits(stacked(found, name), written[name]) == written[name].tobytes(), name
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in found]
    assert stamps == columns["stamp"].tolist() == (columns["cycle"] * 2_000_000).tolist()


@pytest.mark.parametrize("reader", [make_reader, NonSeekingReader])
def test_mcap_with_its_ros2_decoder_reads_the_same_values(
    path: Path, ours: Archive, reader: Any
) -> None:
    found: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        opened = reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _, channel, message, decoded in opened.iter_decoded_messages():
            assert message.log_time == message.publish_time
            found.setdefault(channel.topic, []).append(decoded)
    assert_same_messages(found, ours)


def test_mcap_finds_index_statistics_metadata_and_attachments(path: Path, ours: Archive) -> None:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary.statistics.message_count == 5 * COUNT + 3
        assert len(summary.chunk_indexes) == 5
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {record.name: record.data for record in reader.iter_attachments()}
    assert attachments == ours.attachments
    assert ours.header.entries.items() <= metadata["hil"].items()
    assert metadata["hil.outcome"]["outcome"] == "completed"


def test_rosbags_reads_the_same_values(path: Path, ours: Archive) -> None:
    """With nothing but the definitions in the file."""
    found: dict[str, list[Any]] = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append(message)
    assert_same_messages(found, ours)


@pytest.mark.parametrize(
    "urdf",
    [
        b"",
        b"\xff",
        b"<robot name='x'/>",
        b"<?xml version='1.0' encoding='none'?><robot><link name='a'/>",
        URDF.replace("0.4 -1.1 2.5", "0.4 -1.1").encode(),
        URDF.replace("0.1 -0.2 0.3", "0.1 -0.2").encode(),
        URDF.replace("0.1 -0.2", "here").encode(),
        URDF.replace("plate", "p" * (1 << 20)).encode(),
    ],
)
def test_what_is_no_description_is_not_shown(urdf: bytes) -> None:
    """A recording goes on without it."""
    assert description_messages(urdf) == {}


def test_imported_archives_are_read_as_well(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    position, current = rng.normal(size=(2, 1500, len(JOINTS)))
    stamp = 10**9 + np.arange(1500, dtype=np.int64) * 8_000_000
    file = write_samples(
        tmp_path / "x.mcap",
        Samples(stamp, position, motor_current=current),
        joint_names=JOINTS,
        metadata={},
    )
    found: dict[str, list[Any]] = {}
    with AnyReader([file]) as reader:
        for connection, time, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((time, message))
    states = [message for _, message in found[profile.MEASURED]]
    assert np.array_equal(stacked(states, "position"), position)
    assert [time for time, _ in found[profile.MEASURED]] == stamp.tolist()
    currents = [message for _, message in found[profile.MOTOR_CURRENT]]
    assert np.array_equal(stacked(currents, "motor_current"), current)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_our_reader_takes_chunks_of_every_compression_and_layout(
    path: Path, ours: Archive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compression: Any
) -> None:
    """The same records written by the library with chunks that end within a cycle."""
    copy = tmp_path / path.name
    content = replace(Content.of(path), library="mcap", cycles_per_chunk=COUNT)
    replace(content, chunk_size=40_000, compression=compression).write(copy)
    monkeypatch.setattr("hil.archive.scan._BATCH", 0)
    again = open_archive(copy)
    assert again.complete, again.missing
    for name, column in ours.columns.items():
        assert again.columns[name].tobytes() == column.tobytes(), name
    assert again.events == ours.events


# The writer of the format's makers

NANOSECONDS = st.integers(0, 2**62)


@dataclass(frozen=True)
class Batch:
    """Messages of two channels at the same instants, their content drawn by the seed."""

    stamp: tuple[int, ...]
    seed: int


@dataclass(frozen=True)
class Event:
    stamp: int
    text: bytes


@dataclass(frozen=True)
class Note:
    name: str
    entries: dict[str, str]


@dataclass(frozen=True)
class Flush:
    pass


STEPS = st.lists(
    st.one_of(
        st.builds(Batch, st.lists(NANOSECONDS, max_size=5).map(tuple), st.integers(0, 99)),
        st.builds(Event, NANOSECONDS, st.binary(max_size=40)),
        st.builds(
            Note, st.text(max_size=5), st.dictionaries(st.text(max_size=5), st.text(max_size=5))
        ),
        st.just(Flush()),
    ),
    max_size=8,
)
SIZES = (61, 8)  # odd, so that nothing may rely on alignment


def rows_of(batch: Batch) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(batch.seed)
    return tuple(
        rng.integers(0, 256, (len(batch.stamp), size), np.uint8).view(f"V{size}")[:, 0]
        for size in SIZES
    )


def by_us(steps: list[Any], attachment: bytes) -> bytes:
    file = io.BytesIO()
    writer = McapWriter(file.write, "ros2", "test")
    writer.add_attachment("a.txt", "text/plain", attachment)
    channels = [writer.register(f"/{i}", "cdr", f"s/{i}", "ros2msg", b"int8 x") for i in range(3)]
    written = 0
    for step in steps:
        if isinstance(step, Batch):
            number = written + np.arange(len(step.stamp))
            writer.add_rows(channels[:2], np.array(step.stamp, np.int64), number, rows_of(step))
            written += len(step.stamp)
        elif isinstance(step, Event):
            writer.add_message(channels[2], step.stamp, 7, step.text)
        elif isinstance(step, Note):
            writer.add_metadata(step.name, step.entries)
        else:
            writer.flush()
    writer.finish()
    return file.getvalue()


def by_them(steps: list[Any], attachment: bytes) -> bytes:
    file = io.BytesIO()
    writer = Writer(file, chunk_size=1 << 62, compression=CompressionType.ZSTD)
    writer.start("ros2", "test")
    writer.add_attachment(0, 0, "a.txt", "text/plain", attachment)
    channels = [
        writer.register_channel(
            f"/{i}", "cdr", writer.register_schema(f"s/{i}", "ros2msg", b"int8 x")
        )
        for i in range(3)
    ]
    written = 0
    for step in steps:
        if isinstance(step, Batch):
            rows = rows_of(step)
            for i, stamp in enumerate(step.stamp):
                for channel, messages in zip(channels, rows, strict=False):
                    writer.add_message(channel, stamp, messages[i].tobytes(), stamp, written)
                written += 1
        elif isinstance(step, Event):
            writer.add_message(channels[2], step.stamp, step.text, step.stamp, 7)
        elif isinstance(step, Note):
            writer.add_metadata(step.name, step.entries)
        else:
            writer.flush()
    writer.finish()
    return file.getvalue()


@settings(deadline=None)
@given(steps=STEPS, attachment=st.binary(max_size=50))
def test_the_same_calls_give_the_bytes_of_the_reference_writer(steps, attachment):
    """At its level of compression."""
    with mock.patch.object(mcap_writer, "_LEVEL", 3):
        assert by_us(steps, attachment) == by_them(steps, attachment)
