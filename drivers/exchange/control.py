"""The block of shared memory through which the processes of one cell exchange requests and state.

Fields of eight bytes, each with one writer, read without locks: a store of eight aligned bytes
is atomic. Times are of CLOCK_MONOTONIC, the same in every process.
"""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, ClassVar, Final, Self, TypeAlias

from drivers.cycle_records import attach_memory, create_memory
from drivers.states import Outcome

HEARTBEAT_TIMEOUT: Final = 0.5
"""Age of a heartbeat at which its process counts as dead while a motion is requested, s."""
IDLE_HEARTBEAT_TIMEOUT: Final = 5.0
"""The same without a motion, s: a busy computer may delay a supervisor, whose death is detected at
once by the end of its pipe."""

# Latencies are counted in bins: percentiles for other processes at the cost of a logarithm and a
# store per packet.
LATENCY_BINS: Final = 96
BINS_PER_OCTAVE: Final = 4
FIRST_BIN_SECONDS: Final = 2e-6
"""Upper edge of the first bin, s; each next one is 2 ** (1 / `BINS_PER_OCTAVE`) times longer. The
last contains everything above 24 s."""
OUTCOMES: Final[tuple[Outcome, ...]] = ("lost", "completed", "stopped", "refused")
"""Outcome of a motion by its number in the shared state; "lost" before the first."""


def bin_of(seconds: float) -> int:
    """Return the index of the bin of a latency."""
    if not seconds > FIRST_BIN_SECONDS:
        return 0
    if math.isinf(seconds):
        return LATENCY_BINS - 1
    return min(
        LATENCY_BINS - 1, math.ceil(BINS_PER_OCTAVE * math.log2(seconds / FIRST_BIN_SECONDS))
    )


def upper_edge(index: int) -> float:
    """Return the longest latency of a bin, s; infinite for the last."""
    return (
        math.inf
        if index >= LATENCY_BINS - 1
        else FIRST_BIN_SECONDS * 2.0 ** (index / BINS_PER_OCTAVE)
    )


def quantile(counts: Sequence[int], share: float) -> float | None:
    """Return the latency not exceeded by this share of the replies, s; None without replies.

    It is the upper edge of a bin: never too short, and at most 19 % too long.
    """
    total = sum(counts)
    if total <= 0:
        return None
    cumulated = 0
    for index, count in enumerate(counts):
        cumulated += count
        if cumulated >= share * total and cumulated > 0:
            return upper_edge(index)
    return upper_edge(LATENCY_BINS - 1)


class ArchiveState(IntEnum):
    """State of the archive."""

    NONE = 0
    READY = 1
    FAILED = 2


Gap: TypeAlias = ctypes.Array[ctypes.c_int64]
"""A cache line between the fields of two writers."""
Counts: TypeAlias = ctypes.Array[ctypes.c_int64]
_KINDS: Final[dict[str, Any]] = {
    "float": ctypes.c_double,
    "int": ctypes.c_int64,
    "Gap": ctypes.c_int64 * 8,
    "Counts": ctypes.c_int64 * LATENCY_BINS,
}


class SharedState(ctypes.Structure):
    """The fields of supervisor, exchange and archive, for readers and writers.

    Counts of packets are as in `drivers.events.Counters`.

    Attributes:
        supervisor_heartbeat, exchange_heartbeat, archive_heartbeat: s.
        stop_count: incremented for each requested stop.
        override: requested fraction of the speed; `override_count` is incremented after it.
        finish: 1 if the exchange has to leave open mode and end.
        program_offered: id of the motion to be read, incremented for each.
        program_id: id of the motion that may begin once it was read; negative to withdraw it.
        held: 1 to hold the present motion on its path, 0 to resume it; a command, not a state;
            `hold_count` is incremented after it.
        state: `drivers.states.State` of the session.
        cycle: the controller's cycle.
        interval: in open mode, -1 before the first.
        program_accepted, program_refused: id of the motion accepted or refused last.
        pickup_us: time to read the last motion, µs.
        ended_count: motions that have ended, written after the two fields that follow; valid also
            if the event was lost.
        ended_outcome: of the last of them, an index of `OUTCOMES`.
        ended_interval: of its records, -1 if open mode was not reached.
        overflow: records overwritten before they were archived.
        late: packets without a reply within a cycle of their arrival: left out for a newer one, or
            replied to late; `replied_late` of them got a reply.
        late_packets: packets that came late themselves (`drivers.punctuality`).
        rejected: replies not accepted by the controller.
        worst_turnaround_us: longest time from arrival (in the kernel, if the link has time stamps)
            to the departure of the reply, µs.
        finished: 1 when the exchange has ended properly.
        motion_time: elapsed time of the last motion at its planned speed, s; NaN if unknown.
        rate: motion time per time, 1 at planned speed; NaN if unknown.
        latencies: (`LATENCY_BINS`,) replies by their latency.
        archive_state: an `ArchiveState`.

    Raises:
        ValueError: the memory has none.
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
    replied: int
    missed: int
    duplicates: int
    stale: int
    malformed: int
    foreign: int
    late: int
    replied_late: int
    late_packets: int
    rejected: int
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
        """Return the block in shared memory."""
        mapped = attach_memory(fd)
        if len(mapped) != ctypes.sizeof(cls):
            raise ValueError("this memory has no shared state")
        return cls.from_buffer(mapped)

    def __init__(self, fd: int) -> None:
        """Leave the fields unchanged."""

    @property
    def outcome(self) -> Outcome:
        """Outcome of the last motion."""
        return OUTCOMES[self.ended_outcome]


def create() -> int:
    """Return the descriptor of memory for a block; every field is 0."""
    return create_memory("hil-control", ctypes.sizeof(SharedState))


MAX_CALL_INTERVAL: Final = 0.5
"""Longest time between two calls that counts as silence, s; otherwise this process was held up."""


class HeartbeatMonitor:
    """Measures how long a heartbeat has not changed while this process was running.

    After a suspension of the computer all heartbeats are old; so at most `max_interval` s between
    two calls count. `heartbeat` reads a number, 0 before the first.
    """

    def __init__(
        self, heartbeat: Callable[[], float], *, max_interval: float = MAX_CALL_INTERVAL
    ) -> None:
        self._read = heartbeat
        self._max_interval = max_interval
        self._last = heartbeat()
        self._read_at = time.monotonic()
        self._silence = 0.0

    def silence(self) -> float:
        """Return the seconds since the last change, 0 before the first; to be called often."""
        now = time.monotonic()
        heartbeat = self._read()
        if heartbeat != self._last or heartbeat == 0.0:
            self._last = heartbeat
            self._silence = 0.0
        else:
            self._silence += min(now - self._read_at, self._max_interval)
        self._read_at = now
        return self._silence
