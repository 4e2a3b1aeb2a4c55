"""The controller's end of a real link: where its packets leave and the PC's answers come in.

The controller speaks first and paces; the PC is the server. Which wire lies between is the far
end's business: UDP here, CAN in `sim_fixtures.can_end`.
"""

from __future__ import annotations

import socket
import struct
from contextlib import suppress
from select import select
from time import monotonic, time
from typing import Final, Protocol

from sim_fixtures.errors import SimulationError

LARGEST_DATAGRAM: Final = 65536
_SO_TIMESTAMPNS: Final = 35  # of asm-generic/socket.h, which the socket module does not name
_TIMESPEC: Final = struct.Struct("@ll")
_CONTROL_SPACE: Final = socket.CMSG_SPACE(_TIMESPEC.size)


class FarEnd(Protocol):
    """Moves whole packets; knows no cycle, state or mode."""

    def send(self, packet: bytes) -> None:
        """Send towards the PC. What the network refuses to carry is lost, not an error."""

    def receive(self, timeout: float) -> bytes | None:
        """The next packet of the PC; None if none came within `timeout` seconds (0: look)."""

    def close(self) -> None:
        """Give the link up."""


class FarEndError(SimulationError):
    """The controller's end of a link cannot be opened.

    Attributes:
        place: what was to be opened.
        problem: why it cannot be.
    """

    def __init__(self, place: str, problem: str) -> None:
        self.place = place
        self.problem = problem
        super().__init__(f"{place}: {problem}")

    def __reduce__(self) -> tuple[type[FarEndError], tuple[str, str]]:
        return type(self), (self.place, self.problem)


class UdpFarEnd:
    """One datagram, one packet, to a PC program that listens at `host`:`port` (IPv4).

    The socket is not connected: a PC that does not listen yet is a PC that does not answer, not a
    broken connection. Datagrams of any other address or port are dropped.

    Attributes:
        foreign: datagrams that came from elsewhere.
        last_foreign: where the last of them came from, "host:port"; "" if there was none.
        waited: s that the packet received last lay in the kernel's queue; 0 where that is unknown.
        unsent: packets that the network refused to carry.
        trouble: why it refused the last one, in words; "" if it never did.

    Raises:
        FarEndError: no such host, or the local port is in use.
    """

    def __init__(self, host: str, port: int, *, source_port: int | None = None) -> None:
        self.foreign = 0
        self.last_foreign = ""
        self.waited = 0.0
        self.unsent = 0
        self.trouble = ""
        try:
            self._pc = (socket.gethostbyname(host), port)
        except (OSError, UnicodeError) as error:
            raise FarEndError(f"{host}:{port}", f"no such IPv4 host ({error})") from error
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with suppress(OSError):  # not every system has it; nothing needs it
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        try:
            self._socket.setblocking(False)
            self._socket.bind(("", source_port or 0))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise FarEndError(
                f"local UDP port {source_port}", f"cannot be used ({error})"
            ) from error

    @property
    def source_port(self) -> int:
        """The local port that packets leave from."""
        port: int = self._socket.getsockname()[1]
        return port

    def send(self, packet: bytes) -> None:
        """Send one datagram; a network that is down or full loses it."""
        try:
            self._socket.sendto(packet, self._pc)
        except OSError as error:
            self.unsent += 1
            self.trouble = error.strerror or str(error)

    def receive(self, timeout: float) -> bytes | None:
        """The next datagram of the PC, or None."""
        until = monotonic() + timeout
        while True:
            # select() waits to the microsecond; the time-out of a socket rounds up to the next ms.
            if not select([self._socket], [], [], max(0.0, until - monotonic()))[0]:
                return None
            try:
                packet, control, _, sender = self._socket.recvmsg(LARGEST_DATAGRAM, _CONTROL_SPACE)
            except OSError:  # reported ready, then dropped for a bad checksum; or an ICMP notice
                continue
            if sender == self._pc:
                self.waited = _waited(control)
                return packet
            self.foreign += 1
            self.last_foreign = f"{sender[0]}:{sender[1]}"
            if monotonic() > until:
                return None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _waited(control: list[tuple[int, int, bytes]]) -> float:
    """How long ago the kernel had a datagram [s], by its time stamp."""
    for _, kind, data in control:
        if kind == _SO_TIMESTAMPNS and len(data) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return max(0.0, time() - float(seconds) - 1e-9 * float(nanoseconds))
    return 0.0
