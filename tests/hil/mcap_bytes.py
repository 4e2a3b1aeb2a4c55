"""Bytes of MCAP files as tests make and change them; sound by their own checksums."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from mcap.reader import make_reader
from mcap.records import Attachment, Chunk, Metadata
from mcap.writer import Writer

from hil.archive import container
from hil.archive.chunk import ChunkParser
from hil.archive.container import Record, encoded
from hil.archive.mcap_writer import McapWriter, entries_of
from hil.archive.schema import CYCLE


class Head(NamedTuple):
    """Where a message stands in a chunk, and what precedes its data."""

    channel: int
    sequence: int
    log_time: int
    start: int
    data: int


def record(opcode: int, body: bytes) -> bytes:
    return container.RECORD.pack(opcode, len(body)) + body


def text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def metadata(name: str, entries: Mapping[str, str]) -> bytes:
    return encoded(Metadata(name, dict(entries)))


def chunk(content: bytes, times: tuple[int, int] = (0, 0), level: int = 3) -> bytes:
    packed = zstandard.compress(content, level)
    return encoded(Chunk("zstd", packed, times[1], times[0], zlib.crc32(content), len(content)))


def attachment(name: str, content: bytes) -> bytes:
    return encoded(Attachment(0, 0, name, "", content))


def heads(chunk: bytes) -> Iterator[Head]:
    """The messages of a decompressed chunk."""
    head = struct.Struct("<HIQQ")
    for item in container.split(chunk, 0):
        if item.opcode == container.MESSAGE:
            channel, sequence, log_time, _ = head.unpack_from(item.body)
            start = item.offset + container.RECORD.size
            yield Head(channel, sequence, log_time, item.offset, start + head.size)


def chunks(data: bytes) -> list[tuple[int, int]]:
    """Where each chunk of a file begins and ends."""
    found, at = [], len(container.MAGIC)
    while at < len(data) and data[at] != container.DATA_END:
        opcode, end = container.bounds(data, at, 0)
        if opcode == container.CHUNK:
            found.append((at, end))
        at = end
    return found


def with_attachment(source: Path, target: Path, old: str, new: str) -> Path:
    """A copy with other words, of the same length, in an attachment; its checksum is right."""
    assert len(old.encode()) == len(new.encode())
    data, changed = bytearray(source.read_bytes()), 0
    with source.open("rb") as stream:
        for one in container.records(stream, len(data)):
            if one.opcode == container.ATTACHMENT and old.encode() in one.body:
                content = one.body[:-4].replace(old.encode(), new.encode())
                begin = one.offset + container.RECORD.size
                data[begin : one.end] = content + zlib.crc32(content).to_bytes(4, "little")
                changed += 1
    assert changed == 1
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)
    return target


def rewritten(source: Path, target: Path, *, cycles: int | None = None, **options: Any) -> None:
    """Another program's copy; where `cycles` is given, no chunk has more of them."""
    with source.open("rb") as stream, target.open("wb") as copy:
        reader, writer = make_reader(stream), Writer(copy, **options)
        writer.start("ros2")
        first, last = reader.iter_metadata()
        writer.add_metadata(first.name, first.metadata)
        for one in reader.iter_attachments():
            writer.add_attachment(0, 0, one.name, "x/y", one.data)
        channels: dict[str, int] = {}
        for kind, channel, message in reader.iter_messages(log_time_order=False):
            assert kind is not None
            if channel.topic not in channels:
                number = writer.register_schema(kind.name, kind.encoding, kind.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            if cycles and channel.topic == CYCLE and message.sequence % cycles == 0:
                writer.flush()
            times = message.log_time, message.data, message.publish_time, message.sequence
            writer.add_message(channels[channel.topic], *times)
        writer.add_metadata(last.name, last.metadata)
        writer.finish()


class Indexed:
    """A file that grows record by record, and gets an index that fits."""

    def __init__(self) -> None:
        self.data = bytearray()
        self._writer = McapWriter(self.data.extend, "", "")
        self.data[:] = container.MAGIC  # the header is among the records
        self._writer.position = len(self.data)

    @property
    def checksums(self) -> list[int]:
        """Those of the chunks so far."""
        return self._writer.checksums

    def put(self, data: bytes) -> None:
        """Append a record, given with its head."""
        item = Record(len(self.data), data[0], data[container.RECORD.size :])
        if item.opcode != container.CHUNK:
            self._writer.put(data)
            return
        head, parser = container.chunk(item), ChunkParser()
        found = parser.messages(container.chunk_data(head, item.offset), item.offset)
        for definition in parser.definitions:
            self._writer.note(definition)
        self._writer.add_chunk(head, entries_of(found))

    def ended(self) -> bytes:
        """The file, whole."""
        self._writer.finish()
        return bytes(self.data)
