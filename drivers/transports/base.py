"""What every link offers."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError


class TransportError(DriverError):
    """A link that cannot be opened.

    Attributes:
        link: the address it was to have, in words.
        reason: what is in the way.
        remedy: what to do about it.
    """

    def __init__(self, link: str, reason: str, remedy: str) -> None:
        super().__init__(f"{link} cannot be opened: {reason}; {remedy}")
        self.link = link
        self.reason = reason
        self.remedy = remedy


class Transport(Protocol):
    """The PC's end of a link that carries whole packets of up to 1200 bytes, in order.

    Packets may be lost or come twice; one that arrives is one that was sent (or was corrupted
    beyond what the link can see).

    One that knows how long a packet lay in a queue has `arrived` besides: when the packet received
    last arrived, s on the clock of `now`, or None if unknown; never in the future, nor before the
    packet that came before it. One whose options the system can refuse has `notes`, in words.
    """

    @property
    def now(self) -> float:
        """Monotonic time in s, on the link's own clock."""

    @property
    def ages(self) -> NDArray[np.uint16] | None:
        """How old the values of the packet received last are, in cycles since they were sent.

        (n_axes, 8) for D1..D5, extra1..3 of each axis; None where a packet carries all of them
        at once, so that all are fresh.
        """

    def receive(self, timeout: float) -> bytes | None:
        """The next packet, or None after `timeout` s without one.

        Raises:
            TransportClosed: the link was closed, or its far end is gone for good.
        """

    def send(self, packet: bytes) -> None:
        """Send one packet to where the last one received came from.

        Raises:
            TransportClosed: the link was closed.
        """

    def rejected(self) -> dict[str, int]:
        """Packets discarded below the session since the last call, by kind.

        Kinds are words such as "foreign", "malformed", "torn", "corrupt", "overrun", "unsent".
        """

    def forget_peer(self) -> None:
        """There is no session: its next packet may come from elsewhere at the same address.

        Called, for as long as that is so, after each packet that got no answer, and when there
        was none with an answer for a while.
        """

    def close(self) -> None:
        """Give the link up. Closing twice changes nothing."""


class TransportSpec(Protocol):
    """What is needed to open a link; pickles, so that another process can open it."""

    def open(self) -> Transport:
        """Open the link.

        Raises:
            TransportError: it cannot be opened.
        """
