"""Bytes of MCAP files as tests make and change them; sound by their own checksums."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import zstandard
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema

from hil.archive import container
from hil.archive.chunk import ChunkParser
from hil.archive.container import Record, encoded, parsed
from hil.archive.mcap_writer import Index, entries_of


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


class Indexed:
    """A file that grows record by record, and gets an index that fits."""

    def __init__(self) -> None:
        self.data, self._index, self._parser = bytearray(container.MAGIC), Index(), ChunkParser()
        self.checksums: list[int] = []

    def put(self, data: bytes) -> None:
        """Append a record, given with its head."""
        opcode, length = container.RECORD.unpack_from(data)
        at = len(self.data)
        item = Record(at, opcode, data[container.RECORD.size :], length)
        self.data += data
        if opcode == container.METADATA:
            self._index.add_metadata(at, len(data), container.metadata(item)[0])
        elif opcode == container.ATTACHMENT:
            self._index.add_attachment(at, len(data), container.attachment(item))
        elif opcode in (container.SCHEMA, container.CHANNEL):
            kind: type[Schema | Channel] = Schema if opcode == container.SCHEMA else Channel
            self._index.add_definition(parsed(kind, item.body, at))
        elif opcode == container.CHUNK:
            self._chunk(item)

    def _chunk(self, item: Record) -> None:
        head = container.chunk(item)
        self.checksums.append(head.crc)
        content = container.chunk_data(item, decompressor=zstandard.ZstdDecompressor())
        parser = ChunkParser()
        found = parser.messages(content, item.offset)
        for definition in parser.known.definitions:
            self._index.add_definition(definition)
        sizes = len(head.data), head.size
        place = item.offset, item.size
        for data in self._index.add_chunk(*place, head.compression, sizes, entries_of(found)):
            self.data += data

    def ended(self) -> bytes:
        """The file, whole."""
        return bytes(self.data + self._index.tail(len(self.data)))
