"""MCAP records in file order, with the index at the end; whole batches of messages at a time.

Record for record what `mcap.writer.Writer` makes of the same messages, but for the level of
compression. That one takes messages singly, at some microseconds each, which is most of the time of
an archive of three messages a millisecond; here a batch of messages of constant size is one
structured array. The library makes all other records.

Layout: https://mcap.dev/spec
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
from hil.archive.container import MAGIC, MESSAGE, Record, encoded

_ENTRY = np.dtype([("stamp", "<u8"), ("offset", "<u8")])
_HEAD = struct.Struct("<BQHIQQ")
_MESSAGE_INDEX = struct.Struct("<BQHI")
_COMPRESSION = "zstd"
_LEVEL = -1
"""Of Zstandard. Against the usual 3 it costs 4 % in size, and saves a third of the time both of
writing and of reading (`python -m benchmarks.archive --sizes`)."""

Entries = Mapping[int, Sequence[NDArray[np.void]]]
"""Stamps and offsets of the messages of a chunk by channel, in the order of the first ones."""


def entries_of(found: Mapping[int, Messages]) -> Entries:
    """The entries of messages that were read."""
    return {
        number: [_entries(messages.of_heads("log_time"), messages.places)]
        for number, messages in found.items()
    }


def _entries(stamp: NDArray[np.int64], offset: NDArray[np.int64]) -> NDArray[np.void]:
    entries = np.empty(len(stamp), _ENTRY)
    entries["stamp"], entries["offset"] = stamp, offset
    return entries


def span(entries: Entries) -> tuple[int, int]:
    """First and last stamp [ns], zeros of a chunk without messages."""
    stamps = [part["stamp"] for parts in entries.values() for part in parts if len(part)]
    if not stamps:
        return 0, 0
    return int(min(part.min() for part in stamps)), int(max(part.max() for part in stamps))


class Index:
    """What follows from the other records of a file: message indexes and summary.

    It holds nothing of its own, so a file that lost it gets it back to the byte.
    """

    def __init__(self) -> None:
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._times: tuple[int, int] | None = None

    def add_definition(self, record: Schema | Channel) -> None:
        """Take a schema or a channel."""
        if isinstance(record, Schema):
            self._schemas.setdefault(record.id, record)
        else:
            self._channels.setdefault(record.id, record)

    def add_attachment(self, offset: int, length: int, item: Attachment) -> None:
        """Take an attachment whose record of so many bytes begins at `offset`."""
        times = item.log_time, item.create_time
        place = offset, length, *times, len(item.data)
        self._attachments.append(AttachmentIndex(*place, item.name, item.media_type))

    def add_metadata(self, offset: int, length: int, name: str) -> None:
        """Take a metadata record of so many bytes that begins at `offset`."""
        self._metadata.append(MetadataIndex(offset, length, name))

    def add_chunk(
        self, offset: int, length: int, compression: str, sizes: tuple[int, int], entries: Entries
    ) -> list[bytes]:
        """Take a chunk record of so many bytes that begins at `offset`.

        Args:
            offset: where it begins.
            length: of the whole record.
            compression: as it states.
            sizes: of its records, compressed and not.
            entries: of its messages.

        Returns:
            The message indexes that must follow it.
        """
        indexes: list[bytes] = []
        offsets: dict[int, int] = {}
        at = offset + length
        for channel, parts in entries.items():
            data = b"".join(part.tobytes() for part in parts)
            count = len(data) // _ENTRY.itemsize
            self._counts[channel] = self._counts.get(channel, 0) + count
            body = _MESSAGE_INDEX.size - container.RECORD.size + len(data)
            head = _MESSAGE_INDEX.pack(container.MESSAGE_INDEX, body, channel, len(data))
            indexes.append(head + data)
            offsets[channel] = at
            at += len(indexes[-1])
        first, last = span(entries)
        before = self._times or (first, last)
        self._times = min(before[0], first), max(before[1], last)
        self._chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=offset,
                compression=compression,
                compressed_size=sizes[0],
                message_end_time=last,
                message_index_length=at - offset - length,
                message_index_offsets=offsets,
                message_start_time=first,
                uncompressed_size=sizes[1],
            )
        )
        return indexes

    def summary(self, start: int) -> tuple[bytes, int]:
        """The groups of the summary that begins at `start`, and where their offsets begin."""
        first, last = self._times or (0, 0)
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=last,
            message_start_time=first,
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
        summary, offsets = b"", b""
        for opcode, records in groups:
            data = b"".join(map(encoded, records))
            offsets += encoded(SummaryOffset(opcode, start + len(summary), len(data)))
            summary += data
        return summary + offsets, start + len(summary)

    def tail(self, offset: int) -> bytes:
        """What ends the file: DataEnd, which stands at `offset`, summary, footer and magic."""
        end = encoded(DataEnd(0))
        start = offset + len(end)
        summary, offsets_start = self.summary(start)
        # The checksum of the index covers the footer up to the checksum itself.
        covered = summary + encoded(Footer(start, offsets_start, 0))[: -struct.calcsize("<I")]
        return end + covered + struct.pack("<I", crc32(covered)) + MAGIC


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
        self._index = Index()
        self._checksums: list[int] = []
        self._n_channels = 0
        self._parts: list[bytes] = []  # of the chunk in progress
        self._size = 0
        self._entries: dict[int, list[NDArray[np.void]]] = {}

    @property
    def checksums(self) -> tuple[int, ...]:
        """Those of the chunks written so far, CRC-32 of their records."""
        return tuple(self._checksums)

    def start(self, profile: str, library: str) -> None:
        """Begin the file."""
        self._put(MAGIC)
        self._put(encoded(Header(profile, library)))

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Add a metadata record, in front of the chunk in progress."""
        data = encoded(Metadata(name, dict(entries)))
        self._index.add_metadata(self._position, len(data), name)
        self._put(data)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Add an attachment without times, in front of the chunk in progress."""
        item = Attachment(0, 0, name, media_type, data)
        record = encoded(item)
        self._index.add_attachment(self._position, len(record), item)
        self._put(record)

    def register(
        self, topic: str, message_encoding: str, schema: str, encoding: str, definition: bytes
    ) -> int:
        """Announce a channel and the schema of its messages; returns the channel's id."""
        self._n_channels += 1
        number = self._n_channels
        for record in (
            Schema(number, definition, encoding, schema),
            Channel(number, topic, message_encoding, {}, number),
        ):
            self._index.add_definition(record)
            self._append(encoded(record))
        return number

    def add_message(self, channel: int, stamp: int, sequence: int, data: bytes) -> None:
        """Add one message at `stamp` [ns] to the chunk in progress."""
        length = HEAD.itemsize - container.RECORD.size + len(data)
        entries = _entries(np.array([stamp]), np.array([self._size]))
        self._entries.setdefault(channel, []).append(entries)
        self._append(_HEAD.pack(MESSAGE, length, channel, sequence, stamp, stamp) + data)

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
        records = np.empty(len(stamp), _records_dtype(tuple(rows.itemsize for rows in messages)))
        fields = records.dtype.fields
        assert fields is not None
        offset = self._size + records.itemsize * np.arange(len(stamp))
        for place, (channel, rows) in enumerate(zip(channels, messages, strict=True)):
            record = records[str(place)]
            record["opcode"] = MESSAGE
            record["length"] = HEAD.itemsize - container.RECORD.size + rows.itemsize
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
        data, entries = b"".join(self._parts), self._entries
        self._parts, self._size, self._entries = [], 0, {}
        self.add_chunk(chunk_of(data, entries), entries)

    def add_chunk(self, chunk: Chunk, entries: Entries) -> None:
        """Add a whole chunk, in front of the one in progress.

        Args:
            chunk: its record.
            entries: of its messages.
        """
        record = encoded(chunk)
        sizes = len(chunk.data), chunk.uncompressed_size
        place = self._position, len(record)
        indexes = self._index.add_chunk(*place, chunk.compression, sizes, entries)
        self._checksums.append(chunk.uncompressed_crc)
        self._put(record)
        for data in indexes:
            self._put(data)

    def add_record(self, record: Record) -> None:
        """Add a record that stands in another file: attachment, metadata, schema or channel."""
        place = self._position, record.size
        if record.opcode == container.ATTACHMENT:
            self._index.add_attachment(*place, container.attachment(record))
        elif record.opcode == container.METADATA:
            self._index.add_metadata(*place, container.metadata(record)[0])
        else:
            kind: type[Schema | Channel] = Schema if record.opcode == container.SCHEMA else Channel
            self._index.add_definition(container.parsed(kind, record.body, record.offset))
        self._put(record.data)

    def add_definition(self, record: Schema | Channel) -> None:
        """Note a schema or channel that stands in a chunk added whole."""
        self._index.add_definition(record)

    def finish(self) -> None:
        """Write what is left, the index and the footer."""
        self.flush()
        self._put(self._index.tail(self._position))

    def _append(self, records: bytes) -> None:
        self._parts.append(records)
        self._size += len(records)

    def _put(self, data: bytes) -> None:
        self._write(data)
        self._position += len(data)


def chunk_of(data: bytes, entries: Entries) -> Chunk:
    """The chunk of these records, compressed as ours are."""
    first, last = span(entries)
    return Chunk(
        _COMPRESSION, zstandard.compress(data, _LEVEL), last, first, crc32(data), len(data)
    )


@cache
def _records_dtype(sizes: tuple[int, ...]) -> np.dtype[np.void]:
    """The message records of one instant, one of each data size [bytes], without padding."""
    return np.dtype(
        [
            (str(place), np.dtype([*_head_fields(), ("data", f"V{size}")]))
            for place, size in enumerate(sizes)
        ]
    )


def _head_fields() -> list[tuple[str, np.dtype[np.generic]]]:
    return [(name, HEAD[name]) for name in HEAD.names or ()]
