"""A link in virtual time, to a controller that is an object in the same process."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Protocol

from drivers.errors import TransportClosed
from drivers.transports.faults import Corrupt, Direction, Duplicate, Fault, Lose


class Peer(Protocol):
    """The controller's end. Each cycle: one `next_packet`, then one `accept`."""

    @property
    def period(self) -> float:
        """Cycle in s."""
        ...

    def next_packet(self) -> bytes | None:
        """The packet of the next cycle; None when there will be no more."""
        ...

    def accept(self, reply: bytes | None) -> None:
        """The answer to it; None if none arrived within the cycle."""
        ...


class SimulatedTransport:
    """Carries packets between a session and a peer, one cycle of virtual time per packet.

    Deterministic: the same peer, session and faults give the same bytes at the same times. Time
    is a count of cycles, so that it does not drift.

    Args:
        peer: the controller's end.
        faults: what goes wrong, see `drivers.transports.faults`.

    Attributes:
        cycle: cycles begun so far.
        surplus_replies: answers beyond the first of a cycle (those to duplicates); the peer, which
            takes one answer a cycle, does not see them.
    """

    def __init__(self, peer: Peer, faults: Sequence[Fault] = ()) -> None:
        self.cycle = 0
        self.surplus_replies: list[bytes] = []
        self._peer = peer
        self._lost: set[tuple[int, Direction]] = set()
        self._duplicated: set[int] = set()
        self._corrupted: dict[tuple[int, Direction], list[Corrupt]] = {}
        for fault in faults:
            self._plan(fault)
        self._arrived: deque[bytes] = deque()
        self._waiting = 0.0
        self._awaiting_reply = False
        self._closed = False

    def _plan(self, fault: Fault) -> None:
        if isinstance(fault, Lose):
            cycles = range(fault.cycle, fault.cycle + fault.count)
            self._lost.update((cycle, fault.direction) for cycle in cycles)
        elif isinstance(fault, Duplicate):
            self._duplicated.add(fault.cycle)
        else:
            self._corrupted.setdefault((fault.cycle, fault.direction), []).append(fault)

    @property
    def now(self) -> float:
        """Virtual time in s."""
        return self.cycle * self._peer.period + self._waiting

    def receive(self, timeout: float) -> bytes | None:
        """The peer's next packet, one cycle later; None if that is further off than `timeout`.

        Raises:
            TransportClosed: closed, or the peer has no more packets.
        """
        self._require_open()
        if self._arrived:
            return self._arrived.popleft()
        left = timeout
        while True:
            until_next = self._peer.period - self._waiting
            if left < until_next:
                self._waiting += max(0.0, left)
                return None
            left -= until_next
            packet = self._next_cycle()
            if packet is not None:
                return packet

    def _next_cycle(self) -> bytes | None:
        """Run one cycle; the packet that arrived in it, if one did."""
        if self._awaiting_reply:
            self._peer.accept(None)
        packet = self._peer.next_packet()
        if packet is None:
            self.close()
            raise TransportClosed("the controller's end has no more packets")
        index = self.cycle
        self.cycle += 1
        self._waiting = 0.0
        self._awaiting_reply = True
        if (index, "to_pc") in self._lost:
            return None
        packet = self._corrupt(packet, index, "to_pc")
        if index in self._duplicated:
            self._arrived.append(packet)
        return packet

    def send(self, packet: bytes) -> None:
        """Answer the packet of this cycle.

        Raises:
            TransportClosed: closed.
        """
        self._require_open()
        if not self._awaiting_reply:
            self.surplus_replies.append(packet)
            return
        self._awaiting_reply = False
        index = self.cycle - 1
        if (index, "to_controller") in self._lost:
            self._peer.accept(None)
        else:
            self._peer.accept(self._corrupt(packet, index, "to_controller"))

    def close(self) -> None:
        """Give the link up."""
        self._closed = True
        self._awaiting_reply = False

    def _require_open(self) -> None:
        if self._closed:
            raise TransportClosed("the simulated link was closed")

    def _corrupt(self, packet: bytes, index: int, direction: Direction) -> bytes:
        for fault in self._corrupted.get((index, direction), ()):
            packet = fault.apply(packet)
        return packet
