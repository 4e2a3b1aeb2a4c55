"""Answers to cyclic packets: the safe one for every state, and the frame they are built in.

The safe answer is the one that an independent program gave on real robots (facts on the C4G Open
wire, section 6): everything echoed while the drive is off, target position and velocity given
back in modes 501 and 0, a mode that is not available answered by mode 0 and zeros. An axis in an
open mode that nobody moves gets the target received, at zero velocity; zeros where the answer
would be a correction, whatever the status byte says of the drive, because an echo would make an
offset of a position. Each axis is answered by
its own mode, because axes change modes in different cycles.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.packets import (
    AXIS_LENGTH,
    DRIVE_ON,
    HEADER_LENGTH,
    N_ARMS,
    CyclicPacket,
    Mode,
    cyclic_length,
    next_number,
)
from drivers.states import HOLDABLE, INCREMENTAL

Words = NDArray[np.int32]
Floats = NDArray[np.float32]

WORDS_PER_AXIS: Final = AXIS_LENGTH // 4
_ALL_BITS: Final = -1
# Columns of an axis block seen as nine 4-byte words.
MODE, D1, D2, D3, D4, D5 = range(6)

_HEADER: Final = struct.Struct("<i4sI")
_RETURNED_WORDS: Final[dict[int, tuple[int, ...]]] = {
    Mode.CLOSED: (D1, D2),
    Mode.DRIVING_ON: (D1, D2),
    Mode.CLOSED_MIRRORED: (D1, D2, D3, D4, D5),
    **dict.fromkeys(HOLDABLE, (D1,)),
    **dict.fromkeys(INCREMENTAL, ()),
}


@dataclass(frozen=True, eq=False)
class SafeAnswer:
    """The safe answer to every packet with certain status bytes and modes.

    Attributes:
        status: 4 bytes.
        modes: (n,) modes answered.
        mask: (n, 9) all bits set in the words that are given back as received, none elsewhere.
        held: slots in an open mode with their drive on that are given back their target.
    """

    status: bytes
    modes: Words
    mask: Words
    held: tuple[int, ...]


def safe_answer(status: bytes, modes: Words, arms: Sequence[int] | None) -> SafeAnswer:
    """Work it out.

    Args:
        status: 4 status bytes received.
        modes: (n,) modes received.
        arms: arm of each slot, from 1; None if unknown: every drive counts as on if any is.
    """
    n = len(modes)
    on = [byte == DRIVE_ON for byte in status]
    if arms is None:
        arms = (1,) * n
        on = [any(on)] * N_ARMS
    answered = np.zeros(n, np.int32)
    mask = np.zeros((n, WORDS_PER_AXIS), np.int32)
    held = []
    for slot in range(n):
        mode = int(modes[slot])
        if not on[arms[slot] - 1] and mode not in INCREMENTAL:
            answered[slot] = mode
            mask[slot, D1:] = _ALL_BITS
        elif mode in _RETURNED_WORDS:
            answered[slot] = mode
            mask[slot, list(_RETURNED_WORDS[mode])] = _ALL_BITS
            if mode in HOLDABLE:
                held.append(slot)
    given_back = bytes(
        status[arm - 1] if arm in arms and not on[arm - 1] else 0 for arm in range(1, N_ARMS + 1)
    )
    return SafeAnswer(given_back, answered, mask, tuple(held))


def words_of(packet: CyclicPacket) -> Words:
    """The axis blocks as (n, 9) words; a view, which moves NaN payloads unharmed."""
    return packet.axes.view(np.int32).reshape(-1, WORDS_PER_AXIS)


class ReplyFrame:
    """The bytes of one answer, built in place: 12 + 36 n, whatever the length received.

    Attributes:
        floats: the axis blocks as (n, 9) numbers, to write set-points into.
    """

    def __init__(self, n_axes: int) -> None:
        self._buffer = bytearray(cyclic_length(n_axes))
        words: Words = np.frombuffer(self._buffer, np.int32, offset=HEADER_LENGTH)
        self._words = words.reshape(n_axes, WORDS_PER_AXIS)
        self.floats: Floats = self._words.view(np.float32)

    def safe(self, answer: SafeAnswer, received: Words) -> None:
        """The safe answer in every slot."""
        np.bitwise_and(received, answer.mask, out=self._words)
        self._words[:, MODE] = answer.modes

    def drive_off(self, answer: SafeAnswer, received: Words) -> None:
        """Request drive-off: 505 in every slot.

        The controller is to ignore the targets in such an answer; in case it does not, they are
        where it had them.
        """
        self._safe_and_finite(answer, received)
        self._words[:, MODE] = Mode.DRIVE_OFF_REQUEST

    def following_error(
        self, answer: SafeAnswer, received: Words, offending: NDArray[np.intp]
    ) -> None:
        """Report 508 in the offending slots; the others keep their mode and their target."""
        self._safe_and_finite(answer, received)
        self._words[offending, MODE] = Mode.FOLLOWING_ERROR

    def _safe_and_finite(self, answer: SafeAnswer, received: Words) -> None:
        self.safe(answer, received)
        data = self.floats[:, D1:]
        data[~np.isfinite(data)] = 0.0

    def finish(self, number: int, status: bytes) -> bytes:
        """The answer to packet `number`. Functionality is always zero."""
        _HEADER.pack_into(self._buffer, 0, next_number(number), status, 0)
        return bytes(self._buffer)
