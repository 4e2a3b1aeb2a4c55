"""A link that copies the packets received and sent to a ring."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.record import PacketRing
from drivers.transports.base import Transport

MAX_BUFFERED: Final = 256
"""Packets buffered until their cycle is known."""


class TappedTransport:
    """Wraps a link and copies its packets to the ring `sink`.

    Packets are copied before the wait for the next one, so that replies are not delayed, and when
    their `cycle` is known. Packets of a backlog have the cycle of the one answered; the first ones
    of a backlog of more than `MAX_BUFFERED` that of the one answered before.
    """

    def __init__(self, transport: Transport, sink: PacketRing, cycle: Callable[[], int]) -> None:
        self._transport = transport
        self._sink = sink
        self._cycle = cycle
        self._buffered: list[tuple[float, bool, bytes]] = []  # time, sent, packet

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
        """Time of arrival of the packet received last, None if unknown."""
        arrived: float | None = getattr(self._transport, "arrived", None)
        return arrived

    @property
    def notes(self) -> tuple[str, ...]:
        """Options refused by the system."""
        return tuple(getattr(self._transport, "notes", ()))

    def receive(self, timeout: float) -> bytes | None:
        """See `Transport.receive`."""
        if self._buffered and (timeout > 0.0 or len(self._buffered) >= MAX_BUFFERED):
            self.flush()
        packet = self._transport.receive(timeout)
        if packet is not None:
            arrived = self.arrived
            time = self._transport.now if arrived is None else arrived
            self._buffered.append((time, False, packet))
        return packet

    def send(self, packet: bytes) -> None:
        """See `Transport.send`."""
        self._transport.send(packet)
        self._buffered.append((self._transport.now, True, packet))

    def rejected(self) -> dict[str, int]:
        """See `Transport.rejected`."""
        return self._transport.rejected()

    def forget_peer(self) -> None:
        """See `Transport.forget_peer`."""
        self._transport.forget_peer()

    def close(self) -> None:
        """Close the link."""
        self.flush()
        self._transport.close()

    def flush(self) -> None:
        """Copy the buffered packets to the ring."""
        cycle = self._cycle()
        for time, sent, packet in self._buffered:
            self._sink.put(cycle, time, sent, packet)
        self._buffered.clear()
