"""Faults of a link, as a script that says what happens in which cycle.

Cycles are those of the controller: 0 is the first packet it sends. `FaultyLink` turns a script into
what arrives and when, for a link in virtual time and for a real one alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final, Literal

Direction = Literal["to_pc", "to_controller"]

OVERTAKEN_BY: Final = 1.25
"""Cycles by which a packet is held up that the next one is to overtake."""


MOST_CYCLES: Final = 1_000_000_000
"""Largest cycle and count of a fault: more than eleven days at 1 ms."""


@dataclass(frozen=True)
class _Packets:
    """The packets of `count` cycles from `cycle` on, of one direction."""

    cycle: int
    direction: Direction = "to_pc"
    count: int = 1

    def __post_init__(self) -> None:
        _require_cycles(self, self.cycle, self.count)


@dataclass(frozen=True)
class Lose(_Packets):
    """The packets of `count` cycles from `cycle` on never arrive."""


@dataclass(frozen=True)
class Delay:
    """The packets of `count` cycles from `cycle` on arrive later, by `seconds` plus `cycles`."""

    cycle: int
    seconds: float = 0.0
    cycles: float = 0.0
    direction: Direction = "to_pc"
    count: int = 1

    def __post_init__(self) -> None:
        _require_cycles(self, self.cycle, self.count)
        for value in (self.seconds, self.cycles):
            if not (isfinite(value) and value >= 0.0):
                raise ValueError(f"Delay: {value} is not a time of 0 or more")
        if not self.seconds + self.cycles > 0.0:
            raise ValueError("Delay: neither seconds nor cycles were given")


@dataclass(frozen=True)
class Duplicate(_Packets):
    """The packets of `count` cycles from `cycle` on arrive twice."""


@dataclass(frozen=True)
class Reorder:
    """The packet of this cycle is overtaken by that of the next."""

    cycle: int
    direction: Direction = "to_pc"

    def __post_init__(self) -> None:
        _require_cycles(self, self.cycle, 1)


@dataclass(frozen=True)
class Corrupt:
    """One byte of the packets of some cycles is changed: exclusive-or of `mask` at `offset`."""

    cycle: int
    offset: int
    mask: int = 0xFF
    direction: Direction = "to_pc"
    count: int = 1

    def __post_init__(self) -> None:
        _require_cycles(self, self.cycle, self.count)
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


Fault = Lose | Delay | Duplicate | Reorder | Corrupt


def _require_cycles(fault: object, cycle: int, count: int) -> None:
    name = type(fault).__name__
    if cycle < 0:
        raise ValueError(f"{name}: cycle {cycle} is negative")
    if count < 1:
        raise ValueError(f"{name}: count {count} is not positive")
    for what, value in (("cycle", cycle), ("count", count)):
        if value > MOST_CYCLES:
            raise ValueError(f"{name}: {what} is more than {MOST_CYCLES}")


class FaultyLink:
    """What arrives of each packet, and when. Pure: the same question has the same answer.

    Args:
        faults: the script.
        period: the controller's cycle, s.
    """

    def __init__(self, faults: Sequence[Fault], period: float) -> None:
        self._period = period
        self._planned: dict[Direction, list[tuple[range, Fault]]] = {
            "to_pc": [],
            "to_controller": [],
        }
        for fault in faults:
            cycles = range(fault.cycle, fault.cycle + getattr(fault, "count", 1))
            self._planned[fault.direction].append((cycles, fault))

    def carry(self, cycle: int, direction: Direction, packet: bytes) -> list[tuple[float, bytes]]:
        """The deliveries of the packet sent in `cycle`: delay in s, and bytes.

        An empty packet stands for none: a controller that is silent in this cycle.
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
