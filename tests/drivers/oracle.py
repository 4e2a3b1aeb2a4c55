"""Expected replies, written from the facts on the C4G Open wire (sections 2 and 6) alone.

Independent of the package under test: layout, codes and the safe reply are implemented here a
second time, on raw 4-byte words, so that NaN and signed zeros are compared bit for bit.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Literal, NamedTuple

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
        """Return the block with these fields (1 = D1) and zero in the others."""
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
    """Return the reply to an axis without motion, that of an independent program on a real robot.

    In an open mode the received target is held: D1 as received, at zero velocity; in a mode of
    increments zeros, because only one status is known to mean that the drive is on, and a position
    echoed as an increment would be a jump.
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
    """Return the reply without motion; `arms` is the arm of each slot."""
    on = [byte == DRIVE_ON for byte in received.status]
    status = bytes(
        0 if on[arm] or arm + 1 not in arms else received.status[arm] for arm in range(4)
    )
    axes = tuple(
        safe_axis(axis, on[arm - 1]) for axis, arm in zip(received.axes, arms, strict=True)
    )
    return Packet(answer_number(received.number), status, ZERO, axes)


def lost_target(received: Packet, arms: tuple[int, ...]) -> bool:
    """Whether the target of an open axis of any arm with its drive on is not finite."""
    return any(
        axis.mode in HOLDS_A_POSITION
        and received.status[arm - 1] == DRIVE_ON
        and not math.isfinite(axis.floats[0])
        for axis, arm in zip(received.axes, arms, strict=True)
    )


def drive_off(answer: Packet) -> bool:
    return all(axis.mode == DRIVE_OFF_REQUEST for axis in answer.axes)


def echo(data: bytes) -> bytes:
    """Return the reply to sync and init packets."""
    number = int.from_bytes(data[:4], "little", signed=True)
    return answer_number(number).to_bytes(4, "little") + data[4:]


def differences(ours: Packet, expected: Packet) -> list[str]:
    """Names of the fields in which two answers differ, slots counted from 0."""
    different = [
        name
        for name in ("number", "status", "functionality")
        if getattr(ours, name) != getattr(expected, name)
    ]
    assert len(ours.axes) == len(expected.axes)
    names = ("D1", "D2", "D3", "D4", "D5", "extra1", "extra2", "extra3")
    for slot, (a, b) in enumerate(zip(ours.axes, expected.axes, strict=True)):
        if a.mode != b.mode:
            different.append(f"mode[{slot}]")
        different += [f"{n}[{slot}]" for n, x, y in zip(names, a.d, b.d, strict=True) if x != y]
    return different


LAST = 0x7FFF
SAMPLE_TIME = slice(224, 228)
"""Of an init packet, ms."""
Kind = Literal["nothing", "again", "echo", "init", "cyclic"]


def number_of(packet: bytes) -> int:
    return int.from_bytes(packet[:4], "little", signed=True)


@dataclass
class Reception:
    """Which packets get a reply, and which are duplicates.

    Attributes:
        silence: s after which a packet is none of the same session any more.
        window: numbers ahead of the last one that are later packets of it; from the init packet on
            what comes within `silence`, of two readings of a number the nearer one.
    """

    silence: float
    window: int = LAST // 2
    last: int = 0
    n_axes: int | None = None
    silent: bool = False
    ended: bool = False
    cold: bool = False
    synced: bool = False
    at_init: bool = False
    last_packet: bytes = b""

    def expect(self, packet: bytes) -> Kind:
        """Return the kind of reply to a packet, and record a packet that gets one."""
        kind = self._expect(packet)
        if kind in ("echo", "init", "cyclic"):
            self.last = number_of(packet)
            self.last_packet = packet
            self.silent = False
            self.at_init = kind == "init" or (kind == "echo" and self.at_init)
        return kind

    def _expect(self, packet: bytes) -> Kind:
        if self.ended:
            return "nothing"
        if len(packet) == 1200 and number_of(packet) == 10:
            return self._init(packet)
        number = number_of(packet)
        if len(packet) < 12 or not 1 <= number <= LAST:
            return "nothing"
        on = DRIVE_ON in packet[4:8]
        if self.n_axes is None:
            if on or len(packet) >= 1200:
                return "nothing"
            self.synced = True
            return "echo"
        # A silence, or a clock set forward, ends the start as well.
        if self.at_init and self.cold and not self.silent and number in (11, 12) and not on:
            return "echo" if len(packet) < 1200 else "nothing"
        ahead = (number - self.last) % LAST
        if self.silent and not on and number < 10 and ahead != 1:
            if len(packet) < 1200:
                self.n_axes = None
                self.at_init = False
                self.synced = True
                return "echo"
            return "nothing"
        if not length(self.n_axes) <= len(packet) <= length(20):
            return "nothing"
        if self.silent:
            return "cyclic"
        if ahead == 0:
            # The same number on other bytes is another packet, of no known time.
            return "again" if packet == self.last_packet else "nothing"
        return "cyclic" if ahead <= self.window else "nothing"

    def _init(self, packet: bytes) -> Kind:
        n = int.from_bytes(packet[12:16], "little", signed=True)
        if not 1 <= n <= 20:
            return "nothing"
        if self.at_init and packet == self.last_packet:
            return "again"
        self.cold = self.n_axes is None and self.synced
        self.n_axes = n
        self.synced = False
        cycle = max(1, int.from_bytes(packet[SAMPLE_TIME], "little", signed=True)) / 1000.0
        self.window = max(1, int(min(self.silence / cycle, LAST // 2)))
        return "init"
