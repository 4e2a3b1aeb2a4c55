"""A link in virtual time to a simulated controller in the same process, and its scripted faults.

Faults are by cycle of the controller; 0 is the first packet that it sends.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Final, Literal, NamedTuple, Protocol

from drivers.errors import TransportClosed

Direction = Literal["to_pc", "to_controller"]

OVERTAKING_DELAY_CYCLES: Final = 1.25
"""Delay of a packet that is overtaken by the next, in cycles."""
MAX_CYCLES: Final = 1_000_000_000
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
    """The packet of each of these cycles is overtaken by the next one."""


@dataclass(frozen=True)
class Delay(_Packets):
    """The packets of `count` cycles from `cycle` on arrive later, by `seconds` plus `cycles`."""

    seconds: float = field(default=0.0, kw_only=True)
    cycles: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        if not 0.0 < self.seconds + self.cycles < inf:
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
        delay = 0.0
        copies = 1
        for cycles, fault in self._planned[direction]:
            if cycle not in cycles:
                continue
            match fault:
                case Lose():
                    return []
                case Delay():
                    delay += fault.seconds + fault.cycles * self._period
                case Reorder():
                    delay += OVERTAKING_DELAY_CYCLES * self._period
                case Duplicate():
                    copies += 1
                case Corrupt():
                    packet = fault.apply(packet)
        return [(delay, packet)] * copies


class Peer(Protocol):
    """A simulated controller. Each cycle: one `next_packet`, then one `accept`."""

    @property
    def period(self) -> float:
        """Cycle, s."""

    def next_packet(self) -> bytes | None:
        """Return the packet of the next cycle, empty for none; None at the end of the session."""

    def accept(self, reply: bytes | None) -> None:
        """Receive the reply to it; None if none arrived within the cycle."""


class _Delayed(NamedTuple):
    """A delayed packet: time of arrival, cycle in which it was sent, content."""

    due: float
    cycle: int
    packet: bytes


class SimulatedTransport:
    """Carries packets between a session and a peer, one cycle of virtual time per packet.

    Deterministic: the same peer, session and faults give the same bytes at the same times. The peer
    gets at most one reply per cycle, and none that was sent in an earlier cycle.

    Attributes:
        cycle: cycles begun so far.
        surplus_replies: replies beyond the first of a cycle (those to duplicates).
        late_replies: replies that arrived after the cycle in which they were sent.
    """

    def __init__(self, peer: Peer, faults: Sequence[Fault] = ()) -> None:
        self.cycle = 0
        self.surplus_replies: list[bytes] = []
        self.late_replies: list[bytes] = []
        self._peer = peer
        self._link = FaultyLink(faults, peer.period)
        self._arrived: deque[bytes] = deque()
        self._to_pc: list[_Delayed] = []
        self._to_controller: list[_Delayed] = []
        self._waiting = 0.0
        self._awaiting_reply = False
        self._closed = False

    @property
    def now(self) -> float:
        """Virtual time, s; a count of cycles, so that it does not drift."""
        return self.cycle * self._peer.period + self._waiting

    def rejected(self) -> dict[str, int]:
        """Return nothing: the link discards no packets."""
        return {}

    def forget_peer(self) -> None:
        """Do nothing: there is only one peer."""

    def receive(self, timeout: float) -> bytes | None:
        """Return the next packet; None after `timeout` s without one. Raises TransportClosed."""
        self._require_open()
        remaining = timeout
        while True:
            if self._arrived:
                return self._arrived.popleft()
            remaining = self._advance(remaining)
            if remaining < 0.0:
                return None

    def _advance(self, timeout: float) -> float:
        """Advance to the next event; returns the time left, negative if it expired before."""
        until_cycle = self._peer.period - self._waiting
        until_arrival = self._next_due() - self.now
        until_event = min(until_cycle, max(0.0, until_arrival))
        if timeout < until_event:
            self._waiting += max(0.0, timeout)
            return -1.0
        if until_arrival < until_cycle:
            self._waiting += until_event
        else:
            packet = self._next_cycle()
            if packet is not None:
                self._arrived.append(packet)
        self._deliver()
        return timeout - until_event

    def _next_due(self) -> float:
        """Time of arrival of the next delayed packet, in either direction."""
        if not (self._to_pc or self._to_controller):
            return inf
        return min(delayed.due for delayed in (*self._to_pc, *self._to_controller))

    def _next_cycle(self) -> bytes | None:
        """Begin a cycle; returns the packet that arrives at once, if any."""
        if self._awaiting_reply:
            self._peer.accept(None)
        packet = self._peer.next_packet()
        if packet is None:
            self.close()
            raise TransportClosed("the simulated controller has no more packets")
        index = self.cycle
        self.cycle += 1
        self._waiting = 0.0
        self._awaiting_reply = True
        deliveries = self._link.carry(index, "to_pc", packet)
        at_once = [content for delay, content in deliveries if delay <= 0.0]
        self._to_pc += [
            _Delayed(self.now + delay, index, content) for delay, content in deliveries if delay > 0
        ]
        self._arrived.extend(at_once[1:])
        return at_once[0] if at_once else None

    def _deliver(self) -> None:
        """Deliver the packets due by now, in the order of arrival."""
        if not (self._to_pc or self._to_controller):
            return
        now = self.now
        self._arrived.extend(d.packet for d in sorted(self._to_pc) if d.due <= now)
        self._to_pc = [d for d in self._to_pc if d.due > now]
        for reply in sorted(d for d in self._to_controller if d.due <= now):
            self._hand_over(reply.packet, reply.cycle)
        self._to_controller = [d for d in self._to_controller if d.due > now]

    def send(self, packet: bytes) -> None:
        """Send a reply in the present cycle; raises TransportClosed."""
        self._require_open()
        index = self.cycle - 1
        for delay, content in self._link.carry(index, "to_controller", packet):
            if delay > 0.0:
                self._to_controller.append(_Delayed(self.now + delay, index, content))
            else:
                self._hand_over(content, index)

    def _hand_over(self, reply: bytes, sent_in: int) -> None:
        """Deliver a reply if the peer waits for one of that cycle."""
        if sent_in != self.cycle - 1:
            self.late_replies.append(reply)
        elif self._awaiting_reply:
            self._awaiting_reply = False
            self._peer.accept(reply)
        else:
            self.surplus_replies.append(reply)

    def close(self) -> None:
        """Close the link."""
        self._closed = True
        self._awaiting_reply = False

    def _require_open(self) -> None:
        if self._closed:
            raise TransportClosed("the simulated link was closed")
