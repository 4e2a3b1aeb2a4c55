"""The link over UDP/IPv4: the controller sends first, one datagram per packet.

A cycle costs two system calls, `recvmsg` and `sendto`: the time-out is stored in the socket, and
the kernel attaches the time of arrival to each datagram. `wait` is for work before a packet comes.
"""

from __future__ import annotations

import errno
import ipaddress
import math
import os
import select
import socket
import struct
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.c4g_packets import HEADER_LENGTH, MAX_PACKET_BYTES
from drivers.errors import TransportClosed
from drivers.transports.arrival import CONTROL_BYTES, SO_TIMESTAMPNS, ArrivalClock
from drivers.transports.base import (
    DirectRoute,
    FreePort,
    LinkInUseError,
    TransportError,
    TransportSpec,
)

SOCKET_PRIORITY: Final = 6
"""SO_PRIORITY: the highest without privileges."""
TYPE_OF_SERVICE: Final = 0x28
"""IP_TOS of the manufacturer's library (class AF11)."""
BUSY_POLL_US: Final = 50
"""Time that the kernel may poll the network device before it sleeps, µs."""
# Constants of asm-generic/socket.h that the socket module lacks.
_SO_BUSY_POLL: Final = 46
_SO_MEMINFO: Final = 55
_MEMINFO: Final = struct.Struct("=9I")
_TIMEVAL: Final = struct.Struct("@qq")
MAX_FOREIGN_PACKETS: Final = 1000
"""Datagrams of other hosts skipped after the time-out, more than a queue usually holds."""


@dataclass(frozen=True)
class UdpSpec(TransportSpec):
    """Settings of a UDP link.

    Attributes:
        peer_host: IPv4 address (or name) of the controller, the only host accepted.
        port: of the PC, 1000 in the controller's set-up; 0 for any free port.
        bind: IPv4 address of the PC's network device; "0.0.0.0" for all of them.
    """

    peer_host: str
    port: int
    bind: str = "0.0.0.0"

    def open(self) -> UdpTransport:
        """Bind the port; raises TransportError."""
        return UdpTransport(self.peer_host, self.port, self.bind)

    @property
    def description(self) -> str:
        """Address of the controller."""
        return self.peer_host

    @property
    def is_local(self) -> bool:
        """Whether the controller's address, not a name, is one of the loopback device."""
        try:
            return ipaddress.ip_address(self.peer_host).is_loopback
        except ValueError:
            return False

    @property
    def needs(self) -> tuple[DirectRoute, FreePort]:
        """A route to the controller and the port."""
        return DirectRoute(self.peer_host), FreePort(self.bind, self.port, "UDP")


class UdpTransport:
    """A bound UDP port that accepts datagrams of one host; arguments as for `UdpSpec`.

    The first datagram of plausible length from that host, at the beginning and after `forget_peer`,
    selects its port. Datagrams from other addresses are counted as "foreign", those longer than
    1500 bytes as "malformed", those dropped by the kernel because its queue was full as "overrun".

    Attributes:
        address: host and port bound.
        notes: optional socket options refused by the system.
        arrived: time at which the kernel received the last datagram, on the clock of `now`, not
            before the previous one; None if unknown (`ArrivalClock`).
        polls_until: time until which `receive` polls instead of sleeping: a processor that slept
            wakes up slowly, a virtual one most of all. In the past at first.
    """

    def __init__(self, peer_host: str, port: int, bind: str = "0.0.0.0") -> None:
        self._host = _resolve(peer_host)
        self._socket = _bound(bind, port)
        self.address: tuple[str, int] = self._socket.getsockname()
        self.notes = _set_options(self._socket)
        self._timeout = math.nan
        self._clock = ArrivalClock()
        self.arrived: float | None = None
        self.polls_until = -math.inf
        self._receive = self._socket.recvmsg
        self._send = self._socket.sendto
        self._peer: tuple[str, int] | None = None
        self._rejected: dict[str, int] = {}
        self._dropped = 0
        self._closed = False

    @staticmethod
    def loopback() -> UdpTransport:
        """Return a link of this computer to itself, which receives what it sends.

        Raises:
            TransportError: the loopback device is off.
        """
        link = UdpTransport("127.0.0.1", 0, "127.0.0.1")
        link._peer = link.address
        return link

    @property
    def now(self) -> float:
        """CLOCK_MONOTONIC, s."""
        return time.monotonic()

    def receive(self, timeout: float) -> bytes | None:
        """Return the next datagram of the peer, or None after `timeout` s without one.

        A queued one is found behind up to `MAX_FOREIGN_PACKETS` of other hosts, also with a
        time-out of 0.
        """
        end = time.monotonic() + timeout
        foreign = 0
        while True:
            polls = time.monotonic() < self.polls_until
            flags = socket.MSG_DONTWAIT if polls else self._flags(timeout)
            try:
                packet, control, _, sender = self._receive(
                    MAX_PACKET_BYTES + 1, CONTROL_BYTES, flags
                )
            except BlockingIOError:
                if polls:
                    # To threads of the same priority, such as the one that serves the network
                    # card's interrupt in a kernel with PREEMPT_RT: on this processor no packet
                    # comes without it.
                    os.sched_yield()
                # The kernel counts in scheduler ticks and may return a tick early.
                timeout = end - time.monotonic()
                if timeout <= 0.0:
                    return None
                continue
            except OSError as error:
                raise TransportClosed(self._closed_reason(error)) from error
            if (sender == self._peer and len(packet) <= MAX_PACKET_BYTES) or self._accepts(
                packet, sender
            ):
                self.arrived = self._clock.arrival(control)
                return packet
            # Foreign datagrams do not extend the wait, but those queued behind them are read.
            timeout = max(0.0, end - time.monotonic())
            if timeout == 0.0:
                foreign += 1
                if foreign > MAX_FOREIGN_PACKETS:
                    return None

    def wait(self, timeout: float) -> bool:
        """Whether a datagram, of any host, comes within `timeout` s; to the precision of timers.

        The time-out of `receive` is one of scheduler ticks, which may be longer than a cycle.
        Where the system cannot wait so, it is as if one had come: `receive` says what is wrong.
        """
        try:
            return self._closed or bool(select.select((self._socket,), (), (), timeout)[0])
        except (OSError, ValueError):  # closed meanwhile, or a descriptor beyond FD_SETSIZE
            return True

    def send(self, packet: bytes) -> None:
        """Send to the peer; a datagram that the system does not accept is counted as "unsent".

        Raises:
            TransportClosed: closed.
        """
        if self._peer is None:
            if self._closed:
                raise TransportClosed("the UDP link was closed")
            self._count("unsent")
            return
        try:
            self._send(packet, socket.MSG_DONTWAIT, self._peer)
        except OSError as error:
            if self._closed:
                raise TransportClosed(self._closed_reason(error)) from error
            # A full queue or an unplugged cable: for the controller the reply is lost.
            self._count("unsent")

    def rejected(self) -> dict[str, int]:
        """Return the datagrams discarded since the last call, by kind."""
        counts = self._rejected
        self._rejected = {}
        dropped = 0 if self._closed else _dropped(self._socket)
        if dropped > self._dropped:
            counts["overrun"] = dropped - self._dropped
            self._dropped = dropped
        return counts

    def forget_peer(self) -> None:
        """Take the controller's port from the next datagram of its host."""
        self._peer = None

    def close(self) -> None:
        """Close the port; may be called again."""
        self._closed = True
        self._socket.close()

    def _closed_reason(self, error: Exception) -> str:
        return "the UDP link was closed" if self._closed else f"the UDP socket failed: {error}"

    def _flags(self, timeout: float) -> int:
        """Return the flags of the next call; sets the time-out of the socket if it changes."""
        if timeout == self._timeout:
            return 0
        if timeout <= 0.0 or self._closed:
            return socket.MSG_DONTWAIT
        # Rounded up: zero means no time-out.
        seconds, microseconds = divmod(math.ceil(timeout * 1e6), 1_000_000)
        value = _TIMEVAL.pack(seconds, microseconds)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
        self._timeout = timeout
        return 0

    def _accepts(self, packet: bytes, sender: tuple[str, int]) -> bool:
        if sender != self._peer:
            # A stray short datagram must not select the port.
            first = self._peer is None and HEADER_LENGTH <= len(packet) <= MAX_PACKET_BYTES
            if sender[0] != self._host or not first:
                from_controller = self._peer is None and sender[0] == self._host
                self._count("malformed" if from_controller else "foreign")
                return False
            self._peer = sender
        if len(packet) > MAX_PACKET_BYTES:
            self._count("malformed")
            return False
        return True

    def _count(self, kind: str) -> None:
        self._rejected[kind] = self._rejected.get(kind, 0) + 1


def _resolve(host: str) -> str:
    try:
        return socket.gethostbyname(host)
    except OSError as error:
        raise TransportError(
            f"the UDP link to {host!r}",
            f"the controller's address is unknown ({error})",
            "give its IPv4 address, such as 10.2.12.150",
        ) from error


def _bound(bind: str, port: int) -> socket.socket:
    link = f"UDP port {port} on {bind}"
    if not 0 <= port <= 65535:
        raise TransportError(link, "there is no such port", "use one of 1..65535")
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        udp.bind((bind, port))
    except OSError as error:
        udp.close()
        if error.errno == errno.EADDRINUSE:
            remedy = f"find that program with: ss -ulnp sport = :{port}"
            raise LinkInUseError(link, _holder(port), remedy) from error
        reason, remedy = _BIND_FAILURES.get(
            error.errno or 0, (str(error), "check the address of the PC on the link")
        )
        raise TransportError(link, reason, remedy.format(port=port)) from error
    return udp


def _holder(port: int) -> int | None:
    """Return a process of this user that has a UDP port bound (IPv4); None if none is found."""
    with suppress(OSError, ValueError, IndexError):
        rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
        inodes = {row[9] for row in rows if int(row[1].rpartition(":")[2], 16) == port}
        sockets = {f"socket:[{inode}]" for inode in inodes}
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # of another user, or ended meanwhile
                if any(str(fd.readlink()) in sockets for fd in (process / "fd").iterdir()):
                    return int(process.name)
    return None


_BIND_FAILURES: Final = {
    errno.EACCES: (
        "a port below 1024 is privileged",
        "permit it with: sudo sysctl net.ipv4.ip_unprivileged_port_start={port}",
    ),
    errno.EADDRNOTAVAIL: (
        "no network device of this PC has that address",
        "list the addresses with: ip -4 address",
    ),
}


def _set_options(udp: socket.socket) -> tuple[str, ...]:
    """Set priority, polling and time stamps; returns the refusals."""
    notes = []
    for name, level, option, value in (
        # IP_TOS comes first because it sets a priority of its own.
        ("IP_TOS", socket.IPPROTO_IP, socket.IP_TOS, TYPE_OF_SERVICE),
        ("SO_PRIORITY", socket.SOL_SOCKET, socket.SO_PRIORITY, SOCKET_PRIORITY),
        ("SO_BUSY_POLL", socket.SOL_SOCKET, _SO_BUSY_POLL, BUSY_POLL_US),
        ("SO_TIMESTAMPNS", socket.SOL_SOCKET, SO_TIMESTAMPNS, 1),
    ):
        try:
            udp.setsockopt(level, option, value)
        except OSError as error:
            notes.append(f"{name} = {value} was refused ({error.strerror})")
    return tuple(notes)


def _dropped(udp: socket.socket) -> int:
    """Return the datagrams dropped by the kernel because the queue was full."""
    try:
        return int(
            _MEMINFO.unpack(udp.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size))[8]
        )
    except (OSError, struct.error):  # kernels before 4.12
        return 0
