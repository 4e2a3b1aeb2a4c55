"""The interface of a link."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from drivers.errors import DriverError


class TransportError(DriverError):
    """A link, of this kind and address, that cannot be opened; with reason and remedy."""

    def __init__(self, link: str, reason: str, remedy: str) -> None:
        super().__init__(f"{link} cannot be opened: {reason}; {remedy}")
        self.link = link
        self.reason = reason
        self.remedy = remedy

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the parts of a pickle: the exchange process opens links for another one."""
        return type(self), (self.link, self.reason, self.remedy)


class LinkInUseError(TransportError):
    """A link that another program has open; `holder` is its process, None if unknown."""

    def __init__(self, link: str, holder: int | None, remedy: str) -> None:
        process = "unknown" if holder is None else holder
        super().__init__(link, f"another program uses it (process {process})", remedy)
        self.holder = holder

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the parts of a pickle."""
        return type(self), (self.link, self.holder, self.remedy)


class Transport(Protocol):
    """The PC's end of a link that carries packets of up to 1200 bytes, in order.

    Packets may be lost or duplicated; what arrives is complete, and intact as far as the link can
    check.

    Optional attributes: `arrived`, the time at which the packet received last arrived, s on the
    clock of `now`, None if unknown, never in the future nor before that of the previous packet;
    `notes`, options refused by the system.
    """

    @property
    def now(self) -> float:
        """Monotonic time of the link, s."""

    def receive(self, timeout: float) -> bytes | None:
        """Return the next packet, or None after `timeout` s without one.

        Raises:
            TransportClosed: the link was closed here or by the peer.
        """

    def send(self, packet: bytes) -> None:
        """Send one packet to the sender of the packet received last.

        Raises:
            TransportClosed: the link was closed.
        """

    def rejected(self) -> dict[str, int]:
        """Return the number of packets discarded by the link since the last call, by kind.

        Kinds are "foreign", "malformed", "torn", "corrupt", "overrun", "unsent" and others.
        """

    def forget_peer(self) -> None:
        """Accept the next packet from any port of the controller's host.

        Called without a session, after each packet that got no reply and after a silence.
        """

    def close(self) -> None:
        """Close the link; may be called again."""


@runtime_checkable
class PollingTransport(Transport, Protocol):
    """A link that can be prepared for the next packet before it comes.

    Attributes:
        polls_until: time until which `receive` polls instead of sleeping, on the clock of `now`.
    """

    polls_until: float

    def wait(self, timeout: float) -> bool:
        """Whether a packet comes within `timeout` s; it remains to be received."""

    def loopback(self) -> Transport:
        """Return a link of the same kind that receives what it sends."""


@dataclass(frozen=True)
class DirectRoute:
    """A host that is reached without a router."""

    host: str


@dataclass(frozen=True)
class FreePort:
    """A port that can be bound on a local address."""

    bind: str
    port: int
    protocol: Literal["UDP", "TCP"]


@dataclass(frozen=True)
class CanBus:
    """A CAN FD interface at these bit rates, bit/s; None for the profile's."""

    interface: str
    channel: str
    bitrate: int | None = None
    data_bitrate: int | None = None


@dataclass(frozen=True)
class RtdeServer:
    """A controller that serves real-time data (RTDE) on a TCP port."""

    host: str
    port: int


Need = DirectRoute | FreePort | CanBus | RtdeServer


class TransportSpec(ABC):
    """Settings of a link; pickles, so that another process can open it.

    What is not overridden describes a real controller.
    """

    @abstractmethod
    def open(self) -> Transport:
        """Open the link; raises TransportError."""

    @property
    def description(self) -> str:
        """Where the controller is, as shown to a person."""
        return "the controller"

    @property
    def is_local(self) -> bool:
        """Whether only a simulated controller on this computer can be at the other end."""
        return False

    @property
    def needs(self) -> tuple[Need, ...]:
        """What this computer must offer, for checks that do not open the link."""
        return ()

    def check(self, mode: int | None = None) -> None:
        """Raise DriverError if the link cannot carry the session, or motions in this open mode."""
        del mode
