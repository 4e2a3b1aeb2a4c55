"""Events in shared memory: a ring of bytes that one process writes and others read.

A frame is length, checksum, index and one pickled event. The writer stores the new tail, the frame,
then the new head; a reader copies the frames, then drops those behind the tail valid by then.
"""

from __future__ import annotations

import pickle
import struct
import zlib
from dataclasses import dataclass
from typing import Final

from drivers.cycle_records import attach_memory, create_memory
from drivers.events import Event
from drivers.exchange.control import HEARTBEAT_TIMEOUT, IDLE_HEARTBEAT_TIMEOUT
from drivers.exchange.realtime import RealTimeReport

_SUSPENDED: Final = "it was suspended (Ctrl-Z, SIGSTOP, a debugger), or had no processor time"
NO_SUPERVISOR: Final = (
    f"the supervising program sent no heartbeat for more than {HEARTBEAT_TIMEOUT:g} s: {_SUSPENDED}"
)
"""Reason of a motion that was stopped because its supervisor was silent."""
NO_SUPERVISOR_AT_REST: Final = (
    f"the supervising program sent no heartbeat for more than {IDLE_HEARTBEAT_TIMEOUT:g} s: "
    f"{_SUSPENDED}"
)
SESSION_ENDED: Final = "the controller ended the session"
NO_ARCHIVE: Final = "the archive process sends no heartbeat"


@dataclass(frozen=True)
class ExchangeStarted:
    """The link is open; `notes` are options of the link that the system refused."""

    pid: int
    realtime: RealTimeReport
    notes: tuple[str, ...]


@dataclass(frozen=True)
class CommandRefused:
    """An override, hold or resumption that is not possible; a motion goes on as before."""

    command: str
    reason: str


@dataclass(frozen=True)
class EventsLost:
    """Events were overwritten before they were read; inserted by the reader."""

    count: int


@dataclass(frozen=True)
class Leaving:
    """Motions are no longer accepted; the present one is stopped and open mode left."""

    reason: str


@dataclass(frozen=True)
class ExchangeEnded:
    """Last event of a process that ends properly."""

    reason: str


@dataclass(frozen=True)
class ExchangeFailed:
    """Last event of a process that ends by an internal error; the controller stops the arm."""

    trace: str


ExchangeEvent = (
    Event | ExchangeStarted | CommandRefused | EventsLost | Leaving | ExchangeEnded | ExchangeFailed
)


CAPACITY_BYTES: Final = 4 << 20
"""Bytes, for some hundred refusals with their flight recorders, or 50 000 small events."""
_HEADER_BYTES: Final = 256
_FRAME: Final = struct.Struct("<IIQ")
_HEAD_WORD = 8
_TAIL_WORD = 16


def create(capacity: int = CAPACITY_BYTES) -> int:
    """Return the descriptor of memory for a log of `capacity` bytes."""
    return create_memory("hil-events", _HEADER_BYTES + capacity)


class _Log:
    """The memory: two words of positions, then a ring of bytes."""

    def __init__(self, fd: int) -> None:
        whole = memoryview(attach_memory(fd))
        self._words = whole[:_HEADER_BYTES].cast("Q")
        self._bytes = whole[_HEADER_BYTES:]
        self._capacity = len(self._bytes)

    def _get(self, position: int, count: int) -> bytes:
        begin = position % self._capacity
        first = bytes(self._bytes[begin : begin + count])
        return first + bytes(self._bytes[: count - len(first)])


class EventWriter(_Log):
    """The writer's end."""

    def __init__(self, fd: int) -> None:
        super().__init__(fd)
        self._head = 0
        self._tail = 0
        self._count = 0

    def write(self, event: ExchangeEvent) -> None:
        """Append one event, over the oldest if the log is full; raises ValueError if too long."""
        body = pickle.dumps(event, protocol=5)
        frame = _FRAME.pack(len(body), zlib.crc32(body), self._count) + body
        if len(frame) > self._capacity:
            raise ValueError(f"an event of {len(frame)} bytes in a log of {self._capacity}")
        self._count += 1
        end = self._head + len(frame)
        while end - self._tail > self._capacity:
            length = _FRAME.unpack(self._get(self._tail, _FRAME.size))[0]
            self._tail += _FRAME.size + length
        self._words[_TAIL_WORD] = self._tail
        begin = self._head % self._capacity
        first = min(len(frame), self._capacity - begin)
        self._bytes[begin : begin + first] = frame[:first]
        self._bytes[: len(frame) - first] = frame[first:]
        self._head = end
        self._words[_HEAD_WORD] = end


class EventReader(_Log):
    """A reader's end, from the oldest event available; the `lost` ones appear as `EventsLost`."""

    def __init__(self, fd: int) -> None:
        super().__init__(fd)
        self._position: int = self._words[_TAIL_WORD]
        # Index of the next event; unknown if the first ones are overwritten already.
        self._expected: int | None = None if self._position else 0
        self.lost = 0

    def drain(self) -> list[ExchangeEvent]:
        """Return the events not read yet, in order."""
        head = self._words[_HEAD_WORD]
        begin = max(self._position, self._words[_TAIL_WORD])
        copy = self._get(begin, head - begin)
        valid = self._words[_TAIL_WORD]
        self._position = head
        events: list[ExchangeEvent] = []
        # If the writer lapped all that was copied, its oldest frame begins beyond the copy.
        at = max(begin, valid)
        while at < head:
            length, checksum, index = _FRAME.unpack_from(copy, at - begin)
            at += _FRAME.size
            body = copy[at - begin : at - begin + length]
            at += length
            missing = index - (index if self._expected is None else self._expected)
            self._expected = index + 1
            intact = zlib.crc32(body) == checksum
            lost = missing + (not intact)
            if lost:
                self.lost += lost
                events.append(EventsLost(lost))
            if intact:
                events.append(pickle.loads(body))
        return events
