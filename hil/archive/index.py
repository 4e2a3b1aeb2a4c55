"""The parts of an MCAP file that follow from the others: message indexes and the summary.

Our reader believes the data section alone, but others find their way through these. They hold
nothing of their own, so a file that lost them gets them back to the byte.

Layout: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import BinaryIO, NamedTuple

import numpy as np
from isal.isal_zlib import crc32

from hil.archive import container
from hil.archive.container import RECORD, Chunk, Damage, Fields, Record

_MESSAGE = struct.Struct("<BQHIQQ")
_FOOTER_HEAD = struct.Struct("<BQQQ")
_GROUP = struct.Struct("<BQQ")  # opcode, offset, length
_PLACE = struct.Struct("<QQ")  # offset, length
_MOST_LISTED = 1 << 16  # bytes
_DATA_END = RECORD.pack(container.DATA_END, 4) + bytes(4)


class MessageHead(NamedTuple):
    """Where a message stands in a chunk, and what precedes its data.

    Attributes:
        start: where its record begins.
        data: where its data begin.
        end: where the next record begins.
    """

    channel: int
    sequence: int
    log_time: int
    publish_time: int
    start: int
    data: int
    end: int


class ChunkEntry(NamedTuple):
    """A chunk as the summary lists it; times in ns."""

    start_time: int
    end_time: int
    offset: int
    length: int
    channels: frozenset[int]


def messages(chunk: bytes, offset: int) -> Iterator[MessageHead | Record]:
    """Walk a decompressed chunk; records other than messages come as they are.

    Args:
        chunk: its records.
        offset: where it stands in the file, for the error.

    Raises:
        Damage: it does not hold whole records.
    """
    at = 0
    while at < len(chunk):
        if len(chunk) - at < RECORD.size:
            raise Damage(offset, "(chunk) ends within a record")
        opcode, length = RECORD.unpack_from(chunk, at)
        end = at + RECORD.size + length
        if end > len(chunk):
            raise Damage(offset, "(chunk) ends within a record")
        if opcode != container.MESSAGE:
            yield Record(at, opcode, chunk[at + RECORD.size : end], length)
        elif end < at + _MESSAGE.size:
            raise Damage(offset, "(chunk) ends within a record")
        else:
            _, _, channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(chunk, at)
            yield MessageHead(
                channel, sequence, log_time, publish_time, at, at + _MESSAGE.size, end
            )
        at = end


def split(records: bytes) -> list[bytes]:
    """Whole records one by one, each with its head."""
    found, at = [], 0
    while at < len(records):
        _, length = RECORD.unpack_from(records, at)
        end = at + RECORD.size + length
        found.append(records[at:end])
        at = end
    return found


def record(opcode: int, body: bytes) -> bytes:
    """A record with its head."""
    return RECORD.pack(opcode, len(body)) + body


def text(value: str) -> bytes:
    """A string as it stands in a record."""
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def metadata(name: str, entries: Mapping[str, str]) -> bytes:
    """A metadata record."""
    body = b"".join(text(key) + text(value) for key, value in entries.items())
    return record(container.METADATA, text(name) + struct.pack("<I", len(body)) + body)


def chunk(data: bytes, compressed: bytes, compression: str, times: tuple[int, int]) -> bytes:
    """A chunk record of the records `data`, whose messages lie within `times`."""
    head = struct.pack("<QQQI", *times, len(data), crc32(data)) + text(compression)
    return record(container.CHUNK, head + struct.pack("<Q", len(compressed)) + compressed)


def metadata_places(stream: BinaryIO, size: int) -> list[tuple[int, int]]:
    """Offset and length of the metadata records as the end of a file lists them.

    A few hundred bytes are read and nothing is verified: what stands there must verify itself.
    """
    tail = container.FOOTER_SIZE + len(container.MAGIC)
    stream.seek(max(0, size - tail))
    footer = stream.read(tail)
    if len(footer) < tail:
        return []
    *_, start = _FOOTER_HEAD.unpack_from(footer)
    groups = _listed(stream, start, size - tail - start)
    found = []
    for group in groups:
        if group.opcode == container.SUMMARY_OFFSET and len(group.body) == _GROUP.size:
            opcode, at, length = _GROUP.unpack(group.body)
            if opcode == container.METADATA_INDEX:
                found += [_PLACE.unpack_from(item.body) for item in _listed(stream, at, length)]
    return found


def _listed(stream: BinaryIO, at: int, length: int) -> list[Record]:
    """Short records that follow one another; none where that is not what stands there."""
    if not 0 < length <= _MOST_LISTED or at > container.FARTHEST:
        return []
    stream.seek(at)
    try:
        found = [item for item in messages(stream.read(length), at) if isinstance(item, Record)]
    except Damage:
        return []
    return [item for item in found if len(item.body) >= _PLACE.size]


@dataclass
class IndexBuilder:
    """Collects what message indexes and summary list, record after record as the file has them."""

    _schemas: dict[int, bytes] = field(default_factory=dict)
    _channels: dict[int, bytes] = field(default_factory=dict)
    _chunks: list[bytes] = field(default_factory=list)
    _attachments: list[bytes] = field(default_factory=list)
    _metadata: list[bytes] = field(default_factory=list)
    _counts: dict[int, int] = field(default_factory=dict)
    _times: tuple[int, int] | None = None

    def announce(self, opcode: int, body: bytes) -> None:
        """Take a schema or channel."""
        if opcode not in (container.SCHEMA, container.CHANNEL):
            return
        (identity,) = struct.unpack_from("<H", body)
        known = self._schemas if opcode == container.SCHEMA else self._channels
        known.setdefault(identity, record(opcode, body))

    def add_chunk(self, offset: int, length: int, head: Chunk, data: bytes) -> bytes:
        """Take a chunk record that begins at `offset`; returns the message indexes to follow it.

        Args:
            offset: where it begins.
            length: of the whole record.
            head: as it stands there.
            data: its records.
        """
        entries: dict[int, list[tuple[int, int]]] = {}
        for item in messages(data, offset):
            if isinstance(item, MessageHead):
                entries.setdefault(item.channel, []).append((item.log_time, item.start))
            else:
                self.announce(item.opcode, item.body)
        indexes, offsets = b"", b""
        for channel, listed in entries.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(listed)
            offsets += struct.pack("<HQ", channel, offset + length + len(indexes))
            body = np.array(listed, "<u8").tobytes()
            indexes += record(
                container.MESSAGE_INDEX, struct.pack("<HI", channel, len(body)) + body
            )
        times = span(entries)
        if self._times is None:
            self._times = times
        else:
            self._times = min(self._times[0], times[0]), max(self._times[1], times[1])
        body = struct.pack("<QQQQI", *times, offset, length, len(offsets)) + offsets
        body += struct.pack("<Q", len(indexes)) + text(head.compression)
        body += struct.pack("<QQ", len(head.data), head.size)
        self._chunks.append(record(container.CHUNK_INDEX, body))
        return indexes

    def add_attachment(self, offset: int, item: Record) -> None:
        """Take an attachment that begins at `offset`."""
        fields = Fields(item.body, item.offset)
        log_time, create_time = fields.number("Q"), fields.number("Q")
        name, media_type, data = fields.text(), fields.text(), fields.data("Q")
        body = struct.pack(
            "<QQQQQ", offset, item.end - item.offset, log_time, create_time, len(data)
        )
        self._attachments.append(
            record(container.ATTACHMENT_INDEX, body + text(name) + text(media_type))
        )

    def add_metadata(self, offset: int, length: int, name: str) -> None:
        """Take a metadata record that begins at `offset`."""
        body = struct.pack("<QQ", offset, length) + text(name)
        self._metadata.append(record(container.METADATA_INDEX, body))

    def tail(self, offset: int) -> bytes:
        """What ends the file: DataEnd, which stands at `offset`, summary, footer and magic."""
        start = offset + len(_DATA_END)
        groups = {
            container.SCHEMA: list(self._schemas.values()),
            container.CHANNEL: list(self._channels.values()),
            container.STATISTICS: [self._statistics()],
            container.CHUNK_INDEX: self._chunks,
            container.ATTACHMENT_INDEX: self._attachments,
            container.METADATA_INDEX: self._metadata,
        }
        summary, offsets = b"", b""
        for opcode, group in groups.items():
            joined = b"".join(group)
            body = _GROUP.pack(opcode, start + len(summary), len(joined))
            offsets += record(container.SUMMARY_OFFSET, body)
            summary += joined
        offsets_start = start + len(summary)
        summary += offsets + _FOOTER_HEAD.pack(container.FOOTER, 20, start, offsets_start)
        return _DATA_END + summary + struct.pack("<I", crc32(summary)) + container.MAGIC

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", *item) for item in self._counts.items())
        body = struct.pack(
            "<QHIIIIQQI",
            sum(self._counts.values()),
            len(self._schemas),
            len(self._channels),
            len(self._attachments),
            len(self._metadata),
            len(self._chunks),
            *(self._times or (0, 0)),
            len(counts),
        )
        return record(container.STATISTICS, body + counts)


def span(entries: Mapping[int, list[tuple[int, int]]]) -> tuple[int, int]:
    """First and last log time of the messages of a chunk."""
    stamps = [stamp for listed in entries.values() for stamp, _ in listed]
    return min(stamps, default=0), max(stamps, default=0)


@dataclass(frozen=True)
class Summary:
    """The summary of a file as far as reading needs it.

    Attributes:
        definitions: schema and channel records.
        chunks: in the order of the file.
        others: offset and length of attachments and metadata.
        statistics: the record's body, empty where there is none.
    """

    definitions: tuple[Record, ...]
    chunks: tuple[ChunkEntry, ...]
    others: tuple[tuple[int, int], ...]
    statistics: bytes = b""

    @classmethod
    def read(cls, stream: BinaryIO, size: int, *, start: int | None = None) -> Summary | None:
        """Read it; None where there is none, or where it is not whole or lists nonsense.

        Args:
            stream: the file.
            size: its length.
            start: where the data section ends, of a file in which records have moved: then what
                the summary lists may be elsewhere.
        """
        tail = container.FOOTER_SIZE + len(container.MAGIC)
        if size < tail:
            return None
        stream.seek(size - tail)
        footer = stream.read(tail)
        opcode, length, stated, _ = _FOOTER_HEAD.unpack_from(footer)
        moved, start = start is not None, stated if start is None else start
        (crc,) = struct.unpack_from("<I", footer, _FOOTER_HEAD.size)
        if (opcode, length) != (container.FOOTER, 20) or not footer.endswith(container.MAGIC):
            return None
        if not len(container.MAGIC) <= start <= size - tail or not crc:
            return None
        if size - start > container.LARGEST_RECORD:
            return None
        stream.seek(start)
        body = stream.read(size - tail - start)
        if crc32(body + footer[: _FOOTER_HEAD.size]) != crc:
            return None
        try:
            found = cls._parsed(body, start)
        except Damage:
            return None
        return found if moved or found._is_within(start) else None

    def _is_within(self, end: int) -> bool:
        """Whether what it lists lies before `end`, and nothing twice."""
        at = len(container.MAGIC)
        for offset, length in sorted([*((c.offset, c.length) for c in self.chunks), *self.others]):
            if offset < at:
                return False
            at = offset + length
        return at <= end

    @classmethod
    def of(cls, tail: bytes) -> Summary:
        """That which `IndexBuilder.tail` made."""
        return cls._parsed(tail[len(_DATA_END) : -container.FOOTER_SIZE - len(container.MAGIC)], 0)

    @classmethod
    def _parsed(cls, body: bytes, start: int) -> Summary:
        definitions, chunks, others, statistics = [], [], [], b""
        for item in messages(body, start):
            if isinstance(item, MessageHead):
                raise Damage(start, "has messages in its summary")
            fields = Fields(item.body, start)
            if item.opcode in (container.SCHEMA, container.CHANNEL):
                definitions.append(item)
            elif item.opcode == container.CHUNK_INDEX:
                chunks.append(_chunk_entry(fields))
            elif item.opcode in (container.ATTACHMENT_INDEX, container.METADATA_INDEX):
                others.append((fields.number("Q"), fields.number("Q")))
            elif item.opcode == container.STATISTICS:
                statistics = item.body
        chunks.sort(key=lambda entry: entry.offset)
        return cls(tuple(definitions), tuple(chunks), tuple(sorted(others)), statistics)


def _chunk_entry(fields: Fields) -> ChunkEntry:
    start_time, end_time, offset, length = (fields.number("Q") for _ in range(4))
    end = fields.number("I") + fields.at
    channels = set()
    while fields.at < end:
        channels.add(fields.number("H"))
        fields.number("Q")
    return ChunkEntry(start_time, end_time, offset, length, frozenset(channels))
