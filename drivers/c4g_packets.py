"""C4G Open packets: bytes to numbers and back, bit for bit.

All fields are little-endian int32 or IEEE float32 without padding. The cyclic layout is the same
in both directions; the controller sends first and every reply has the received number plus one.
Quantities are as on the wire (motor revolutions, revolutions per cycle, A).
Layout and codes: facts on the C4G Open wire, sections 2 to 4.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import ClassVar, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.arrays import Array
from drivers.errors import PacketError

LAST_NUMBER: Final = 0x7FFF
INIT_NUMBER: Final = 10
INIT_LENGTH: Final = 1200
HEADER_LENGTH: Final = 12
AXIS_LENGTH: Final = 36
MAX_AXES: Final = 20
MAX_CYCLIC_LENGTH: Final = HEADER_LENGTH + AXIS_LENGTH * MAX_AXES
MAX_PACKET_BYTES: Final = 1500
"""Bytes of the longest packet (the buffer of the manufacturer's library)."""
N_ARMS: Final = 4
AXES_PER_ARM: Final = 10
NO_SLOT: Final = 0xFF

DRIVE_ON: Final = 5
"""Status byte of an arm whose drive is on, controller to PC."""
EXIT_FROM_OPEN: Final = 1
"""Status byte that requests the end of open mode, PC to controller."""

_HEADER: Final = struct.Struct("<i4s4s")
_NUMBER: Final = struct.Struct("<i")


class Mode(IntEnum):
    """Mode of one axis on the wire. 3 and 6 exist but their meaning is unknown."""

    CLOSED = 0
    POSITION_FEED_FORWARD = 1
    FEED_FORWARD = 2
    POSITION = 4
    POSITION_RELATIVE = 5
    DELTA_POSITION = 7
    VELOCITY = 8
    DELTA_CURRENT = 9
    CLOSED_MIRRORED = 10
    POSITION_FEED_FORWARD_PRIMED = 11
    FEED_FORWARD_PRIMED = 12
    POSITION_PRIMED = 14
    POSITION_RELATIVE_PRIMED = 15
    DELTA_POSITION_PRIMED = 17
    PAUSE_BY_PC = 500
    DRIVING_ON = 501
    PAUSE_BY_CONTROLLER = 502
    END_OF_SESSION = 504
    DRIVE_OFF_REQUEST = 505
    RESTART = 506
    FOLLOWING_ERROR = 508


MODE_FIELDS: Final[Mapping[int, tuple[int, ...]]] = {
    Mode.POSITION_FEED_FORWARD: (1, 2, 4, 5),
    Mode.FEED_FORWARD: (4, 5),
    Mode.POSITION: (1, 2),
    Mode.POSITION_RELATIVE: (1, 2),
    Mode.DELTA_POSITION: (1,),
    Mode.VELOCITY: (4,),
    Mode.DELTA_CURRENT: (5,),
    Mode.POSITION_FEED_FORWARD_PRIMED: (1, 2, 4, 5),
    Mode.FEED_FORWARD_PRIMED: (4, 5),
    Mode.POSITION_PRIMED: (1, 2),
    Mode.POSITION_RELATIVE_PRIMED: (1, 2),
    Mode.DELTA_POSITION_PRIMED: (1,),
}
"""Fields of D1..D5 that a reply contains in each open mode; all others are zero."""

AXIS_DTYPE: Final = np.dtype([("mode", "<i4"), ("d", "<f4", (5,)), ("extra", "<f4", (3,))])
"""One axis block: mode, D1..D5, extra1..extra3."""

_PER_ARM: Final = (N_ARMS, AXES_PER_ARM)
INIT_DTYPE: Final = np.dtype(
    [
        ("number", "<i4"),
        ("fields_per_packet", "<i4"),
        ("fields_per_axis", "<i4"),
        ("n_axes", "<i4"),
        ("open_mode", "<i4", _PER_ARM),
        ("header_types", "<i4", (3,)),
        ("axis_types", "<i4", (9,)),
        ("sample_time", "<i4"),
        ("open_axes_map", "<i4", _PER_ARM),
        ("calibration", "<f4", _PER_ARM),
        ("current_limit", "<f4", _PER_ARM),
        ("version", "<i4", (3,)),
        ("kinematic_influence", "<f4", _PER_ARM),
        ("gear_ratio", "<f4", _PER_ARM),
        ("following_error", "<f4", _PER_ARM),
    ]
)
"""The init packet. Arrays (4, 10) are indexed [arm - 1, axis - 1]."""


def next_number(number: int) -> int:
    """Return the number of the reply to packet `number`; 0x7FFF is followed by 1."""
    return 1 if number >= LAST_NUMBER else number + 1


def cyclic_length(n_axes: int) -> int:
    """Return the length of a cyclic packet with `n_axes` open axes, bytes."""
    return HEADER_LENGTH + AXIS_LENGTH * n_axes


def packet_number(packet: bytes) -> int:
    """Return the sequence number of any packet; PacketError outside 1..0x7FFF."""
    if len(packet) < HEADER_LENGTH:
        raise PacketError("length", len(packet), f"at least the {HEADER_LENGTH} bytes of a header")
    number: int = _NUMBER.unpack_from(packet)[0]
    if not 1 <= number <= LAST_NUMBER:
        raise PacketError("number", number, f"1..{LAST_NUMBER}")
    return number


def is_init(packet: bytes) -> bool:
    """Whether this is the init packet: number 10 *and* 1200 bytes.

    Cyclic packets have the number 10 too, after the numbers wrap around.
    """
    return len(packet) == INIT_LENGTH and _NUMBER.unpack_from(packet)[0] == INIT_NUMBER


def echo(packet: bytes) -> bytes:
    """Return the packet with the number of its reply: the reply to sync and init packets."""
    return _NUMBER.pack(next_number(packet_number(packet))) + packet[4:]


@dataclass(frozen=True, eq=False, slots=True)
class CyclicPacket:
    """One packet of the cyclic exchange, in either direction.

    `status` and `functionality` have one byte per arm; the latter is always zero towards the
    controller. `axes` (n_axes,) of `AXIS_DTYPE`, in slot order, is read-only after `decode`.
    """

    number: int
    status: bytes
    functionality: bytes
    axes: NDArray[np.void]

    @classmethod
    def decode(cls, packet: bytes, n_axes: int) -> CyclicPacket:
        """Decode a packet with `n_axes` slots; the rest is ignored. Raises PacketError."""
        if not HEADER_LENGTH + AXIS_LENGTH * n_axes <= len(packet) <= MAX_CYCLIC_LENGTH:
            raise PacketError(
                "length",
                len(packet),
                f"{cyclic_length(n_axes)} bytes for {n_axes} axes, or up to "
                f"{MAX_CYCLIC_LENGTH} with an unused tail",
            )
        number, status, functionality = _HEADER.unpack_from(packet)
        if not 1 <= number <= LAST_NUMBER:
            raise PacketError("number", number, f"1..{LAST_NUMBER}")
        axes = np.frombuffer(packet, AXIS_DTYPE, n_axes, HEADER_LENGTH)
        return cls(number, status, functionality, axes)

    @classmethod
    def zeros(cls, number: int, n_axes: int) -> CyclicPacket:
        """Return a packet with every field zero, whose `axes` may be filled in place."""
        return cls(number, bytes(N_ARMS), bytes(N_ARMS), np.zeros(n_axes, AXIS_DTYPE))

    def encode(self) -> bytes:
        """Return the 12 + 36 n bytes."""
        return _HEADER.pack(self.number, self.status, self.functionality) + self.axes.tobytes()


class OpenAxis(NamedTuple):
    """Position of an open axis: arm from 1, logical axis and slot from 0."""

    arm: int
    axis: int
    slot: int


def _per_axis(name: str) -> property:
    """Return a property of the field `name` (4, 10) of an init packet."""
    return property(lambda init: init.record[name][0])


@dataclass(frozen=True, eq=False, slots=True)
class InitPacket:
    """The controller's description of its arms, before the cyclic exchange.

    Arrays are (4, 10), as received; entries of axes that are not open may hold anything, NaN
    included.

    Attributes:
        record: (1,) of `INIT_DTYPE`, every field.
        open_axes_map: slot of each logical axis; 0xFF (or -1) where the axis is not open.
        calibration: motor revolutions at the joints' zero.
        current_limit: A.
        kinematic_influence: coupling coefficients; entries 3, 4, 5 of an arm are k54, k64, k65.
        gear_ratio: TxRate, signed motor revolutions per joint revolution.
        following_error: thresholds in motor revolutions.
    """

    attachment: ClassVar[str] = "init_packet.bin"
    record: NDArray[np.void] = field(repr=False)
    open_axes_map = _per_axis("open_axes_map")
    calibration = _per_axis("calibration")
    current_limit = _per_axis("current_limit")
    kinematic_influence = _per_axis("kinematic_influence")
    gear_ratio = _per_axis("gear_ratio")
    following_error = _per_axis("following_error")

    @classmethod
    def decode(cls, packet: bytes) -> InitPacket:
        """Decode 1200 bytes; raises PacketError."""
        if len(packet) != INIT_LENGTH:
            raise PacketError("length", len(packet), f"{INIT_LENGTH} bytes")
        init = cls(np.frombuffer(packet, INIT_DTYPE))
        if init.number != INIT_NUMBER:
            raise PacketError("number", init.number, f"{INIT_NUMBER} (init)")
        if not 1 <= init.n_axes <= MAX_AXES:
            raise PacketError("n_axes", init.n_axes, f"1..{MAX_AXES}")
        return init

    @classmethod
    def build(
        cls, n_axes: int, sample_time: int, arm_1: Mapping[str, ArrayLike], **fields: ArrayLike
    ) -> InitPacket:
        """Return an init packet with arm 1's first `n_axes` axes open in slots 0..n_axes-1.

        `arm_1` has per-axis fields of arm 1 (`calibration`, ...), (k,) with k <= 10, zero beyond;
        `fields` are other fields of `INIT_DTYPE`, in full.
        """
        record = np.zeros(1, INIT_DTYPE)
        record["number"] = INIT_NUMBER
        record["fields_per_packet"] = 3
        record["fields_per_axis"] = 9
        record["n_axes"] = n_axes
        record["sample_time"] = sample_time
        record["open_mode"] = -1
        record["open_mode"][0, 0, :n_axes] = Mode.CLOSED
        record["open_axes_map"] = NO_SLOT
        record["open_axes_map"][0, 0, :n_axes] = np.arange(n_axes)
        for name, values in arm_1.items():
            row = np.asarray(values)
            record[name][0, 0, : len(row)] = row
        for name, value in fields.items():
            record[name] = value
        return cls(record)

    def encode(self) -> bytes:
        """Return the 1200 bytes."""
        return self.record.tobytes()

    @property
    def number(self) -> int:
        """10 from a controller, 11 in the reply."""
        return int(self.record["number"][0])

    @property
    def n_axes(self) -> int:
        """Open axes over all arms: the axis blocks of each cyclic packet."""
        return int(self.record["n_axes"][0])

    @property
    def sample_time(self) -> int:
        """Cycle in ms, as on the wire."""
        return int(self.record["sample_time"][0])

    @property
    def period(self) -> float:
        """Cycle in s."""
        return self.sample_time / 1000.0

    @property
    def version(self) -> tuple[int, int, int]:
        """Major, minor and build number of the controller's software."""
        major, minor, build = (int(part) for part in self.record["version"][0])
        return major, minor, build

    def wrist_coupling(self, arm: int = 1) -> tuple[float, float, float]:
        """Return (k54, k64, k65) of one arm."""
        k54, k64, k65 = (float(k) for k in self.kinematic_influence[arm - 1, 3:6])
        return k54, k64, k65

    def stated(
        self, limit: Literal["current_limit", "following_error"], arm: int, n_joints: int
    ) -> Array:
        """Return a limit of the first joints of an arm, from 1 (n,) [A, motor revolutions]."""
        values = self.current_limit if limit == "current_limit" else self.following_error
        return np.asarray(values[arm - 1, :n_joints], dtype=np.float64)

    def open_axes(self) -> Sequence[OpenAxis]:
        """Return the open axes of all arms in slot order; PacketError for an invalid map."""
        table = self.open_axes_map
        axes = [
            OpenAxis(arm + 1, axis, int(table[arm, axis]))
            for arm in range(N_ARMS)
            for axis in range(AXES_PER_ARM)
            if table[arm, axis] not in (NO_SLOT, -1)
        ]
        axes.sort(key=lambda open_axis: open_axis.slot)
        slots = [open_axis.slot for open_axis in axes]
        if slots != list(range(self.n_axes)):
            raise PacketError(
                "open_axes_map", slots, f"each slot 0..{self.n_axes - 1} for exactly one axis"
            )
        return axes


class PacketSequence:
    """Follows the controller's packet numbers (1..0x7FFF, then 1 again).

    A number at most `window` ahead of the last is new. The window is what can be missed before
    silence ends the session, so a number further ahead cannot belong to the same session.

    Attributes:
        last: number of the last packet replied to.
        cycle: the controller's cycles since its init packet, missed ones included.
        broken: a silence ended the sequence: the next number, whichever it is, is new.
    """

    def __init__(self) -> None:
        self.last = 0
        self.cycle = 0
        self.broken = False
        self._window = LAST_NUMBER // 2

    def restart(self, number: int, window: float) -> None:
        """Count from this number on, accepting at most `window` cycles ahead."""
        self.last = number
        self.cycle = 0
        self.broken = False
        # Beyond half of all numbers, ahead could not be distinguished from behind.
        self._window = max(1, min(int(window), LAST_NUMBER // 2))

    def distance(self, number: int) -> int:
        """Return the cycles from the last packet replied to to this one, 0..0x7FFE."""
        return (number - self.last) % LAST_NUMBER

    def is_duplicate(self, number: int) -> bool:
        """Whether this is the number of the last packet."""
        return number == self.last and not self.broken

    def is_stale(self, number: int) -> bool:
        """Whether this cannot be a later packet of the same session."""
        return not self.broken and not 1 <= self.distance(number) <= self._window

    def leads_to(self, number: int, missed: int) -> bool:
        """Whether this number follows the last with at most `missed` in between, or is first."""
        return self.broken or self.last == 0 or self.distance(number) <= missed + 1

    def accept(self, number: int) -> int:
        """Advance to this number; return how many packets were missed before it."""
        ahead = self.distance(number)
        if ahead == 0 or ahead > self._window:
            ahead = 1  # after a silence, whose length the numbers do not give
        self.last = number
        self.cycle += ahead
        self.broken = False
        return ahead - 1
