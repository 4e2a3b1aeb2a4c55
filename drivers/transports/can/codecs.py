"""Cyclic frames of both profiles: conversion of packets and replies.

FD: two frames up, one down, numbers as in C4G packets. Classic: packed integers in frames of eight
bytes. Positions are rounded to 2^-16 motor revolutions. A number outside its field is sent as the
most negative value of the field and read as NaN, which the guard refuses. D4 is computed from
consecutive D3, and the D2 of a reply from consecutive D1.

Most replies return what the controller sent (drive off, axes closed). The PC has some of these
values only aged or rounded, so such an axis is *mirrored*: not sent, and filled in at the
controller's end from the packet that it sent.
"""

from __future__ import annotations

import math
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import cycle
from typing import ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import Ages
from drivers.errors import PacketError
from drivers.packets import (
    AXIS_DTYPE,
    DRIVE_ON,
    EXIT_FROM_OPEN,
    HEADER_LENGTH,
    LAST_NUMBER,
    N_ARMS,
    CyclicPacket,
    Mode,
    next_number,
)
from drivers.transports.can.layout import (
    CLASSIC_DOWN,
    CLASSIC_MODE_CODES,
    CLASSIC_UP_AXIS,
    CLASSIC_UP_HEADER,
    COUNTS_PER_AMPERE,
    COUNTS_PER_REVOLUTION,
    CURRENT_BITS,
    DIFFERENCE_BITS,
    DOWN_COUNTER_BITS,
    FD_DOWN,
    FD_MODE_CODES,
    FD_UP_A,
    FD_UP_B,
    FUNCTIONALITY,
    MAX_AXES,
    REVOLUTION_BITS,
    UP_COUNTER_BITS,
    Action,
    CanModeError,
    CanValueError,
    Frame,
    Word,
)

Words = NDArray[np.int32]
Array = NDArray[np.float64]

WORDS_PER_AXIS: Final = 9
NEVER: Final = 0xFFFF
"""Age of a value that was never received, and largest age."""
_D1, _D2, _D3, _D4, _D5 = range(1, 6)
_SLOW: Final = (2, 6, 7, 8)
"""Columns of D2, extra1..3 in an axis block of nine words (mode first)."""
_UNKNOWN: Final = int(np.float32(np.nan).view(np.int32))


def slow_turns(n_axes: int) -> Iterator[int]:
    """Yield the index of the slow value of each cycle, for `n_axes` axes."""
    values = [MAX_AXES * field + axis for field in range(len(_SLOW)) for axis in range(n_axes)]
    return cycle([*values, FUNCTIONALITY])


def slow_value(index: int, words: Words, functionality: bytes) -> bytes:
    """Return the four bytes of a slow value in a packet's words (n, 9)."""
    if index == FUNCTIONALITY:
        return functionality
    field, axis = divmod(index, MAX_AXES)
    value: bytes = words[axis, _SLOW[field]].tobytes()
    return value


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


def drive_off(sent: Sent) -> Reply:
    """Return a reply with mode 505 in every axis, sent if the actual one cannot be."""
    axis = AxisReply(False, int(Mode.DRIVE_OFF_REQUEST))
    return Reply(next_number(sent.number), 0, (axis,) * len(sent.words))


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


class Codec(ABC):
    """Frames of one profile for 1..6 axes, with identifiers and bytes of each.

    Cycle numbers in frames are modulo `up_modulus` and `down_modulus`; a set must be complete
    within `span_cycles`, because its number repeats.
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

    @abstractmethod
    def up(self, number: int, status: int, words: Words, slow: tuple[int, bytes]) -> list[Frame]:
        """Encode a packet; CanModeError for a mode without a code."""

    @abstractmethod
    def read_up(self, payloads: Sequence[bytes]) -> UpSet:
        """Decode the frames of one cycle; PacketError for an unknown mode code."""

    @abstractmethod
    def down(self, reply: Reply, sent: Sent) -> list[Frame]:
        """Encode a reply; CanModeError, CanValueError if the frames cannot carry it."""

    @abstractmethod
    def read_down(self, payloads: Sequence[bytes], sent: Sent) -> Reply:
        """Decode a reply; PacketError for an unknown code."""

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


class FdCodec(Codec):
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


class ClassicCodec(Codec):
    """Frames of the classic profile.

    The instance at the controller's end stores the last set-points to compute their step.
    """

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
