"""Other people's readers open our archives and see the same values, to the bit; what a check
computes is the index of the writer of the `mcap` library."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from drivers.cycle_records import cycle_dtype
from hil.archive import Archive, ArchiveWriter, open_archive, verified_records
from hil.archive import schema as profile
from hil.archive.schema import description_message
from tests.hil.mcap_bytes import Content, Indexed

JOINTS = ("shoulder", "elbow", "a_joint_with_a_long_name", "wrist")
COUNT = 250
URDF = """<robot name="arm"><link name="base"/><link name="plate"/>
<joint name="mount" type="fixed"><parent link="base"/><child link="plate"/>
<origin xyz="0.1 -0.2 0.3" rpy="0.4 -1.1 2.5"/></joint></robot>"""
STATE = {"position": "position", "velocity": "velocity", "effort": "torque"}


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
    ) as archive:
        archive.event(2_000_000, "MotionStarted", "off we go")
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


def assert_same_messages(by_topic: dict[str, list[Any]], ours: Archive) -> None:
    """Decoded messages by topic hold what our reader reads."""
    cycles = by_topic[profile.CYCLE]
    measured = by_topic[profile.MEASURED]
    for name, column in ours.columns.items():
        if name != "stamp":
            assert bits(stacked(cycles, name), column) == column.tobytes(), name
    for word, column_name in STATE.items():
        column = ours.columns[column_name]
        assert bits(stacked(measured, word), column) == column.tobytes()
    commanded = by_topic[profile.COMMANDED]
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
    assert [message.data for message in by_topic[profile.DESCRIPTION]] == [URDF]
    (event,) = by_topic[profile.EVENTS]
    assert (event.name, event.msg, event.level) == ("MotionStarted", "off we go", 20)
    assert event.stamp.sec == 4000


def decoded_by_mcap(path: Path, reader: Any) -> Iterator[tuple[str, Any]]:
    with path.open("rb") as stream:
        opened = reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _, channel, message, decoded in opened.iter_decoded_messages():
            assert message.log_time == message.publish_time
            yield channel.topic, decoded


def decoded_by_rosbags(path: Path) -> Iterator[tuple[str, Any]]:
    """With nothing but the definitions in the file."""
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            yield connection.topic, reader.deserialize(raw, connection.msgtype)


@pytest.mark.parametrize(
    "decoded",
    [
        partial(decoded_by_mcap, reader=make_reader),
        partial(decoded_by_mcap, reader=NonSeekingReader),
        decoded_by_rosbags,
    ],
)
def test_others_read_the_same_values(path: Path, ours: Archive, decoded: Any) -> None:
    by_topic: dict[str, list[Any]] = {}
    for topic, message in decoded(path):
        by_topic.setdefault(topic, []).append(message)
    assert_same_messages(by_topic, ours)


def test_mcap_finds_index_statistics_metadata_and_attachments(path: Path, ours: Archive) -> None:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary.statistics.message_count == 3 * COUNT + 2
        assert len(summary.chunk_indexes) == 5
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {record.name: record.data for record in reader.iter_attachments()}
    assert attachments == ours.attachments
    assert ours.header.entries.items() <= metadata["hil"].items()
    assert metadata["hil.outcome"]["outcome"] == "completed"


def test_what_is_no_description_is_not_shown() -> None:
    """The recording is written without it."""
    for urdf in (b"\xff", URDF.replace("plate", "p" * (1 << 20)).encode()):
        assert description_message(urdf) is None


@pytest.mark.parametrize("compression", list(CompressionType))
def test_our_reader_takes_chunks_of_every_compression_and_layout(
    path: Path, ours: Archive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compression: Any
) -> None:
    """The same records written by the library with chunks that end within a cycle."""
    copy = tmp_path / path.name
    content = replace(Content.of(path), library="mcap", cycles_per_chunk=COUNT)
    replace(content, chunk_size=40_000, compression=compression).write(copy)
    monkeypatch.setattr("hil.archive.scan._BATCH_BYTES", 0)
    again = open_archive(copy)
    assert again.complete, again.missing
    for name, column in ours.columns.items():
        assert again.columns[name].tobytes() == column.tobytes(), name
    assert again.events == ours.events


def test_a_check_computes_the_index_that_the_library_writes() -> None:
    """For messages of sizes that are not aligned and stamps in any order, metadata in between."""
    rng = np.random.default_rng(3)
    stamps = [0, 2**62, 5, 5, 1, 7]
    output = io.BytesIO()
    writer: Any = Writer(output, chunk_size=1 << 62, compression=CompressionType.ZSTD)
    writer.start("ros2", "test")
    writer.add_attachment(0, 0, "a.txt", "text/plain", b"one")
    channels = [
        writer.register_channel(f"/{i}", "cdr", writer.register_schema(f"s/{i}", "x", b"int8 x"))
        for i in range(3)
    ]
    for start, stop in ((0, 4), (4, 4), (4, 6)):
        for number in range(start, stop):
            stamp = stamps[number]
            for channel, size in zip(channels, (61, 8), strict=False):
                writer.add_message(channel, stamp, rng.bytes(size), stamp, number)
        writer.add_message(channels[2], 9 + start, b"event", 9 + start, 7)
        writer.add_metadata("note", {"key": "ä"})
        writer.flush()
    writer.finish()
    data = output.getvalue()
    computed = Indexed()
    for record in verified_records.records(io.BytesIO(data), len(data)):
        if record.opcode not in (verified_records.MESSAGE_INDEX, verified_records.DATA_END):
            computed.put(data[record.offset : record.end])
    assert computed.ended() == data
