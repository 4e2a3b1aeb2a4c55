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
from hil.archive.container import MAGIC, MESSAGE, RECORD, Record, encoded

_ENTRY = np.dtype([("stamp", "<u8"), ("offset", "<u8")])
_HEAD = struct.Struct("<BQHIQQ")
_MESSAGE_INDEX = struct.Struct("<BQHI")
_LEVEL = -1
"""Of Zstandard. Against the usual 3 it costs 4 % in size, and saves a third of the time both of
writing and of reading (`python -m benchmarks.archive --sizes`)."""

Entries = Mapping[int, NDArray[np.void]]
"""Stamps and offsets of the messages of a chunk by channel, in the order of the first ones."""


def entries_of(found: Mapping[int, Messages]) -> Entries:
    """The entries of messages that were read."""
    return {
        number: _entries(messages.of_heads("log_time"), np.concatenate(messages.places))
        for number, messages in found.items()
    }


def _entries(stamp: NDArray[np.int64], offset: NDArray[np.int64]) -> NDArray[np.void]:
    entries = np.empty(len(stamp), _ENTRY)
    entries["stamp"], entries["offset"] = stamp, offset
    return entries


def span(entries: Entries) -> tuple[int, int]:
    """First and last stamp [ns], zeros of a chunk without messages."""
    stamps = [part["stamp"] for part in entries.values() if len(part)] or [np.zeros(1, np.uint64)]
    return int(min(part.min() for part in stamps)), int(max(part.max() for part in stamps))


class McapWriter:
    """Writes one MCAP file to `write`, which receives whole records.

    Chunks end at `flush` and nowhere else; a chunk without messages is not written, what was
    registered for it goes into the next. Compressed by Zstandard, with checksums of chunks,
    attachments and index.

    Message indexes and summary follow from the other records: a file that lost them gets them back
    to the byte.

    Args:
        write: takes the next bytes of the file.
        profile, library: of its header.

    Attributes:
        position: where the next record begins.
        checksums: of the chunks written so far, CRC-32 of their records.
    """

    def __init__(self, write: Callable[[bytes], object], profile: str, library: str) -> None:
        self.position = 0
        self.checksums: list[int] = []
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
        self.put(encoded(Header(profile, library)))

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Add a metadata record, in front of the chunk in progress."""
        self.put(encoded(Metadata(name, dict(entries))))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Add an attachment without times, in front of the chunk in progress."""
        self.put(encoded(Attachment(0, 0, name, media_type, data)))

    def put(self, data: bytes) -> None:
        """Add a record that is no chunk, given with its head, and list it in the summary.

        Raises:
            Damage: its body is not of its kind.
        """
        record, place = Record(self.position, data[0], data[RECORD.size :]), self.position
        if record.opcode == container.METADATA:
            name, _ = container.metadata(record)
            self._metadata.append(MetadataIndex(place, len(data), name))
        elif record.opcode == container.ATTACHMENT:
            item = container.attachment(record)
            times, size = (item.log_time, item.create_time), len(item.data)
            self._attachments.append(
                AttachmentIndex(place, len(data), *times, size, item.name, item.media_type)
            )
        elif record.opcode in (container.SCHEMA, container.CHANNEL):
            self.note(container.item(record))
        self._put(data)

    def register(
        self, topic: str, message_encoding: str, schema: str, encoding: str, definition: bytes
    ) -> int:
        """Announce a channel and the schema of its messages; returns the channel's id."""
        number = len(self._channels) + 1
        for item in (
            Schema(number, definition, encoding, schema),
            Channel(number, topic, message_encoding, {}, number),
        ):
            self.note(item)
            self._append(encoded(item))
        return number

    def note(self, item: McapRecord) -> None:
        """List a schema or channel in the summary; it stands in a chunk."""
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
        """Add messages of several channels of the same instants, instant by instant.

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
        self._parts, self._size, self._entries = [], 0, {}
        first, last = span(entries)
        packed = zstandard.compress(data, _LEVEL)
        self.add_chunk(Chunk("zstd", packed, last, first, crc32(data), len(data)), entries)

    def add_chunk(self, chunk: Chunk, entries: Entries) -> None:
        """Add a whole chunk and its message indexes, in front of the chunk in progress.

        Args:
            chunk: its record.
            entries: of its messages.
        """
        start, record = self.position, encoded(chunk)
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
        self.checksums.append(chunk.uncompressed_crc)
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
        """Write what is left, the index and the footer."""
        self.flush()
        self._put(encoded(DataEnd(0)))
        start = self.position
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((one.message_end_time for one in self._chunks), default=0),
            message_start_time=min((one.message_start_time for one in self._chunks), default=0),
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
        # The checksum of the index covers the footer up to the checksum itself.
        footer = encoded(Footer(start, start + len(summary), 0))
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
    """The message records of one instant, one of each data size [bytes], without padding."""
    head = [(name, HEAD[name]) for name in HEAD.names or ()]
    return np.dtype(
        [(str(place), np.dtype([*head, ("data", f"V{size}")])) for place, size in enumerate(sizes)]
    )
