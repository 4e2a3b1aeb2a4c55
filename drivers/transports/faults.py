"""Faults of a link, as a script that says what happens in which cycle.

Cycles are those of the transport: 0 is the first packet the controller sends.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Direction = Literal["to_pc", "to_controller"]


@dataclass(frozen=True)
class Lose:
    """The packets of `count` cycles from `cycle` on never arrive."""

    cycle: int
    direction: Direction = "to_pc"
    count: int = 1

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"Lose: count {self.count} is not positive")


@dataclass(frozen=True)
class Duplicate:
    """The controller's packet of this cycle arrives twice."""

    cycle: int


@dataclass(frozen=True)
class Corrupt:
    """One byte of the packet of this cycle is changed: exclusive-or of `mask` at `offset`."""

    cycle: int
    offset: int
    mask: int = 0xFF
    direction: Direction = "to_pc"

    def __post_init__(self) -> None:
        if not 1 <= self.mask <= 0xFF:
            raise ValueError(f"Corrupt: mask {self.mask} is not one of 1..255")
        if self.offset < 0:
            raise ValueError(f"Corrupt: offset {self.offset} is negative")

    def apply(self, packet: bytes) -> bytes:
        """The packet with that byte changed; unchanged if it is shorter."""
        if self.offset >= len(packet):
            return packet
        changed = bytearray(packet)
        changed[self.offset] ^= self.mask
        return bytes(changed)


Fault = Lose | Duplicate | Corrupt
