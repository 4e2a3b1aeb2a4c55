"""Writer of MCAP files that adds whole batches of messages at a time.

It writes the bytes of `mcap.writer.Writer`, and the records are the library's. The library's writer
is not used: it adds messages singly, six times the time of a cycle (`benchmarks.archive_writing`),
its level of compression is fixed, and it accepts no chunk that is compressed already, which is how
`hil.archive.repair` restores an archive to the byte. Here a batch of messages of constant size is
one structured array.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from functools import cache

import numpy as np
import zstandard
from isal.isal_zlib import crc32
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from hil.archive import container
from hil.archive.cdr import Rows
from hil.archive.chunk import HEAD, Messages
from hil.archive.container import MAGIC, MESSAGE, RECORD, encode
from hil.archive.schema import Channel as CdrChannel

_ENTRY = np.dtype([("stamp", "<u8"), ("offset", "<u8")])
_HEAD = struct.Struct("<BQHIQQ")
_MESSAGE_INDEX = struct.Struct("<BQHI")
_LEVEL = -1
"""Of Zstandard. Compared with 3, the default, files are 4 % larger, and writing and reading take a
third less time (`python -m benchmarks.archive --sizes`)."""

Entries = Mapping[int, NDArray[np.void]]
"""Stamps and offsets of the messages of a chunk, by channel in order of first occurrence."""


def entries_of(by_channel: Mapping[int, Messages]) -> Entries:
    """Return the index entries of messages that were read."""
    return {
        number: _entries(messages.of_heads("log_time"), np.concatenate(messages.places))
        for number, messages in by_channel.items()
    }


def _entries(stamp: NDArray[np.int64], offset: NDArray[np.int64]) -> NDArray[np.void]:
    entries = np.empty(len(stamp), _ENTRY)
    entries["stamp"] = stamp
    entries["offset"] = offset
    return entries


def span(entries: Entries) -> tuple[int, int]:
    """Return first and last stamp [ns], zeros of a chunk without messages."""
    stamps = [part["stamp"] for part in entries.values() if len(part)] or [np.zeros(1, np.uint64)]
    return int(min(part.min() for part in stamps)), int(max(part.max() for part in stamps))


class McapWriter:
    """Writes one MCAP file to `write`, which receives complete records.

    Chunks end at `flush` only; one without messages is not written. Message indexes and summary
    depend on the other records only, so that a repair restores them exactly.

    Attributes:
        position: where the next record begins.
    """

    def __init__(self, write: Callable[[bytes], object], profile: str, library: str) -> None:
        self.position = 0
        self._write = write
        self._parts: list[bytes] = []  # of the chunk in progress
        self._size = 0
        self._entries: dict[int, list[NDArray[np.void]]] = {}
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._put(MAGIC)
        self.put(Header(profile, library))

    def put(self, record: McapRecord) -> None:
        """Add a record other than a chunk in front of the chunk in progress, and index it."""
        data = encode(record)
        place = self.position
        if isinstance(record, Metadata):
            self._metadata.append(MetadataIndex(place, len(data), record.name))
        elif isinstance(record, Attachment):
            times = (record.log_time, record.create_time)
            size = len(record.data)
            self._attachments.append(
                AttachmentIndex(place, len(data), *times, size, record.name, record.media_type)
            )
        else:
            self.note(record)
        self._put(data)

    def register(self, channel: CdrChannel) -> int:
        """Define a channel and the schema of its messages; return the channel's id."""
        number = len(self._channels) + 1
        for item in (
            Schema(number, channel.definition.encode(), "ros2msg", channel.schema),
            Channel(number, channel.topic, "cdr", {}, number),
        ):
            self.note(item)
            self._append(encode(item))
        return number

    def note(self, item: McapRecord) -> None:
        """List a schema or channel, which is in a chunk, in the summary."""
        if isinstance(item, Schema):
            self._schemas.setdefault(item.id, item)
        elif isinstance(item, Channel):
            self._channels.setdefault(item.id, item)

    def add_message(self, channel: int, stamp: int, sequence: int, data: bytes) -> None:
        """Add one message at `stamp` [ns] to the chunk in progress."""
        length = HEAD.itemsize - RECORD.size + len(data)
        self._entries.setdefault(channel, []).append(
            _entries(np.array([stamp]), np.array([self._size]))
        )
        self._append(_HEAD.pack(MESSAGE, length, channel, sequence, stamp, stamp) + data)

    def add_rows(
        self,
        channels: Sequence[int],
        stamp: NDArray[np.int64],
        sequence: NDArray[np.int64],
        messages: Sequence[Rows],
    ) -> None:
        """Add messages of several channels, one of each at each stamp.

        `stamp` (k,) is in ns, `sequence` (k,) below 2^32; `messages` has, for each channel, its k
        messages, contiguous.
        """
        if not len(stamp):
            return
        records = np.empty(len(stamp), _records_dtype(tuple(rows.itemsize for rows in messages)))
        fields = records.dtype.fields
        assert fields is not None
        offset = self._size + records.itemsize * np.arange(len(stamp))
        for place, (channel, rows) in enumerate(zip(channels, messages, strict=True)):
            record = records[str(place)]
            record["opcode"] = MESSAGE
            record["length"] = HEAD.itemsize - RECORD.size + rows.itemsize
            record["channel"] = channel
            record["sequence"] = sequence
            record["log_time"] = record["publish_time"] = stamp
            record["data"] = rows.view(record["data"].dtype)
            begin = offset + fields[str(place)][1]
            self._entries.setdefault(channel, []).append(_entries(stamp, begin))
        self._append(records.tobytes())

    def flush(self) -> None:
        """End the chunk in progress, if it has messages."""
        if not self._entries:
            return
        data = b"".join(self._parts)
        entries = {number: np.concatenate(parts) for number, parts in self._entries.items()}
        self._parts = []
        self._size = 0
        self._entries = {}
        first, last = span(entries)
        packed = zstandard.compress(data, _LEVEL)
        self.add_chunk(Chunk("zstd", packed, last, first, crc32(data), len(data)), entries)

    def add_chunk(self, chunk: Chunk, entries: Entries) -> None:
        """Add a complete chunk and its message indexes, in front of the chunk in progress."""
        start = self.position
        record = encode(chunk)
        self._put(record)
        end = self.position
        offsets: dict[int, int] = {}
        for channel, part in entries.items():
            offsets[channel] = self.position
            data = part.tobytes()
            self._counts[channel] = self._counts.get(channel, 0) + len(part)
            length = _MESSAGE_INDEX.size - RECORD.size + len(data)
            head = _MESSAGE_INDEX.pack(container.MESSAGE_INDEX, length, channel, len(data))
            self._put(head + data)
        first, last = span(entries)
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=last,
                message_index_length=self.position - end,
                message_index_offsets=offsets,
                message_start_time=first,
                uncompressed_size=chunk.uncompressed_size,
            )
        )

    def finish(self) -> None:
        """Write the pending chunk, the index and the footer."""
        self.flush()
        self._put(encode(DataEnd(0)))
        start = self.position
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: list[tuple[int, Sequence[McapRecord]]] = [
            (container.SCHEMA, [*self._schemas.values()]),
            (container.CHANNEL, [*self._channels.values()]),
            (container.STATISTICS, [statistics]),
            (container.CHUNK_INDEX, self._chunks),
            (container.ATTACHMENT_INDEX, self._attachments),
            (container.METADATA_INDEX, self._metadata),
        ]
        summary = b""
        offsets = b""
        for opcode, records in groups:
            data = b"".join(map(encode, records))
            offsets += encode(SummaryOffset(opcode, start + len(summary), len(data)))
            summary += data
        # The checksum of the index covers the footer up to the checksum itself.
        footer = encode(Footer(start, start + len(summary), 0))
        covered = (summary + offsets + footer)[: -struct.calcsize("<I")]
        self._put(covered + struct.pack("<I", crc32(covered)) + MAGIC)

    def _append(self, records: bytes) -> None:
        self._parts.append(records)
        self._size += len(records)

    def _put(self, data: bytes) -> None:
        self._write(data)
        self.position += len(data)


@cache
def _records_dtype(sizes: tuple[int, ...]) -> np.dtype[np.void]:
    """Return the type of the records at one stamp, one of each data size [bytes], unpadded."""
    head = [(name, HEAD[name]) for name in HEAD.names or ()]
    return np.dtype(
        [(str(place), np.dtype([*head, ("data", f"V{size}")])) for place, size in enumerate(sizes)]
    )
