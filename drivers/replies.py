"""Safe replies to cyclic packets, and the frame in which replies are built.

The safe reply is the one that an independent program gave on real robots (facts on the C4G Open
wire, section 6): everything echoed while the drive is off, target position and velocity returned in
modes 501 and 0, a mode that is not available replied to with mode 0 and zeros. An axis in an open
mode without motion gets the target received, at zero velocity; zeros where the reply would be a
correction, with any status byte, because an echo would make an offset of a position. Each axis is
handled by its own mode, because axes change modes in different cycles.
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
from drivers.states import (
    CLOSED_MODES,
    HOLDABLE,
    INCREMENTAL,
    KNOWN_MODES,
    OPEN_MODES,
    Input,
    read_input,
)

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
class SafeReply:
    """Safe reply to every packet with certain status bytes and modes.

    Attributes:
        status: 4 bytes.
        modes: (n,) modes of the reply.
        mask: (n, 9) all bits set in the words that are returned as received, none elsewhere.
        returned: slots in an open mode with their drive on whose target is returned.
    """

    status: bytes
    modes: Words
    mask: Words
    returned: tuple[int, ...]


def safe_reply(status: bytes, modes: Words, arms: Sequence[int] | None) -> SafeReply:
    """Compute the safe reply to 4 status bytes and modes (n,).

    `arms` is the arm of each slot, from 1; None if unknown: every drive counts as on if any is.
    """
    n = len(modes)
    on = [byte == DRIVE_ON for byte in status]
    if arms is None:
        arms = (1,) * n
        on = [any(on)] * N_ARMS
    replied = np.zeros(n, np.int32)
    mask = np.zeros((n, WORDS_PER_AXIS), np.int32)
    returned = []
    for slot in range(n):
        mode = int(modes[slot])
        if not on[arms[slot] - 1] and mode not in INCREMENTAL:
            replied[slot] = mode
            mask[slot, D1:] = _ALL_BITS
        elif mode in _RETURNED_WORDS:
            replied[slot] = mode
            mask[slot, list(_RETURNED_WORDS[mode])] = _ALL_BITS
            if mode in HOLDABLE:
                returned.append(slot)
    reply_status = bytes(
        status[arm - 1] if arm in arms and not on[arm - 1] else 0 for arm in range(1, N_ARMS + 1)
    )
    return SafeReply(reply_status, replied, mask, tuple(returned))


def words_of(packet: CyclicPacket) -> Words:
    """Return the axis blocks as (n, 9) words, a view, which preserves NaN payloads."""
    return packet.axes.view(np.int32).reshape(-1, WORDS_PER_AXIS)


class ReplyFrame:
    """The 12 + 36 n bytes of one reply, built in place.

    Attributes:
        floats: the axis blocks as (n, 9) numbers, to write set-points into.
    """

    def __init__(self, n_axes: int) -> None:
        self._buffer = bytearray(cyclic_length(n_axes))
        words: Words = np.frombuffer(self._buffer, np.int32, offset=HEADER_LENGTH)
        self._words = words.reshape(n_axes, WORDS_PER_AXIS)
        self.floats: Floats = self._words.view(np.float32)

    def safe(self, reply: SafeReply, received: Words) -> None:
        """Fill in the safe reply in every slot."""
        np.bitwise_and(received, reply.mask, out=self._words)
        self._words[:, MODE] = reply.modes

    def drive_off(self, reply: SafeReply, received: Words) -> None:
        """Request drive-off: 505 in every slot, with the targets received in case they are used."""
        self._safe_and_finite(reply, received)
        self._words[:, MODE] = Mode.DRIVE_OFF_REQUEST

    def following_error(
        self, reply: SafeReply, received: Words, offending: NDArray[np.intp]
    ) -> None:
        """Report 508 in the offending slots; the others keep their mode and their target."""
        self._safe_and_finite(reply, received)
        self._words[offending, MODE] = Mode.FOLLOWING_ERROR

    def _safe_and_finite(self, reply: SafeReply, received: Words) -> None:
        self.safe(reply, received)
        data = self.floats[:, D1:]
        data[~np.isfinite(data)] = 0.0

    def finish(self, number: int, status: bytes) -> bytes:
        """Return the reply to packet `number`; functionality is always zero."""
        _HEADER.pack_into(self._buffer, 0, next_number(number), status, 0)
        return bytes(self._buffer)


@dataclass(frozen=True, eq=False)
class Reading:
    """Status bytes and modes of a packet, interpreted.

    Attributes:
        input: of the state machine.
        reply: the safe reply.
        status: status byte of the arm.
        modes: (n,) mode of each joint.
        ready: (n,) joints in the wanted mode; closed ones where they are to stay closed.
        returned: (n,) joints in an open mode whose safe reply is the target received.
        powered: some wanted axis is in an open mode and the drive is on.
        any_open: some wanted axis is in an open mode.
        unwanted: first joint in an open mode other than the wanted one, or None.
        other_slots: slots in `reply.returned` that are not joints of the arm.
    """

    input: Input
    reply: SafeReply
    status: int
    modes: NDArray[np.int32]
    ready: NDArray[np.bool_]
    returned: NDArray[np.bool_]
    powered: bool
    any_open: bool
    unwanted: int | None
    other_slots: tuple[int, ...]

    @property
    def fault(self) -> str:
        """Why these modes are refused, by the first unknown one, else the first open one."""
        known = np.isin(self.modes, list(KNOWN_MODES))
        joint = int(np.argmax(np.isin(self.modes, list(OPEN_MODES)) if known.all() else ~known))
        reason = "it was not closed before" if known.all() else "the reply to that mode is unknown"
        return f"joint {joint + 1} is in mode {self.modes[joint]}: {reason}"


class Reader:
    """Interprets status and modes of packets; caches the last, because modes rarely change.

    Args:
        slots: (n,) slot of each wanted axis; none if the arm has no open axis.
        arms: arm of each slot, from 1; None if unknown: any drive that is on counts.
        arm: the arm that is moved, from 1.
        mode: wanted open mode.
        opened: (n,) which axes are to be open; None for all.
    """

    def __init__(
        self,
        slots: NDArray[np.intp],
        arms: tuple[int, ...] | None,
        arm: int,
        mode: int,
        opened: NDArray[np.bool_] | None = None,
    ) -> None:
        self._slots = slots
        self._opened = np.ones(len(slots), dtype=np.bool_) if opened is None else opened
        self._arms = arms
        self._arm = arm
        self._mode = mode
        self._key: tuple[bytes, bytes] | None = None
        self._last: Reading | None = None

    def read(self, status: bytes, modes: Words) -> Reading:
        """Interpret 4 status bytes and the modes of all slots."""
        key = (status, modes.tobytes())
        if self._last is None or key != self._key:
            self._key = key
            self._last = self._interpret(status, modes.copy())
        return self._last

    def _interpret(self, status: bytes, modes: Words) -> Reading:
        wanted = modes[self._slots]
        drive_on = (DRIVE_ON in status) if self._arms is None else status[self._arm - 1] == DRIVE_ON
        is_open = np.isin(wanted, list(OPEN_MODES))
        closed = ~self._opened & np.isin(wanted, list(CLOSED_MODES))
        ready = closed | (self._opened & (wanted == self._mode))
        unwanted = np.flatnonzero(is_open & ~ready)
        reply = safe_reply(status, modes, self._arms)
        joints = set(self._slots.tolist())
        return Reading(
            input=read_input(drive_on, modes.tolist(), wanted[~closed].tolist(), self._mode),
            reply=reply,
            status=status[self._arm - 1],
            modes=wanted,
            ready=ready,
            returned=np.isin(wanted, list(HOLDABLE)),
            powered=drive_on and bool(is_open.any()),
            any_open=bool(is_open.any()),
            unwanted=int(unwanted[0]) if unwanted.size else None,
            other_slots=tuple(slot for slot in reply.returned if slot not in joints),
        )
