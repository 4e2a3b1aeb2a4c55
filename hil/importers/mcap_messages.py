"""Messages of other people's MCAP files, whoever wrote them and with whatever chunks."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

from mcap.reader import McapReader, NonSeekingReader, SeekingReader, make_reader
from mcap.records import Channel, Schema

from hil.archive import container
from hil.errors import SourceError
from hil.reading import opened

LARGEST_CHUNK: Final = 1 << 28
"""Bytes of records in one chunk; usual are one to sixteen million."""


def check_sizes(stream: BinaryIO) -> None:
    """Go through the chunks of a file, which is at its beginning afterwards.

    Raises:
        Damage: it is cut off, or a chunk is not of the size that it claims, or too large.
        ValueError: the index lists what is no chunk, or one twice.
        Exception: what the readers of the index say of bytes that are none.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    begun = set()
    for record in container.records(stream, size, only=(container.CHUNK,), check_end=False):
        head = container.chunk(record)
        container.decompressed(head, record.offset, largest=LARGEST_CHUNK)
        begun.add(record.offset)
    stream.seek(0)
    summary = make_reader(stream).get_summary()
    offsets = [index.chunk_start_offset for index in summary.chunk_indexes] if summary else []
    if len(set(offsets)) != len(offsets) or not begun.issuperset(offsets):
        raise ValueError("its index does not fit its chunks")
    stream.seek(0)


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
