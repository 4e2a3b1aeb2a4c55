"""The messages of a decompressed chunk, found all at once.

A recording repeats itself: each cycle adds the same few messages of the same lengths. Once that
pattern is known, what follows is read as a matrix with a pattern per row, and that is *verified*:
opcode, length and channel at each place where a message should begin. That is the whole walk, done
in a few array operations. Anything else in between is walked record by record.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
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


def stamps(data: Bytes) -> NDArray[np.int64]:
    """Time stamps in the data of messages (k, size), shape (k,) [ns]."""
    stamp = data[:, _STAMP_AT].view(_STAMP)[:, 0]
    found = np.multiply(stamp["sec"], 10**9, dtype=np.int64)
    found += stamp["nanosec"]
    return np.asarray(found)


@dataclass(frozen=True, eq=False)
class Messages:
    """The messages of one channel in one chunk, or in several that follow each other.

    Attributes:
        heads: what precedes their data, in order, each an array (k, 31) of bytes.
        parts: their data, each an array (k, size) of messages of one size.
        starts: where in the chunk the first of each part begins, and how far the next is.
    """

    heads: list[Bytes] = field(default_factory=list)
    parts: list[Bytes] = field(default_factory=list)
    starts: list[tuple[int, int]] = field(default_factory=list)

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    def of_heads(self, name: str) -> NDArray[Any]:
        """A field of `HEAD`, of all messages."""
        found = [head.view(HEAD)[:, 0][name] for head in self.heads]
        return found[0] if len(found) == 1 else np.concatenate(found)

    @property
    def places(self) -> NDArray[np.int64]:
        """Where in the chunk each begins, shape (k,)."""
        places = [
            start + step * np.arange(len(part))
            for (start, step), part in zip(self.starts, self.parts, strict=True)
        ]
        return np.concatenate(places)

    @cached_property
    def stamps(self) -> NDArray[np.int64]:
        """Time stamps of all, shape (k,) [ns]; none where a message is too short for one."""
        if any(part.shape[1] < _STAMP_AT.stop for part in self.parts):
            return np.zeros(0, np.int64)
        found = [stamps(part) for part in self.parts]
        return found[0] if len(found) == 1 else np.concatenate(found)

    def all(self) -> list[bytes]:
        """The data of each message."""
        return [bytes(message) for part in self.parts for message in part]

    def first(self) -> bytes:
        """The data of the first message."""
        return bytes(self.parts[0][0])

    def matrix(self, size: int) -> Bytes | None:
        """The data as bytes (k, size); None when there is a message of another size."""
        if any(part.shape[1] != size for part in self.parts):
            return None
        return self.parts[0] if len(self.parts) == 1 else np.concatenate(self.parts)

    def append(self, head: Bytes, data: Bytes, start: int, step: int) -> None:
        """Append messages, the first of which begins at `start`, the next `step` behind it."""
        self.heads.append(head)
        self.parts.append(data)
        self.starts.append((start, step))


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
    head: slice
    data: slice


class ChunkParser:
    """Finds messages, chunk after chunk, and takes the schemas and channels among them."""

    def __init__(self) -> None:
        self.known = KnownChannels()
        self._pattern: list[_Place] = []

    def repeats(self, chunk: bytes) -> bool:
        """Whether a chunk may be nothing but the known pattern, to judge by its length."""
        return bool(self._pattern) and len(chunk) % self._pattern[-1].data.stop == 0

    def repeated(self, chunks: Sequence[bytes]) -> dict[int, Messages] | None:
        """The messages of chunks by channel if they repeat the known pattern and nothing else.

        The chunks must each be of a length that `repeats`.
        """
        data = chunks[0] if len(chunks) == 1 else b"".join(chunks)
        rows = self._run(data, 0)
        if rows is None or rows.size != len(data):
            return None
        found: dict[int, Messages] = {}
        self._add(rows, 0, found)
        return found

    def messages(self, chunk: bytes, offset: int) -> dict[int, Messages]:
        """The messages of a chunk by channel.

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
            if rows is not None and len(rows):
                self._add(rows, at, found)
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
                row = np.frombuffer(chunk, np.uint8, end - at, at)[None]
                _, _, channel = _FIXED.unpack(head)
                messages = found.setdefault(channel, Messages())
                messages.append(row[:, : HEAD.itemsize], row[:, HEAD.itemsize :], at, 0)
            else:
                body = chunk[at + container.RECORD.size : end]
                self.known.take(Record(offset, opcode, body, len(body)))
            at = end
        return found

    def by_topic(self, found: dict[int, Messages], offset: int) -> dict[str, Messages]:
        """The same by topic.

        Raises:
            Damage: a channel is not known.
        """
        unknown = found.keys() - self.known.channels.keys()
        if unknown:
            raise Damage(offset, f"(chunk) has messages of an unknown channel {min(unknown)}")
        return {self.known.channels[number].topic: messages for number, messages in found.items()}

    def _run(self, chunk: bytes, at: int) -> Bytes | None:
        """As many repetitions of the pattern as follow from `at` on, shape (k, size)."""
        if not self._pattern:
            return None
        size = self._pattern[-1].data.stop
        count = (len(chunk) - at) // size
        if not count:
            return None
        rows = np.frombuffer(chunk, np.uint8, count * size, at).reshape(-1, size)
        matching = np.ones(count, np.bool_)
        for place in self._pattern:
            for where, word in place.words:
                matching &= rows[:, where].view(_WORD)[:, 0] == word
        return rows if matching.all() else rows[: int(matching.argmin())]

    def _add(self, rows: Bytes, at: int, found: dict[int, Messages]) -> None:
        for place in self._pattern:
            messages = found.setdefault(place.channel, Messages())
            start = at + place.head.start
            messages.append(rows[:, place.head], rows[:, place.data], start, rows.shape[1])

    def _learn(self, heads: list[bytes]) -> bool:
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
            data, end = start + HEAD.itemsize, start + container.RECORD.size + length
            places.append(_Place(channel, words, slice(start, data), slice(data, end)))
            start = end
        changed = len({place.channel for place in places}) == len(places)
        changed &= places != self._pattern
        if changed:
            self._pattern = places
        return changed
