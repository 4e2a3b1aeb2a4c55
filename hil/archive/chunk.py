"""The messages of a decompressed chunk, found all at once.

A recording repeats itself: each cycle adds the same few messages of the same lengths. Once that
pattern is known, what follows is taken for a matrix with a pattern per row, and that is *verified*:
opcode, length and channel at each place where a message should begin. That is the whole walk, done
in a few array operations. Anything else in between is walked record by record.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.archive import container
from hil.archive.container import Damage
from hil.archive.known_channels import KnownChannels

Bytes = NDArray[np.uint8]

_RECORD = container.RECORD
_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_FIXED = struct.Struct("<BQH")  # the part of it that repeats with the pattern
_SEQUENCE = np.dtype("<u4")
_IN_BODY = _HEAD.size - _RECORD.size  # the part of it that the record's length counts
_WORD = np.dtype("<u8")
_WORDS_AT = (0, _FIXED.size - _WORD.itemsize)  # two words that overlap cover the fixed part
_LONGEST_PATTERN = 16  # messages


@dataclass(frozen=True, eq=False)
class Messages:
    """The messages of one channel in one chunk, or in several that follow each other.

    Attributes:
        parts: their data in order, each an array (k, size) of messages of one size.
        sequence: their numbers as written, shape (k,) for each part.
    """

    parts: list[Bytes]
    sequences: list[NDArray[np.uint32]]

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    @property
    def sequence(self) -> NDArray[np.uint32]:
        """The numbers of all messages."""
        return self.sequences[0] if len(self.sequences) == 1 else np.concatenate(self.sequences)

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


class _Place(NamedTuple):
    """Where in the pattern a message stands, and the head it must have as two words."""

    channel: int
    words: tuple[tuple[slice, int], ...]
    sequence: slice
    data: slice


class ChunkParser:
    """Finds messages, chunk after chunk, and takes the schemas and channels among them."""

    def __init__(self) -> None:
        self.known = KnownChannels()
        self._pattern: list[_Place] = []

    def repeats(self, chunk: bytes) -> bool:
        """Whether a chunk may be nothing but the known pattern, to judge by its length."""
        return bool(self._pattern) and len(chunk) % self._pattern[-1].data.stop == 0

    def repeated(self, chunks: Sequence[bytes]) -> dict[str, Messages] | None:
        """The messages of chunks by topic if they repeat the known pattern and nothing else.

        The chunks must each be of a length that `repeats`.
        """
        data = chunks[0] if len(chunks) == 1 else b"".join(chunks)
        rows = self._run(data, 0)
        if rows is None or rows.size != len(data):
            return None
        found: dict[int, Messages] = {}
        self._add(rows, found)
        return self._by_topic(found, 0)

    def messages(self, chunk: bytes, offset: int) -> dict[str, Messages]:
        """The messages of a chunk by topic.

        Args:
            chunk: decompressed records.
            offset: where the chunk's record begins in the file, for the error.

        Raises:
            Damage: the chunk does not hold whole records, or announcements that fit its messages.
        """
        found: dict[int, Messages] = {}
        recent: deque[bytes] = deque(maxlen=_LONGEST_PATTERN)
        at = 0
        while at < len(chunk):
            rows = self._run(chunk, at)
            if rows is not None and len(rows):
                self._add(rows, found)
                at += rows.size
                continue
            opcode, end = _bounds(chunk, at, offset)
            if opcode == container.MESSAGE:
                head = chunk[at : at + _FIXED.size]
                if head in recent and self._learn(list(recent)[recent.index(head) :]):
                    recent.clear()
                    continue
                recent.append(head)
                _, _, channel, sequence, _, _ = _HEAD.unpack_from(chunk, at)
                data = np.frombuffer(chunk, np.uint8, end - at - _HEAD.size, at + _HEAD.size)
                _append(found, channel, data[None], np.array([sequence], np.uint32))
            else:
                self.known.take(opcode, chunk[at + _RECORD.size : end], offset)
            at = end
        return self._by_topic(found, offset)

    def _by_topic(self, found: dict[int, Messages], offset: int) -> dict[str, Messages]:
        unknown = found.keys() - self.known.channels.keys()
        if unknown:
            raise Damage(offset, f"(chunk) has messages of an unknown channel {min(unknown)}")
        return {self.known.topic(channel): messages for channel, messages in found.items()}

    def _run(self, chunk: bytes, at: int) -> Bytes | None:
        """As many repetitions of the pattern as follow from `at` on, shape (k, size)."""
        if not self._pattern:
            return None
        size = self._pattern[-1].data.stop
        count = (len(chunk) - at) // size
        if not count:
            return None
        rows = np.frombuffer(chunk, np.uint8, count * size, at).reshape(-1, size)
        kept = np.ones(count, np.bool_)
        for place in self._pattern:
            for where, word in place.words:
                kept &= rows[:, where].view(_WORD)[:, 0] == word
        return rows if kept.all() else rows[: int(kept.argmin())]

    def _add(self, rows: Bytes, found: dict[int, Messages]) -> None:
        for place in self._pattern:
            sequence = rows[:, place.sequence].view(_SEQUENCE)[:, 0]
            _append(found, place.channel, rows[:, place.data], sequence)

    def _learn(self, heads: list[bytes]) -> bool:
        """Take one round of heads for the pattern, if no channel comes twice in it."""
        places, start = [], 0
        for head in heads:
            _, length, channel = _FIXED.unpack(head)
            words = tuple(
                (
                    slice(start + at, start + at + _WORD.itemsize),
                    int.from_bytes(head[at : at + 8], "little"),
                )
                for at in _WORDS_AT
            )
            number = start + _FIXED.size
            end = start + _RECORD.size + length
            sequence = slice(number, number + _SEQUENCE.itemsize)
            places.append(_Place(channel, words, sequence, slice(start + _HEAD.size, end)))
            start = end
        changed = len({place.channel for place in places}) == len(places)
        changed &= places != self._pattern
        if changed:
            self._pattern = places
        return changed


def _bounds(chunk: bytes, at: int, offset: int) -> tuple[int, int]:
    """Opcode and end of the record at `at`."""
    if len(chunk) - at < _RECORD.size:
        raise Damage(offset, "(chunk) ends within a record")
    opcode, length = _RECORD.unpack_from(chunk, at)
    end = at + _RECORD.size + length
    if end > len(chunk) or (opcode == container.MESSAGE and length < _IN_BODY):
        raise Damage(offset, "(chunk) ends within a record")
    return opcode, end


def _append(
    found: dict[int, Messages], channel: int, data: Bytes, sequence: NDArray[np.uint32]
) -> None:
    messages = found.setdefault(channel, Messages([], []))
    messages.parts.append(data)
    messages.sequences.append(sequence)
