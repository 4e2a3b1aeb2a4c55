"""One cycle as the PC saw it, and the ring buffer that keeps the last of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

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
"""What the controller says of each joint, in the order of the wire (D1..D5, extra1..3)."""
COMMANDED = ("commanded_position", "commanded_velocity")
"""What it was answered."""


def cycle_dtype(n_joints: int) -> np.dtype[np.void]:
    """Layout of one CycleRecord of an arm with `n_joints` joints; fixed size.

    ``cycle`` controller's cycles since its init packet, missed ones counted in; ``number`` wire
    sequence number; ``arrival`` s, for diagnosis only; ``gap`` packets missed before this one;
    ``interval`` index of the interval in open mode, -1 outside; ``state`` `State` after this
    packet; ``status`` status byte of the arm; ``mode`` of each joint; ``age`` cycles since the
    oldest joint value of each of `MEASURED` was sent (0: in this packet). Joint arrays are joint
    side in SI (rad, rad/s), currents motor side in A, ``diagonal_inertia`` kg·m²; ``commanded_*``
    is what this packet was answered, NaN where no set-point was sent. Where the controller makes
    the targets, ``commanded_position`` is its target with the offset added (mode 7, else NaN) and
    ``commanded_velocity`` the velocity fed forward (modes 2 and 8, else NaN).
    """
    joint = (n_joints,)
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = [
        ("cycle", "<i8"),
        ("arrival", "<f8"),
        ("number", "<i4"),
        ("gap", "<i4"),
        ("interval", "<i4"),
        ("state", "u1"),
        ("status", "u1"),
        *((name, "<f8", joint) for name in (*MEASURED, *COMMANDED)),
        ("mode", "<i4", joint),
        ("age", "<u2", (len(MEASURED),)),
    ]
    return np.dtype(fields, align=True)


class CycleRecords:
    """The last `capacity` records, written in place by the session, which never waits.

    Whoever reads them does so beside the writer: `CycleRing` in the same thread, a reader of
    shared memory in another process.

    Args:
        n_joints: n.
        capacity: number of rows, unless they are given.
        rows: (capacity,) of `cycle_dtype`, memory to keep them in (shared with a reader, say).
    """

    def __init__(
        self, n_joints: int, capacity: int = 4096, rows: NDArray[np.void] | None = None
    ) -> None:
        self.n_joints = n_joints
        self.rows = np.zeros(capacity, cycle_dtype(n_joints)) if rows is None else rows
        self.capacity = len(self.rows)
        # Column views: assigning through them costs a third of assigning to a record's field.
        self.cycle = self.rows["cycle"]
        self.arrival = self.rows["arrival"]
        self.number = self.rows["number"]
        self.gap = self.rows["gap"]
        self.interval = self.rows["interval"]
        self.state = self.rows["state"]
        self.status = self.rows["status"]
        self.mode = self.rows["mode"]
        self.age = self.rows["age"]
        joint_bytes = 8 * n_joints
        self.measured = self._block(MEASURED[0], len(MEASURED), joint_bytes)
        self.commanded = self._block(COMMANDED[0], len(COMMANDED), joint_bytes)
        self._written = 0

    def _block(self, first: str, count: int, joint_bytes: int) -> Array:
        """Consecutive joint fields of all rows as one array (capacity, count, n)."""
        fields = self.rows.dtype.fields
        assert fields is not None
        return np.ndarray(
            (self.capacity, count, self.n_joints),
            np.float64,
            self.rows.view(np.uint8),
            offset=fields[first][1],
            strides=(self.rows.itemsize, joint_bytes, 8),
        )

    @property
    def slot(self) -> int:
        """Index of the row to fill before `commit`."""
        return self._written % self.capacity

    def commit(self) -> None:
        """Make the row at `slot` part of the ring."""
        self._written += 1

    def last(self, count: int) -> NDArray[np.void]:
        """A copy of the newest `count` records (fewer if there are fewer), oldest first."""
        count = min(count, self._written, self.capacity)
        return self.rows.take(np.arange(self._written - count, self._written), mode="wrap")


class CycleRing(CycleRecords):
    """Records drained by the thread that writes them.

    Where it drains too rarely, the oldest records are overwritten and counted in `overflow`.
    Drained records stay readable through `last` until they are overwritten.
    """

    def __init__(self, n_joints: int, capacity: int = 4096) -> None:
        super().__init__(n_joints, capacity)
        self._read = 0
        self._lost = 0

    @property
    def overflow(self) -> int:
        """Records overwritten before they were drained, so far."""
        return self._lost + max(0, self._written - self._read - self.capacity)

    def drain(self) -> NDArray[np.void]:
        """A copy of the records not drained yet, (k,), oldest first."""
        self._lost = self.overflow
        fresh = self.last(self._written - self._read)
        self._read = self._written
        return fresh
