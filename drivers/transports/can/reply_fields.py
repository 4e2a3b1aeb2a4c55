"""What a reply says, in the words that the frames have for it.

Most replies give back what the controller sent (the drive is off, the axes are closed). The PC has
some of that only as aged or rounded values, so such an axis is not sent at all: it is *mirrored*,
and the controller's end fills in what it sent itself, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.packets import (
    AXIS_DTYPE,
    DRIVE_ON,
    HEADER_LENGTH,
    N_ARMS,
    CyclicPacket,
    Mode,
    next_number,
)
from drivers.transports.can.errors import CanModeError, CanValueError
from drivers.transports.can.slow import WORDS_PER_AXIS, Words

_D1, _D2, _D5, _EXTRA1 = 1, 2, 5, 6
_TARGETS_BACK: Final = frozenset((int(Mode.CLOSED), int(Mode.DRIVING_ON)))
NO_TARGET: Final = frozenset((int(Mode.DRIVE_OFF_REQUEST), int(Mode.FOLLOWING_ERROR)))
"""Modes of an answer whose targets the controller ignores."""


class AxisAnswer(NamedTuple):
    """The answer for one axis; `d1` and `d2` mean nothing where it is mirrored."""

    mirrored: bool
    mode: int
    d1: float
    d2: float


@dataclass(frozen=True)
class Answer:
    """One reply. `status` is the status byte of the arm."""

    number: int
    status: int
    axes: tuple[AxisAnswer, ...]


@dataclass(frozen=True, eq=False)
class Sent:
    """The cyclic packet that is answered, as one end knows it.

    Attributes:
        number: its number.
        status: status byte of arm 1.
        words: (n, 9) its axis blocks.
        mask: (n, 9) all bits set in what a mirrored axis gives back.
        mirrors: (n,) whether the axis can be mirrored at all.
    """

    number: int
    status: int
    words: Words
    mask: Words
    mirrors: NDArray[np.bool_]

    @property
    def modes(self) -> list[int]:
        """Mode of each slot."""
        modes: list[int] = self.words[:, 0].tolist()
        return modes


def words_of(packet: bytes, n_axes: int) -> Words:
    """The axis blocks of a cyclic packet as (n, 9) words; a read-only view."""
    count = n_axes * AXIS_DTYPE.itemsize // 4
    return np.frombuffer(packet, np.int32, count, HEADER_LENGTH).reshape(n_axes, WORDS_PER_AXIS)


class Mirror:
    """Works out what a mirrored axis gives back; remembers the last, because modes rarely change.

    With the drive off everything, in modes 0 and 501 D1 and D2, in mode 10 D1 to D5.
    """

    def __init__(self) -> None:
        self._key: tuple[int, bytes] | None = None
        self._mask: Words = np.zeros((0, WORDS_PER_AXIS), np.int32)
        self._mirrors = np.zeros(0, np.bool_)

    def sent(self, packet: bytes, n_axes: int) -> Sent:
        """Understand the packet that is answered."""
        words = words_of(packet, n_axes)
        number = int.from_bytes(packet[:4], "little", signed=True)
        status = packet[4]
        key = (status, words[:, 0].tobytes())
        if key != self._key:
            self._key = key
            self._mask, self._mirrors = _mirrored(status, words[:, 0].tolist())
        return Sent(number, status, words, self._mask, self._mirrors)


def _mirrored(status: int, modes: Sequence[int]) -> tuple[Words, NDArray[np.bool_]]:
    mask = np.zeros((len(modes), WORDS_PER_AXIS), np.int32)
    for slot, mode in enumerate(modes):
        if status != DRIVE_ON:
            mask[slot] = -1
        elif mode in _TARGETS_BACK:
            mask[slot, : _D2 + 1] = -1
        elif mode == Mode.CLOSED_MIRRORED:
            mask[slot, : _D5 + 1] = -1
    return mask, mask[:, 0] != 0


def read_reply(reply: bytes, sent: Sent) -> Answer:
    """Put a reply into words.

    Raises:
        CanModeError: it carries what the frames have no room for.
        CanValueError: a target is not finite.
    """
    n_axes = len(sent.words)
    words = words_of(reply, n_axes)
    mirrored = sent.mirrors & (words == (sent.words & sent.mask)).all(axis=1)
    floats = words.view(np.float32)
    surplus = (floats[:, _D2 + 1 :] != 0.0).any(axis=1) & ~mirrored
    modes: list[int] = words[:, 0].tolist()
    if surplus.any():
        slot = int(np.flatnonzero(surplus)[0])
        raise CanModeError(
            modes[slot], slot,
            f"the answer in mode {modes[slot]} (slot {slot}) needs more than D1 and D2",
        )  # fmt: skip
    targets = floats[:, _D1 : _D2 + 1].tolist()
    axes = tuple(
        AxisAnswer(bool(same), mode, d1, d2)
        for same, mode, (d1, d2) in zip(mirrored, modes, targets, strict=True)
    )
    for slot, axis in enumerate(axes):
        if not axis.mirrored:
            _require_finite(axis, slot)
    return Answer(int.from_bytes(reply[:4], "little", signed=True), reply[4], axes)


def _require_finite(axis: AxisAnswer, slot: int) -> None:
    for field, value in (("D1", axis.d1), ("D2", axis.d2)):
        if not math.isfinite(value):
            raise CanValueError(field, slot, value, "finite numbers")


def write_reply(answer: Answer, sent: Sent) -> bytes:
    """The reply itself, at the controller's end: 12 + 36 n bytes."""
    packet = CyclicPacket.zeros(answer.number, len(answer.axes))
    words = packet.axes.view(np.int32).reshape(-1, WORDS_PER_AXIS)
    floats = words.view(np.float32)
    for slot, axis in enumerate(answer.axes):
        if axis.mirrored:
            words[slot] = sent.words[slot] & sent.mask[slot]
        else:
            words[slot, 0] = axis.mode
            floats[slot, _D1] = axis.d1
            floats[slot, _D2] = axis.d2
    status = bytes((answer.status, *bytes(N_ARMS - 1)))
    return CyclicPacket(answer.number, status, packet.functionality, packet.axes).encode()


def drive_off(sent: Sent) -> Answer:
    """Mode 505 in every axis: what is sent where an answer cannot be."""
    number = next_number(sent.number)
    axes = (AxisAnswer(False, int(Mode.DRIVE_OFF_REQUEST), 0.0, 0.0),) * len(sent.words)
    return Answer(number, 0, axes)
