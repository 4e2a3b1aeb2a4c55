"""Vectorised decoding of packets, independent of the product.

Layout and codes are those of `tests/drivers/oracle.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tests.drivers import oracle

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Words = NDArray[np.int32]

INIT_LENGTH: Final = 1200
N_ARMS: Final = 4
PER_ARM: Final = 10
REFUSALS: Final = (oracle.DRIVE_OFF_REQUEST, oracle.FOLLOWING_ERROR)
CLOSED: Final = (0, 10, 501)
PAUSES: Final = (500, 502)
MODE, D1 = range(2)  # columns of an axis block
_WORDS: Final = 9


@dataclass(frozen=True, eq=False)
class Packets:
    """Cyclic packets of one length, decoded."""

    number: NDArray[np.int32]  # (m,)
    status: NDArray[np.uint8]  # (m, 4)
    function: NDArray[np.int32]  # (m,) the four function bytes as one number
    words: Words  # (m, n, 9) axis blocks as 4-byte words: mode, D1..D5, extra1..3

    @classmethod
    def of(cls, packets: Sequence[bytes], n_axes: int) -> Packets:
        """Decode the first `n_axes` slots of each packet."""
        length = oracle.length(n_axes)
        joined = b"".join(packet[:length] for packet in packets)
        rows: Words = np.frombuffer(joined, "<i4").reshape(len(packets), length // 4)
        status = np.frombuffer(joined, np.uint8).reshape(len(packets), length)[:, 4:8]
        blocks = rows[:, 3:].reshape(len(packets), n_axes, _WORDS)
        return cls(rows[:, 0], status, rows[:, 2], blocks)

    @property
    def mode(self) -> Words:
        """(m, n) mode of each slot."""
        return self.words[:, :, MODE]

    @property
    def d(self) -> NDArray[np.float32]:
        """(m, n, 8) the numbers of each slot."""
        floats: NDArray[np.float32] = np.ascontiguousarray(self.words[:, :, D1:]).view(np.float32)
        return floats


def next_number(number: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the number of the answer to each packet."""
    return np.where(number == 0x7FFF, 1, number + 1).astype(np.int32)


@dataclass(frozen=True, eq=False)
class Init:
    """Decoded init packet, for the joints of one arm."""

    n_axes: int  # slots of a cyclic packet
    period: float  # s
    arms: tuple[int, ...] | None  # arm of each slot, from 1; None for an impossible map
    slots: tuple[int, ...] | None  # slot of each joint of the arm that is moved; None likewise
    threshold: Array  # (n,) following error, motor revolutions
    current: Array  # (n,) limit, A

    @classmethod
    def of(cls, packet: bytes, arm: int, n_joints: int) -> Init:
        """Decode it for an arm (from 1) of so many joints."""
        ints = np.frombuffer(packet, "<i4")
        table = ints[57:97].reshape(N_ARMS, PER_ARM)
        n_axes = int(ints[3])
        place = {
            int(slot): (row + 1, axis)
            for row in range(N_ARMS)
            for axis, slot in enumerate(table[row].tolist())
            if slot not in (0xFF, -1)
        }
        count = int(np.count_nonzero((table != 0xFF) & (table != -1)))
        arms = slots = None
        if sorted(place) == list(range(n_axes)) and count == n_axes:
            arms = tuple(place[slot][0] for slot in range(n_axes))
            slot_of = {axis: slot for slot, (row, axis) in place.items() if row == arm}
            if all(joint in slot_of for joint in range(n_joints)):
                slots = tuple(slot_of[joint] for joint in range(n_joints))
        row = slice(PER_ARM * (arm - 1), PER_ARM * (arm - 1) + n_joints)
        floats = np.frombuffer(packet, "<f4").astype(np.float64)
        return cls(
            n_axes, int(ints[56]) / 1000.0, arms, slots, floats[260:300][row], floats[137:177][row]
        )


@dataclass(frozen=True, eq=False)
class Gears:
    """Motor revolutions from joint angles, by the formulas of docs/cell-file.md."""

    matrix: Array  # (n, n) motor revolutions per rad
    offset: Array  # (n,) motor revolutions at joint angles of zero

    @classmethod
    def of(cls, table: Any) -> Gears:
        """Return the gears of a cell's `[drive_train]`."""
        kr = np.array(table.gear_ratio, float)
        sign = np.array(table.joint_sign, float)
        shift = np.radians(np.array(table.joint_offset_deg, float))
        k54 = table.k54 or 0.0
        k64 = table.k64 or 0.0
        k65 = table.k65 or 0.0
        turned = np.eye(len(kr))  # of the controller's angles
        if len(kr) >= 6:
            turned[4, 3] = -k54
            turned[5, 4], turned[5, 3] = -k65, k65 * k54 - k64
        turned *= kr[:, np.newaxis] / (2.0 * np.pi)
        return cls(turned * sign, np.array(table.calibration, float) + turned @ shift)

    def motor(self, q: Array) -> Array:
        """Return motor revolutions of joint angles (m, n) [rad]."""
        return np.asarray(q @ self.matrix.T + self.offset)

    def joint(self, motor: Array) -> Array:
        """Return joint angles [rad] of motor revolutions (m, n)."""
        return np.asarray(np.linalg.solve(self.matrix, (motor - self.offset).T).T, np.float64)
