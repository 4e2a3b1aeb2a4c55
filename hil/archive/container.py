"""The MCAP container (https://mcap.dev/spec): records in file order, each verified.

The `mcap` library reads and writes single records; files are read here, twice as fast, and a
truncated or forged record becomes `Damage` with its place.
"""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple, TypeVar

import lz4.frame
import zstandard
from isal.isal_zlib import crc32  # ten times as fast as that of zlib
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
)

MAGIC = b"\x89MCAP0\r\n"
LARGEST_CHUNK = 1 << 24  # bytes; own chunks have a tenth of a megabyte
MOST_INFLATION = 1000  # times what is compressed; an arm at rest reaches a tenth
LARGEST_RECORD = 1 << 28  # bytes; attachments and summaries are far smaller
_FARTHEST = 1 << 62  # bytes, less than the end of any file

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX = range(9, 14)
SUMMARY_OFFSET, DATA_END = 14, 15
BUT_INDEXES = frozenset(range(256)) - {MESSAGE_INDEX}

RECORD = struct.Struct("<BQ")  # opcode, length of the body
FOOTER_SIZE = RECORD.size + 20
_CHUNK_HEAD = struct.Struct("<QQQII")  # times, size, checksum, length of the compression's name
_LENGTH = struct.Struct("<Q")
_CRC = struct.Struct("<I")
_NO_CRC = 0
_SMALL = 4096  # bytes that are read faster than skipped
_UNCOVERED = _CRC.size + len(MAGIC)  # bytes at the end of a file, not covered by the checksum
_KINDS: dict[int, type[McapRecord]] = {
    SCHEMA: Schema,
    CHANNEL: Channel,
    METADATA: Metadata,
    CHUNK_INDEX: ChunkIndex,
    METADATA_INDEX: MetadataIndex,
    ATTACHMENT_INDEX: AttachmentIndex,
}
_Parsed = TypeVar("_Parsed", bound=McapRecord)


class Damage(Exception):  # noqa: N818 - also passed on as a finding
    """Bytes that violate the format: `reason` follows "the record at byte `offset`"."""

    def __init__(self, offset: int, reason: str) -> None:
        super().__init__(reason)
        self.offset = offset
        self.reason = reason


class Record(NamedTuple):
    """One record of a file, a chunk or a summary."""

    offset: int
    opcode: int
    body: bytes

    @property
    def size(self) -> int:
        """Number of bytes with its head."""
        return RECORD.size + len(self.body)

    @property
    def end(self) -> int:
        """Where the next record begins."""
        return self.offset + self.size

    @property
    def data(self) -> bytes:
        """Its bytes as in the file."""
        return RECORD.pack(self.opcode, len(self.body)) + self.body


class _Body(ReadDataStream):
    """The fields of a record; a field that is cut short raises `EndOfFile`."""

    def __init__(self, body: bytes) -> None:
        super().__init__(BytesIO(body))
        self._size = len(body)

    def read(self, length: int) -> bytes:
        if length > self._size - self.count:
            raise EndOfFile
        return super().read(length)


def parse(kind: type[_Parsed], record: Record) -> _Parsed:
    """Return a record of this kind; `Damage` if the body does not fit it."""
    try:
        found: _Parsed = kind.read(_Body(record.body))  # type: ignore[attr-defined]
    except EndOfFile:
        raise Damage(record.offset, "is shorter than its fields") from None
    except UnicodeDecodeError:
        raise Damage(record.offset, "holds text that is not UTF-8") from None
    return found


def encode(record: McapRecord) -> bytes:
    """Return the bytes of a record, with its head."""
    builder: Any = RecordBuilder()  # its methods are not annotated
    record.write(builder)
    return bytes(builder.end())


def record_bounds(data: bytes | memoryview, at: int, offset: int) -> tuple[int, int]:
    """Return opcode and end of the record at `at`, in a chunk or summary at `offset`."""
    if len(data) - at >= RECORD.size:
        opcode, length = RECORD.unpack_from(data, at)
        end = at + RECORD.size + length
        if end <= len(data):
            return opcode, end
    raise Damage(offset, "(chunk) ends within a record")


def split_records(data: bytes, offset: int) -> Iterator[Record]:
    """Yield the records of a chunk or summary, each with its place in it."""
    at = 0
    while at < len(data):
        opcode, end = record_bounds(data, at, offset)
        yield Record(at, opcode, data[at + RECORD.size : end])
        at = end


def record_at(stream: BinaryIO, offset: int, length: int) -> Record:
    """Read the record that an index places at `offset`, `length` with its head."""
    if RECORD.size <= length <= LARGEST_RECORD and offset <= _FARTHEST:
        stream.seek(offset)
        data = stream.read(length)
        if len(data) < length:
            raise Damage(offset, "is cut off")
        opcode, body_length = RECORD.unpack_from(data)
        if body_length == length - RECORD.size:
            return Record(offset, opcode, data[RECORD.size :])
    raise Damage(offset, "is not of the length in the index")


def records(
    stream: BinaryIO,
    size: int,
    *,
    only: Collection[int] = BUT_INDEXES,
    skip: Collection[int] = (),
    check_end: bool = True,
) -> Iterator[Record]:
    """Yield the records of the data section up to DataEnd; then check the end of the file.

    Args:
        stream: the file, at its beginning.
        size: its length.
        only: opcodes of the records that are read; others are skipped.
        skip: places of records of which only the head is read.
        check_end: whether to check summary and footer.

    Raises:
        Damage: the file is truncated, or its bytes violate the format.
    """
    if stream.read(len(MAGIC)) != MAGIC:
        raise Damage(0, "is not the beginning of an MCAP file")
    offset, opcode = len(MAGIC), -1
    read, seek = stream.read, stream.seek
    while opcode != DATA_END:
        head = read(RECORD.size)
        if not head:
            raise Damage(offset, "is missing: the file ends before its footer")
        if len(head) < RECORD.size:
            raise Damage(offset, "is cut off")
        opcode, length = RECORD.unpack(head)
        if not opcode:  # a sparse file would have as many records as bytes
            raise Damage(offset, "is zeros, where one must begin")
        if length > size - offset - RECORD.size:
            raise Damage(offset, "is cut off, or its length is corrupt")
        if opcode not in only and length <= _SMALL:
            read(length)
        elif opcode not in only:
            seek(length, os.SEEK_CUR)
        elif offset in skip:
            yield Record(offset, opcode, b"")
            seek(length, os.SEEK_CUR)
        elif length > LARGEST_RECORD:
            raise Damage(offset, f"claims {length} bytes of content")
        else:
            yield Record(offset, opcode, read(length))
        offset += RECORD.size + length
    if check_end:
        tail = read(min(size - offset, LARGEST_RECORD))
        footer = _footer(tail)
        if footer is None or footer.summary_crc not in (_NO_CRC, crc32(tail[:-_UNCOVERED])):
            raise Damage(offset, "(index and footer) is cut off, or fails its checksum")


def _footer(tail: bytes) -> Footer | None:
    """Return the footer at the end of these bytes; None where they do not end a file."""
    start = len(tail) - FOOTER_SIZE - len(MAGIC)
    head = (FOOTER, FOOTER_SIZE - RECORD.size)
    if start < 0 or not tail.endswith(MAGIC) or RECORD.unpack_from(tail, start) != head:
        return None
    return parse(Footer, Record(0, FOOTER, tail[start + RECORD.size : -len(MAGIC)]))


def parse_item(record: Record) -> Any:
    """Return a schema, channel, metadata record, attachment or entry of an index."""
    if record.opcode == ATTACHMENT:
        return parse_attachment(record)
    if record.opcode not in _KINDS:
        raise Damage(record.offset, "is of another kind")
    return parse(_KINDS[record.opcode], record)


def parse_attachment(record: Record) -> Attachment:
    """Return an attachment, its checksum verified."""
    found = parse(Attachment, record)
    if _CRC.unpack(record.body[-_CRC.size :]) != (crc32(record.body[: -_CRC.size]),):
        raise Damage(record.offset, f"(attachment {found.name!r}) fails its checksum")
    return found


def parse_metadata(record: Record) -> tuple[str, dict[str, str]]:
    """Return name and entries of a metadata record."""
    found = parse(Metadata, record)
    return found.name, found.metadata


def parse_chunk(record: Record) -> Chunk:
    """Return a chunk record, still compressed; three times as fast as the library."""
    body = record.body
    try:
        start, end, size, crc, name_length = _CHUNK_HEAD.unpack_from(body)
        name_end = _CHUNK_HEAD.size + name_length
        compression = body[_CHUNK_HEAD.size : name_end].decode()
        (length,) = _LENGTH.unpack_from(body, name_end)
    except (struct.error, UnicodeDecodeError):
        raise Damage(record.offset, "(chunk) has a head that cannot be read") from None
    data = body[name_end + _LENGTH.size :]
    if len(data) != length:
        raise Damage(record.offset, "(chunk) has another length than its fields")
    return Chunk(compression, data, end, start, crc, size)


def chunk_data(head: Chunk, offset: int) -> bytes:
    """Return the records of a chunk at `offset`, decompressed, their checksum verified."""
    data = decompress(head, offset)
    if crc32(data) != head.uncompressed_crc:
        missing = head.uncompressed_crc == _NO_CRC
        raise Damage(offset, f"(chunk) {'has no' if missing else 'fails its'} checksum")
    return data


def decompress(head: Chunk, offset: int, *, largest: int = LARGEST_CHUNK) -> bytes:
    """Return the records of a chunk at `offset`, their checksum not verified.

    At most one byte more than declared is decompressed: a corrupt frame fills no memory. `Damage`
    if the size is above `largest` or `MOST_INFLATION`, not as declared, or the data are corrupt.
    """
    size, data = head.uncompressed_size, head.data
    if size > min(largest, MOST_INFLATION * len(data)):
        raise Damage(offset, f"(chunk) claims {size} bytes of content")
    try:
        if head.compression == "zstd":
            if zstandard.frame_content_size(data) not in (-1, size):
                raise Damage(offset, "(chunk) has another length than it claims")
            decompressor = _decompressor(threading.get_ident())
            data = decompressor.decompress(data, max_output_size=max(1, size))
        elif head.compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif head.compression:
            problem = f"(chunk) is compressed with {head.compression!r}, known: zstd, lz4"
            raise Damage(offset, problem)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise Damage(offset, "(chunk) cannot be decompressed") from error
    if len(data) != size:
        raise Damage(offset, "(chunk) has another length than it claims")
    return bytes(data)


@lru_cache(maxsize=16)
def _decompressor(thread: int) -> zstandard.ZstdDecompressor:  # noqa: ARG001 - one of each thread
    return zstandard.ZstdDecompressor()


@dataclass(frozen=True)
class Summary:
    """The records of a file's summary, parsed on demand."""

    records: Sequence[Record]

    @classmethod
    def read(cls, stream: BinaryIO, size: int, *, start: int | None = None) -> Summary | None:
        """Read the summary; None where it is missing or incomplete.

        `start` is where the data section ends, of a file in which records may have moved: the
        places in the summary may then be wrong.
        """
        last = size - FOOTER_SIZE - len(MAGIC)
        if last < 0:
            return None
        stream.seek(last)
        footer = _footer(stream.read(size - last))
        if footer is None or footer.summary_crc == _NO_CRC:
            return None
        start = footer.summary_start if start is None else start
        if not len(MAGIC) <= start <= last <= start + LARGEST_RECORD:
            return None
        stream.seek(start)
        data = stream.read(size - start)
        if crc32(data[:-_UNCOVERED]) != footer.summary_crc:
            return None
        try:
            return cls([*split_records(data[: last - start], 0)])
        except Damage:
            return None

    @property
    def definitions(self) -> list[Record]:
        """Schema and channel records."""
        return [record for record in self.records if record.opcode in (SCHEMA, CHANNEL)]

    def entries(self, opcode: int) -> list[Any]:
        """Return the entries of one kind of index; none where one of them is damaged."""
        try:
            return [parse_item(record) for record in self.records if record.opcode == opcode]
        except Damage:
            return []

    @property
    def places(self) -> list[tuple[int, int]]:
        """Offset and length of the records in an index, in the order of the file."""
        others = [*self.entries(METADATA_INDEX), *self.entries(ATTACHMENT_INDEX)]
        chunks = self.entries(CHUNK_INDEX)
        return sorted(
            [(one.offset, one.length) for one in others]
            + [(one.chunk_start_offset, one.chunk_length) for one in chunks]
        )
