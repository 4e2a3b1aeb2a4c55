"""Messages of any MCAP file, of any program and chunk size."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from isal.isal_zlib import crc32
from mcap.records import Channel, Schema

from hil.archive import container
from hil.archive.container import Damage, Record
from hil.errors import SourceError
from hil.reading import open_file

LARGEST_CHUNK: Final = 1 << 28
"""Bytes of records in one chunk; usually one to sixteen million."""
MOST_BYTES: Final = 4 << 30
"""Bytes of messages that are read, all topics together."""
_HEAD: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_READ: Final = (container.SCHEMA, container.CHANNEL, container.MESSAGE, container.CHUNK)


@dataclass(frozen=True)
class Topic:
    """Type and encoding of the messages of a topic."""

    kind: str  #: type, such as ``sensor_msgs/msg/JointState``
    encoding: str  #: of the messages, such as ``cdr``, ``json`` or ``protobuf``
    schema_encoding: str = ""  #: of the definition, such as ``ros2msg``
    definition: bytes = b""  #: of the type

    @property
    def is_ros2(self) -> bool:
        """Whether the messages are those of ROS 2."""
        return self.encoding == "cdr" and self.schema_encoding in ("ros2msg", "")

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
    schemas: dict[int, Schema] = {}
    topics: dict[str, Topic] = {}
    names: dict[int, str] = {}
    found: list[tuple[str, int, bytes]] = []
    size = 0
    with _opened(path) as stream:
        for record in _records(stream):
            if record.opcode == container.SCHEMA:
                schema = container.parse_item(record)
                schemas.setdefault(schema.id, schema)
            elif record.opcode == container.CHANNEL:
                channel: Channel = container.parse_item(record)
                kind = schemas.get(channel.schema_id, Schema(0, b"", "", "without schema"))
                topic = Topic(kind.name, channel.message_encoding, kind.encoding, kind.data)
                topics.setdefault(channel.topic, topic)
                names.setdefault(channel.id, channel.topic)
            elif record.opcode == container.MESSAGE:
                number, _, log_time, _ = _HEAD.unpack_from(record.body)
                name = names[number]
                if wanted(name, topics[name]):
                    found.append((name, log_time, record.body[_HEAD.size :]))
                    size += len(record.body)
            if size > MOST_BYTES:
                problem = (
                    f"has more than {MOST_BYTES} bytes of numbers: too large to be read at once"
                )
                remedy = "cut it, or leave out topics (`mcap filter`)"
                raise SourceError(path, problem, remedy=remedy)
    return topics, sorted(found, key=lambda message: message[1])


def _records(stream: BinaryIO) -> Iterator[Record]:
    """Yield schemas, channels and messages in the order of the file, also those in chunks."""
    size = os.fstat(stream.fileno()).st_size
    for record in container.records(stream, size, only=_READ):
        if record.opcode != container.CHUNK:
            yield record
            continue
        head = container.parse_chunk(record)
        data = container.decompress(head, record.offset, largest=LARGEST_CHUNK)
        if head.uncompressed_crc and crc32(data) != head.uncompressed_crc:
            raise Damage(record.offset, "(chunk) fails its checksum")
        yield from container.split_records(data, record.offset)


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """Open the file; convert all errors of reading to `SourceError`."""
    try:
        with open_file(path) as stream:
            yield stream
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror or error}") from error
    except (Damage, KeyError, struct.error) as error:
        place = f"at byte {error.offset}: " if isinstance(error, Damage) else ""
        problem = f"is not an MCAP file, or truncated ({place}{type(error).__name__}: {error})"
        remedy = "recover it (`hil archive repair` for archives of hil, `mcap recover` for others)"
        raise SourceError(path, problem, remedy=remedy) from error
