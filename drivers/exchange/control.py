"""The block of shared memory by which the processes of one cell tell each other what they want.

Fields of eight bytes, each with one writer, read without locks: a store of eight aligned bytes
is seen whole or not at all. Times are those of CLOCK_MONOTONIC, the same in every process.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final, overload

from drivers.exchange import memory
from drivers.exchange.latency import BINS

STALE: Final = 0.5
"""s after which a heartbeat counts as that of a dead process."""
PATIENCE: Final = 5.0
"""The same where no motion was requested: a busy computer may keep a supervisor waiting, and the
death of one is shown by its end of the pipe at once."""
_WORDS: Final = 128
_LATENCIES: Final = 64


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


class _Whole:
    """An integer field."""

    def __init__(self, index: int) -> None:
        self._index = index

    @overload
    def __get__(self, block: None, owner: type[ControlBlock]) -> _Whole: ...
    @overload
    def __get__(self, block: ControlBlock, owner: type[ControlBlock]) -> int: ...
    def __get__(self, block: ControlBlock | None, owner: type[ControlBlock]) -> _Whole | int:
        return self if block is None else int(block.wholes[self._index])

    def __set__(self, block: ControlBlock, value: int) -> None:
        block.wholes[self._index] = value


class _Real:
    """A floating-point field."""

    def __init__(self, index: int) -> None:
        self._index = index

    @overload
    def __get__(self, block: None, owner: type[ControlBlock]) -> _Real: ...
    @overload
    def __get__(self, block: ControlBlock, owner: type[ControlBlock]) -> float: ...
    def __get__(self, block: ControlBlock | None, owner: type[ControlBlock]) -> _Real | float:
        return self if block is None else float(block.reals[self._index])

    def __set__(self, block: ControlBlock, value: float) -> None:
        block.reals[self._index] = value


def create() -> int:
    """Descriptor of memory for a block; every field is 0."""
    return memory.create("hil-control", 8 * _WORDS)


class ControlBlock:
    """The fields, for whoever reads or writes them. Those of different writers lie apart.

    Attributes:
        latencies: (`latency.BINS`,) answers by how long they took, counted by the exchange.
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
    """

    supervisor_heartbeat = _Real(0)
    stop_count = _Whole(1)
    override = _Real(2)
    finish = _Whole(3)
    program_id = _Whole(4)
    override_count = _Whole(5)
    held = _Whole(6)
    hold_count = _Whole(7)
    program_offered = _Whole(8)

    exchange_heartbeat = _Real(16)
    state = _Whole(17)
    cycle = _Whole(18)
    interval = _Whole(19)
    program_accepted = _Whole(20)
    program_refused = _Whole(21)
    pickup_us = _Real(22)
    ended_count = _Whole(23)
    overflow = _Whole(24)
    answered = _Whole(25)
    missed = _Whole(26)
    duplicates = _Whole(27)
    stale = _Whole(28)
    malformed = _Whole(29)
    foreign = _Whole(30)
    late = _Whole(31)
    refused = _Whole(32)
    worst_turnaround_us = _Real(33)
    finished = _Whole(34)
    answered_late = _Whole(35)
    unanswered = _Whole(36)
    ended_outcome = _Whole(37)
    ended_interval = _Whole(38)
    motion_time = _Real(39)
    rate = _Real(40)

    archive_heartbeat = _Real(48)
    archive_state = _Whole(49)

    def __init__(self, fd: int) -> None:
        whole = memoryview(memory.attach(fd)).cast("B")
        if len(whole) != 8 * _WORDS:
            raise ValueError("this memory is not a control block")
        self.wholes = whole.cast("q")
        self.reals = whole.cast("d")
        self.latencies = self.wholes[_LATENCIES : _LATENCIES + BINS]
