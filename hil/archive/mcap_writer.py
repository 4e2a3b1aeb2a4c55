"""MCAP records in file order, with the index at the end; whole batches of messages at a time.

Record for record what `mcap.writer.Writer` makes of the same messages, but for the level of
compression. That one takes messages singly, at some microseconds each, which is most of the time of
an archive of three messages a millisecond; here a batch of messages of constant size is one
structured array.

Layout: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from hil.archive.cdr import Rows
from hil.archive.container import MAGIC, MESSAGE

_INDEX_DTYPE = np.dtype([("stamp", "<u8"), ("offset", "<u8")])
_HEAD_FIELDS = (
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("stamp", "<u8"),
    ("published", "<u8"),
)
_HEAD = struct.Struct("<BQHIQQ")
_BEFORE_LENGTH_COUNTS = struct.calcsize("<BQ")
_INDEX_HEAD = struct.Struct("<BQHI")
_COMPRESSION = "zstd"
_LEVEL = -1
"""Of Zstandard. Against the usual 3 it costs 4 % in size, and saves a third of the time both of
writing and of reading (`python -m benchmarks.archive --sizes`)."""


class _OpenChunk:
    """Records of the chunk in progress, and where its messages lie.

    Attributes:
        size: bytes so far.
        first, last: earliest and latest stamp [ns].
        messages: messages so far.
        index: per channel, in the order of their first messages, packed entries of its index.
    """

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self.size = 0
        self.first = self.last = 0
        self.messages = 0
        self.index: dict[int, list[bytes]] = {}

    def append(self, records: bytes) -> None:
        self._parts.append(records)
        self.size += len(records)

    def note(self, channel: int, stamp: NDArray[np.int64], offset: NDArray[np.int64]) -> None:
        """Note messages of a channel at these stamps [ns] and offsets in the chunk."""
        entries = np.empty(len(stamp), _INDEX_DTYPE)
        entries["stamp"], entries["offset"] = stamp, offset
        self.index.setdefault(channel, []).append(entries.tobytes())
        self.first, self.last = _spanned(self.messages, self.first, self.last, stamp)
        self.messages += len(stamp)

    def data(self) -> bytes:
        return b"".join(self._parts)


class McapWriter:
    """Writes one MCAP file to `write`, which is told whole records.

    Chunks end at `flush` and nowhere else; a chunk without messages is not written, what was
    registered for it goes into the next. Compressed by Zstandard, with checksums of chunks,
    attachments and index.

    Args:
        write: takes the next bytes of the file.
    """

    def __init__(self, write: Callable[[bytes], object]) -> None:
        self._write = write
        self._position = 0
        self._chunk = _OpenChunk()
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._checksums: list[int] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._first = self._last = 0

    @property
    def checksums(self) -> tuple[int, ...]:
        """Those of the chunks written so far, CRC-32 of their records."""
        return tuple(self._checksums)

    def start(self, profile: str, library: str) -> None:
        """Begin the file."""
        self._put(MAGIC)
        self._put(_bytes_of(Header(profile, library)))

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Add a metadata record, in front of the chunk in progress."""
        offset = self._position
        length = self._put(_bytes_of(Metadata(name, dict(entries))))
        self._metadata.append(MetadataIndex(offset, length, name))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Add an attachment without times, in front of the chunk in progress."""
        offset = self._position
        length = self._put(_bytes_of(Attachment(0, 0, name, media_type, data)))
        self._attachments.append(AttachmentIndex(offset, length, 0, 0, len(data), name, media_type))

    def register(
        self, topic: str, message_encoding: str, schema: str, encoding: str, definition: bytes
    ) -> int:
        """Announce a channel and the schema of its messages; returns the channel's id."""
        number = len(self._channels) + 1
        self._schemas.append(Schema(number, definition, encoding, schema))
        self._channels.append(Channel(number, topic, message_encoding, {}, number))
        self._chunk.append(_bytes_of(self._schemas[-1]))
        self._chunk.append(_bytes_of(self._channels[-1]))
        return number

    def add_message(self, channel: int, stamp: int, sequence: int, data: bytes) -> None:
        """Add one message at `stamp` [ns] to the chunk in progress."""
        length = _HEAD.size - _BEFORE_LENGTH_COUNTS + len(data)
        self._note(channel, np.array([stamp]), np.array([self._chunk.size]))
        self._chunk.append(_HEAD.pack(MESSAGE, length, channel, sequence, stamp, stamp) + data)

    def add_rows(
        self,
        channels: Sequence[int],
        stamp: NDArray[np.int64],
        sequence: NDArray[np.int64],
        messages: Sequence[Rows],
    ) -> None:
        """Add messages of several channels taken at the same instants, instant by instant.

        Args:
            channels: their ids.
            stamp: shape (k,), nanoseconds.
            sequence: shape (k,), the number of each instant, below 2^32.
            messages: per channel its k messages, contiguous.
        """
        if not len(stamp):
            return
        sizes = tuple(rows.itemsize for rows in messages)
        records = np.empty(len(stamp), _records_dtype(sizes))
        offset = self._chunk.size + records.itemsize * np.arange(len(stamp))
        for place, (channel, rows) in enumerate(zip(channels, messages, strict=True)):
            record = records[str(place)]
            record["opcode"] = MESSAGE
            record["length"] = _HEAD.size - _BEFORE_LENGTH_COUNTS + rows.itemsize
            record["channel"] = channel
            record["sequence"] = sequence
            record["stamp"] = record["published"] = stamp
            record["data"] = rows.view(record["data"].dtype)
            fields = records.dtype.fields
            assert fields is not None
            self._note(channel, stamp, offset + fields[str(place)][1])
        self._chunk.append(records.tobytes())

    def flush(self) -> None:
        """End the chunk in progress, if it has messages."""
        chunk = self._chunk
        if not chunk.messages:
            return
        self._chunk = _OpenChunk()
        data = chunk.data()
        packed = zstandard.compress(data, _LEVEL)
        crc = zlib.crc32(data)
        self._checksums.append(crc)
        record = Chunk(_COMPRESSION, packed, chunk.last, chunk.first, crc, len(data))
        start = self._position
        length = self._put(_bytes_of(record))
        index_start = self._position
        offsets = {}
        for channel, entries in chunk.index.items():
            offsets[channel] = self._position
            self._put(_message_index(channel, b"".join(entries)))
        self._chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=_COMPRESSION,
                compressed_size=len(packed),
                message_end_time=chunk.last,
                message_index_length=self._position - index_start,
                message_index_offsets=offsets,
                message_start_time=chunk.first,
                uncompressed_size=len(data),
            )
        )

    def finish(self) -> None:
        """Write what is left, the index and the footer."""
        self.flush()
        self._put(_bytes_of(DataEnd(0)))
        start = self._position
        groups: list[tuple[int, Sequence[Any]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        summary = bytearray()
        offsets = bytearray()
        for opcode, records in groups:
            data = b"".join(map(_bytes_of, records))
            offsets += _bytes_of(SummaryOffset(opcode, start + len(summary), len(data)))
            summary += data
        offsets_start = start + len(summary)
        summary += offsets
        # The checksum of the index covers the footer up to the checksum itself.
        footer = _bytes_of(Footer(start, offsets_start, 0))[: -struct.calcsize("<I")]
        crc = zlib.crc32(footer, zlib.crc32(summary))
        self._put(bytes(summary))
        self._put(_bytes_of(Footer(start, offsets_start, crc)))
        self._put(MAGIC)

    def _note(self, channel: int, stamp: NDArray[np.int64], offset: NDArray[np.int64]) -> None:
        self._chunk.note(channel, stamp, offset)
        messages = sum(self._counts.values())
        self._first, self._last = _spanned(messages, self._first, self._last, stamp)
        self._counts[channel] = self._counts.get(channel, 0) + len(stamp)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=self._last,
            message_start_time=self._first,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _put(self, data: bytes) -> int:
        self._write(data)
        self._position += len(data)
        return len(data)


def _spanned(before: int, first: int, last: int, stamp: NDArray[np.int64]) -> tuple[int, int]:
    """First and last stamp once these are added to `before` others."""
    low, high = int(stamp.min()), int(stamp.max())
    return (min(first, low) if before else low), max(last, high)


@cache
def _records_dtype(sizes: tuple[int, ...]) -> np.dtype[np.void]:
    """The message records of one instant, one of each data size [bytes], without padding."""
    return np.dtype(
        [
            (str(place), np.dtype([*_HEAD_FIELDS, ("data", f"V{size}")]))
            for place, size in enumerate(sizes)
        ]
    )


def _message_index(channel: int, entries: bytes) -> bytes:
    after_length = _INDEX_HEAD.size - _BEFORE_LENGTH_COUNTS
    head = (Opcode.MESSAGE_INDEX, after_length + len(entries), channel, len(entries))
    return _INDEX_HEAD.pack(*head) + entries


def _bytes_of(record: Any) -> bytes:
    builder: Any = RecordBuilder()  # its methods are not annotated
    record.write(builder)
    return bytes(builder.end())
