"""Bytes of MCAP files that tests create and change, with valid checksums."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

import zstandard
from mcap.reader import make_reader
from mcap.records import Attachment, Chunk, Metadata
from mcap.writer import CompressionType, IndexType, Writer

from hil.archive import verified_records
from hil.archive.chunk_messages import ChunkParser
from hil.archive.header import with_checksum
from hil.archive.index import FileIndex
from hil.archive.schema import CYCLE
from hil.archive.verified_records import Record, encode


class Head(NamedTuple):
    """Place of a message in a chunk, and the head of its record."""

    channel: int
    sequence: int
    log_time: int
    start: int
    data: int


def record(opcode: int, body: bytes) -> bytes:
    return verified_records.RECORD.pack(opcode, len(body)) + body


def text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def metadata(name: str, entries: Mapping[str, str]) -> bytes:
    return encode(Metadata(name, dict(entries)))


def chunk(content: bytes, times: tuple[int, int] = (0, 0), level: int = 3) -> bytes:
    packed = zstandard.compress(content, level)
    return encode(Chunk("zstd", packed, times[1], times[0], zlib.crc32(content), len(content)))


def attachment(name: str, content: bytes) -> bytes:
    return encode(Attachment(0, 0, name, "", content))


def heads(chunk: bytes) -> Iterator[Head]:
    """Yield the messages of a decompressed chunk."""
    head = struct.Struct("<HIQQ")
    for item in verified_records.split_records(chunk, 0):
        if item.opcode == verified_records.MESSAGE:
            channel, sequence, log_time, _ = head.unpack_from(item.body)
            start = item.offset + verified_records.RECORD.size
            yield Head(channel, sequence, log_time, item.offset, start + head.size)


def chunks(data: bytes) -> list[tuple[int, int]]:
    """Return begin and end of each chunk of a file."""
    bounds = []
    at = len(verified_records.MAGIC)
    while at < len(data) and data[at] != verified_records.DATA_END:
        opcode, end = verified_records.record_bounds(data, at, 0)
        if opcode == verified_records.CHUNK:
            bounds.append((at, end))
        at = end
    return bounds


def with_attachment(source: Path, target: Path, old: str, new: str) -> Path:
    """Copy a file with another text of the same length in an attachment, checksum included."""
    assert len(old.encode()) == len(new.encode())
    data = bytearray(source.read_bytes())
    changed = 0
    with source.open("rb") as stream:
        for record in verified_records.records(stream, len(data)):
            if record.opcode == verified_records.ATTACHMENT and old.encode() in record.body:
                content = record.body[:-4].replace(old.encode(), new.encode())
                begin = record.offset + verified_records.RECORD.size
                data[begin : record.end] = content + zlib.crc32(content).to_bytes(4, "little")
                changed += 1
    assert changed == 1
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)
    return target


@dataclass(frozen=True)
class Message:
    topic: str
    schema: str
    text: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


@dataclass
class Content:
    """Content of an archive, to be changed and written by the library."""

    messages: list[Message]
    metadata: dict[str, str]
    outcome: dict[str, str]
    attachments: dict[str, bytes]
    profile: str = "ros2"
    library: str = "hil"
    compression: CompressionType = CompressionType.ZSTD
    indexes: IndexType = IndexType.ALL
    encoding: str = "cdr"
    cycles_per_chunk: int = 10
    chunk_size: int = 1 << 40

    @classmethod
    def of(cls, path: Path) -> Self:
        with path.open("rb") as stream:
            reader = make_reader(stream)
            messages = [
                Message(
                    channel.topic, kind.name if kind else "", kind.data.decode() if kind else "",
                    message.log_time, message.publish_time, message.sequence, message.data,
                )
                for kind, channel, message in reader.iter_messages(log_time_order=False)
            ]  # fmt: skip
            metadata = [dict(record.metadata) for record in reader.iter_metadata()]
            attachments = {
                attachment.name: attachment.data for attachment in reader.iter_attachments()
            }
        for entries in metadata:
            entries.pop("checksum", None)  # those of others have none
        return cls(messages, metadata[0], metadata[1], attachments)

    def write(self, path: Path) -> Path:
        with path.open("wb") as stream:
            writer = Writer(
                stream, self.chunk_size, compression=self.compression, index_types=self.indexes
            )
            writer.start(self.profile, self.library)
            writer.add_metadata("hil", with_checksum(self.metadata))
            for name, data in sorted(self.attachments.items()):
                writer.add_attachment(0, 0, name, "text/plain", data)
            channels: dict[str, int] = {}
            cycles = 0
            for message in self.messages:
                if message.topic not in channels:
                    kind = writer.register_schema(message.schema, "ros2msg", message.text.encode())
                    channel = writer.register_channel(message.topic, self.encoding, kind)
                    channels[message.topic] = channel
                if message.topic == CYCLE:
                    if cycles and cycles % self.cycles_per_chunk == 0:
                        writer.flush()
                    cycles += 1
                times = message.log_time, message.data, message.publish_time, message.sequence
                writer.add_message(channels[message.topic], *times)
            writer.flush()
            writer.add_metadata("hil.outcome", with_checksum(self.outcome))
            writer.finish()
        return path


class Indexed:
    """A file to which records are appended, completed with a valid index."""

    def __init__(self) -> None:
        self.data = bytearray(verified_records.MAGIC)
        self._index = FileIndex()

    def put(self, data: bytes) -> None:
        """Append a record, given with its head."""
        item = Record(len(self.data), data[0], data[verified_records.RECORD.size :])
        if item.opcode == verified_records.CHUNK:
            head = verified_records.parse_chunk(item)
            parser = ChunkParser()
            by_channel = parser.messages(
                verified_records.chunk_data(head, item.offset), item.offset
            )
            for definition in parser.definitions:
                self._index.define(definition)
            data += self._index.add_chunk(head, by_channel, item.offset, len(data))
        else:
            self._index.add(verified_records.parse_item(item), item.offset, len(data))
        self.data += data

    def ended(self) -> bytes:
        """Return the complete file."""
        return bytes(self.data) + self._index.ended(len(self.data))
