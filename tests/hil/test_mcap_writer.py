"""Our MCAP writer against the one of the format's makers: the same calls, the same records.

Chunks are compressed at another level, so their compressed bytes, and what counts these, differ.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import AttachmentIndex, Chunk, ChunkIndex, Footer, MetadataIndex, SummaryOffset
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import CompressionType, Writer

from hil.archive.mcap_writer import McapWriter

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


def ours(steps: list, attachment: bytes) -> bytes:
    file = io.BytesIO()
    writer = McapWriter(file.write)
    writer.start("ros2", "test")
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


def theirs(steps: list, attachment: bytes) -> bytes:
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


def positioned(file: bytes) -> list[tuple[int, Any]]:
    """The records of a file, each with the byte it begins at."""
    stream = io.BytesIO(file)
    reader = StreamReader(stream, emit_chunks=True, validate_crcs=True)
    found, start = [], 8  # behind the magic
    for record in reader.records:
        found.append((start, record))
        start = stream.tell()
    return found


def content(record: Any) -> Any:
    """A record without what depends on how well chunks compress."""
    if isinstance(record, Chunk):
        data, _ = get_chunk_data_stream(record, validate_crc=True)
        assert isinstance(data, ReadDataStream)
        return replace(record, data=data.read(record.uncompressed_size))
    if isinstance(record, ChunkIndex):
        return replace(
            record,
            chunk_length=0,
            chunk_start_offset=0,
            compressed_size=0,
            message_index_offsets=dict.fromkeys(record.message_index_offsets, 0),
        )
    if isinstance(record, AttachmentIndex | MetadataIndex):
        return replace(record, offset=0)
    if isinstance(record, SummaryOffset):
        return replace(record, group_start=0)
    if isinstance(record, Footer):
        return replace(record, summary_start=0, summary_offset_start=0, summary_crc=0)
    return record


@settings(deadline=None)
@given(steps=STEPS, attachment=st.binary(max_size=50))
def test_the_same_calls_give_the_records_of_the_reference_writer(steps, attachment):
    found = [content(record) for _, record in positioned(ours(steps, attachment))]
    expected = [content(record) for _, record in positioned(theirs(steps, attachment))]
    assert found == expected


@settings(deadline=None)
@given(steps=STEPS, attachment=st.binary(max_size=50))
def test_what_the_index_points_at_is_there(steps, attachment):
    file = ours(steps, attachment)
    records = dict(positioned(file))
    summary = make_reader(io.BytesIO(file), validate_crcs=True).get_summary()
    assert summary is not None
    for index in summary.chunk_indexes:
        chunk = records[index.chunk_start_offset]
        assert isinstance(chunk, Chunk)
        assert len(chunk.data) == index.compressed_size
        after = index.chunk_start_offset + index.chunk_length
        assert after in records
        for channel, offset in index.message_index_offsets.items():
            assert records[offset].channel_id == channel
        assert max([after, *index.message_index_offsets.values()]) in records
        assert after + index.message_index_length in records
    for name in ("attachment", "metadata"):
        for index in getattr(summary, f"{name}_indexes"):
            assert records[index.offset].name == index.name
            assert index.offset + index.length in records
