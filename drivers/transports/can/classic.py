"""Cyclic frames of the classic profile: packed integers in frames of eight bytes.

Positions are rounded to 2^-16 motor revolutions. A number outside its field is sent as the field's
most negative value and read as NaN, which no guard lets pass. D4 is formed from consecutive D3,
and the D2 of an answer from consecutive D1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import PacketError
from drivers.packets import DRIVE_ON, EXIT_FROM_OPEN, LAST_NUMBER, Mode, next_number
from drivers.transports.can.errors import CanModeError, CanValueError
from drivers.transports.can.fd import UpSet
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
    REVOLUTION_BITS,
    UP_COUNTER_BITS,
    Action,
    Frame,
    Word,
)
from drivers.transports.can.reply_fields import Answer, AxisAnswer, Sent
from drivers.transports.can.slow import WORDS_PER_AXIS, Words

_ABSOLUTE: Final = frozenset(
    (int(Mode.POSITION_FEED_FORWARD), int(Mode.POSITION), int(Mode.POSITION_RELATIVE))
)
"""Modes whose D1 is a position."""
_MODES: Final = {code: mode for mode, code in CLASSIC_MODE_CODES.items()}
_CODES: Final = np.array([_MODES[code] for code in range(16)], np.int32)
_WORDS: Final = {
    int(Mode.DRIVE_OFF_REQUEST): Word.DRIVE_OFF,
    int(Mode.FOLLOWING_ERROR): Word.FOLLOWING_ERROR,
}
_UP_MASK: Final = (1 << UP_COUNTER_BITS) - 1
_DOWN_MASK: Final = (1 << DOWN_COUNTER_BITS) - 1
_D1_MASK: Final = (1 << REVOLUTION_BITS) - 1
_D1_MOST: Final = (1 << REVOLUTION_BITS - 1) - 1
_MODE_AT, _D3_AT, _DIFFERENCE_AT, _CURRENT_AT = 4, 8, 35, 52
_ACTION_AT: Final = (6, 35)
_D1_AT: Final = (8, 37)
FORGOTTEN: Final = 16
"""Cycles between two set-points after which no velocity is formed from them."""


class ClassicCodec:
    """Frames of the classic profile for 1..6 axes.

    The instance at the controller's end remembers the last set-points, to form their step.
    """

    up_modulus: Final = 1 << UP_COUNTER_BITS
    down_modulus: Final = 1 << DOWN_COUNTER_BITS
    span_cycles: Final = 12
    """Cycles within which a set must be complete; the shorter counter repeats after 16."""

    def __init__(self, n_axes: int) -> None:
        self.n_axes = n_axes
        self.up_ids = (CLASSIC_UP_HEADER, *CLASSIC_UP_AXIS[:n_axes])
        self.down_ids = CLASSIC_DOWN[: (n_axes + 1) // 2]
        self.lengths = dict.fromkeys((*self.up_ids, *self.down_ids), 8)
        self._set_points: dict[int, tuple[int, int]] = {}

    def number(self, frame: Frame) -> int:
        """What tells the frames of one cycle from those of another."""
        return frame.data[0] & (_DOWN_MASK if frame.id in self.down_ids else _UP_MASK)

    def up(self, number: int, status: int, words: Words, slow: tuple[int, bytes]) -> list[Frame]:
        """Frames of a packet.

        Raises:
            CanModeError: a mode without a code.
        """
        codes = [_code(mode, slot) for slot, mode in enumerate(words[:, 0].tolist())]
        with np.errstate(invalid="ignore"):  # a signalling NaN is one like any other
            numbers = words.view(np.float32).astype(np.float64)
        target = _counts(numbers[:, 1], COUNTS_PER_REVOLUTION)
        actual = _counts(numbers[:, 3], COUNTS_PER_REVOLUTION)
        current = _counts(numbers[:, 5], COUNTS_PER_AMPERE)
        packed = np.array(codes, np.uint64) << np.uint64(_MODE_AT) | np.uint64(number & _UP_MASK)
        packed |= _packed(actual, REVOLUTION_BITS, _D3_AT)
        packed |= _packed(target - actual, DIFFERENCE_BITS, _DIFFERENCE_AT)
        packed |= _packed(current, CURRENT_BITS, _CURRENT_AT)
        data = packed.astype("<u8").tobytes()
        header = number.to_bytes(2, "little") + bytes((status, slow[0])) + slow[1]
        return [
            Frame(self.up_ids[0], header),
            *(Frame(self.up_ids[1 + i], data[8 * i : 8 * i + 8]) for i in range(self.n_axes)),
        ]

    def read_up(self, payloads: Sequence[bytes]) -> UpSet:
        """Read the frames of one cycle."""
        header = payloads[0]
        packed = np.frombuffer(b"".join(payloads[1:]), "<u8")
        actual = _unpacked(packed, REVOLUTION_BITS, _D3_AT)
        difference = _unpacked(packed, DIFFERENCE_BITS, _DIFFERENCE_AT)
        words = np.zeros((self.n_axes, WORDS_PER_AXIS), np.int32)
        floats = words.view(np.float32)
        words[:, 0] = _CODES[(packed >> np.uint64(_MODE_AT)).astype(np.intp) & 0xF]
        floats[:, 1] = (actual + difference) / COUNTS_PER_REVOLUTION
        floats[:, 3] = actual / COUNTS_PER_REVOLUTION
        floats[:, 5] = _unpacked(packed, CURRENT_BITS, _CURRENT_AT) / COUNTS_PER_AMPERE
        number = header[0] | header[1] << 8
        return UpSet(number, header[2], words, (header[3], header[4:8]), actual)

    def down(self, answer: Answer, sent: Sent) -> list[Frame]:
        """Frames of an answer.

        Raises:
            CanModeError: an answer that there is no action for.
            CanValueError: a target outside its field.
        """
        leaving = answer.status == EXIT_FROM_OPEN and sent.status == DRIVE_ON
        expected = 0 if sent.status == DRIVE_ON else sent.status
        if not leaving and answer.status not in (0, expected):
            raise CanModeError(
                None, None, f"status {answer.status} in answer to status {sent.status} has no code"
            )
        received = sent.modes
        frames = []
        for pair, frame_id in enumerate(self.down_ids):
            packed = answer.number & _DOWN_MASK
            for side, slot in enumerate(range(2 * pair, min(2 * pair + 2, self.n_axes))):
                action, field = _act(answer.axes[slot], received[slot], slot, leaving=leaving)
                packed |= action << _ACTION_AT[side] | (field & _D1_MASK) << _D1_AT[side]
            frames.append(Frame(frame_id, packed.to_bytes(8, "little")))
        return frames

    def is_reply_to(self, frame: Frame, sent_number: int) -> bool:
        """Whether a frame down belongs to the answer to that packet."""
        return frame.data[0] & _DOWN_MASK == next_number(sent_number) & _DOWN_MASK

    def read_down(self, payloads: Sequence[bytes], sent: Sent) -> Answer:
        """Read an answer; the step of a set-point is that from the one before.

        Raises:
            PacketError: a word without a meaning, or a set-point out of range.
        """
        number = next_number(sent.number)
        received = sent.modes
        leaving = False
        axes = []
        for slot in range(self.n_axes):
            pair, side = divmod(slot, 2)
            packed = int.from_bytes(payloads[pair], "little")
            action = packed >> _ACTION_AT[side] & 3
            field = packed >> _D1_AT[side] & _D1_MASK
            if action in (Action.SET, Action.SET_AND_EXIT):
                axes.append(self._set_point(slot, number, received[slot], field))
                leaving |= action == Action.SET_AND_EXIT
                continue
            self._set_points.pop(slot, None)
            word = field if action == Action.WORD else Word.MIRROR
            leaving |= bool(word & Word.EXIT)
            axes.append(_understood(word & ~Word.EXIT, received[slot]))
        status = 0 if sent.status == DRIVE_ON else sent.status
        return Answer(number, EXIT_FROM_OPEN if leaving else status, tuple(axes))

    def _set_point(self, slot: int, number: int, mode: int, field: int) -> AxisAnswer:
        counts = field - (1 << REVOLUTION_BITS) if field > _D1_MOST else field
        if abs(counts) > _D1_MOST:
            raise PacketError("set-point", counts, "a number within its field")
        step = 0.0
        before = self._set_points.get(slot)
        if mode in _ABSOLUTE and before is not None:
            ahead = (number - before[0]) % LAST_NUMBER
            if 1 <= ahead <= FORGOTTEN:
                step = (counts - before[1]) / ahead / COUNTS_PER_REVOLUTION
        self._set_points[slot] = (number, counts)
        return AxisAnswer(False, mode, counts / COUNTS_PER_REVOLUTION, step)


def _act(axis: AxisAnswer, received: int, slot: int, *, leaving: bool) -> tuple[int, int]:
    """Action and D1 field of one axis.

    Raises:
        CanModeError, CanValueError: there is none.
    """
    still = axis.d1 == 0.0 and axis.d2 == 0.0
    word: int | None = None
    if axis.mirrored:
        word = Word.MIRROR
    elif axis.mode in _WORDS:
        word = _WORDS[axis.mode]
    elif axis.mode == received and (axis.mode in _ABSOLUTE or not still):
        if axis.mode not in _ABSOLUTE and axis.mode != Mode.DELTA_POSITION:
            raise CanModeError(
                axis.mode, slot, f"targets in mode {axis.mode} (slot {slot}) have no code"
            )
        return (Action.SET_AND_EXIT if leaving else Action.SET), _target(axis.d1, slot)
    elif axis.mode == received and still:
        word = Word.ZERO
    elif axis.mode == Mode.CLOSED and still:
        word = Word.CLOSED_ZERO
    if word is None:
        raise CanModeError(
            axis.mode, slot, f"mode {axis.mode} in answer to {received} (slot {slot}) has no code"
        )
    if leaving:
        return Action.WORD, word | Word.EXIT
    return (Action.MIRROR, 0) if word == Word.MIRROR else (Action.WORD, word)


def _target(d1: float, slot: int) -> int:
    counts = round(d1 * COUNTS_PER_REVOLUTION) if math.isfinite(d1) else None
    if counts is None or abs(counts) > _D1_MOST:
        most = _D1_MOST / COUNTS_PER_REVOLUTION
        raise CanValueError("D1", slot, d1, f"{-most:.2f}..{most:.2f} motor revolutions")
    return counts


def _understood(word: int, received: int) -> AxisAnswer:
    """What a word says.

    Raises:
        PacketError: nothing that is known.
    """
    modes = {
        Word.MIRROR: received,
        Word.CLOSED_ZERO: int(Mode.CLOSED),
        Word.ZERO: received,
        Word.DRIVE_OFF: int(Mode.DRIVE_OFF_REQUEST),
        Word.FOLLOWING_ERROR: int(Mode.FOLLOWING_ERROR),
    }
    if word not in modes:
        raise PacketError("word", word, "one of the classic CAN profile")
    return AxisAnswer(word == Word.MIRROR, modes[word], 0.0, 0.0)


def _counts(values: NDArray[np.float64], per_unit: int) -> NDArray[np.float64]:
    """Rounded; NaN for what is not finite."""
    return np.where(np.isfinite(values), np.rint(values * per_unit), np.nan)


def _packed(counts: NDArray[np.float64], bits: int, at: int) -> NDArray[np.uint64]:
    """Two's complement in place; the most negative value where it does not fit."""
    lowest = -(1 << bits - 1)
    fits = np.abs(counts) < -lowest
    whole = np.where(fits, counts, lowest).astype(np.int64)
    field = whole.astype(np.uint64) & np.uint64((1 << bits) - 1)
    return field << np.uint64(at)


def _unpacked(packed: NDArray[np.uint64], bits: int, at: int) -> NDArray[np.float64]:
    """Signed numbers; NaN for the most negative value."""
    left = np.uint64(64 - bits - at)
    signed = (packed << left).view(np.int64) >> np.int64(64 - bits)
    return np.where(signed == -(1 << bits - 1), np.nan, signed.astype(np.float64))


def _code(mode: int, slot: int) -> int:
    code = CLASSIC_MODE_CODES.get(mode)
    if code is None:
        raise CanModeError(mode, slot, f"mode {mode} (slot {slot}) has no code")
    return code
