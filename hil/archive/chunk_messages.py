"""Vectorised search for the messages of decompressed chunks.

Each cycle of a recording adds the same few messages of the same lengths. Once that pattern is
known, the rest is read as a matrix with one repetition per row, after opcode, length and channel of
each message were verified. Anything else is read record by record.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from hil.archive import verified_records
from hil.archive.verified_records import Damage, Record

Bytes = NDArray[np.uint8]
Content = bytes | memoryview

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
"""Record head and fixed fields in front of the data of a message."""
_FIXED = struct.Struct("<BQH")  # the part of it that repeats with the pattern
_STAMP = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])
_STAMP_AT = slice(HEAD.itemsize + 4, HEAD.itemsize + 4 + _STAMP.itemsize)  # after the encapsulation
_MAX_PATTERN_MESSAGES = 16  # messages


@dataclass(frozen=True, eq=False)
class ChunkMessages:
    """The messages of one channel in one chunk, or in several consecutive ones.

    Attributes:
        parts: records in order, each an array (k, size) of bytes of messages of one size.
        places: where in the chunk the records of each part begin, (k,).
    """

    parts: list[Bytes] = field(default_factory=list)
    places: list[NDArray[np.int64]] = field(default_factory=list)

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    def of_heads(self, name: str) -> NDArray[Any]:
        """Return a field of `HEAD` of all messages."""
        heads = [part[:, : HEAD.itemsize].view(HEAD)[:, 0][name] for part in self.parts]
        return heads[0] if len(heads) == 1 else np.concatenate(heads)

    @property
    def data(self) -> list[Bytes]:
        """The data of the messages of each part, (k, size)."""
        return [part[:, HEAD.itemsize :] for part in self.parts]

    @cached_property
    def stamps(self) -> NDArray[np.int64]:
        """Time stamps, shape (k,) [ns]; empty where a message is too short for one."""
        if any(part.shape[1] < _STAMP_AT.stop for part in self.parts):
            return np.zeros(0, np.int64)
        raw_stamps = [part[:, _STAMP_AT].view(_STAMP)[:, 0] for part in self.parts]
        stamps = [stamp["sec"] * np.int64(10**9) + stamp["nanosec"] for stamp in raw_stamps]
        return stamps[0] if len(stamps) == 1 else np.concatenate(stamps)

    def all(self) -> list[bytes]:
        """Return the data of each message."""
        return [bytes(message) for data in self.data for message in data]


class ChunkParser:
    """Finds the messages of chunks, and reads the schemas and channels among them.

    A number or a topic must not be redefined: samples of two channels would be confused.
    """

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._round: list[tuple[int, slice]] = []  # channel and record of the pattern's messages
        self._begin = b""
        self._fixed = np.zeros(0, np.intp)  # places of the bytes that repeat with it
        self._expected = np.zeros(0, np.uint8)

    @property
    def topics(self) -> set[str]:
        """The topics of all channels."""
        return {channel.topic for channel in self.channels.values()}

    @property
    def definitions(self) -> list[Schema | Channel]:
        """All schemas and channels."""
        return [*self.schemas.values(), *self.channels.values()]

    def schema(self, topic: str) -> Schema | None:
        """Return the schema of a topic's messages, if it is known."""
        identity = next(
            channel.schema_id for channel in self.channels.values() if channel.topic == topic
        )
        return self.schemas.get(identity)

    def define(self, record: Record) -> None:
        """Read a schema or channel; other records are ignored. `Damage` if it is one redefined."""
        if record.opcode in (verified_records.SCHEMA, verified_records.CHANNEL):
            self.add(verified_records.parse_item(record), record.offset)

    def add(self, item: Schema | Channel, offset: int) -> None:
        """Add a definition; `Damage` at `offset` if it is one redefined."""
        again = ""
        if isinstance(item, Schema):
            if not item.id:
                raise Damage(offset, "(schema) has the number 0, which means none")
            if self.schemas.setdefault(item.id, item) != item:
                again = f"schema {item.id}"
        else:
            channels = self.channels.values()
            same = [
                channel
                for channel in channels
                if channel.id == item.id or channel.topic == item.topic
            ]
            if same not in ([], [item]):
                again = f"channel {item.id}"
            self.channels.setdefault(item.id, item)
        if again:
            raise Damage(offset, f"defines {again} a second time, differently")

    def messages(self, chunk: Content, offset: int) -> dict[int, ChunkMessages]:
        """Return the messages of one chunk, or of several consecutive ones, by channel.

        `offset` is its place in the file. `Damage` if records are truncated or definitions differ.
        """
        by_channel: dict[int, ChunkMessages] = {}
        recent: deque[Content] = deque(maxlen=_MAX_PATTERN_MESSAGES)
        at = 0
        while at < len(chunk):
            rows = self._repeated(chunk, at)
            if len(rows):
                first = at + rows.shape[1] * np.arange(len(rows))
                for channel, place in self._round:
                    messages = by_channel.setdefault(channel, ChunkMessages())
                    messages.parts.append(rows[:, place])
                    messages.places.append(first + place.start)
                at += rows.size
                continue
            opcode, end = verified_records.record_bounds(chunk, at, offset)
            if opcode == verified_records.MESSAGE:
                if end - at < HEAD.itemsize:
                    raise Damage(offset, "(chunk) ends in the middle of a record")
                head = chunk[at : at + _FIXED.size]
                if head in recent and self._learn([*recent][recent.index(head) :]):
                    recent.clear()
                    continue
                recent.append(head)
                messages = by_channel.setdefault(_FIXED.unpack(head)[2], ChunkMessages())
                messages.parts.append(np.frombuffer(chunk, np.uint8, end - at, at)[None])
                messages.places.append(np.array([at]))
            else:
                body = bytes(chunk[at + verified_records.RECORD.size : end])
                self.define(Record(offset, opcode, body))
            at = end
        return by_channel

    def _repeated(self, chunk: Content, at: int) -> Bytes:
        """Return the repetitions of the pattern that follow from `at` on, shape (k, size)."""
        if not self._round or chunk[at : at + _FIXED.size] != self._begin:
            return np.zeros((0, 0), np.uint8)
        size = self._round[-1][1].stop
        count = (len(chunk) - at) // size
        rows = np.frombuffer(chunk, np.uint8, count * size, at).reshape(count, size)
        same = (rows[:, self._fixed] == self._expected).all(axis=1)
        return rows if same.all() else rows[: int(same.argmin())]

    def _learn(self, heads: Sequence[Content]) -> bool:
        """Use one round of heads as the pattern, if it is new and no channel occurs twice."""
        _, lengths, channels = zip(*map(_FIXED.unpack, heads), strict=True)
        ends = np.cumsum([verified_records.RECORD.size + length for length in lengths]).tolist()
        begins = [0, *ends[:-1]]
        new = [*zip(channels, map(slice, begins, ends), strict=True)]
        if len(set(channels)) < len(channels) or new == self._round:
            return False
        self._round = new
        self._begin = bytes(heads[0])
        self._fixed = np.add.outer(begins, np.arange(_FIXED.size)).ravel()
        self._expected = np.frombuffer(b"".join(heads), np.uint8)
        return True
