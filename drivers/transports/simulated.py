"""A link in virtual time, to a controller that is an object in the same process."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import inf
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.errors import TransportClosed
from drivers.transports.faults import Fault, FaultyLink


class Peer(Protocol):
    """The controller's end. Each cycle: one `next_packet`, then one `accept`."""

    @property
    def period(self) -> float:
        """Cycle in s."""

    def next_packet(self) -> bytes | None:
        """The packet of the next cycle, empty for none; None when there will be no more."""

    def accept(self, reply: bytes | None) -> None:
        """The answer to it; None if none arrived within the cycle."""


class _Delayed(NamedTuple):
    """Something under way: when it arrives, the cycle it was sent in, what it is."""

    due: float
    cycle: int
    packet: bytes


class SimulatedTransport:
    """Carries packets between a session and a peer, one cycle of virtual time per packet.

    Deterministic: the same peer, session and faults give the same bytes at the same times. Time
    is a count of cycles, so that it does not drift.

    The peer gets at most one answer per cycle, and none that was sent in an earlier one: an answer
    held up past the end of its cycle came too late, and for the peer there was none.

    Args:
        peer: the controller's end.
        faults: what goes wrong, see `drivers.transports.faults`.

    Attributes:
        cycle: cycles begun so far.
        surplus_replies: answers beyond the first of a cycle (those to duplicates).
        late_replies: answers that arrived after the cycle in which they were sent.
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
        """Virtual time in s."""
        return self.cycle * self._peer.period + self._waiting

    @property
    def ages(self) -> NDArray[np.uint16] | None:
        """None: every field of a packet is of its own cycle."""
        return None

    def rejected(self) -> dict[str, int]:
        """Nothing is discarded below the session."""
        return {}

    def forget_peer(self) -> None:
        """There is only one peer."""

    def receive(self, timeout: float) -> bytes | None:
        """The next packet to arrive; None if that is further off than `timeout`.

        Raises:
            TransportClosed: closed, or the peer has no more packets.
        """
        self._require_open()
        left = timeout
        while True:
            if self._arrived:
                return self._arrived.popleft()
            left = self._pass_time(left)
            if left < 0.0:
                return None

    def _pass_time(self, patience: float) -> float:
        """Go on to the next event; what is left of the patience, negative if it ran out first."""
        until_cycle = self._peer.period - self._waiting
        until_arrival = self._next_due() - self.now
        until_event = min(until_cycle, max(0.0, until_arrival))
        if patience < until_event:
            self._waiting += max(0.0, patience)
            return -1.0
        if until_arrival < until_cycle:
            self._waiting += until_event
        else:
            packet = self._next_cycle()
            if packet is not None:
                self._arrived.append(packet)
        self._deliver()
        return patience - until_event

    def _next_due(self) -> float:
        """When the next delayed packet arrives, either way."""
        if not (self._to_pc or self._to_controller):
            return inf
        return min(delayed.due for delayed in (*self._to_pc, *self._to_controller))

    def _next_cycle(self) -> bytes | None:
        """Begin a cycle; the packet that arrives at once, if one does."""
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
        deliveries = self._link.carry(index, "to_pc", packet)
        at_once = [content for delay, content in deliveries if delay <= 0.0]
        self._to_pc += [
            _Delayed(self.now + delay, index, content) for delay, content in deliveries if delay > 0
        ]
        self._arrived.extend(at_once[1:])
        return at_once[0] if at_once else None

    def _deliver(self) -> None:
        """Hand over what has arrived by now, in the order of its arrival."""
        if not (self._to_pc or self._to_controller):
            return
        now = self.now
        self._arrived.extend(d.packet for d in sorted(self._to_pc) if d.due <= now)
        self._to_pc = [d for d in self._to_pc if d.due > now]
        for reply in sorted(d for d in self._to_controller if d.due <= now):
            self._hand_over(reply.packet, reply.cycle)
        self._to_controller = [d for d in self._to_controller if d.due > now]

    def send(self, packet: bytes) -> None:
        """Answer the packet received last; the answer belongs to the present cycle.

        Raises:
            TransportClosed: closed.
        """
        self._require_open()
        index = self.cycle - 1
        for delay, content in self._link.carry(index, "to_controller", packet):
            if delay > 0.0:
                self._to_controller.append(_Delayed(self.now + delay, index, content))
            else:
                self._hand_over(content, index)

    def _hand_over(self, reply: bytes, sent_in: int) -> None:
        """Give the peer an answer, if it waits for one of that cycle."""
        if sent_in != self.cycle - 1:
            self.late_replies.append(reply)
        elif self._awaiting_reply:
            self._awaiting_reply = False
            self._peer.accept(reply)
        else:
            self.surplus_replies.append(reply)

    def close(self) -> None:
        """Give the link up."""
        self._closed = True
        self._awaiting_reply = False

    def _require_open(self) -> None:
        if self._closed:
            raise TransportClosed("the simulated link was closed")
