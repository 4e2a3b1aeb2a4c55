"""Messages of other people's MCAP files, whoever wrote them and with whatever chunks."""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import lz4.frame
import zstandard
from mcap.reader import McapReader, NonSeekingReader, SeekingReader, make_reader
from mcap.records import Channel, Schema

from hil.archive import container
from hil.errors import SourceError
from hil.reading import opened

LARGEST_CHUNK: Final = 1 << 28
"""Bytes of records in one chunk; usual are one to sixteen million."""
MOST_INFLATION: Final = 1000
"""Times what is compressed; an arm at rest reaches a tenth."""
_SLACK: Final = 1 << 20  # bytes, where next to nothing is compressed

_FIXED = struct.Struct("<QQQII")  # times, size, checksum, length of the compression's name
_LENGTH = struct.Struct("<Q")
_LONGEST_NAME = 32
_FRAME_HEAD = 32  # bytes, more than any frame has before its first block


class _Chunk(NamedTuple):
    """Where a chunk begins, what it becomes, and where its compressed records are."""

    offset: int
    size: int
    compression: bytes
    at: int
    length: int


def check_sizes(stream: BinaryIO) -> None:
    """Go through the chunks of a file, which is at its beginning afterwards.

    Raises:
        ValueError: a chunk, or all of them together, would become too large, or the index lists
            what is no chunk, or one twice.
        Exception: what the readers of the index say of bytes that are none.
    """
    size = stream.seek(0, os.SEEK_END)
    begun, inflated = set(), 0
    for chunk in _chunks(stream, size):
        _check(chunk, stream)
        begun.add(chunk.offset)
        inflated += chunk.size
    if inflated > _most(size):
        raise ValueError(f"its chunks claim {inflated} bytes of content")
    stream.seek(0)
    summary = make_reader(stream).get_summary()
    offsets = [index.chunk_start_offset for index in summary.chunk_indexes] if summary else []
    if len(set(offsets)) != len(offsets) or not begun.issuperset(offsets):
        raise ValueError("its index does not fit its chunks")
    stream.seek(0)


def _chunks(stream: BinaryIO, size: int) -> Iterator[_Chunk]:
    """The chunks up to the end of the data, or to where the file is cut off.

    A hole of a file is zeros, and would be as many records as it has bytes.
    """
    stream.seek(0)
    at = len(container.MAGIC)
    if stream.read(at) != container.MAGIC:
        raise ValueError("it does not begin as MCAP files do")
    while at + container.RECORD.size <= size:
        stream.seek(at)
        opcode, length = container.RECORD.unpack(stream.read(container.RECORD.size))
        body, end = at + container.RECORD.size, at + container.RECORD.size + length
        if opcode in (container.DATA_END, container.FOOTER) or end > size:
            return
        if opcode == 0:
            raise ValueError(f"at byte {at} there is no record")
        if opcode == container.CHUNK:
            yield _chunk(at, stream.read(_FIXED.size + _LONGEST_NAME + _LENGTH.size), body, end)
        at = end


def _chunk(offset: int, head: bytes, body: int, end: int) -> _Chunk:
    _, _, size, _, name_length = _FIXED.unpack_from(head)
    if name_length > _LONGEST_NAME:
        raise ValueError(f"the chunk at byte {offset} has no head")
    compression = head[_FIXED.size : _FIXED.size + name_length]
    (length,) = _LENGTH.unpack_from(head, _FIXED.size + name_length)
    at = body + _FIXED.size + name_length + _LENGTH.size
    if length > end - at:
        raise ValueError(f"the chunk at byte {offset} is longer than its record")
    return _Chunk(offset, size, compression, at, length)


def _check(chunk: _Chunk, stream: BinaryIO) -> None:
    """Check that a chunk becomes as large as it says, and that this is not absurd."""
    if chunk.size > min(LARGEST_CHUNK, _most(chunk.length)):
        raise ValueError(f"the chunk at byte {chunk.offset} claims {chunk.size} bytes of content")
    stream.seek(chunk.at)
    if chunk.compression == b"zstd" and chunk.length:
        # Of a frame that does not say it, no more than the chunk says is decompressed.
        stated = zstandard.frame_content_size(stream.read(min(_FRAME_HEAD, chunk.length)))
        known = stated in (-1, chunk.size)
    elif chunk.compression == b"lz4" and chunk.length:
        data = stream.read(chunk.length)
        frame = lz4.frame.LZ4FrameDecompressor()
        known = len(frame.decompress(data, max_length=chunk.size + 1)) == chunk.size
    else:
        known = chunk.length == chunk.size
    if not known:
        raise ValueError(f"the chunk at byte {chunk.offset} is not of the size that it claims")


def _most(compressed: int) -> int:
    return _SLACK + MOST_INFLATION * compressed


JOINT_STATES = frozenset({"sensor_msgs/msg/JointState", "sensor_msgs/JointState"})
"""Names of the type that ROS 2 has for joint states."""


@dataclass(frozen=True)
class Topic:
    """What a file says of a topic.

    Attributes:
        kind: type of its messages, such as ``sensor_msgs/msg/JointState``.
        encoding: of the messages, such as ``cdr``, ``json`` or ``protobuf``.
        schema_encoding: of the definition, such as ``ros2msg``.
        definition: of the type.
    """

    kind: str
    encoding: str
    schema_encoding: str = ""
    definition: bytes = b""

    @property
    def is_ros2(self) -> bool:
        """Whether the messages are those of ROS 2."""
        return self.encoding == "cdr" and self.schema_encoding in ("ros2msg", "")

    def __str__(self) -> str:
        return self.kind if self.is_ros2 else f"{self.kind} in {self.encoding or 'no encoding'}"


def topics(path: Path) -> dict[str, Topic]:
    """The topics of a file by name.

    Raises:
        SourceError: it cannot be read, is no MCAP file or is cut off.
    """
    with _opened(path) as stream:
        check_sizes(stream)
        summary = make_reader(stream).get_summary()
        if summary is not None and summary.channels:
            channels = [(summary.schemas.get(c.schema_id), c) for c in summary.channels.values()]
        else:
            channels = _scanned(stream)
    return {channel.topic: _topic(schema, channel) for schema, channel in channels}


def messages(path: Path, wanted: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
    """Topic, log time [ns] and data of messages of some topics, by their time.

    Raises:
        SourceError: the file cannot be read or is cut off.
    """
    with _opened(path) as stream:
        check_sizes(stream)
        for _, channel, message in _reader(stream).iter_messages(wanted):
            yield channel.topic, message.log_time, message.data


def _reader(stream: BinaryIO) -> McapReader:
    """One that goes by the index, or one that goes through the file where the index is not whole.

    The latter keeps all messages that are wanted in memory, to put them in order.
    """
    summary = make_reader(stream).get_summary()
    stream.seek(0)
    if summary is not None and summary.channels and summary.chunk_indexes:
        return SeekingReader(stream, validate_crcs=True)
    return NonSeekingReader(stream, validate_crcs=True)


def _scanned(stream: BinaryIO) -> list[tuple[Schema | None, Channel]]:
    """The channels of a file without index that have messages."""
    stream.seek(0)
    found: dict[int, tuple[Schema | None, Channel]] = {}
    for schema, channel, _ in NonSeekingReader(stream).iter_messages(log_time_order=False):
        found.setdefault(channel.id, (schema, channel))
    return list(found.values())


def _topic(schema: Schema | None, channel: Channel) -> Topic:
    if schema is None:
        return Topic("without schema", channel.message_encoding)
    return Topic(schema.name, channel.message_encoding, schema.encoding, schema.data)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The file; whatever the readers say of it becomes our error."""
    try:
        with opened(path) as stream:
            yield stream
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror or error}") from error
    except Exception as error:  # nobody lists what the readers raise for bytes that are no MCAP
        raise SourceError(
            path,
            f"is no MCAP file, or cut off ({type(error).__name__}: {error})",
            remedy="recover it first (`hil archive repair` for archives of hil, `mcap recover` "
            "for others)",
        ) from error
