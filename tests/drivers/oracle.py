"""What a PC has to answer, written from the facts on the C4G Open wire (sections 2 and 6) alone.

Knows nothing of the package under test: layout, codes and the safe answer are stated here a
second time, on raw 4-byte words, so that NaN and signed zeros are compared bit for bit.
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

DRIVE_ON = 5
ZERO = bytes(4)
HOLDS_A_POSITION = (1, 4, 5, 11, 14, 15)
TAKES_INCREMENTS = (2, 7, 8, 9, 12, 17)
OPEN = HOLDS_A_POSITION + TAKES_INCREMENTS
DRIVE_OFF_REQUEST = 505
FOLLOWING_ERROR = 508


class Axis(NamedTuple):
    """One axis block: D1..D5 and extra1..3 are words `d[0]` .. `d[7]`."""

    mode: int
    d: tuple[bytes, ...]

    @property
    def floats(self) -> tuple[float, ...]:
        return tuple(struct.unpack("<f", word)[0] for word in self.d)

    def keep(self, *fields: int) -> Axis:
        """These fields (1 = D1) as they are, zero in the others."""
        return Axis(self.mode, tuple(w if k + 1 in fields else ZERO for k, w in enumerate(self.d)))


class Packet(NamedTuple):
    number: int
    status: bytes
    functionality: bytes
    axes: tuple[Axis, ...]


def length(n: int) -> int:
    return 12 + 36 * n


def answer_number(number: int) -> int:
    return 1 if number == 0x7FFF else number + 1


def parse(data: bytes, n: int) -> Packet:
    """The first n slots of a cyclic packet."""
    number = int.from_bytes(data[:4], "little", signed=True)
    axes = []
    for slot in range(n):
        block = data[12 + 36 * slot : 48 + 36 * slot]
        mode = int.from_bytes(block[:4], "little", signed=True)
        axes.append(Axis(mode, tuple(block[4 + 4 * k : 8 + 4 * k] for k in range(8))))
    return Packet(number, data[4:8], data[8:12], tuple(axes))


def build(packet: Packet) -> bytes:
    head = packet.number.to_bytes(4, "little", signed=True) + packet.status + packet.functionality
    return head + b"".join(
        axis.mode.to_bytes(4, "little", signed=True) + b"".join(axis.d) for axis in packet.axes
    )


def safe_axis(axis: Axis, drive_on: bool) -> Axis:
    """The answer to an axis that nobody moves: an independent program's, on a real robot.

    In an open mode the received target is held: D1 as received, at zero velocity; where the mode
    takes increments, by zeros, for only one status is known to mean that the drive is on, and a
    position echoed as an increment would be a jump.
    """
    if axis.mode in TAKES_INCREMENTS:
        return axis.keep()
    if not drive_on:
        return axis
    if axis.mode in (0, 501):
        return axis.keep(1, 2)
    if axis.mode == 10:
        return axis.keep(1, 2, 3, 4, 5)
    if axis.mode in HOLDS_A_POSITION:
        return axis.keep(1)
    return Axis(0, (ZERO,) * 8)


def safe_answer(received: Packet, arms: tuple[int, ...]) -> Packet:
    """The whole answer where nothing is moved; `arms` says whose axis stands in which slot."""
    on = [byte == DRIVE_ON for byte in received.status]
    status = bytes(
        0 if on[arm] or arm + 1 not in arms else received.status[arm] for arm in range(4)
    )
    axes = tuple(
        safe_axis(axis, on[arm - 1]) for axis, arm in zip(received.axes, arms, strict=True)
    )
    return Packet(answer_number(received.number), status, ZERO, axes)


def lost_target(received: Packet, arms: tuple[int, ...]) -> bool:
    """An axis open with its drive on, of whichever arm, has a target that is no number."""
    return any(
        axis.mode in HOLDS_A_POSITION
        and received.status[arm - 1] == DRIVE_ON
        and not math.isfinite(axis.floats[0])
        for axis, arm in zip(received.axes, arms, strict=True)
    )


def drive_off(answer: Packet) -> bool:
    return all(axis.mode == DRIVE_OFF_REQUEST for axis in answer.axes)


def echo(data: bytes) -> bytes:
    """The answer to sync and init packets."""
    number = int.from_bytes(data[:4], "little", signed=True)
    return answer_number(number).to_bytes(4, "little") + data[4:]


def differences(ours: Packet, expected: Packet) -> list[str]:
    """Names of the fields in which two answers differ, slots counted from 0."""
    found = [
        name
        for name in ("number", "status", "functionality")
        if getattr(ours, name) != getattr(expected, name)
    ]
    assert len(ours.axes) == len(expected.axes)
    names = ("D1", "D2", "D3", "D4", "D5", "extra1", "extra2", "extra3")
    for slot, (a, b) in enumerate(zip(ours.axes, expected.axes, strict=True)):
        if a.mode != b.mode:
            found.append(f"mode[{slot}]")
        found += [f"{n}[{slot}]" for n, x, y in zip(names, a.d, b.d, strict=True) if x != y]
    return found
