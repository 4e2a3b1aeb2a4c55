"""What every link offers."""

from __future__ import annotations

from typing import Protocol


class Transport(Protocol):
    """The PC's end of a link that carries whole packets of up to 1200 bytes, in order.

    Packets may be lost or come twice; one that arrives is one that was sent (or was corrupted
    beyond what the link can see).
    """

    @property
    def now(self) -> float:
        """Monotonic time in s, on the link's own clock."""
        ...

    def receive(self, timeout: float) -> bytes | None:
        """The next packet, or None after `timeout` s without one.

        Raises:
            TransportClosed: the link was closed, or its far end is gone for good.
        """
        ...

    def send(self, packet: bytes) -> None:
        """Send one packet to where the last one received came from.

        Raises:
            TransportClosed: the link was closed.
        """
        ...

    def close(self) -> None:
        """Give the link up. Closing twice changes nothing."""
        ...
