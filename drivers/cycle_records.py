"""Ring buffers of cycle records.

A ring uses its own memory or that of a descriptor, which other processes can read. The writer fills
a row and then increments the count of rows written; it never waits. A reader copies rows and then
reads the count again, to find those overwritten meanwhile. This requires that stores of one
processor become visible to others in order and that loads are not reordered, as on x86.
"""

from __future__ import annotations

import json
import math
import mmap
import os
from collections.abc import Sequence
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.arrays import Array

MEASURED = (
    "target_position",
    "target_velocity",
    "position",
    "velocity",
    "target_current",
    "model_current",
    "diagonal_inertia",
    "extra3",
)
"""Values received of each joint, in the order of the wire (D1..D5, extra1..3)."""
COMMANDED = ("commanded_position", "commanded_velocity")
"""Values sent in the reply."""
ARM_STATE: Final = "arm_state"
"""Field of what a controller sends beyond the others, if it sends any such."""


def cycle_dtype(n_joints: int, state: np.dtype[np.void] | None = None) -> np.dtype[np.void]:
    """Return the layout of one cycle record of an arm with `n_joints` joints.

    `state` is the layout of ``arm_state``, which is absent without it.

    ``cycle`` controller's cycles since its init packet, missed ones counted in; ``number`` wire
    sequence number; ``arrival`` s, for diagnosis only; ``gap`` packets missed before this one;
    ``interval`` index of the interval in open mode, -1 outside; ``state`` `State` after this
    packet; ``status`` status byte of the arm; ``mode`` of each joint. Joint arrays are joint side
    in SI (rad, rad/s), currents motor side in A, ``diagonal_inertia`` kg·m²; ``commanded_*`` are
    those of the reply, NaN where no set-point was sent.
    """
    joint = (n_joints,)
    fields: list[tuple[str, Any] | tuple[str, str, tuple[int]]] = [
        ("cycle", "<i8"),
        ("arrival", "<f8"),
        ("number", "<i4"),
        ("gap", "<i4"),
        ("interval", "<i4"),
        ("state", "u1"),
        ("status", "u1"),
        *((name, "<f8", joint) for name in (*MEASURED, *COMMANDED)),
        ("mode", "<i4", joint),
    ]
    return np.dtype(fields if state is None else [*fields, (ARM_STATE, state)], align=True)


class RowColumns:
    """How numbers of packets become fields of rows, a few operations for all of them.

    Args:
        layout: fields of a row: floats first, then integers.
        places: index in the packet of each number of a row; -1 if the packet lacks it.
        factors: scale of each number.
        count: numbers in a packet.
        unknown: value of integers that the packet lacks; missing floats are NaN.
    """

    def __init__(
        self,
        layout: np.dtype[np.void],
        places: Sequence[int],
        factors: Sequence[float],
        count: int,
        unknown: int,
    ) -> None:
        kinds = [layout[name] for name in layout.names or ()]
        floats = sum(math.prod(kind.shape) for kind in kinds if kind.base.kind == "f")
        self._blocks = np.dtype(
            [("floats", "<f8", (floats,)), ("integers", "<i4", (len(places) - floats,))]
        )
        self._count = count
        self._unknown = unknown
        self._floats = np.array(places[:floats])
        self._integers = np.array(places[floats:])
        self._factors = np.array(factors[:floats])

    def write(self, numbers: ArrayLike, rows: NDArray[np.void]) -> None:
        """Write numbers (k, count) of packets into rows (k,)."""
        known = np.empty((len(rows), self._count + 1))
        known[:, :-1] = numbers
        blocks = rows.view(self._blocks)
        known[:, -1] = math.nan
        np.multiply(known[:, self._floats], self._factors, out=blocks["floats"])
        known[:, -1] = self._unknown
        # Bits may be above the range of integers with a sign.
        blocks["integers"][:] = known[:, self._integers].astype(np.int64)


def create_memory(name: str, size: int) -> int:
    """Return a descriptor of `size` zero bytes to be shared; the name is for diagnosis only."""
    fd = os.memfd_create(name, os.MFD_CLOEXEC)
    os.ftruncate(fd, size)
    return fd


def attach_memory(fd: int) -> mmap.mmap:
    """Map all of the memory of a descriptor, shared, for reading and writing."""
    return mmap.mmap(fd, os.fstat(fd).st_size)


_TAG: Final = 0x31474E4952434948
_HEADER_BYTES: Final = 4096
_STATE_AT: Final = 256
"""Where in the header the layout of the arm's state is, as JSON; the words are before it."""
# Indices of 8-byte words; different writers have different cache lines.
_KIND_WORD = 0
_JOINTS_WORD = 1
_CAPACITY_WORD = 2
_STATE_LENGTH = 3
_WRITTEN_WORD = 8
_READ_WORD = 16


class RingReader:
    """Reader of a ring of cycle records of `n_joints` joints.

    Args:
        fd: descriptor of memory of `CycleRing.shared`.
        acknowledge: write the position of this reader to the memory, so that the writer counts rows
            overwritten before they were read; for one reader at a time.

    Attributes:
        missed: rows overwritten before this reader read them.

    Raises:
        ValueError: the memory is not such a ring.
    """

    def __init__(self, fd: int, n_joints: int, *, acknowledge: bool = True) -> None:
        self._map(memoryview(attach_memory(fd)), n_joints)
        # Beside another process the row behind the last one written may be half overwritten.
        self._readable = self.capacity - 1
        self._acknowledge = acknowledge
        self._read = self._oldest()

    def _map(self, memory: memoryview, n_joints: int) -> None:
        whole = memory.cast("B")
        self._words = words = whole[:_STATE_AT].cast("q")
        if len(whole) < _HEADER_BYTES or words[_KIND_WORD] != _TAG:
            raise ValueError("this memory is not a ring of cycle records")
        if words[_JOINTS_WORD] != n_joints:
            raise ValueError(f"this ring is for {words[_JOINTS_WORD]} joints, not {n_joints}")
        self.n_joints = n_joints
        self.capacity = int(words[_CAPACITY_WORD])
        description = bytes(whole[_STATE_AT : _STATE_AT + words[_STATE_LENGTH]])
        dtype = cycle_dtype(n_joints, _layout_of(description))
        self.rows: NDArray[np.void] = np.frombuffer(whole[_HEADER_BYTES:], dtype, self.capacity)
        self.missed = 0

    def _oldest(self) -> int:
        return max(0, self._words[_WRITTEN_WORD] - self._readable)

    def drain(self) -> NDArray[np.void]:
        """Return a copy of the rows not read yet, (k,), oldest first."""
        end = self._words[_WRITTEN_WORD]
        begin = max(self._read, self._oldest())
        rows = self.rows.take(np.arange(begin, end), mode="wrap")
        overwritten = min(max(0, self._oldest() - begin), len(rows))
        self.missed += begin - self._read + overwritten
        self._read = end
        if self._acknowledge:
            self._words[_READ_WORD] = end
        return rows[overwritten:]


class CycleRing(RingReader):
    """The last `capacity` cycle records, written in place; `shared` ones can be read elsewhere.

    If records are not drained in time, the oldest are overwritten.

    Args:
        n_joints: number of joints.
        capacity: number of records.
        state: layout of the arm's state (`ControllerProtocol.state`); shared memory states
            its own.
        fd: descriptor of shared memory to map; None for memory of its own.

    Attributes:
        fd: descriptor of the memory, -1 for its own memory.
        written: records written.
        overflow: records overwritten before they were drained.
        arm_state: states of the arm (capacity,), None where records have none.
    """

    def __init__(
        self,
        n_joints: int,
        capacity: int = 4096,
        *,
        state: np.dtype[np.void] | None = None,
        fd: int | None = None,
    ) -> None:
        if fd is None:
            memory = memoryview(bytearray(_bytes_of(n_joints, capacity, state)))
            _describe(memory, n_joints, capacity, state)
            self._map(memory, n_joints)
            self._readable = capacity
            self._acknowledge = True
            self._read = 0
        else:
            super().__init__(fd, n_joints)
        self.fd = -1 if fd is None else fd
        self.written = self._words[_WRITTEN_WORD]
        self.overflow = 0
        # Column views: assigning through them costs a third of assigning to a record's field.
        self.cycle = self.rows["cycle"]
        self.arrival = self.rows["arrival"]
        self.number = self.rows["number"]
        self.gap = self.rows["gap"]
        self.interval = self.rows["interval"]
        self.state = self.rows["state"]
        self.status = self.rows["status"]
        self.mode = self.rows["mode"]
        names = self.rows.dtype.names or ()
        self.arm_state: NDArray[np.void] | None = (
            self.rows[ARM_STATE] if ARM_STATE in names else None
        )
        self.measured = self._block(MEASURED)
        self.commanded = self._block(COMMANDED)

    @classmethod
    def shared(cls, n_joints: int, capacity: int, state: np.dtype[np.void] | None = None) -> Self:
        """Allocate shared memory for `capacity` records."""
        if capacity < 2:
            raise ValueError(f"a shared ring of {capacity} cycle records; at least 2 are needed")
        fd = create_memory("hil-cycles", _bytes_of(n_joints, capacity, state))
        _describe(memoryview(attach_memory(fd)), n_joints, capacity, state)
        return cls(n_joints, fd=fd)

    def commit(self) -> None:
        """Add the row filled last to the ring."""
        words = self._words
        written = self.written
        if words[_READ_WORD] <= written - self.capacity:
            self.overflow += 1
        self.written = words[_WRITTEN_WORD] = written + 1

    def _block(self, names: tuple[str, ...]) -> Array:
        """Return consecutive joint fields of all rows as one array (capacity, count, n)."""
        fields = self.rows.dtype.fields
        assert fields is not None
        return np.ndarray(
            (self.capacity, len(names), self.n_joints),
            np.float64,
            self.rows.view(np.uint8),
            offset=fields[names[0]][1],
            strides=(self.rows.itemsize, 8 * self.n_joints, 8),
        )

    @property
    def slot(self) -> int:
        """Index of the row to fill before `commit`."""
        return self.written % self.capacity

    def last(self, count: int) -> NDArray[np.void]:
        """Return a copy of the newest `count` records (or all of them), oldest first."""
        count = min(count, self.written, self.capacity)
        return self.rows.take(np.arange(self.written - count, self.written), mode="wrap")


def _bytes_of(n_joints: int, capacity: int, state: np.dtype[np.void] | None) -> int:
    """Return the size of a ring."""
    return _HEADER_BYTES + capacity * cycle_dtype(n_joints, state).itemsize


def _describe(
    memory: memoryview, n_joints: int, capacity: int, state: np.dtype[np.void] | None
) -> None:
    """Write the header of a ring."""
    whole = memory.cast("B")
    words = whole[:_STATE_AT].cast("q")
    description = b"" if state is None else json.dumps(state.descr).encode()
    words[_STATE_LENGTH] = len(description)
    whole[_STATE_AT : _STATE_AT + len(description)] = description
    words[_JOINTS_WORD], words[_CAPACITY_WORD], words[_KIND_WORD] = n_joints, capacity, _TAG


def _layout_of(description: bytes) -> np.dtype[np.void] | None:
    """Return the layout of a state, None of no description."""
    if not description:
        return None
    fields = [(name, kind, *map(tuple, shape)) for name, kind, *shape in json.loads(description)]
    return np.dtype(fields)
