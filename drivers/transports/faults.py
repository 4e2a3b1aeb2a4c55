"""Scripted faults of a link, by cycle of the controller; 0 is the first packet that it sends.

`FaultyLink` applies them to packets, in virtual time and on real links.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

Direction = Literal["to_pc", "to_controller"]

OVERTAKEN_BY: Final = 1.25
"""Delay of a packet that is overtaken by the next, in cycles."""
MOST_CYCLES: Final = 1_000_000_000
"""Largest cycle and count of a fault: more than eleven days at 1 ms."""


@dataclass(frozen=True)
class _Packets:
    """The packets of `count` cycles from `cycle` on, of one direction."""

    cycle: int
    direction: Direction = "to_pc"
    count: int = 1


class Lose(_Packets):
    """The packets of `count` cycles from `cycle` on never arrive."""


class Duplicate(_Packets):
    """The packets of `count` cycles from `cycle` on arrive twice."""


class Reorder(_Packets):
    """The packet of each of these cycles is overtaken by that of the next."""


@dataclass(frozen=True)
class Delay(_Packets):
    """The packets of `count` cycles from `cycle` on arrive later, by `seconds` plus `cycles`."""

    seconds: float = field(default=0.0, kw_only=True)
    cycles: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        if not 0.0 < self.seconds + self.cycles < math.inf:
            raise ValueError("the delay is not a finite time above zero")


@dataclass(frozen=True)
class Corrupt(_Packets):
    """One byte of the packets is changed: exclusive-or of `mask` at `offset`."""

    offset: int = field(kw_only=True)
    mask: int = field(default=0xFF, kw_only=True)

    def __post_init__(self) -> None:
        if not 1 <= self.mask <= 0xFF:
            raise ValueError(f"the mask {self.mask} is not one of 1..255")

    def apply(self, packet: bytes) -> bytes:
        """Return the packet with that byte changed; unchanged if it is shorter."""
        if self.offset >= len(packet):
            return packet
        changed = bytearray(packet)
        changed[self.offset] ^= self.mask
        return bytes(changed)


Fault = Lose | Delay | Duplicate | Reorder | Corrupt


class FaultyLink:
    """Deliveries of each packet under scripted faults, without state; `period` in s."""

    def __init__(self, faults: Sequence[Fault], period: float) -> None:
        self._period = period
        self._planned: dict[Direction, list[tuple[range, Fault]]] = {
            "to_pc": [],
            "to_controller": [],
        }
        for fault in faults:
            cycles = range(fault.cycle, fault.cycle + fault.count)
            self._planned[fault.direction].append((cycles, fault))

    def carry(self, cycle: int, direction: Direction, packet: bytes) -> list[tuple[float, bytes]]:
        """Return the deliveries of the packet sent in `cycle`: delay in s, and bytes.

        An empty packet means that nothing is sent in this cycle.
        """
        if not packet:
            return []
        delay, copies = 0.0, 1
        for cycles, fault in self._planned[direction]:
            if cycle not in cycles:
                continue
            match fault:
                case Lose():
                    return []
                case Delay():
                    delay += fault.seconds + fault.cycles * self._period
                case Reorder():
                    delay += OVERTAKEN_BY * self._period
                case Duplicate():
                    copies += 1
                case Corrupt():
                    packet = fault.apply(packet)
        return [(delay, packet)] * copies
