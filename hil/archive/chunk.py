"""The messages of a decompressed chunk, found all at once.

A recording repeats itself: each cycle adds the same few messages of the same lengths. Once that
pattern is known, what follows is read as a matrix with a pattern per row, and that is *verified*:
opcode, length and channel at each place where a message should begin. That is the whole walk, done
in a few array operations. Anything else in between is walked record by record.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from hil.archive import container
from hil.archive.container import Damage, Record

Bytes = NDArray[np.uint8]

HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
"""What precedes the data of a message."""
_FIXED = struct.Struct("<BQH")  # the part of it that repeats with the pattern
_WORD = np.dtype("<u8")
_WORDS_AT = (0, _FIXED.size - _WORD.itemsize)  # two words that overlap cover the fixed part
_STAMP = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])
_STAMP_AT = slice(4, 4 + _STAMP.itemsize)  # in the data of a message, behind its encapsulation
_LONGEST_PATTERN = 16  # messages


@dataclass(frozen=True, eq=False)
class Messages:
    """The messages of one channel in one chunk, or in several that follow each other.

    Attributes:
        parts: their records in order, each an array (k, size) of bytes of messages of one size.
        places: where in the chunk the records of each part begin, (k,).
    """

    parts: list[Bytes] = field(default_factory=list)
    places: list[NDArray[np.int64]] = field(default_factory=list)

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    def of_heads(self, name: str) -> NDArray[Any]:
        """A field of `HEAD`, of all messages."""
        heads = [part[:, : HEAD.itemsize].view(HEAD)[:, 0][name] for part in self.parts]
        return np.concatenate(heads)

    @property
    def data(self) -> list[Bytes]:
        """The data of the messages of each part, (k, size)."""
        return [part[:, HEAD.itemsize :] for part in self.parts]

    @cached_property
    def stamps(self) -> NDArray[np.int64]:
        """Time stamps of all, shape (k,) [ns]; none where a message is too short for one."""
        if any(data.shape[1] < _STAMP_AT.stop for data in self.data):
            return np.zeros(0, np.int64)
        stamps = [data[:, _STAMP_AT].view(_STAMP)[:, 0] for data in self.data]
        stamp = np.concatenate(stamps)
        return np.asarray(stamp["sec"] * np.int64(10**9) + stamp["nanosec"])

    def all(self) -> list[bytes]:
        """The data of each message."""
        return [bytes(message) for data in self.data for message in data]

    def matrix(self, size: int) -> Bytes | None:
        """The data as bytes (k, size); None when there is a message of another size."""
        data = self.data
        if any(part.shape[1] != size for part in data):
            return None
        return data[0] if len(data) == 1 else np.concatenate(data)


class KnownChannels:
    """Schemas and channels by their numbers; what is known once stays what it is.

    Were a number or a topic to change its meaning in mid-file, samples of one channel would be
    mistaken for those of another.
    """

    def __init__(self, known: KnownChannels | None = None) -> None:
        self.schemas: dict[int, Schema] = dict(known.schemas) if known else {}
        self.channels: dict[int, Channel] = dict(known.channels) if known else {}

    @property
    def topics(self) -> set[str]:
        """The topics of all channels."""
        return {channel.topic for channel in self.channels.values()}

    @property
    def definitions(self) -> list[Schema | Channel]:
        """All of them."""
        return [*self.schemas.values(), *self.channels.values()]

    def schema(self, topic: str) -> Schema | None:
        """The schema of a topic's messages, if it is known."""
        identity = next(one.schema_id for one in self.channels.values() if one.topic == topic)
        return self.schemas.get(identity)

    def take(self, record: Record) -> None:
        """Take a schema or channel; other records are passed over.

        Raises:
            Damage: the record is torn, or says something else than one before.
        """
        if record.opcode not in (container.SCHEMA, container.CHANNEL):
            return
        item, again = container.item(record), ""
        if isinstance(item, Schema):
            if not item.id:
                raise Damage(record.offset, "(schema) has the number 0, which stands for none")
            if self.schemas.setdefault(item.id, item) != item:
                again = f"schema {item.id}"
        elif isinstance(item, Channel):
            known = self.channels.values()
            same = [one for one in known if one.id == item.id or one.topic == item.topic]
            if same not in ([], [item]):
                again = f"channel {item.id}"
            self.channels.setdefault(item.id, item)
        if again:
            raise Damage(record.offset, f"announces {again} a second time, as another")


class _Place(NamedTuple):
    """Where in the pattern a message stands, and the head it must have as two words."""

    channel: int
    words: tuple[tuple[slice, int], ...]
    record: slice


class ChunkParser:
    """Finds messages, chunk after chunk, and takes the schemas and channels among them."""

    def __init__(self) -> None:
        self.known = KnownChannels()
        self._pattern: list[_Place] = []

    def messages(self, chunk: bytes, offset: int) -> dict[int, Messages]:
        """The messages of a chunk by channel; of several chunks that follow each other likewise.

        Args:
            chunk: decompressed records.
            offset: where the chunk's record begins in the file, for the error.

        Raises:
            Damage: the chunk does not hold whole records, or definitions that fit one another.
        """
        found: dict[int, Messages] = {}
        recent: deque[bytes] = deque(maxlen=_LONGEST_PATTERN)
        at = 0
        while at < len(chunk):
            rows = self._run(chunk, at)
            if len(rows):
                first = at + rows.shape[1] * np.arange(len(rows))
                for place in self._pattern:
                    messages = found.setdefault(place.channel, Messages())
                    messages.parts.append(rows[:, place.record])
                    messages.places.append(first + place.record.start)
                at += rows.size
                continue
            opcode, end = container.bounds(chunk, at, offset)
            if opcode == container.MESSAGE:
                if end - at < HEAD.itemsize:
                    raise Damage(offset, "(chunk) ends within a record")
                head = chunk[at : at + _FIXED.size]
                if head in recent and self._learn(list(recent)[recent.index(head) :]):
                    recent.clear()
                    continue
                recent.append(head)
                messages = found.setdefault(_FIXED.unpack(head)[2], Messages())
                messages.parts.append(np.frombuffer(chunk, np.uint8, end - at, at)[None])
                messages.places.append(np.array([at]))
            else:
                self.known.take(Record(offset, opcode, chunk[at + container.RECORD.size : end]))
            at = end
        return found

    def by_topic(self, found: Mapping[int, Messages], offset: int) -> dict[str, Messages]:
        """The same by topic.

        Raises:
            Damage: a channel is not known.
        """
        unknown = found.keys() - self.known.channels.keys()
        if unknown:
            raise Damage(offset, f"(chunk) has messages of an unknown channel {min(unknown)}")
        return {self.known.channels[number].topic: messages for number, messages in found.items()}

    def _run(self, chunk: bytes, at: int) -> Bytes:
        """As many repetitions of the pattern as follow from `at` on, shape (k, size)."""
        size = self._pattern[-1].record.stop if self._pattern else len(chunk) + 1
        count = (len(chunk) - at) // size
        rows = np.frombuffer(chunk, np.uint8, count * size, at).reshape(count, size)
        matching = np.ones(count, np.bool_)
        for place in self._pattern:
            for where, word in place.words:
                matching &= rows[:, where].view(_WORD)[:, 0] == word
        return rows if matching.all() else rows[: int(matching.argmin())]

    def _learn(self, heads: Sequence[bytes]) -> bool:
        """Take one round of heads for the pattern, if no channel comes twice in it."""
        places, start = [], 0
        for head in heads:
            _, length, channel = _FIXED.unpack(head)
            words = tuple(
                (
                    slice(start + at, start + at + _WORD.itemsize),
                    int.from_bytes(head[at : at + _WORD.itemsize], "little"),
                )
                for at in _WORDS_AT
            )
            end = start + container.RECORD.size + length
            places.append(_Place(channel, words, slice(start, end)))
            start = end
        changed = len({place.channel for place in places}) == len(places)
        changed &= places != self._pattern
        if changed:
            self._pattern = places
        return changed
