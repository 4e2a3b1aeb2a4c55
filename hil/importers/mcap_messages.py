"""Messages of any MCAP file, of any program and chunk size, read by the `mcap` library."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Final

from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from hil.archive import verified_records
from hil.archive.verified_records import Damage
from hil.base.errors import SourceError
from hil.base.safe_input import open_file

MAX_FOREIGN_CHUNK_BYTES: Final = 1 << 28
"""Bytes of records in one chunk; usually one to sixteen million."""
MAX_TOTAL_BYTES: Final = 4 << 30
"""Bytes of messages that are read, all topics together."""
_MAX_STAMP_NS: Final = 2**63 - 1  # ns; later ones are wrong, and no signed number


@dataclass(frozen=True)
class Topic:
    """Type and encoding of the messages of a topic."""

    kind: str  #: type, such as ``sensor_msgs/msg/JointState``
    encoding: str  #: of the messages, such as ``cdr``, ``json`` or ``protobuf``
    schema_encoding: str = ""  #: of the definition, such as ``ros2msg``
    definition: bytes = b""  #: of the type

    @property
    def is_ros2(self) -> bool:
        """Whether the messages are ROS 2 messages."""
        return self.encoding == "cdr" and self.schema_encoding in ("ros2msg", "ros2idl", "")

    @property
    def is_ros(self) -> bool:
        """Whether the messages are ROS 1 or ROS 2 messages."""
        return self.is_ros2 or self.encoding == "ros1"

    def __str__(self) -> str:
        return self.kind if self.is_ros2 else f"{self.kind} in {self.encoding or 'no encoding'}"


def read(
    path: Path, wanted: Callable[[str, Topic], bool]
) -> tuple[dict[str, Topic], list[tuple[str, int, bytes]]]:
    """Return the topics of a file by name, and the wanted messages in the order of time.

    `wanted` is a predicate on name and topic. Of a message: name of the topic, log time [ns], data.

    Raises:
        SourceError: it cannot be read, is no MCAP file, is truncated, or has too many messages.
    """
    schemas: dict[int, Schema] = {0: Schema(0, b"", "", "without schema")}
    topics: dict[str, Topic] = {}
    names: dict[int, str] = {}
    messages: list[tuple[str, int, bytes]] = []
    size = 0
    with _opened(path) as stream:
        for record in _records(stream):
            if isinstance(record, Schema):
                schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                kind = schemas.get(record.schema_id, schemas[0])
                topic = Topic(kind.name, record.message_encoding, kind.encoding, kind.data)
                topics.setdefault(record.topic, topic)
                names.setdefault(record.id, record.topic)
            elif isinstance(record, Message):
                name = names[record.channel_id]
                if wanted(name, topics[name]):
                    messages.append((name, min(record.log_time, _MAX_STAMP_NS), record.data))
                    size += len(record.data)
            if size > MAX_TOTAL_BYTES:
                problem = (
                    f"has more than {MAX_TOTAL_BYTES} bytes of numbers: too large for one reading"
                )
                remedy = "cut it, or leave out topics (`mcap filter`)"
                raise SourceError(path, problem, remedy=remedy)
    return topics, sorted(messages, key=lambda message: message[1])


def _records(stream: BinaryIO) -> Iterator[McapRecord]:
    """Yield the records in the order of the file, also inside chunks.

    Chunks are decompressed in limited memory, which the library does not do.
    """
    reader = StreamReader(
        stream, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_FOREIGN_CHUNK_BYTES
    )
    for record in reader.records:
        if isinstance(record, Chunk):
            data = verified_records.decompress(
                record, stream.tell(), largest=MAX_FOREIGN_CHUNK_BYTES
            )
            yield from breakup_chunk(replace(record, compression="", data=data), validate_crc=True)
        else:
            yield record


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """Open the file; convert all errors of reading to `SourceError`."""
    try:
        with open_file(path) as stream:
            # The library would search zeros behind a truncated file to their end.
            size = stream.seek(0, os.SEEK_END)
            stream.seek(max(0, size - len(verified_records.MAGIC)))
            if stream.read() != verified_records.MAGIC:
                raise Damage(size, "it has no end")
            stream.seek(0)
            yield stream
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror or error}") from error
    except (Damage, McapError, KeyError, ValueError, struct.error, MemoryError) as error:
        where = f"at byte {error.offset}: " if isinstance(error, Damage) else ""
        problem = f"is not an MCAP file, or truncated ({where}{type(error).__name__}: {error})"
        remedy = "recover it (`hil archive repair` for archives of hil, `mcap recover` for others)"
        raise SourceError(path, problem, remedy=remedy) from error
