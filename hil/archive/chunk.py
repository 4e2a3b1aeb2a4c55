"""The messages of a decompressed chunk, found all at once.

A recording repeats itself: each cycle adds the same few messages of the same lengths. Once the
pattern of one chunk is known, another one is taken for a matrix with a pattern per row, and that is
*verified*: opcode, length and channel at each place where a message should begin. That is the whole
walk, done in a few array operations. A chunk with anything else in it is walked record by record.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.archive import container
from hil.archive.container import Damage

Bytes = NDArray[np.uint8]

_RECORD = struct.Struct("<BQ")
_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_FIXED = struct.Struct("<BQH")  # the part of it that repeats with the pattern
_SEQUENCE = np.dtype("<u4")
_IN_BODY = _HEAD.size - _RECORD.size  # the part of it that the record's length counts


@dataclass(frozen=True, eq=False)
class Messages:
    """The messages of one channel in one chunk.

    Attributes:
        data: the data of each message; shape (k, size) where all have one size.
        sequence: shape (k,), their numbers as written.
    """

    data: Bytes | list[bytes]
    sequence: NDArray[np.uint32]

    def __len__(self) -> int:
        return len(self.sequence)

    def message(self, index: int) -> bytes:
        """The data of one message."""
        return bytes(self.data[index])

    def matrix(self, size: int) -> Bytes | None:
        """The data as bytes (k, size); None when there is a message of another size."""
        if isinstance(self.data, np.ndarray):
            return self.data if self.data.shape[1] == size else None
        if any(len(message) != size for message in self.data):
            return None
        return np.frombuffer(b"".join(self.data), np.uint8).reshape(-1, size)


class _Place(NamedTuple):
    """Where in the pattern a message stands, and the head it must have."""

    channel: int
    head: Bytes
    fixed: slice
    sequence: slice
    data: slice


class ChunkParser:
    """Finds schemas, channels and messages, chunk after chunk."""

    def __init__(self) -> None:
        self.schemas: dict[int, container.SchemaRecord] = {}
        self.channels: dict[int, container.ChannelRecord] = {}
        self._pattern: list[_Place] = []

    def messages(self, chunk: bytes, offset: int) -> dict[str, Messages]:
        """The messages of a chunk by topic.

        Args:
            chunk: decompressed records.
            offset: where the chunk's record begins in the file, for the error.

        Raises:
            Damage: the chunk does not hold whole records, or a channel was never announced.
        """
        found = self._matched(chunk)
        if found is None:
            found = self._walk(chunk, offset)
        unknown = found.keys() - self.channels.keys()
        if unknown:
            raise Damage(offset, f"(chunk) has messages of an unknown channel {min(unknown)}")
        return {self.channels[channel].topic: messages for channel, messages in found.items()}

    def _matched(self, chunk: bytes) -> dict[int, Messages] | None:
        """The messages by channel if the chunk repeats the known pattern and nothing else."""
        if not self._pattern or len(chunk) % self._pattern[-1].data.stop:
            return None
        rows = np.frombuffer(chunk, np.uint8).reshape(-1, self._pattern[-1].data.stop)
        found = {}
        for place in self._pattern:
            if not (rows[:, place.fixed] == place.head).all():
                return None
            sequence = rows[:, place.sequence].view(_SEQUENCE)[:, 0]
            found[place.channel] = Messages(rows[:, place.data], sequence)
        return found

    def _walk(self, chunk: bytes, offset: int) -> dict[int, Messages]:
        """Walk a chunk record by record; remember the pattern of its messages."""
        found: dict[int, tuple[list[bytes], list[int]]] = {}
        heads: list[bytes] = []
        at = 0
        while at < len(chunk):
            if len(chunk) - at < _RECORD.size:
                raise Damage(offset, "(chunk) ends within a record")
            opcode, length = _RECORD.unpack_from(chunk, at)
            end = at + _RECORD.size + length
            if end > len(chunk) or (opcode == container.MESSAGE and length < _IN_BODY):
                raise Damage(offset, "(chunk) ends within a record")
            if opcode == container.MESSAGE:
                _, _, channel, sequence, _, _ = _HEAD.unpack_from(chunk, at)
                data, numbers = found.setdefault(channel, ([], []))
                data.append(chunk[at + _HEAD.size : end])
                numbers.append(sequence)
                heads.append(chunk[at : at + _FIXED.size])
            else:
                self._announce(opcode, chunk[at + _RECORD.size : end], offset)
            at = end
        self._pattern = _pattern(heads)
        return {
            channel: Messages(data, np.array(numbers, np.uint32))
            for channel, (data, numbers) in found.items()
        }

    def _announce(self, opcode: int, body: bytes, offset: int) -> None:
        if opcode == container.SCHEMA:
            schema = container.schema(body, offset)
            self.schemas[schema.id] = schema
        elif opcode == container.CHANNEL:
            channel = container.channel(body, offset)
            self.channels[channel.id] = channel


def _pattern(heads: list[bytes]) -> list[_Place]:
    """The shortest pattern with one message per channel that repeats; empty if none does."""
    period = len(set(heads))
    repeats = all(a == b for a, b in zip(heads, heads[period:], strict=False))
    if not heads or not repeats or len(heads) % period:
        return []
    places, start = [], 0
    for head in heads[:period]:
        _, length, channel = _FIXED.unpack(head)
        fixed, data, end = start + _FIXED.size, start + _HEAD.size, start + _RECORD.size + length
        sequence = slice(fixed, fixed + _SEQUENCE.itemsize)
        expected = np.frombuffer(head, np.uint8)
        places.append(_Place(channel, expected, slice(start, fixed), sequence, slice(data, end)))
        start = end
    return places if len({place.channel for place in places}) == period else []
