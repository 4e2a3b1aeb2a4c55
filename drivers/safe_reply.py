"""Packets classified, the safe reply to each, and the builder of replies.

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

from drivers.errors import RefusalError
from drivers.packets import (
    AXIS_LENGTH,
    DRIVE_ON,
    EXIT_FROM_OPEN,
    HEADER_LENGTH,
    N_ARMS,
    CyclicPacket,
    Mode,
    OpenAxis,
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
        held_slots: slots in an open mode with their drive on whose target is returned.
    """

    status: bytes
    modes: Words
    mask: Words
    held_slots: tuple[int, ...]


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
    held_slots = []
    for slot in range(n):
        mode = int(modes[slot])
        if not on[arms[slot] - 1] and mode not in INCREMENTAL:
            replied[slot] = mode
            mask[slot, D1:] = _ALL_BITS
        elif mode in _RETURNED_WORDS:
            replied[slot] = mode
            mask[slot, list(_RETURNED_WORDS[mode])] = _ALL_BITS
            if mode in HOLDABLE:
                held_slots.append(slot)
    reply_status = bytes(
        status[arm - 1] if arm in arms and not on[arm - 1] else 0 for arm in range(1, N_ARMS + 1)
    )
    return SafeReply(reply_status, replied, mask, tuple(held_slots))


def words_of(packet: CyclicPacket) -> Words:
    """Return the axis blocks as (n, 9) words, a view, which preserves NaN payloads."""
    return packet.axes.view(np.int32).reshape(-1, WORDS_PER_AXIS)


class ReplyBuilder:
    """Builds the replies to one controller, 12 + 36 n bytes each, in place.

    `fill_safe` or `fill_refusal` begins a reply, `finish` ends it; set-points are written into
    `floats` in between.

    Args:
        n_axes: slots of the controller's packets.
        arm: the arm that is moved, from 1.
        axes: open axes by the controller's map; none if that is invalid.

    Attributes:
        floats: the axis blocks as (n, 9) numbers.
    """

    def __init__(self, n_axes: int, arm: int, axes: Sequence[OpenAxis] = ()) -> None:
        self._buffer = bytearray(cyclic_length(n_axes))
        words: Words = np.frombuffer(self._buffer, np.int32, offset=HEADER_LENGTH)
        self._words = words.reshape(n_axes, WORDS_PER_AXIS)
        self.floats: Floats = self._words.view(np.float32)
        self._arm = arm
        self._axis_of = {axis.slot: (axis.arm, axis.axis) for axis in axes}
        self._status = bytes(N_ARMS)

    def fill_safe(self, reply: SafeReply, received: Words) -> None:
        """Fill in the safe reply in every slot."""
        np.bitwise_and(received, reply.mask, out=self._words)
        self._words[:, MODE] = reply.modes
        self._status = reply.status

    def fill_refusal(self, reply: SafeReply, received: Words, offending: int | None) -> None:
        """Report a following error, 508, in slot `offending`, or request drive-off, 505, in all.

        Targets received are returned in case they are used. With a 508 open axes hold theirs, so
        each must be finite; otherwise drive-off is requested.
        """
        self.fill_safe(reply, received)
        data = self.floats[:, D1:]
        data[~np.isfinite(data)] = 0.0
        targets = received.view(np.float32)[list(reply.held_slots), D1]
        if offending is None or not np.isfinite(targets).all():
            self._words[:, MODE] = Mode.DRIVE_OFF_REQUEST
        else:
            self._words[offending, MODE] = Mode.FOLLOWING_ERROR

    def require_targets(self, slots: Sequence[int], cycle: int) -> None:
        """Require finite targets where they are returned in an open mode, in axes of any arm.

        Raises:
            RefusalError: one is not finite.
        """
        if not slots:
            return
        values = self.floats[list(slots), D1]
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            arm, axis = self._axis_of.get(slots[bad[0]], (self._arm, slots[bad[0]]))
            name = f"axis {axis + 1} of arm {arm}"
            message = f"target received of {name}, which is open, is {values[bad[0]]}"
            raise RefusalError(message, cycle)

    def request_exit(self) -> None:
        """Ask for the end of open mode in the status byte of the arm."""
        status = bytearray(self._status)
        status[self._arm - 1] = EXIT_FROM_OPEN
        self._status = bytes(status)

    def finish(self, number: int) -> bytes:
        """Return the reply to packet `number`; functionality is always zero."""
        _HEADER.pack_into(self._buffer, 0, next_number(number), self._status, 0)
        return bytes(self._buffer)


@dataclass(frozen=True, eq=False)
class PacketStatus:
    """Status bytes and modes of a packet, interpreted.

    Attributes:
        input: of the state machine.
        reply: the safe reply.
        status: status byte of the arm.
        modes: (n,) mode of each joint.
        ready: (n,) joints in the wanted mode; closed ones where they are to stay closed.
        held_joints: (n,) joints in an open mode whose safe reply is the target received.
        powered: some wanted axis is in an open mode and the drive is on.
        any_open: some wanted axis is in an open mode.
        unwanted: first joint in an open mode other than the wanted one, or None.
        other_slots: slots in `reply.held_slots` that are not joints of the arm.
    """

    input: Input
    reply: SafeReply
    status: int
    modes: NDArray[np.int32]
    ready: NDArray[np.bool_]
    held_joints: NDArray[np.bool_]
    powered: bool
    any_open: bool
    unwanted: int | None
    other_slots: tuple[int, ...]

    @property
    def fault(self) -> str:
        """Why these modes are refused, by the first unknown one, else the first open one."""
        with_reply = np.isin(self.modes, list(KNOWN_MODES))
        joint = int(
            np.argmax(np.isin(self.modes, list(OPEN_MODES)) if with_reply.all() else ~with_reply)
        )
        reason = (
            "it was not closed before" if with_reply.all() else "the reply to that mode is unknown"
        )
        return f"joint {joint + 1} is in mode {self.modes[joint]}: {reason}"

    def misplaced(self, in_motion: bool) -> int | None:
        """Return a joint that is not in the mode a requested motion needs, or None.

        Before the motion an axis may still be closed; `in_motion` every one has to be open.
        """
        if not self.powered:
            return None
        if in_motion and self.input is not Input.OPEN:
            return int(np.argmin(self.ready))
        return self.unwanted


class PacketClassifier:
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
        self._last: PacketStatus | None = None

    def classify(self, status: bytes, modes: Words) -> PacketStatus:
        """Interpret 4 status bytes and the modes of all slots."""
        key = (status, modes.tobytes())
        if self._last is None or key != self._key:
            self._key = key
            self._last = self._interpret(status, modes.copy())
        return self._last

    def _interpret(self, status: bytes, modes: Words) -> PacketStatus:
        wanted = modes[self._slots]
        drive_on = (DRIVE_ON in status) if self._arms is None else status[self._arm - 1] == DRIVE_ON
        is_open = np.isin(wanted, list(OPEN_MODES))
        closed = ~self._opened & np.isin(wanted, list(CLOSED_MODES))
        ready = closed | (self._opened & (wanted == self._mode))
        unwanted = np.flatnonzero(is_open & ~ready)
        reply = safe_reply(status, modes, self._arms)
        joints = set(self._slots.tolist())
        return PacketStatus(
            input=read_input(drive_on, modes.tolist(), wanted[~closed].tolist(), self._mode),
            reply=reply,
            status=status[self._arm - 1],
            modes=wanted,
            ready=ready,
            held_joints=np.isin(wanted, list(HOLDABLE)),
            powered=drive_on and bool(is_open.any()),
            any_open=bool(is_open.any()),
            unwanted=int(unwanted[0]) if unwanted.size else None,
            other_slots=tuple(slot for slot in reply.held_slots if slot not in joints),
        )
