"""The CAN profile without I/O: frames, codecs, bus load, and both ends of a session.

The DBC files in this folder describe the frames for CAN tools. Standard (11-bit) identifiers; lower
ones have priority on the bus, so replies come first.

Start packets, and others that cyclic frames cannot carry, are sent as segments. After the init
packet, cyclic packets are sent as cyclic frames, and a reply is sent as its packet was. FD: two
frames up, one down, numbers as in C4G packets. Classic: packed integers in frames of eight bytes.
Positions are rounded to 2^-16 motor revolutions. A number outside its field is sent as the most
negative value of the field and read as NaN, which the guard refuses. D4 is computed from
consecutive D3, and the D2 of a reply from consecutive D1.

Most replies return what the controller sent (drive off, axes closed). The PC has some of these
values only aged or rounded, so such an axis is *mirrored*: not sent, and filled in at the
controller's end from the packet that it sent.
"""

from __future__ import annotations

import math
import struct
import zlib
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import cycle
from typing import ClassVar, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import Ages
from drivers.errors import DriverError, PacketError
from drivers.packets import (
    AXIS_DTYPE,
    DRIVE_ON,
    EXIT_FROM_OPEN,
    HEADER_LENGTH,
    LAST_NUMBER,
    N_ARMS,
    CyclicPacket,
    InitPacket,
    Mode,
    cyclic_length,
    is_init,
    next_number,
)
from drivers.transports.base import TransportError

Words = NDArray[np.int32]
Array = NDArray[np.float64]

MAX_AXES: Final = 6
PAYLOADS_FD: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Bytes that a CAN FD frame can carry."""

FD_DOWN: Final = 0x100
FD_UP_A: Final = 0x110
FD_UP_B: Final = 0x111
CLASSIC_DOWN: Final = (0x120, 0x121, 0x122)
CLASSIC_UP_HEADER: Final = 0x130
CLASSIC_UP_AXIS: Final = tuple(range(0x131, 0x131 + MAX_AXES))
SEGMENT_DOWN: Final = 0x180
SEGMENT_UP: Final = 0x181

# Classic: packed integers.
REVOLUTION_BITS: Final = 27
DIFFERENCE_BITS: Final = 17
CURRENT_BITS: Final = 12
COUNTS_PER_REVOLUTION: Final = 65536
COUNTS_PER_AMPERE: Final = 64
UP_COUNTER_BITS: Final = 4
DOWN_COUNTER_BITS: Final = 6

FUNCTIONALITY: Final = 4 * MAX_AXES
"""Index of the functionality word, the last of the slow values: D2, extra1..3 of each axis go up
one value per cycle, in turn, then this."""


class Frame(NamedTuple):
    """One data frame with a standard identifier."""

    id: int
    data: bytes


FD_MODE_CODES: Final[dict[int, int]] = {
    **{mode: mode for mode in range(18)},
    **{mode: mode - 300 for mode in range(500, 509)},
}
"""Mode on the C4G wire to its byte in FD frames."""
CLASSIC_MODE_CODES: Final[dict[int, int]] = {
    mode: code
    for code, mode in enumerate((0, 1, 2, 4, 5, 7, 8, 9, 10, 500, 501, 502, 504, 505, 506, 508))
}
"""Mode on the C4G wire to its four bits in classic frames."""


class Action:
    """Action for one axis in a classic frame: two bits."""

    MIRROR: Final = 0
    SET: Final = 1
    SET_AND_EXIT: Final = 2
    WORD: Final = 3


class Word:
    """Meaning of the D1 field of an axis whose action is WORD; EXIT is added to any of them."""

    MIRROR: Final = 0
    CLOSED_ZERO: Final = 1
    ZERO: Final = 2
    DRIVE_OFF: Final = 3
    FOLLOWING_ERROR: Final = 4
    EXIT: Final = 16


class CanError(TransportError):
    """The bus cannot carry this session."""

    def __init_subclass__(cls, *, remedy: str) -> None:
        cls.remedy = remedy

    def __init__(self, reason: str) -> None:
        DriverError.__init__(self, f"CAN: {reason}; {self.remedy}")
        self.link, self.reason = "CAN", reason


class CanAxesError(CanError, remedy="the profile carries one to six axes of arm 1; use UDP"):
    """The controller opens axes that the frames cannot carry."""


class CanBusLoadError(CanError, remedy="use a longer cycle, a faster bus or fewer axes"):
    """The frames of a cycle take too large a share of it."""


class CanModeError(
    CanError, remedy="the profile moves axes in modes 4, 5 and 7; use UDP for others"
):
    """A mode or a reply that the frames cannot carry."""


class CanValueError(CanError, remedy="check calibration and gear ratios"):
    """A number outside the range of its field."""


ProfileName = Literal["fd", "classic"]
LOAD_LIMIT: Final = 0.70
"""Largest share of a cycle for the frames, with worst-case stuffing."""
_CLASSIC_HEAD: Final = 1 + 11 + 3 + 4  # start, identifier, RTR IDE r0, length
_TAIL: Final = 1 + 2 + 7 + 3  # CRC delimiter, acknowledge, end of frame, interframe space
_FD_ARBITRATION: Final = 1 + 11 + 5  # start, identifier, RRS IDE FDF res BRS
_FD_CONTROL: Final = 1 + 4  # ESI, length


def classic_bits(n_bytes: int) -> int:
    """Return the bits of a classic data frame with 0..8 bytes, with worst-case stuffing.

    Bits of ISO 11898-1 with 11-bit identifiers, interframe space included. A classic frame is
    stuffed up to its CRC; an FD frame up to its data, and its CRC field at fixed places. The worst
    case is a stuff bit after the first five equal bits and then after every fourth.
    """
    stuffable = _CLASSIC_HEAD + 8 * n_bytes + 15
    return stuffable + (stuffable - 1) // 4 + _TAIL


def fd_bits(n_bytes: int) -> tuple[int, int]:
    """Return the bits of an FD frame in its arbitration and data phases; see `classic_bits`."""
    crc, fixed = (17, 6) if n_bytes <= 16 else (21, 7)
    payload = _FD_CONTROL + 8 * n_bytes
    early = (_FD_ARBITRATION - 1) // 4
    late = (_FD_ARBITRATION + payload - 1) // 4 - early
    return _FD_ARBITRATION + early + _TAIL, payload + late + 4 + crc + fixed


@dataclass(frozen=True)
class BusRates:
    """Profile and bit rates, bit/s; on FD `bitrate` is that of the arbitration phase."""

    profile: ProfileName
    bitrate: int = 1_000_000
    data_bitrate: int = 5_000_000

    def duration(self, n_bytes: int) -> float:
        """Return the longest time on the bus of one frame with this payload, s."""
        nominal, data = fd_bits(n_bytes) if self.profile == "fd" else (classic_bits(n_bytes), 0)
        return nominal / self.bitrate + data / self.data_bitrate

    def cycle_payloads(self, n_axes: int) -> tuple[int, ...]:
        """Return the bytes of each frame of one cycle, in both directions."""
        if self.profile == "fd":
            return 64, 48, 64
        return (8,) * (1 + n_axes + (n_axes + 1) // 2)

    def load(self, n_axes: int, period: float) -> float:
        """Return the share of the bus used by the cyclic frames; 1 is a full bus."""
        return sum(self.duration(size) for size in self.cycle_payloads(n_axes)) / period

    def require_load(self, n_axes: int, period: float) -> None:
        """Check that the frames of a cycle fit `LOAD_LIMIT`; raises CanBusLoadError."""
        load = self.load(n_axes, period)
        if load > LOAD_LIMIT:
            count = len(self.cycle_payloads(n_axes))
            raise CanBusLoadError(
                f"{count} {self.profile} frames for {n_axes} axes fill {100.0 * load:.1f} % of a "
                f"cycle of {1e3 * period:g} ms; allowed is {100.0 * LOAD_LIMIT:.0f} %"
            )


WORDS_PER_AXIS: Final = 9
NEVER: Final = 0xFFFF
"""Age of a value that was never received, and largest age."""
_D1, _D2, _D3, _D4, _D5 = range(1, 6)
_SLOW: Final = (2, 6, 7, 8)
"""Columns of D2, extra1..3 in an axis block of nine words (mode first)."""
_UNKNOWN: Final = int(np.float32(np.nan).view(np.int32))


class SlowStore:
    """Latest slow values (one is sent per cycle, in turn), and their ages.

    `ages` (n, 8) are cycles since each of D1..D5, extra1..3 was sent, `NEVER` before the first.
    """

    def __init__(self, n_axes: int) -> None:
        self._shape = (n_axes, len(_SLOW))
        self.forget()

    def forget(self) -> None:
        """Discard all values."""
        self.functionality = bytes(4)
        self._values: Words = np.full(self._shape, _UNKNOWN, np.int32)
        self._elapsed = np.full(self._shape, NEVER, np.int64)
        self.ages = self._as_ages(self._elapsed)
        self._last: int | None = None

    def update(self, number: int, index: int, value: bytes, words: Words) -> int:
        """Store the slow value of a cycle and write all of them into its words, (n, 9).

        Returns the cycles since the previous update, 0 for the first; negative if this cycle is
        older, whose slow values are unknown.
        """
        ahead = 0 if self._last is None else (number - self._last) % LAST_NUMBER
        if ahead > LAST_NUMBER // 2 or (ahead == 0 and self._last is not None):
            words[:, _SLOW] = _UNKNOWN
            self.ages = self._as_ages(np.full_like(self._elapsed, NEVER))
            return -1
        self._last = number
        np.minimum(self._elapsed + ahead, NEVER, out=self._elapsed)
        field, axis = divmod(index, MAX_AXES)
        if index == FUNCTIONALITY:
            self.functionality = value
        elif field < len(_SLOW) and axis < self._shape[0]:
            self._values[axis, field] = np.frombuffer(value, np.int32)[0]
            self._elapsed[axis, field] = 0
        self._values[self._elapsed == NEVER] = _UNKNOWN
        words[:, _SLOW] = self._values
        self.ages = self._as_ages(self._elapsed)
        return ahead

    def _as_ages(self, elapsed: NDArray[np.int64]) -> Ages:
        ages: Ages = np.zeros((self._shape[0], WORDS_PER_AXIS - 1), np.uint16)
        ages[:, [column - 1 for column in _SLOW]] = elapsed
        return ages


class AxisReply(NamedTuple):
    """The reply for one axis; `d1` and `d2` are not used if it is mirrored."""

    mirrored: bool
    mode: int
    d1: float = 0.0
    d2: float = 0.0


class Reply(NamedTuple):
    """One reply; `status` is the status byte of the arm."""

    number: int
    status: int
    axes: tuple[AxisReply, ...]


@dataclass(frozen=True, eq=False)
class Sent:
    """The cyclic packet that a reply belongs to, as sent or received at one end.

    `status` is that of arm 1, `words` (n, 9) its axis blocks; `mask` (n, 9) has all bits set in the
    words that a mirrored axis returns, none if it cannot be mirrored.
    """

    number: int
    status: int
    words: Words
    modes: list[int]
    mask: Words

    @classmethod
    def of(cls, packet: bytes, n_axes: int) -> Sent:
        """Read a packet."""
        words = words_of(packet, n_axes)
        modes: list[int] = words[:, 0].tolist()
        mask = _mirrored(packet[4], tuple(modes))
        return cls(int.from_bytes(packet[:4], "little", signed=True), packet[4], words, modes, mask)


def words_of(packet: bytes, n_axes: int) -> Words:
    """Return the axis blocks of a cyclic packet as (n, 9) words, a read-only view."""
    count = n_axes * AXIS_DTYPE.itemsize // 4
    return np.frombuffer(packet, np.int32, count, HEADER_LENGTH).reshape(n_axes, WORDS_PER_AXIS)


_RETURNED: Final[Mapping[int, int]] = {
    Mode.CLOSED: _D2 + 1,
    Mode.DRIVING_ON: _D2 + 1,
    Mode.CLOSED_MIRRORED: _D5 + 1,
}
"""Number of words that a mirrored axis returns with its drive on; all with the drive off."""


@lru_cache(maxsize=256)
def _mirrored(status: int, modes: tuple[int, ...]) -> Words:
    mask = np.zeros((len(modes), WORDS_PER_AXIS), np.int32)
    for slot, mode in enumerate(modes):
        words = _RETURNED.get(mode, 0) if status == DRIVE_ON else WORDS_PER_AXIS
        mask[slot, :words] = -1
    return mask


def read_reply(reply: bytes, sent: Sent) -> Reply:
    """Decode a reply; raises CanModeError, CanValueError if the frames cannot carry it."""
    words = words_of(reply, len(sent.words))
    mirrored = (sent.mask[:, 0] != 0) & (words == (sent.words & sent.mask)).all(axis=1)
    floats = words.view(np.float32)
    modes: list[int] = words[:, 0].tolist()
    surplus = np.flatnonzero((floats[:, _D2 + 1 :] != 0.0).any(axis=1) & ~mirrored)
    if surplus.size:
        slot = int(surplus[0])
        raise CanModeError(
            f"the reply in mode {modes[slot]} (slot {slot}) needs more than D1 and D2"
        )
    targets = floats[:, _D1 : _D2 + 1]
    for slot, field in np.argwhere(~np.isfinite(targets) & ~mirrored[:, None]):
        raise _out_of_range(f"D{field + 1}", slot, targets[slot, field], "finite numbers")
    axes = zip(mirrored.tolist(), modes, *targets.T.tolist(), strict=True)
    number = int.from_bytes(reply[:4], "little", signed=True)
    return Reply(number, reply[4], tuple(AxisReply(*axis) for axis in axes))


def _out_of_range(field: str, slot: int, value: float, limits: str) -> CanValueError:
    return CanValueError(f"{field} of slot {slot} is {value:.9g}; its field holds {limits}")


def write_reply(reply: Reply, sent: Sent) -> bytes:
    """Encode a reply at the controller's end: 12 + 36 n bytes."""
    axes = CyclicPacket.zeros(reply.number, len(reply.axes)).axes
    words = axes.view(np.int32).reshape(-1, WORDS_PER_AXIS)
    floats = words.view(np.float32)
    for slot, axis in enumerate(reply.axes):
        if axis.mirrored:
            words[slot] = sent.words[slot] & sent.mask[slot]
        else:
            words[slot, 0] = axis.mode
            floats[slot, [_D1, _D2]] = axis.d1, axis.d2
    status = bytes((reply.status, *bytes(N_ARMS - 1)))
    return CyclicPacket(reply.number, status, bytes(N_ARMS), axes).encode()


class UpSet(NamedTuple):
    """Decoded frames of one cycle; slow values in `words` (n, 9) are zero.

    `slow` is index and four bytes of the slow value; `counts` (n,) D3 in counts, NaN out of range,
    to compute D4 from; None if D4 was sent.
    """

    number: int
    status: int
    words: Words
    slow: tuple[int, bytes]
    counts: Array | None = None


class _Frames:
    """What both codecs share; a codec has the frames of one profile for 1..6 axes.

    Cycle numbers in frames are modulo `up_modulus` and `down_modulus`; a set must be complete
    within `span_cycles`, because its number repeats. `lengths` are bytes by identifier.
    """

    up_ids: tuple[int, ...]
    down_ids: tuple[int, ...]
    lengths: Mapping[int, int]
    up_modulus: ClassVar[int]
    down_modulus: ClassVar[int]
    span_cycles: ClassVar[int]
    _up_mask: ClassVar[int]
    _down_mask: ClassVar[int]
    _codes: ClassVar[Mapping[int, int]]

    def __init__(self, n_axes: int) -> None:
        self.n_axes = n_axes

    def number(self, frame: Frame) -> int:
        """Return the cycle number in a frame."""
        mask = self._down_mask if frame.id in self.down_ids else self._up_mask
        return int.from_bytes(frame.data[:2], "little") & mask

    def is_reply_to(self, frame: Frame, sent_number: int) -> bool:
        """Whether a frame down belongs to the reply to that packet."""
        return self.number(frame) == next_number(sent_number) & self._down_mask

    def _code(self, mode: int, slot: int) -> int:
        code = self._codes.get(mode)
        if code is None:
            raise CanModeError(f"mode {mode} (slot {slot}) has no code")
        return code


_UP_A: Final = np.dtype(
    [("number", "<u2"), ("mode", "u1", (6,)), ("d1", "<f4", (6,)), ("d3", "<f4", (6,)),
     ("d4", "<f4", (2,))]
)  # fmt: skip
_UP_B: Final = np.dtype(
    [("number", "<u2"), ("status", "u1"), ("slow", "u1"), ("value", "V4"), ("d4", "<f4", (4,)),
     ("d5", "<f4", (6,))]
)  # fmt: skip
_DOWN: Final = struct.Struct("<HBB6B2x6f6f4x")
"""number, status, mirrored axes (a bit each), modes, D1, D2"""
_FD_MODES: Final = {code: mode for mode, code in FD_MODE_CODES.items()}


class FdCodec(_Frames):
    """Frames of the FD profile."""

    up_ids = (FD_UP_A, FD_UP_B)
    down_ids = (FD_DOWN,)
    lengths: Mapping[int, int] = {
        FD_UP_A: _UP_A.itemsize,
        FD_UP_B: _UP_B.itemsize,
        FD_DOWN: _DOWN.size,
    }
    up_modulus = down_modulus = LAST_NUMBER
    span_cycles = 1000
    _up_mask = _down_mask = 0xFFFF
    _codes = FD_MODE_CODES

    def up(self, number: int, status: int, words: Words, slow: tuple[int, bytes]) -> list[Frame]:
        """Encode a packet; CanModeError for a mode without a code."""
        modes = [self._code(mode, slot) for slot, mode in enumerate(words[:, 0].tolist())]
        values = np.zeros((MAX_AXES, WORDS_PER_AXIS), np.int32)
        values[: self.n_axes] = words
        floats = values.view(np.float32)
        a, b = np.zeros((), _UP_A), np.zeros((), _UP_B)
        a["number"] = b["number"] = number
        a["mode"][: self.n_axes] = modes
        a["d1"], a["d3"], a["d4"] = floats[:, _D1], floats[:, _D3], floats[:2, _D4]
        b["status"], b["slow"], b["value"] = status, slow[0], np.void(slow[1])
        b["d4"], b["d5"] = floats[2:, _D4], floats[:, _D5]
        return [Frame(FD_UP_A, a.tobytes()), Frame(FD_UP_B, b.tobytes())]

    def read_up(self, payloads: Sequence[bytes]) -> UpSet:
        """Decode the frames of one cycle; PacketError for an unknown mode code."""
        n = self.n_axes
        first, second = payloads
        a, b = np.frombuffer(first, _UP_A)[0], np.frombuffer(second, _UP_B)[0]
        words = np.zeros((MAX_AXES, WORDS_PER_AXIS), np.int32)
        floats = words.view(np.float32)
        words[:n, 0] = [_fd_mode(code) for code in first[2 : 2 + n]]
        floats[:, _D1], floats[:, _D3], floats[:, _D5] = a["d1"], a["d3"], b["d5"]
        floats[:2, _D4], floats[2:, _D4] = a["d4"], b["d4"]
        return UpSet(int(a["number"]), second[2], words[:n], (second[3], second[4:8]))

    def down(self, reply: Reply, sent: Sent) -> list[Frame]:  # noqa: ARG002 - as classic frames
        """Encode a reply; CanModeError for a mode without a code."""
        axes = (*reply.axes, *(AxisReply(False, 0),) * (MAX_AXES - self.n_axes))
        payload = _DOWN.pack(
            reply.number,
            reply.status,
            sum(axis.mirrored << slot for slot, axis in enumerate(axes)),
            *(self._code(axis.mode, slot) for slot, axis in enumerate(axes)),
            *(0.0 if axis.mirrored else axis.d1 for axis in axes),
            *(0.0 if axis.mirrored else axis.d2 for axis in axes),
        )
        return [Frame(FD_DOWN, payload)]

    def read_down(self, payloads: Sequence[bytes], sent: Sent) -> Reply:  # noqa: ARG002
        """Decode a reply; PacketError for an unknown mode code."""
        number, status, mirrored, *fields = _DOWN.unpack(payloads[0])
        codes, d1, d2 = (fields[at : at + self.n_axes] for at in range(0, 3 * MAX_AXES, MAX_AXES))
        axes = tuple(
            AxisReply(bool(mirrored >> slot & 1), _fd_mode(codes[slot]), d1[slot], d2[slot])
            for slot in range(self.n_axes)
        )
        return Reply(number, status, axes)


def _fd_mode(code: int) -> int:
    mode = _FD_MODES.get(code)
    if mode is None:
        raise PacketError("mode code", code, "one of the CAN FD profile")
    return mode


_ABSOLUTE: Final = (Mode.POSITION_FEED_FORWARD, Mode.POSITION, Mode.POSITION_RELATIVE)
"""Modes in which D1 is a position."""
_CLASSIC_MODES: Final = np.array(list(CLASSIC_MODE_CODES), np.int32)
"""(16,) mode of each code, in order."""
_WORDS: Final[Mapping[int, int]] = {
    Mode.DRIVE_OFF_REQUEST: Word.DRIVE_OFF,
    Mode.FOLLOWING_ERROR: Word.FOLLOWING_ERROR,
}
_D1_MASK: Final = (1 << REVOLUTION_BITS) - 1
_D1_MOST: Final = _D1_MASK >> 1
_MODE_AT, _D3_AT, _DIFFERENCE_AT, _CURRENT_AT = 4, 8, 35, 52
_ACTION_AT: Final = (6, 35)
_D1_AT: Final = (8, 37)
MAX_STEP_CYCLES: Final = 16
"""Cycles between two set-points above which no velocity is computed from them."""


class ClassicCodec(_Frames):
    """Frames of the classic profile; stores the last set-points received for their step."""

    up_modulus = 1 << UP_COUNTER_BITS
    down_modulus = 1 << DOWN_COUNTER_BITS
    span_cycles = 12
    _up_mask = up_modulus - 1
    _down_mask = down_modulus - 1
    _codes = CLASSIC_MODE_CODES

    def __init__(self, n_axes: int) -> None:
        super().__init__(n_axes)
        self.up_ids = (CLASSIC_UP_HEADER, *CLASSIC_UP_AXIS[:n_axes])
        self.down_ids = CLASSIC_DOWN[: (n_axes + 1) // 2]
        self.lengths = dict.fromkeys((*self.up_ids, *self.down_ids), 8)
        self._set_points: dict[int, tuple[int, int]] = {}

    def up(self, number: int, status: int, words: Words, slow: tuple[int, bytes]) -> list[Frame]:
        """Encode a packet; CanModeError for a mode without a code."""
        codes = [self._code(mode, slot) for slot, mode in enumerate(words[:, 0].tolist())]
        with np.errstate(invalid="ignore"):  # a signalling NaN is one like any other
            numbers = words.view(np.float32).astype(np.float64)
        target = _counts(numbers[:, _D1], COUNTS_PER_REVOLUTION)
        actual = _counts(numbers[:, _D3], COUNTS_PER_REVOLUTION)
        current = _counts(numbers[:, _D5], COUNTS_PER_AMPERE)
        packed = np.array(codes, np.uint64) << np.uint64(_MODE_AT)
        packed |= np.uint64(number & self._up_mask)
        packed |= _packed(actual, REVOLUTION_BITS, _D3_AT)
        packed |= _packed(target - actual, DIFFERENCE_BITS, _DIFFERENCE_AT)
        packed |= _packed(current, CURRENT_BITS, _CURRENT_AT)
        data = packed.astype("<u8").tobytes()
        header = number.to_bytes(2, "little") + bytes((status, slow[0])) + slow[1]
        axes = [data[at : at + 8] for at in range(0, len(data), 8)]
        return [Frame(*frame) for frame in zip(self.up_ids, (header, *axes), strict=True)]

    def read_up(self, payloads: Sequence[bytes]) -> UpSet:
        """Decode the frames of one cycle."""
        header = payloads[0]
        packed = np.frombuffer(b"".join(payloads[1:]), "<u8")
        actual = _unpacked(packed, REVOLUTION_BITS, _D3_AT)
        difference = _unpacked(packed, DIFFERENCE_BITS, _DIFFERENCE_AT)
        words = np.zeros((self.n_axes, WORDS_PER_AXIS), np.int32)
        floats = words.view(np.float32)
        words[:, 0] = _CLASSIC_MODES[(packed >> np.uint64(_MODE_AT)).astype(np.intp) & 0xF]
        floats[:, _D1] = (actual + difference) / COUNTS_PER_REVOLUTION
        floats[:, _D3] = actual / COUNTS_PER_REVOLUTION
        floats[:, _D5] = _unpacked(packed, CURRENT_BITS, _CURRENT_AT) / COUNTS_PER_AMPERE
        number = int.from_bytes(header[:2], "little")
        return UpSet(number, header[2], words, (header[3], header[4:8]), actual)

    def down(self, reply: Reply, sent: Sent) -> list[Frame]:
        """Encode a reply; CanModeError, CanValueError if the frames cannot carry it."""
        leaving = reply.status == EXIT_FROM_OPEN and sent.status == DRIVE_ON
        expected = 0 if sent.status == DRIVE_ON else sent.status
        if not leaving and reply.status not in (0, expected):
            raise CanModeError(
                f"status {reply.status} in reply to status {sent.status} has no code"
            )
        frames = []
        for pair, frame_id in enumerate(self.down_ids):
            packed = reply.number & self._down_mask
            for side, slot in enumerate(range(2 * pair, min(2 * pair + 2, self.n_axes))):
                action, field = _action(reply.axes[slot], sent.modes[slot], slot, leaving=leaving)
                packed |= action << _ACTION_AT[side] | (field & _D1_MASK) << _D1_AT[side]
            frames.append(Frame(frame_id, packed.to_bytes(8, "little")))
        return frames

    def read_down(self, payloads: Sequence[bytes], sent: Sent) -> Reply:
        """Decode a reply; PacketError for an unknown code or a set-point out of range."""
        number = next_number(sent.number)
        leaving = False
        axes = []
        for slot, received in enumerate(sent.modes):
            pair, side = divmod(slot, 2)
            packed = int.from_bytes(payloads[pair], "little")
            action = packed >> _ACTION_AT[side] & 3
            field = packed >> _D1_AT[side] & _D1_MASK
            if action in (Action.SET, Action.SET_AND_EXIT):
                axes.append(self._set_point(slot, number, received, field))
                leaving |= action == Action.SET_AND_EXIT
                continue
            self._set_points.pop(slot, None)
            word = field if action == Action.WORD else Word.MIRROR
            leaving |= bool(word & Word.EXIT)
            axes.append(_word_reply(word & ~Word.EXIT, received))
        status = 0 if sent.status == DRIVE_ON else sent.status
        return Reply(number, EXIT_FROM_OPEN if leaving else status, tuple(axes))

    def _set_point(self, slot: int, number: int, mode: int, field: int) -> AxisReply:
        counts = field - (1 << REVOLUTION_BITS) if field > _D1_MOST else field
        if abs(counts) > _D1_MOST:
            raise PacketError("set-point", counts, "a number within its field")
        step = 0.0
        before = self._set_points.get(slot)
        if mode in _ABSOLUTE and before is not None:
            ahead = (number - before[0]) % LAST_NUMBER
            if 1 <= ahead <= MAX_STEP_CYCLES:
                step = (counts - before[1]) / ahead / COUNTS_PER_REVOLUTION
        self._set_points[slot] = (number, counts)
        return AxisReply(False, mode, counts / COUNTS_PER_REVOLUTION, step)


def _action(axis: AxisReply, received: int, slot: int, *, leaving: bool) -> tuple[int, int]:
    """Return action and D1 field of one axis; CanModeError, CanValueError if there is none."""
    still = axis.d1 == 0.0 and axis.d2 == 0.0
    if axis.mirrored:
        word = Word.MIRROR
    elif axis.mode in _WORDS:
        word = _WORDS[axis.mode]
    elif axis.mode == received and (axis.mode in _ABSOLUTE or not still):
        if axis.mode not in _ABSOLUTE and axis.mode != Mode.DELTA_POSITION:
            raise CanModeError(f"targets in mode {axis.mode} (slot {slot}) have no code")
        return (Action.SET_AND_EXIT if leaving else Action.SET), _target(axis.d1, slot)
    elif axis.mode == received:
        word = Word.ZERO
    elif axis.mode == Mode.CLOSED and still:
        word = Word.CLOSED_ZERO
    else:
        raise CanModeError(f"mode {axis.mode} in reply to {received} (slot {slot}) has no code")
    if leaving:
        return Action.WORD, word | Word.EXIT
    return (Action.MIRROR, 0) if word == Word.MIRROR else (Action.WORD, word)


def _target(d1: float, slot: int) -> int:
    counts = round(d1 * COUNTS_PER_REVOLUTION) if math.isfinite(d1) else None
    if counts is None or abs(counts) > _D1_MOST:
        most = _D1_MOST / COUNTS_PER_REVOLUTION
        raise _out_of_range("D1", slot, d1, f"{-most:.2f}..{most:.2f} motor revolutions")
    return counts


def _word_reply(word: int, received: int) -> AxisReply:
    """Return the reply that a word stands for; PacketError if it is unknown."""
    modes = {
        Word.MIRROR: received,
        Word.CLOSED_ZERO: int(Mode.CLOSED),
        Word.ZERO: received,
        Word.DRIVE_OFF: int(Mode.DRIVE_OFF_REQUEST),
        Word.FOLLOWING_ERROR: int(Mode.FOLLOWING_ERROR),
    }
    if word not in modes:
        raise PacketError("word", word, "one of the classic CAN profile")
    return AxisReply(word == Word.MIRROR, modes[word])


def _counts(values: Array, per_unit: int) -> Array:
    """Round; NaN for values that are not finite."""
    return np.where(np.isfinite(values), np.rint(values * per_unit), np.nan)


def _packed(counts: Array, bits: int, at: int) -> NDArray[np.uint64]:
    """Return fields in two's complement; the most negative value for numbers out of range."""
    lowest = -(1 << bits - 1)
    whole = np.where(np.abs(counts) < -lowest, counts, lowest).astype(np.int64)
    field = whole.astype(np.uint64) & np.uint64((1 << bits) - 1)
    return field << np.uint64(at)


def _unpacked(packed: NDArray[np.uint64], bits: int, at: int) -> Array:
    """Return signed numbers; NaN for the most negative value."""
    left = np.uint64(64 - bits - at)
    signed = (packed << left).view(np.int64) >> np.int64(64 - bits)
    return np.where(signed == -(1 << bits - 1), np.nan, signed.astype(np.float64))


Codec = FdCodec | ClassicCodec

LONGEST: Final = 1500
"""Bytes of the longest packet."""
_HEAD: Final = struct.Struct("<BBHI")
_PREFIX: Final = 2
TRANSFER_TIMEOUT: Final = 1.0
"""Time without a new segment after which a transfer is abandoned, s."""
DUPLICATE_TIME: Final = 0.1
"""Time within which a frame of a complete transfer counts as a duplicate, s."""


def segments(packet: bytes, size: int, transfer: int) -> list[bytes]:
    """Divide a packet of 1..1500 bytes into payloads of at most `size` bytes, 8 or 64.

    Segment 0 is the transfer number (u8), 0, the length (u16) and the CRC-32 of the packet; the
    others are the transfer number, their index and data.
    """
    if not 1 <= len(packet) <= LONGEST:
        raise ValueError(f"a packet has 1..{LONGEST} bytes, not {len(packet)}")
    payloads = [_HEAD.pack(transfer, 0, len(packet), zlib.crc32(packet))]
    room = size - _PREFIX
    for index, at in enumerate(range(0, len(packet), room), start=1):
        payload = bytes((transfer, index)) + packet[at : at + room]
        length = next(size for size in PAYLOADS_FD if size >= len(payload))
        payloads.append(payload.ljust(length, b"\0"))
    return payloads


class SegmentAssembler:
    """Assembles packets from segments; only complete ones with the right CRC are returned.

    `size` is that of a full payload, 8 or 64 bytes. Counted in `discarded` are "torn" (a segment is
    missing), "corrupt" (wrong CRC or length) and "malformed" (not a segment).
    """

    def __init__(self, size: int, discarded: Counter[str]) -> None:
        self._room = size - _PREFIX
        self._discarded = discarded
        self._transfer = -1
        self._parts: dict[int, bytes] = {}
        self._done = True
        self._last = 0.0
        self._finished: dict[int, float] = {}

    def add(self, payload: bytes, time: float) -> bytes | None:
        """Add a segment received at `time` (s); returns the packet when it is complete."""
        if len(payload) <= _PREFIX or (payload[1] == 0 and len(payload) != _HEAD.size):
            self._discarded["malformed"] += 1
            return None
        transfer, index = payload[0], payload[1]
        finished = self._finished.get(transfer)
        if finished is not None and abs(time - finished) <= DUPLICATE_TIME:
            return None
        known = self._parts.get(index, payload)
        recent = abs(time - self._last) <= TRANSFER_TIMEOUT
        if self._done or transfer != self._transfer or known != payload or not recent:
            if not self._done:
                self._discarded["torn"] += 1
            self._transfer, self._parts, self._done = transfer, {}, False
        self._last = time
        self._parts[index] = payload
        packet = self._complete()
        if self._done:
            self._finished[transfer] = time
        return packet

    def _complete(self) -> bytes | None:
        head = self._parts.get(0)
        if head is None:
            return None
        _, _, length, crc = _HEAD.unpack(head)
        if 1 <= length <= LONGEST:
            needed = range(1, 1 - (-length // self._room))
            if not self._parts.keys() >= set(needed):
                return None
            data = b"".join(self._parts[i][_PREFIX:] for i in needed)[:length]
            if len(data) == length and zlib.crc32(data) == crc:
                self._done = True
                return data
        self._done = True
        self._discarded["corrupt"] += 1
        return None


LATE: Final = 3
"""Cycles by which a frame may be older than the present set without starting a new one."""


class SetAssembler:
    """Collects one frame of each identifier with the same cycle number, modulo `modulus`.

    A frame of another cycle starts a new set; an incomplete set is dropped and counted as "torn".
    Duplicates and frames of up to `LATE` cycles earlier are ignored. Numbers repeat, so all frames
    of a set must also arrive within `span` s.
    """

    def __init__(
        self, ids: Sequence[int], modulus: int, span: float, discarded: Counter[str]
    ) -> None:
        self._ids = tuple(ids)
        self._modulus = modulus
        self._span = span
        self._discarded = discarded
        self._number = -1
        self._began = 0.0
        self._parts: dict[int, bytes] = {}
        self._done = True

    def add(self, frame_id: int, number: int, data: bytes, time: float) -> list[bytes] | None:
        """Add a frame; returns all payloads in the order of `ids` when the set is complete."""
        timely = abs(time - self._began) <= self._span
        if not timely or number != self._number or self._parts.get(frame_id, data) != data:
            if timely and self._number >= 0 and self._is_late(number):
                return None
            if not self._done:
                self._discarded["torn"] += 1
            self._number, self._began, self._parts, self._done = number, time, {}, False
        if self._done:
            return None
        self._parts[frame_id] = data
        if len(self._parts) < len(self._ids):
            return None
        self._done = True
        return [self._parts[frame_id] for frame_id in self._ids]

    def _is_late(self, number: int) -> bool:
        return 1 <= (self._number - number) % self._modulus <= LATE


MAX_SENT: Final = 16
"""Packets stored at each end, for late replies."""


class End(ABC):
    """Common base of both ends.

    Attributes:
        discarded: frames, sets and packets discarded, by kind: "foreign", "malformed", "torn",
            "corrupt", "unannounced" (cyclic frames without an init packet), "stale" (replies to
            packets no longer stored).
    """

    _upwards: ClassVar[bool]
    """Whether this is the PC's end."""

    def __init__(self, rates: BusRates) -> None:
        self.discarded: Counter[str] = Counter()
        self.rates = rates
        fd = rates.profile == "fd"
        self._kind: type[Codec] = FdCodec if fd else ClassicCodec
        self._size = 64 if fd else 8
        self._transfer = -1
        self._segments = SegmentAssembler(self._size, self.discarded)
        self._profile_ids = self._ids(self._kind(MAX_AXES))
        self._codec: Codec | None = None
        self._sets: SetAssembler | None = None
        self._sent: deque[Sent] = deque(maxlen=MAX_SENT)

    def _ids(self, codec: Codec) -> tuple[int, ...]:
        return codec.up_ids if self._upwards else codec.down_ids

    def _cyclic_session(self, packet: bytes) -> InitPacket | None:
        """Return the init packet if cyclic frames follow it, None for any other packet.

        One that is invalid is passed on to the session; no cyclic frames follow it.

        Raises:
            CanAxesError, CanBusLoadError: too many axes, another arm, or too short a cycle.
        """
        if not is_init(packet):
            return None
        try:
            init = InitPacket.decode(packet)
            arms = {axis.arm for axis in init.open_axes()}
        except PacketError:
            return None
        if init.n_axes > MAX_AXES:
            raise CanAxesError(f"the controller opens {init.n_axes} axes")
        if arms != {1}:
            raise CanAxesError(f"the controller opens axes of arm {max(arms)}")
        if init.sample_time < 1:
            return None
        self.rates.require_load(init.n_axes, init.period)
        return init

    def _start(self, init: InitPacket) -> None:
        """Prepare for the cyclic frames of a session."""
        self._codec = codec = self._kind(init.n_axes)
        modulus = codec.up_modulus if self._upwards else codec.down_modulus
        span = codec.span_cycles * init.period
        self._sets = SetAssembler(self._ids(codec), modulus, span, self.discarded)
        self._sent.clear()

    def receive(self, frame: Frame, time: float) -> bytes | None:
        """Add a frame that arrived at `time` (s); returns the packet when it is complete.

        Raises CanError for an init packet of a session that this bus cannot carry.
        """
        if frame.id == (SEGMENT_UP if self._upwards else SEGMENT_DOWN):
            packet = self._segments.add(frame.data, time)
            if packet is not None:
                self._segmented_packet(packet)
            return packet
        codec, sets = self._codec, self._sets
        if frame.id not in self._profile_ids:
            self.discarded["foreign"] += 1
        elif codec is None or sets is None or frame.id not in self._ids(codec):
            self.discarded["unannounced" if self._upwards else "foreign"] += 1
        elif len(frame.data) != codec.lengths[frame.id]:
            self.discarded["malformed"] += 1
        else:
            payloads = sets.add(frame.id, codec.number(frame), frame.data, time)
            try:
                return None if payloads is None else self._packet(codec, frame, payloads)
            except PacketError:
                self.discarded["malformed"] += 1
        return None

    def _segmented_packet(self, packet: bytes) -> None:  # noqa: B027  used by one end
        """Handle a packet that came as segments."""

    @abstractmethod
    def _packet(self, codec: Codec, frame: Frame, payloads: Sequence[bytes]) -> bytes | None:
        """Decode a complete set of which `frame` is the last; PacketError if it is invalid."""

    def _as_segments(self, packet: bytes) -> list[Frame]:
        frame_id = SEGMENT_DOWN if self._upwards else SEGMENT_UP
        self._transfer = (self._transfer + 1) % 256
        parts = segments(packet, self._size, self._transfer)
        return [Frame(frame_id, payload) for payload in parts]


class PcEnd(End):
    """The PC's end; `ages` (n_axes, 8) of the last packet, None if it came as segments."""

    _upwards = True

    def __init__(self, rates: BusRates) -> None:
        super().__init__(rates)
        self._slow = SlowStore(1)
        self._before: NDArray[np.float64] | None = None
        self.ages: Ages | None = None

    def forget(self) -> None:
        """Discard the slow values after a silence."""
        self._slow.forget()
        self._before = None

    def _segmented_packet(self, packet: bytes) -> None:
        self.ages = None
        if not is_init(packet):
            return
        self._codec = self._sets = None
        self._sent.clear()
        init = self._cyclic_session(packet)
        if init is not None:
            self._start(init)
            self._slow = SlowStore(init.n_axes)
            self._before = None

    def _packet(self, codec: Codec, frame: Frame, payloads: Sequence[bytes]) -> bytes:  # noqa: ARG002
        cycle = codec.read_up(payloads)
        ahead = self._slow.update(cycle.number, *cycle.slow, cycle.words)
        if cycle.counts is not None:
            self._set_velocity(cycle.counts, cycle.words.view(np.float32), ahead)
        status = bytes((cycle.status, 0, 0, 0))
        axes = cycle.words.view(AXIS_DTYPE).reshape(-1)
        packet = CyclicPacket(cycle.number, status, self._slow.functionality, axes).encode()
        self._sent.append(Sent.of(packet, codec.n_axes))
        self.ages = self._slow.ages
        return packet

    def _set_velocity(
        self, counts: NDArray[np.float64], floats: NDArray[np.float32], ahead: int
    ) -> None:
        """Set D4 to the mean over the cycles since the last set, which is its age."""
        if self._before is None or ahead < 1:
            floats[:, 4] = np.nan
            self._slow.ages[:, 3] = NEVER
        else:
            floats[:, 4] = (counts - self._before) / (ahead * COUNTS_PER_REVOLUTION)
            self._slow.ages[:, 3] = ahead - 1
        if ahead >= 0:
            self._before = counts

    def reply(self, packet: bytes) -> list[Frame]:
        """Return the frames of a reply.

        Raises:
            CanModeError, CanValueError: the frames cannot carry it.
        """
        codec = self._codec
        if codec is not None and len(packet) == cyclic_length(codec.n_axes):
            number = int.from_bytes(packet[:4], "little", signed=True)
            for sent in reversed(self._sent):
                if next_number(sent.number) == number:
                    return codec.down(read_reply(packet, sent), sent)
        return self._as_segments(packet)

    def drive_off(self) -> list[Frame]:
        """Return frames that request drive-off in reply to the newest cyclic packet, if any."""
        if not self._sent or self._codec is None:
            return []
        sent = self._sent[-1]
        axis = AxisReply(False, int(Mode.DRIVE_OFF_REQUEST))
        return self._codec.down(Reply(next_number(sent.number), 0, (axis,) * len(sent.words)), sent)


def _slow_turns(n_axes: int) -> Iterator[int]:
    """Yield the index of the slow value of each cycle, for `n_axes` axes."""
    values = [MAX_AXES * field + axis for field in range(len(_SLOW)) for axis in range(n_axes)]
    return cycle([*values, FUNCTIONALITY])


class ControllerEnd(End):
    """The controller's end; `segmented` tells whether the last packet went as segments."""

    _upwards = False

    def __init__(self, rates: BusRates) -> None:
        super().__init__(rates)
        self._turns = _slow_turns(1)
        self.segmented = False

    def packet(self, packet: bytes) -> list[Frame]:
        """Return the frames of a packet of the controller.

        Raises:
            CanError: an init packet of a session that this bus cannot carry.
        """
        init = self._cyclic_session(packet)
        if init is not None:
            self._start(init)
            self._turns = _slow_turns(init.n_axes)
        frames = self._cyclic(packet)
        self.segmented = frames is None
        return self._as_segments(packet) if frames is None else frames

    def _cyclic(self, packet: bytes) -> list[Frame] | None:
        """Return cyclic frames, None if they cannot carry this packet."""
        codec = self._codec
        if codec is None or len(packet) != cyclic_length(codec.n_axes):
            return None
        sent = Sent.of(packet, codec.n_axes)
        if not 1 <= sent.number <= LAST_NUMBER:
            return None
        index = next(self._turns)
        field, axis = divmod(index, MAX_AXES)
        functional = index == FUNCTIONALITY
        value = packet[8:12] if functional else sent.words[axis, _SLOW[field]].tobytes()
        try:
            frames = codec.up(sent.number, sent.status, sent.words, (index, value))
        except CanModeError:
            return None
        self._sent.append(sent)
        return frames

    def _packet(self, codec: Codec, frame: Frame, payloads: Sequence[bytes]) -> bytes | None:
        for sent in reversed(self._sent):
            if codec.is_reply_to(frame, sent.number):
                return write_reply(codec.read_down(payloads, sent), sent)
        self.discarded["stale"] += 1
        return None
