"""Cyclic frames of the FD profile: two up, one down, numbers as they are on the C4G wire."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.errors import PacketError
from drivers.packets import LAST_NUMBER, next_number
from drivers.transports.can.errors import CanModeError
from drivers.transports.can.layout import (
    FD_DOWN,
    FD_MODE_CODES,
    FD_UP_A,
    FD_UP_B,
    MAX_AXES,
    Frame,
)
from drivers.transports.can.reply_fields import Answer, AxisAnswer, Sent
from drivers.transports.can.slow import WORDS_PER_AXIS, Words

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
_MODES: Final = {code: mode for mode, code in FD_MODE_CODES.items()}
_NOTHING: Final = AxisAnswer(False, 0, 0.0, 0.0)
_D1, _D3, _D4, _D5 = 1, 3, 4, 5


class UpSet(NamedTuple):
    """The frames of one cycle, read.

    Attributes:
        number, status: of the packet.
        words: (n, 9) modes and numbers, the slow ones zero.
        slow: index and four bytes of the slow value.
        counts: (n,) D3 in counts, NaN out of range, where D4 has to be formed from them; None
            where D4 was sent.
    """

    number: int
    status: int
    words: Words
    slow: tuple[int, bytes]
    counts: NDArray[np.float64] | None = None


class FdCodec:
    """Frames of the FD profile for 1..6 axes."""

    up_ids: Final = (FD_UP_A, FD_UP_B)
    down_ids: Final = (FD_DOWN,)
    lengths: Final = {FD_UP_A: _UP_A.itemsize, FD_UP_B: _UP_B.itemsize, FD_DOWN: _DOWN.size}
    up_modulus: Final = LAST_NUMBER
    down_modulus: Final = LAST_NUMBER
    span_cycles: Final = 1000
    """Cycles within which a set must be complete; the number repeats after 32767."""

    def __init__(self, n_axes: int) -> None:
        self.n_axes = n_axes

    def number(self, frame: Frame) -> int:
        """What tells the frames of one cycle from those of another."""
        return _number(frame.data)

    def up(self, number: int, status: int, words: Words, slow: tuple[int, bytes]) -> list[Frame]:
        """Frames of a packet.

        Raises:
            CanModeError: a mode without a code.
        """
        modes = [_code(mode, slot) for slot, mode in enumerate(words[:, 0].tolist())]
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
        """Read the frames of one cycle.

        Raises:
            PacketError: a mode code without a meaning.
        """
        n = self.n_axes
        a = np.frombuffer(payloads[0], _UP_A)[0]
        b = np.frombuffer(payloads[1], _UP_B)[0]
        words = np.zeros((MAX_AXES, WORDS_PER_AXIS), np.int32)
        floats = words.view(np.float32)
        words[:n, 0] = [_mode(code) for code in payloads[0][2 : 2 + n]]
        floats[:, _D1], floats[:, _D3], floats[:, _D5] = a["d1"], a["d3"], b["d5"]
        floats[:2, _D4], floats[2:, _D4] = a["d4"], b["d4"]
        slow = (payloads[1][3], payloads[1][4:8])
        return UpSet(_number(payloads[0]), payloads[1][2], words[:n], slow)

    def down(self, answer: Answer, sent: Sent) -> list[Frame]:  # noqa: ARG002 - as classic frames
        """The frame of an answer.

        Raises:
            CanModeError: a mode without a code.
        """
        empty = MAX_AXES - self.n_axes
        axes = (*answer.axes, *(_NOTHING,) * empty)
        mirrored = sum(axis.mirrored << slot for slot, axis in enumerate(axes))
        payload = _DOWN.pack(
            answer.number,
            answer.status,
            mirrored,
            *(_code(axis.mode, slot) for slot, axis in enumerate(axes)),
            *(0.0 if axis.mirrored else axis.d1 for axis in axes),
            *(0.0 if axis.mirrored else axis.d2 for axis in axes),
        )
        return [Frame(FD_DOWN, payload)]

    def is_reply_to(self, frame: Frame, sent_number: int) -> bool:
        """Whether a frame down belongs to the answer to that packet."""
        return _number(frame.data) == next_number(sent_number)

    def read_down(self, payloads: Sequence[bytes], sent: Sent) -> Answer:  # noqa: ARG002
        """Read an answer.

        Raises:
            PacketError: a mode code without a meaning.
        """
        number, status, mirrored, *fields = _DOWN.unpack(payloads[0])
        codes, d1, d2 = (fields[at : at + MAX_AXES] for at in range(0, 3 * MAX_AXES, MAX_AXES))
        axes = tuple(
            AxisAnswer(bool(mirrored >> slot & 1), _mode(codes[slot]), d1[slot], d2[slot])
            for slot in range(self.n_axes)
        )
        return Answer(number, status, axes)


def _number(payload: bytes) -> int:
    return payload[0] | payload[1] << 8


def _code(mode: int, slot: int) -> int:
    code = FD_MODE_CODES.get(mode)
    if code is None:
        raise CanModeError(mode, slot, f"mode {mode} (slot {slot}) has no code")
    return code


def _mode(code: int) -> int:
    mode = _MODES.get(code)
    if mode is None:
        raise PacketError("mode code", code, "one of the CAN FD profile")
    return mode
