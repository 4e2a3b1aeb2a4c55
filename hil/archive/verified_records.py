"""The MCAP container (https://mcap.dev/spec): records in file order, each verified.

The fields of records are read and written by the `mcap` library. Its stream reader parses every
message index, returns a record that the end of the file cuts short as if it were whole, and bounds
no decompression; the walk is therefore here, twice as fast, and can skip chunks. A truncated or
forged record becomes `Damage` with its place.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Collection, Iterator
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
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
)

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 1 << 24  # bytes; own chunks have a tenth of a megabyte
MAX_COMPRESSION_RATIO = 1000  # times what is compressed; an arm at rest reaches a tenth
MAX_RECORD_BYTES = 1 << 28  # bytes; attachments and summaries are far smaller

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX = range(9, 14)
SUMMARY_OFFSET = 14
DATA_END = 15

RECORD = struct.Struct("<BQ")  # opcode, length of the body
FOOTER_SIZE = RECORD.size + 20
_CHUNK_HEAD = struct.Struct("<QQQII")  # times, size, checksum, length of the compression's name
# times, place and length of the chunk, length of the places by channel
_CHUNK_INDEX_HEAD = struct.Struct("<QQQQI")
_CHANNEL_PLACE = struct.Struct("<HQ")
_INDEX_LENGTH = struct.Struct("<QI")  # of the message index, and of the compression's name
_SIZES = struct.Struct("<QQ")  # of the chunk, compressed and not
_LENGTH = struct.Struct("<Q")
_CRC = struct.Struct("<I")
_NO_CRC = 0
# bytes at the end of a file, not covered by the checksum
_UNCHECKED_TAIL_BYTES = _CRC.size + len(MAGIC)
_KINDS: dict[int, type[McapRecord]] = {
    HEADER: Header,
    SCHEMA: Schema,
    CHANNEL: Channel,
    METADATA: Metadata,
    ATTACHMENT_INDEX: AttachmentIndex,
    METADATA_INDEX: MetadataIndex,
}
_Parsed = TypeVar("_Parsed", bound=McapRecord)


class Damage(Exception):  # noqa: N818 - also passed on as a finding
    """Bytes that violate the format: `reason` follows "the record at byte `offset`"."""

    def __init__(self, offset: int, reason: str) -> None:
        super().__init__(reason)
        self.offset = offset
        self.reason = reason


class Head(NamedTuple):
    """Kind and place of a record, with its head."""

    opcode: int
    offset: int
    end: int


class Record(NamedTuple):
    """One record of a file, a chunk or a summary."""

    offset: int
    opcode: int
    body: bytes

    @property
    def end(self) -> int:
        """Where the next record begins."""
        return self.offset + RECORD.size + len(self.body)


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
        parsed: _Parsed = kind.read(_Body(record.body))  # type: ignore[attr-defined]
    except EndOfFile:
        raise Damage(record.offset, "is shorter than its fields") from None
    except UnicodeDecodeError:
        raise Damage(record.offset, "holds text that is not UTF-8") from None
    return parsed


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
    raise Damage(offset, "(chunk) ends in the middle of a record")


def split_records(data: bytes, offset: int) -> Iterator[Record]:
    """Yield the records of a chunk or summary, each with its place in it."""
    at = 0
    while at < len(data):
        opcode, end = record_bounds(data, at, offset)
        yield Record(at, opcode, data[at + RECORD.size : end])
        at = end


def heads(stream: BinaryIO, size: int, only: Collection[int] = range(256)) -> Iterator[Head]:
    """Yield the heads of the records of the data section up to DataEnd, that one included.

    `size` is the length of the file; records of other kinds than `only` are skipped. The stream may
    be moved meanwhile.

    Raises:
        Damage: the file is truncated, or its bytes violate the format.
    """
    stream.seek(0)
    if stream.read(len(MAGIC)) != MAGIC:
        raise Damage(0, "is not the beginning of an MCAP file")
    offset = len(MAGIC)
    opcode = -1
    seek = stream.seek
    read = stream.read
    while opcode != DATA_END:
        seek(offset)
        head = read(RECORD.size)
        if not head:
            raise Damage(offset, "is missing: the file ends before its footer")
        if len(head) < RECORD.size:
            raise Damage(offset, "is cut off")
        opcode, length = RECORD.unpack(head)
        if not opcode:  # a sparse file would have as many records as bytes
            raise Damage(offset, "is zeros where a record must begin")
        end = offset + RECORD.size + length
        if end > size:
            raise Damage(offset, "is cut off, or its length is corrupt")
        if opcode in only or opcode == DATA_END:
            yield Head(opcode, offset, end)
        offset = end


def read_record(stream: BinaryIO, head: Head) -> Record:
    """Read the record with this head; `Damage` if it is too large, or the file has shrunk."""
    start = head.offset + RECORD.size
    length = head.end - start
    if length > MAX_RECORD_BYTES:
        raise Damage(head.offset, f"claims {length} bytes of content")
    stream.seek(start)
    body = stream.read(length)
    if len(body) < length:
        raise Damage(head.offset, "is cut off")
    return Record(head.offset, head.opcode, body)


def records(stream: BinaryIO, size: int, *, only: Collection[int] = range(256)) -> Iterator[Record]:
    """Yield the records of the data section with these opcodes, see `heads`; then check the end."""
    for head in heads(stream, size, only):
        if head.opcode in only:
            yield read_record(stream, head)
        if head.opcode == DATA_END:
            check_end(stream, size, head.end)


def check_end(stream: BinaryIO, size: int, offset: int) -> None:
    """Check summary and footer, which follow DataEnd at `offset`; else `Damage`."""
    stream.seek(offset)
    tail = stream.read(min(size - offset, MAX_RECORD_BYTES))
    footer = _footer(tail)
    if footer is None or footer.summary_crc not in (_NO_CRC, crc32(tail[:-_UNCHECKED_TAIL_BYTES])):
        raise Damage(offset, "(index and footer) is cut off, or fails its checksum")


def read_summary(stream: BinaryIO, size: int, *kinds: int, start: int | None = None) -> list[Any]:
    """Return the records of these kinds in the summary; none where it is missing or damaged.

    It begins at `start`, None for where the footer says: records in front of it may be missing.
    """
    last = size - FOOTER_SIZE - len(MAGIC)
    if last < 0:
        return []
    stream.seek(last)
    footer = _footer(stream.read(size - last))
    if footer is None or footer.summary_crc == _NO_CRC:
        return []
    start = footer.summary_start if start is None else start
    if not len(MAGIC) <= start <= last <= start + MAX_RECORD_BYTES:
        return []
    stream.seek(start)
    data = stream.read(size - start)
    if crc32(data[:-_UNCHECKED_TAIL_BYTES]) != footer.summary_crc:
        return []
    summary = data[: last - start]
    try:
        return [
            parse_item(record) for record in split_records(summary, 0) if record.opcode in kinds
        ]
    except Damage:
        return []


def indexed(stream: BinaryIO, size: int) -> list[Head]:
    """Return the heads of the chunks, attachments and metadata that the summary lists, in order."""
    heads = []
    for index in read_summary(stream, size, CHUNK_INDEX, ATTACHMENT_INDEX, METADATA_INDEX):
        if isinstance(index, ChunkIndex):
            begin = index.chunk_start_offset
            end = index.chunk_start_offset + index.chunk_length
            head = Head(CHUNK, begin, end)
        else:
            opcode = ATTACHMENT if isinstance(index, AttachmentIndex) else METADATA
            head = Head(opcode, index.offset, index.offset + index.length)
        if head.offset + RECORD.size <= head.end <= size:
            heads.append(head)
    return sorted(heads, key=lambda head: head.offset)


def _footer(tail: bytes) -> Footer | None:
    """Return the footer at the end of these bytes; None where they do not end a file."""
    start = len(tail) - FOOTER_SIZE - len(MAGIC)
    head = (FOOTER, FOOTER_SIZE - RECORD.size)
    if start < 0 or not tail.endswith(MAGIC) or RECORD.unpack_from(tail, start) != head:
        return None
    return parse(Footer, Record(0, FOOTER, tail[start + RECORD.size : -len(MAGIC)]))


def parse_item(record: Record) -> Any:
    """Return a record of `_KINDS`, or an attachment, its checksum verified."""
    if record.opcode == ATTACHMENT:
        return parse_attachment(record)
    if record.opcode == CHUNK_INDEX:
        return parse_chunk_index(record)
    if record.opcode not in _KINDS:
        raise Damage(record.offset, "is of another kind")
    return parse(_KINDS[record.opcode], record)


def parse_attachment(record: Record) -> Attachment:
    """Return an attachment, its checksum verified."""
    attachment = parse(Attachment, record)
    if _CRC.unpack(record.body[-_CRC.size :]) != (crc32(record.body[: -_CRC.size]),):
        raise Damage(record.offset, f"(attachment {attachment.name!r}) fails its checksum")
    return attachment


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


def parse_chunk_index(record: Record) -> ChunkIndex:
    """Return the index of a chunk; eight times as fast as the library."""
    body = record.body
    try:
        first, last, start, length, places_length = _CHUNK_INDEX_HEAD.unpack_from(body)
        end = _CHUNK_INDEX_HEAD.size + places_length
        places = dict(_CHANNEL_PLACE.iter_unpack(body[_CHUNK_INDEX_HEAD.size : end]))
        index_length, name_length = _INDEX_LENGTH.unpack_from(body, end)
        name_end = end + _INDEX_LENGTH.size + name_length
        compression = body[end + _INDEX_LENGTH.size : name_end].decode()
        compressed, size = _SIZES.unpack_from(body, name_end)
    except struct.error:
        raise Damage(record.offset, "is shorter than its fields") from None
    except UnicodeDecodeError:
        raise Damage(record.offset, "holds text that is not UTF-8") from None
    return ChunkIndex(
        length, start, compression, compressed, last, index_length, places, first, size
    )


def chunk_data(head: Chunk, offset: int) -> bytes:
    """Return the records of a chunk at `offset`, decompressed, their checksum verified."""
    data = decompress(head, offset)
    if crc32(data) != head.uncompressed_crc:
        missing = head.uncompressed_crc == _NO_CRC
        raise Damage(offset, f"(chunk) {'has no' if missing else 'fails its'} checksum")
    return data


def decompress(head: Chunk, offset: int, *, largest: int = MAX_CHUNK_BYTES) -> bytes:
    """Return the records of a chunk at `offset`, their checksum not verified.

    At most one byte more than declared is decompressed: a corrupt frame fills no memory. `Damage`
    if the size is above `largest` or `MAX_COMPRESSION_RATIO`, not as declared, or the data are
    corrupt.
    """
    size = head.uncompressed_size
    data = head.data
    if size > min(largest, MAX_COMPRESSION_RATIO * len(data)):
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
