"""The MCAP container as far as an archive needs it: records in file order, each verified.

Only the data section is believed. It is self-delimiting and its chunks and attachments carry
checksums, so a file cut off anywhere can be read up to its last whole chunk; the index at the end
is for other programs. Whatever is wrong with the bytes surfaces as `Damage`, with the place.

Layout: https://mcap.dev/spec
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard
from isal.isal_zlib import crc32  # ten times as fast as that of zlib

MAGIC = b"\x89MCAP0\r\n"
LARGEST_CHUNK = 1 << 24  # bytes; ours have a tenth of a megabyte
LARGEST_RECORD = 1 << 28  # bytes; neither attachments nor summaries come near
MOST_INFLATION = 1000  # times what is compressed; an arm at rest reaches a tenth

HEADER = 0x01
FOOTER = 0x02
SCHEMA = 0x03
CHANNEL = 0x04
MESSAGE = 0x05
CHUNK = 0x06
MESSAGE_INDEX = 0x07
CHUNK_INDEX = 0x08
ATTACHMENT = 0x09
ATTACHMENT_INDEX = 0x0A
STATISTICS = 0x0B
METADATA = 0x0C
METADATA_INDEX = 0x0D
SUMMARY_OFFSET = 0x0E
DATA_END = 0x0F

RECORD = struct.Struct("<BQ")  # opcode, length of the body
FOOTER_SIZE = RECORD.size + 20
_CHUNK_HEAD = struct.Struct("<QQQII")  # times, size, checksum, length of the compression's name
_LENGTH = struct.Struct("<Q")
_NO_CRC = 0
FARTHEST = 1 << 62  # bytes, less than the end of any file


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
    """One record of the data section; a body that was not asked for is empty."""

    offset: int
    opcode: int
    body: bytes
    length: int

    @property
    def end(self) -> int:
        """Where the next record begins."""
        return self.offset + RECORD.size + self.length


class Chunk(NamedTuple):
    """The head of a chunk record, and its compressed records."""

    start_time: int
    end_time: int
    size: int
    crc: int
    compression: str
    data: memoryview


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


class Fields:
    """Reads the fields of a record body one after the other; running out is damage.

    Args:
        body: the record without its head.
        offset: where the record stands in the file, for the error.
    """

    def __init__(self, body: bytes, offset: int) -> None:
        self._body = body
        self._offset = offset
        self.at = 0

    def number(self, code: str) -> int:
        """Read a number; `code` is that of `struct`."""
        size = struct.calcsize("<" + code)
        value: int
        (value,) = struct.unpack("<" + code, self._take(size))
        return value

    def text(self) -> str:
        """Read a string."""
        try:
            return self._take(self.number("I")).decode()
        except UnicodeDecodeError:
            raise Damage(self._offset, "holds text that is not UTF-8") from None

    def data(self, code: str) -> bytes:
        """Read bytes whose count precedes them."""
        return self._take(self.number(code))

    def mapping(self) -> dict[str, str]:
        """Read strings by name."""
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


def record_at(stream: BinaryIO, offset: int, length: int) -> Record:
    """Read the record that an index says begins at `offset`, `length` with its head.

    Raises:
        Damage: it is not there.
    """
    if not RECORD.size <= length <= LARGEST_RECORD or offset > FARTHEST:
        raise Damage(offset, "is not of the length that the index says")
    stream.seek(offset)
    data = stream.read(length)
    if len(data) != length:
        raise Damage(offset, "is cut off")
    opcode, body_length = RECORD.unpack_from(data)
    if body_length != length - RECORD.size:
        raise Damage(offset, "is not of the length that the index says")
    return Record(offset, opcode, data[RECORD.size :], body_length)


def records(
    stream: BinaryIO, size: int, *, skip: Collection[int] = (), check_end: bool = True
) -> Iterator[Record]:
    """Walk the records of the data section, DataEnd included; then check the end of the file.

    Args:
        stream: the file, at its beginning.
        size: its length.
        skip: opcodes of records whose bodies are passed over.
        check_end: whether to check summary and footer.

    Raises:
        Damage: the file is cut off, or its bytes do not keep the format.
    """
    if stream.read(len(MAGIC)) != MAGIC:
        raise Damage(0, "is not the beginning of an MCAP file")
    offset = len(MAGIC)
    read, seek = stream.read, stream.seek
    while True:
        head = read(RECORD.size)
        if not head:
            raise Damage(offset, "is missing: the file ends before its footer")
        if len(head) < RECORD.size:
            raise Damage(offset, "is cut off")
        opcode, length = RECORD.unpack(head)
        if length > size - offset - RECORD.size:
            raise Damage(offset, "is cut off, or its length is corrupt")
        if length > LARGEST_RECORD and opcode not in skip:
            raise Damage(offset, f"claims {length} bytes of content")
        if opcode in skip:
            seek(length, os.SEEK_CUR)
            yield Record(offset, opcode, b"", length)
        else:
            yield Record(offset, opcode, read(length), length)
        offset += RECORD.size + length
        if opcode == DATA_END:
            if check_end:
                _check_end(read(min(size - offset, LARGEST_RECORD)), offset)
            return


def data_end(stream: BinaryIO, size: int) -> int | None:
    """Where the summary must begin, found from head to head; None where the way is broken."""
    stream.seek(0)
    try:
        for record in records(stream, size, skip=range(256), check_end=False):
            if record.opcode == DATA_END:
                return record.end
    except Damage:
        return None
    return None


def _check_end(tail: bytes, offset: int) -> None:
    """Check summary and footer, which follow DataEnd."""
    if len(tail) < FOOTER_SIZE + len(MAGIC) or not tail.endswith(MAGIC):
        raise Damage(offset, "(index and footer) is cut off")
    footer = tail[-FOOTER_SIZE - len(MAGIC) : -len(MAGIC)]
    opcode, length = RECORD.unpack_from(footer)
    (crc,) = struct.unpack_from("<I", footer, FOOTER_SIZE - 4)
    covered = tail[: -len(MAGIC) - 4]
    if opcode != FOOTER or length != 20 or (crc != _NO_CRC and crc32(covered) != crc):
        raise Damage(offset, "(index and footer) fails its checksum")


def metadata(record: Record) -> tuple[str, dict[str, str]]:
    """Name and entries of a metadata record."""
    fields = Fields(record.body, record.offset)
    return fields.text(), fields.mapping()


def attachment(record: Record) -> tuple[str, bytes]:
    """Name and content of an attachment, its checksum verified."""
    fields = Fields(record.body, record.offset)
    fields.number("Q")
    fields.number("Q")
    name = fields.text()
    fields.text()
    data = fields.data("Q")
    covered = record.body[: fields.at]
    crc = fields.number("I")
    if crc != crc32(covered):
        raise Damage(record.offset, f"(attachment {name!r}) fails its checksum")
    return name, data


def schema(body: bytes, offset: int) -> SchemaRecord:
    """Read a schema record that stands in a chunk at `offset`."""
    fields = Fields(body, offset)
    identity, name, encoding = fields.number("H"), fields.text(), fields.text()
    definition = fields.data("I").decode(errors="replace")
    if not identity:
        raise Damage(offset, "(schema) has the number 0, which says that there is none")
    return SchemaRecord(identity, name, encoding, definition)


def channel(body: bytes, offset: int) -> ChannelRecord:
    """Read a channel record that stands in a chunk at `offset`."""
    fields = Fields(body, offset)
    return ChannelRecord(fields.number("H"), fields.number("H"), fields.text(), fields.text())


def chunk(record: Record) -> Chunk:
    """Read a chunk record, without decompressing it."""
    body = memoryview(record.body)
    try:
        start_time, end_time, size, crc, name_length = _CHUNK_HEAD.unpack_from(body)
        name_end = _CHUNK_HEAD.size + name_length
        compression = bytes(body[_CHUNK_HEAD.size : name_end]).decode()
        (length,) = _LENGTH.unpack_from(body, name_end)
    except (struct.error, UnicodeDecodeError):
        raise Damage(record.offset, "(chunk) has a head that cannot be read") from None
    data = body[name_end + _LENGTH.size :]
    if len(data) != length:
        raise Damage(record.offset, "(chunk) has another length than its fields")
    return Chunk(start_time, end_time, size, crc, compression, data)


def chunk_data(record: Record, *, decompressor: zstandard.ZstdDecompressor) -> bytes:
    """Decompress the records of a chunk and verify their checksum."""
    head = chunk(record)
    if head.size > min(LARGEST_CHUNK, MOST_INFLATION * len(head.data)):
        raise Damage(record.offset, f"(chunk) claims {head.size} bytes of content")
    data = _decompressed(head, record.offset, decompressor)
    if len(data) != head.size:
        raise Damage(record.offset, "(chunk) has another length than it claims")
    if crc32(data) != head.crc:
        missing = head.crc == _NO_CRC
        raise Damage(record.offset, f"(chunk) {'has no' if missing else 'fails its'} checksum")
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
        return bytes(chunk.data)
    raise Damage(offset, f"(chunk) is compressed with {chunk.compression!r}, known: zstd, lz4")
