"""The MCAP container as far as an archive needs it: records in file order, each verified.

Only the data section is believed. It is self-delimiting and its chunks and attachments carry
checksums, so a file cut off anywhere can be read up to its last whole chunk; the index at the end
is for other programs. Whatever is wrong with the bytes surfaces as `Damage`, with the place.

Layout: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
LARGEST_CHUNK = 1 << 30  # bytes; a greater size is a corrupt one

HEADER = 0x01
FOOTER = 0x02
SCHEMA = 0x03
CHANNEL = 0x04
MESSAGE = 0x05
CHUNK = 0x06
ATTACHMENT = 0x09
METADATA = 0x0C
DATA_END = 0x0F

_RECORD = struct.Struct("<BQ")
_FOOTER_SIZE = _RECORD.size + 20
_NO_CRC = 0


class Damage(Exception):  # noqa: N818 - handed on as a finding, too
    """Bytes that do not keep the format.

    Attributes:
        offset: where in the file the damaged record begins.
        reason: what is wrong, to stand after "the record at byte ...".
    """

    def __init__(self, offset: int, reason: str) -> None:
        super().__init__(reason)
        self.offset = offset
        self.reason = reason


class Record(NamedTuple):
    """One record of the data section."""

    offset: int
    opcode: int
    body: bytes


class Chunk(NamedTuple):
    """The head of a chunk record, and its compressed records."""

    size: int
    crc: int
    compression: str
    data: bytes


class SchemaRecord(NamedTuple):
    """A schema: how the messages of a channel are to be read."""

    id: int
    name: str
    encoding: str
    definition: str


class ChannelRecord(NamedTuple):
    """A channel: a topic and the schema of its messages."""

    id: int
    schema_id: int
    topic: str
    encoding: str


class _Fields:
    """Reads the fields of a record body one after the other; running out is damage."""

    def __init__(self, body: bytes, offset: int) -> None:
        self._body = body
        self._offset = offset
        self.at = 0

    def number(self, code: str) -> int:
        size = struct.calcsize("<" + code)
        value: int
        (value,) = struct.unpack("<" + code, self._take(size))
        return value

    def text(self) -> str:
        try:
            return self._take(self.number("I")).decode()
        except UnicodeDecodeError:
            raise Damage(self._offset, "holds text that is not UTF-8") from None

    def data(self, code: str) -> bytes:
        return self._take(self.number(code))

    def mapping(self) -> dict[str, str]:
        end = self.number("I") + self.at
        entries = {}
        while self.at < end:
            key = self.text()
            entries[key] = self.text()
        return entries

    def _take(self, size: int) -> bytes:
        part = self._body[self.at : self.at + size]
        if len(part) != size:
            raise Damage(self._offset, "is shorter than its fields")
        self.at += size
        return part


def records(stream: BinaryIO, size: int) -> Iterator[Record]:
    """Walk the records of the data section, DataEnd included; then check the end of the file.

    Raises:
        Damage: the file is cut off, or its bytes do not keep the format.
    """
    if stream.read(len(MAGIC)) != MAGIC:
        raise Damage(0, "is not the beginning of an MCAP file")
    offset = len(MAGIC)
    while True:
        head = stream.read(_RECORD.size)
        if not head:
            raise Damage(offset, "is missing: the file ends before its footer")
        if len(head) < _RECORD.size:
            raise Damage(offset, "is cut off")
        opcode, length = _RECORD.unpack(head)
        if length > size - offset - _RECORD.size:
            raise Damage(offset, "is cut off, or its length is corrupt")
        yield Record(offset, opcode, stream.read(length))
        offset += _RECORD.size + length
        if opcode == DATA_END:
            _check_end(stream.read(), offset)
            return


def _check_end(tail: bytes, offset: int) -> None:
    """Check summary and footer, which follow DataEnd."""
    if len(tail) < _FOOTER_SIZE + len(MAGIC) or not tail.endswith(MAGIC):
        raise Damage(offset, "(index and footer) is cut off")
    footer = tail[-_FOOTER_SIZE - len(MAGIC) : -len(MAGIC)]
    opcode, length = _RECORD.unpack_from(footer)
    (crc,) = struct.unpack_from("<I", footer, _FOOTER_SIZE - 4)
    covered = tail[: -len(MAGIC) - 4]
    if opcode != FOOTER or length != 20 or (crc != _NO_CRC and zlib.crc32(covered) != crc):
        raise Damage(offset, "(index and footer) fails its checksum")


def metadata(record: Record) -> tuple[str, dict[str, str]]:
    """Name and entries of a metadata record."""
    fields = _Fields(record.body, record.offset)
    return fields.text(), fields.mapping()


def attachment(record: Record) -> tuple[str, bytes]:
    """Name and content of an attachment, its checksum verified."""
    fields = _Fields(record.body, record.offset)
    fields.number("Q")
    fields.number("Q")
    name = fields.text()
    fields.text()
    data = fields.data("Q")
    covered = record.body[: fields.at]
    crc = fields.number("I")
    if crc not in (_NO_CRC, zlib.crc32(covered)):
        raise Damage(record.offset, f"(attachment {name!r}) fails its checksum")
    return name, data


def schema(body: bytes, offset: int) -> SchemaRecord:
    """Read a schema record that stands in a chunk at `offset`."""
    fields = _Fields(body, offset)
    identity, name, encoding = fields.number("H"), fields.text(), fields.text()
    definition = fields.data("I").decode(errors="replace")
    return SchemaRecord(identity, name, encoding, definition)


def channel(body: bytes, offset: int) -> ChannelRecord:
    """Read a channel record that stands in a chunk at `offset`."""
    fields = _Fields(body, offset)
    return ChannelRecord(fields.number("H"), fields.number("H"), fields.text(), fields.text())


def chunk_data(record: Record, *, decompressor: zstandard.ZstdDecompressor) -> bytes:
    """Decompress the records of a chunk and verify their checksum."""
    fields = _Fields(record.body, record.offset)
    fields.number("Q")
    fields.number("Q")
    size, crc = fields.number("Q"), fields.number("I")
    chunk = Chunk(size, crc, fields.text(), fields.data("Q"))
    if size > LARGEST_CHUNK:
        raise Damage(record.offset, f"(chunk) claims {size} bytes of content")
    data = _decompressed(chunk, record.offset, decompressor)
    if len(data) != size:
        raise Damage(record.offset, "(chunk) has another length than it claims")
    if crc != _NO_CRC and zlib.crc32(data) != crc:
        raise Damage(record.offset, "(chunk) fails its checksum")
    return data


def _decompressed(chunk: Chunk, offset: int, decompressor: zstandard.ZstdDecompressor) -> bytes:
    """Decompress to at most one byte more than announced: a corrupt frame fills no memory."""
    try:
        if chunk.compression == "zstd":
            claimed = zstandard.frame_content_size(chunk.data)
            if claimed not in (-1, chunk.size):
                raise Damage(offset, "(chunk) has another length than it claims")
            return decompressor.decompress(chunk.data, max_output_size=max(1, chunk.size))
        if chunk.compression == "lz4":
            frame = lz4.frame.LZ4FrameDecompressor()
            return bytes(frame.decompress(chunk.data, max_length=chunk.size + 1))
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise Damage(offset, "(chunk) cannot be decompressed") from error
    if chunk.compression == "":
        return chunk.data
    raise Damage(offset, f"(chunk) is compressed with {chunk.compression!r}, known: zstd, lz4")
