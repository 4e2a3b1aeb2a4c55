"""A link whose packets are left as they were, both ways."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.record import PacketRing
from drivers.transports.base import Transport

MOST_WAITING: Final = 256
"""Packets that wait for their cycle; a flood is handed on in parts, with the cycle known then."""


class _Passed(NamedTuple):
    """A packet that went through."""

    time: float
    sent: bool
    packet: bytes


class TappedTransport:
    """Passes everything on to another link, and its packets to a sink as well.

    A packet reaches the sink when its answer is out, before the next one is waited for: nothing
    but its place in a list is taken note of between the two. Its cycle is known by then; packets
    that had piled up and were left out have that of the one answered, but for those of a pile of
    more than `MOST_WAITING`: they are not delayed, and have that of the one answered before.

    Args:
        transport: the link.
        sink: where the packets go.
        cycle: the controller's cycle of the packet answered last.
    """

    def __init__(self, transport: Transport, sink: PacketRing, cycle: Callable[[], int]) -> None:
        self._transport = transport
        self._sink = sink
        self._cycle = cycle
        self._passed: list[_Passed] = []

    @property
    def now(self) -> float:
        """Time on the link's clock."""
        return self._transport.now

    @property
    def ages(self) -> NDArray[np.uint16] | None:
        """See `Transport.ages`."""
        return self._transport.ages

    @property
    def arrived(self) -> float | None:
        """When the packet received last arrived, of a link that knows."""
        arrived: float | None = getattr(self._transport, "arrived", None)
        return arrived

    @property
    def notes(self) -> tuple[str, ...]:
        """Options that the system refused, in words, of a link that has such."""
        return tuple(getattr(self._transport, "notes", ()))

    def receive(self, timeout: float) -> bytes | None:
        """See `Transport.receive`."""
        if self._passed and (timeout > 0.0 or len(self._passed) >= MOST_WAITING):
            self.settle()
        packet = self._transport.receive(timeout)
        if packet is not None:
            arrived = self.arrived
            time = self._transport.now if arrived is None else arrived
            self._passed.append(_Passed(time, False, packet))
        return packet

    def send(self, packet: bytes) -> None:
        """See `Transport.send`."""
        self._transport.send(packet)
        self._passed.append(_Passed(self._transport.now, True, packet))

    def rejected(self) -> dict[str, int]:
        """See `Transport.rejected`."""
        return self._transport.rejected()

    def forget_peer(self) -> None:
        """See `Transport.forget_peer`."""
        self._transport.forget_peer()

    def close(self) -> None:
        """Give the link up."""
        self.settle()
        self._transport.close()

    def settle(self) -> None:
        """Hand to the sink what has passed; called between an answer and the next packet."""
        cycle = self._cycle()
        for time, sent, packet in self._passed:
            self._sink.put(cycle, time, sent, packet)
        self._passed.clear()
