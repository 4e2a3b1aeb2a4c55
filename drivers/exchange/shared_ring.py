"""Rings of cycle records and of raw packets in shared memory: one process writes, others read.

The writer fills a row and then raises the count of rows written; it never waits and never looks
back. A reader copies rows and then reads the count again, to find out which of them were
overwritten meanwhile. That is sound where stores of one processor are seen by others in their
order and loads are not moved ahead of earlier ones, as on x86.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.exchange import memory
from drivers.packet_records import CAPACITY, PACKET_DTYPE, PacketRows
from drivers.record import CycleRecords, cycle_dtype

_MAGIC: Final = 0x31474E4952434948
_PACKETS_MAGIC: Final = 0x31474E4952504948
_HEADER_BYTES: Final = 256
# Indices of 8-byte words, those of different writers on different cache lines.
_TAG, _JOINTS, _CAPACITY, _WRITTEN, _READ = 0, 1, 2, 8, 16


class SharedCycleRing(CycleRecords):
    """Records that other processes can read, the writer's end.

    Attributes:
        fd: descriptor of the memory.
    """

    def __init__(self, fd: int, n_joints: int) -> None:
        mapped = memory.attach(fd)
        words = memoryview(mapped).cast("B")[:_HEADER_BYTES].cast("q")
        capacity = _checked(words, n_joints)
        rows: NDArray[np.void] = np.frombuffer(
            mapped, cycle_dtype(n_joints), capacity, _HEADER_BYTES
        )
        super().__init__(n_joints, capacity, rows)
        self.fd = fd
        self._words = words
        self._lost = 0
        self._written = words[_WRITTEN]

    @classmethod
    def create(cls, n_joints: int, capacity: int) -> SharedCycleRing:
        """Ask for memory for `capacity` records."""
        row = cycle_dtype(n_joints).itemsize
        return cls(_asked_for("hil-cycles", "records", _MAGIC, n_joints, row, capacity), n_joints)

    @classmethod
    def attach(cls, fd: int, n_joints: int) -> SharedCycleRing:
        """Write into memory that another process asked for.

        Raises:
            ValueError: it is not a ring of `n_joints` joints.
        """
        return cls(fd, n_joints)

    @property
    def written(self) -> int:
        """Records written so far."""
        return self._written

    def commit(self) -> None:
        """Make the row at `slot` part of the ring."""
        words = self._words
        if words[_READ] <= self._written - self.capacity:
            self._lost += 1
        self._written += 1
        words[_WRITTEN] = self._written

    @property
    def overflow(self) -> int:
        """Records overwritten before the reader had them, so far."""
        return self._lost


class SharedPacketRing(PacketRows):
    """Raw packets that other processes can read, the writer's end.

    Attributes:
        fd: descriptor of the memory.
    """

    def __init__(self, fd: int) -> None:
        whole = memoryview(memory.attach(fd)).cast("B")
        words = whole[:_HEADER_BYTES].cast("q")
        capacity = _checked(words, PACKET_DTYPE.itemsize, _PACKETS_MAGIC, "raw packets")
        rows = whole[_HEADER_BYTES:][: capacity * PACKET_DTYPE.itemsize]
        super().__init__(rows)
        self.fd = fd
        self._words = words
        self.written = words[_WRITTEN]

    @classmethod
    def create(cls, capacity: int = CAPACITY) -> SharedPacketRing:
        """Ask for memory for `capacity` packets."""
        row = PACKET_DTYPE.itemsize
        return cls(_asked_for("hil-packets", "packets", _PACKETS_MAGIC, row, row, capacity))

    def put(self, cycle: int, time: float, sent: bool, packet: bytes) -> None:
        """Keep one packet, over the oldest where there is no room."""
        super().put(cycle, time, sent, packet)
        self._words[_WRITTEN] = self.written


class _RowReader:
    """Reads rows that another process writes, from the oldest one still there.

    Attributes:
        overflow: rows that were overwritten before this reader had them.
        capacity: of the ring.
    """

    def __init__(
        self, fd: int, dtype: np.dtype[np.void], check: tuple[int, int, str], *, acknowledge: bool
    ) -> None:
        mapped = memory.attach(fd)
        self._words = memoryview(mapped).cast("B")[:_HEADER_BYTES].cast("q")
        self.capacity = _checked(self._words, *check)
        self._rows: NDArray[np.void] = np.frombuffer(mapped, dtype, self.capacity, _HEADER_BYTES)
        self._acknowledge = acknowledge
        self._read = self._oldest()
        self.overflow = 0

    def _oldest(self) -> int:
        # The row behind the last one written may be half overwritten already.
        return max(0, self._words[_WRITTEN] + 1 - self.capacity)

    def drain(self) -> NDArray[np.void]:
        """A copy of the rows not read yet, (k,), oldest first."""
        end = self._words[_WRITTEN]
        begin = max(self._read, self._oldest())
        records = self._rows.take(np.arange(begin, end), mode="wrap")
        torn = min(max(0, self._oldest() - begin), len(records))
        self.overflow += begin - self._read + torn
        self._read = end
        if self._acknowledge:
            self._words[_READ] = end
        return records[torn:]


class RingReader(_RowReader):
    """Reads a ring of cycle records; one reader acknowledges.

    Args:
        fd: descriptor of the memory.
        n_joints: of the records.
        acknowledge: whether the writer learns how far this reader got, so that it counts what
            it overwrites; one reader at a time may.

    Raises:
        ValueError: it is not a ring of `n_joints` joints.
    """

    def __init__(self, fd: int, n_joints: int, *, acknowledge: bool = True) -> None:
        check = (n_joints, _MAGIC, "cycle records")
        super().__init__(fd, cycle_dtype(n_joints), check, acknowledge=acknowledge)


class PacketReader(_RowReader):
    """Reads a ring of raw packets, rows of `PACKET_DTYPE`.

    Raises:
        ValueError: it is not one.
    """

    def __init__(self, fd: int) -> None:
        check = (PACKET_DTYPE.itemsize, _PACKETS_MAGIC, "raw packets")
        super().__init__(fd, PACKET_DTYPE, check, acknowledge=False)


def _asked_for(name: str, what: str, magic: int, width: int, row: int, capacity: int) -> int:
    """Descriptor of memory for a ring of `capacity` rows of `row` bytes; see `_checked`."""
    if capacity < 2:
        raise ValueError(f"a shared ring of {capacity} {what}; at least 2 are needed")
    fd = memory.create(name, _HEADER_BYTES + capacity * row)
    words = memoryview(memory.attach(fd)).cast("B")[:_HEADER_BYTES].cast("q")
    words[_JOINTS], words[_CAPACITY], words[_TAG] = width, capacity, magic
    return fd


def _checked(
    words: memoryview, width: int, magic: int = _MAGIC, what: str = "cycle records"
) -> int:
    """Capacity of the ring whose header this is; `width` is joints, or bytes of a packet's row."""
    if len(words) < _HEADER_BYTES // 8 or words[_TAG] != magic:
        raise ValueError(f"this memory is not a ring of {what}")
    if words[_JOINTS] != width:
        unit = "joints" if magic == _MAGIC else "bytes a packet"
        raise ValueError(f"this ring is for {words[_JOINTS]} {unit}, not {width}")
    return int(words[_CAPACITY])
