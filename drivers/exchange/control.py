"""The block of shared memory by which the processes of one cell tell each other what they want.

Fields of eight bytes, each with one writer, read without locks: a store of eight aligned bytes
is seen whole or not at all. Times are those of CLOCK_MONOTONIC, the same in every process.

Percentiles of the latencies counted in it, and `HeartbeatMonitor`, which finds dead processes.
"""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, ClassVar, Final, Self, TypeAlias

from drivers.record import attach_memory, create_memory

STALE: Final = 0.5
"""s after which a heartbeat counts as that of a dead process."""
PATIENCE: Final = 5.0
"""The same where no motion was requested: a busy computer may keep a supervisor waiting, and the
death of one is shown by its end of the pipe at once."""


# How long answers take is counted in bins, so that other processes can tell percentiles: that costs
# a logarithm and a store per packet, whatever the number of packets.
BINS: Final = 48
PER_OCTAVE: Final = 4
SHORTEST: Final = 2e-6
"""s; the first bin holds everything up to it, each next one 2 ** (1 / `PER_OCTAVE`) times more.
The last holds all that took longer than 5.8 ms."""


def bin_of(seconds: float) -> int:
    """Index of the bin that a latency falls into."""
    if not seconds > SHORTEST:
        return 0
    if math.isinf(seconds):
        return BINS - 1
    return min(BINS - 1, math.ceil(PER_OCTAVE * math.log2(seconds / SHORTEST)))


def upper_edge(index: int) -> float:
    """Longest latency of a bin, s; that of the last is infinite."""
    return math.inf if index >= BINS - 1 else SHORTEST * 2.0 ** (index / PER_OCTAVE)


def quantile(counts: Sequence[int], share: float) -> float | None:
    """Latency not exceeded by this share of the answers, s; None without any.

    It is the upper edge of a bin: never too short, and at most 19 % too long.
    """
    total = sum(counts)
    if total <= 0:
        return None
    needed, seen = share * total, 0
    for index, count in enumerate(counts):
        seen += count
        if seen >= needed and seen > 0:
            return upper_edge(index)
    return upper_edge(BINS - 1)


class ArchiveState(IntEnum):
    """What the archive process says of the archive."""

    NONE = 0
    READY = 1
    FAILED = 2


class Ended(IntEnum):
    """How the last motion ended; the names are those of `drivers.events.Outcome`."""

    NONE = 0
    COMPLETED = 1
    STOPPED = 2
    REFUSED = 3
    LOST = 4


Gap: TypeAlias = ctypes.Array[ctypes.c_int64]
"""A cache line between the fields of two writers."""
Counts: TypeAlias = ctypes.Array[ctypes.c_int64]
_KINDS: Final[dict[str, Any]] = {
    "float": ctypes.c_double,
    "int": ctypes.c_int64,
    "Gap": ctypes.c_int64 * 8,
    "Counts": ctypes.c_int64 * BINS,
}


class ControlBlock(ctypes.Structure):
    """The fields, for whoever reads or writes them. Those of different writers lie apart.

    Args:
        fd: descriptor of the memory.

    Attributes:
        latencies: (`BINS`,) answers by how long they took, counted by the exchange.
        supervisor_heartbeat: s.
        stop_count: raised by one for each stop asked for.
        override: fraction of the speed asked for.
        override_count: raised by one for each override asked for, after it was written.
        finish: 1 when the exchange is to leave open mode and end.
        program_offered: id of the program to be read, raised for each.
        program_id: of the program that may begin once it was read; negative to withdraw it.
        held: 1 if the motion going on is to rest on its path, 0 if it is to go on; an order, not
            a state: it says nothing of a later motion.
        hold_count: raised by one each time, after `held` was written.
        exchange_heartbeat: s.
        state: `drivers.states.State` of the session.
        cycle: the controller's cycle.
        interval: in open mode, -1 before the first.
        program_accepted: id of the program accepted last.
        program_refused: id of the program refused last.
        pickup_us: microseconds the last program took to be read.
        ended_count: motions that have ended, raised after the two that follow were written; a
            second witness, should the event get lost.
        ended_outcome: of the last of them, an `Ended`.
        ended_interval: of its records, -1 if it never saw open mode.
        overflow: records overwritten before the archive had them.
        answered: packets, as `drivers.events.Counters` has it; so are the ones that follow.
        missed: packets that never arrived.
        duplicates: packets that came twice.
        stale: packets that came too late.
        malformed: packets that were none.
        foreign: packets from elsewhere.
        late: packets whose answer did not leave within a cycle of their arrival: left out for a
            newer one, or answered late.
        answered_late: those of them that were answered all the same.
        unanswered: answers of ours that the controller did not take.
        refused: set-points refused.
        worst_turnaround_us: microseconds from a packet's arrival (in the kernel, where the link
            can say) to the departure of its answer.
        finished: 1 when the exchange has ended properly.
        motion_time: s of the motion taken last that were gone through; NaN if it does not tell.
        rate: how fast its motion time runs, 1 as planned; NaN likewise.
        archive_heartbeat: s.
        archive_state: an `ArchiveState`.

    Raises:
        ValueError: the memory is not a control block.
    """

    supervisor_heartbeat: float
    stop_count: int
    override: float
    finish: int
    program_id: int
    override_count: int
    held: int
    hold_count: int
    program_offered: int
    _exchange: Gap
    exchange_heartbeat: float
    state: int
    cycle: int
    interval: int
    program_accepted: int
    program_refused: int
    pickup_us: float
    ended_count: int
    ended_outcome: int
    ended_interval: int
    overflow: int
    answered: int
    missed: int
    duplicates: int
    stale: int
    malformed: int
    foreign: int
    late: int
    answered_late: int
    unanswered: int
    refused: int
    worst_turnaround_us: float
    finished: int
    motion_time: float
    rate: float
    latencies: Counts
    _archive: Gap
    archive_heartbeat: float
    archive_state: int

    _fields_: ClassVar = [(name, _KINDS[kind]) for name, kind in __annotations__.items()]

    def __new__(cls, fd: int) -> Self:
        """Return the block that lies in shared memory."""
        mapped = attach_memory(fd)
        if len(mapped) != ctypes.sizeof(cls):
            raise ValueError("this memory is not a control block")
        return cls.from_buffer(mapped)

    def __init__(self, fd: int) -> None:
        """Leave the fields as they are."""

    @property
    def outcome(self) -> str:
        """How the last motion ended, a `drivers.events.Outcome`, or "none"."""
        return Ended(self.ended_outcome).name.lower()

    def copied(self) -> Self:
        """Return the fields as they are at this moment."""
        copy: Self = type(self).from_buffer_copy(self)
        return copy


def create() -> int:
    """Descriptor of memory for a block; every field is 0."""
    return create_memory("hil-control", ctypes.sizeof(ControlBlock))


MAX_INTERVAL: Final = 0.5
"""s between two looks that count at most; in a longer time this process was held up itself."""


class HeartbeatMonitor:
    """How long a heartbeat has stood still while somebody was awake to see it.

    Its age would not do: a machine that was suspended wakes with every heartbeat old.

    Args:
        beat: the heartbeat, any number; 0 before the first.
        max_interval: s; `MAX_INTERVAL` for somebody who looks more often.
    """

    def __init__(self, beat: Callable[[], float], *, max_interval: float = MAX_INTERVAL) -> None:
        self._beat, self._longest = beat, max_interval
        self._last, self._seen = beat(), time.monotonic()
        self._quiet = 0.0

    def silence(self) -> float:
        """Seconds since the last beat; 0 before the first. To be called often."""
        now, beat = time.monotonic(), self._beat()
        if beat != self._last or beat == 0.0:
            self._last, self._quiet = beat, 0.0
        else:
            self._quiet += min(now - self._seen, self._longest)
        self._seen = now
        return self._quiet
