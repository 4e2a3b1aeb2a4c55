"""Link to a Universal Robots controller: frames in, set-points and program out.

Outputs and inputs are on the RTDE connection; the program goes to the primary interface, which says
in words why it does not run. Connections are opened from here only, so that no port of this
computer is needed.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from drivers.errors import TransportClosed
from drivers.transports.arrival import CONTROL_BYTES, SO_TIMESTAMPNS, ArrivalClock
from drivers.transports.base import (
    DirectRoute,
    Need,
    RtdeServer,
    Transport,
    TransportError,
    TransportSpec,
)
from drivers.ur import rtde
from drivers.ur.connection import (
    CONNECT_TIMEOUT,
    READ_BYTES,
    RtdeConnection,
    connected,
    link_name,
    no_reply,
    reason,
)
from drivers.ur.description import UrDescription
from drivers.ur.identity import DASHBOARD_PORT, PRIMARY_PORT, ask_identity
from drivers.ur.messages import MessageReader
from drivers.ur.registers import INPUTS
from drivers.ur.wire import OPTIONAL, REQUIRED

MAX_UNSENT_BYTES: Final = 1 << 14
"""Bytes of replies that may wait for the network; further ones are dropped."""


@dataclass(frozen=True)
class RtdeSpec(TransportSpec):
    """Settings of a link to a Universal Robots controller.

    Attributes:
        host: address or name of the controller.
        port: of its real-time data exchange.
        primary_port, dashboard_port: of its primary interface and its dashboard server.
    """

    host: str
    port: int = rtde.PORT
    primary_port: int = PRIMARY_PORT
    dashboard_port: int = DASHBOARD_PORT

    def open(self) -> Transport:
        """Connect, and claim the registers; nothing moves by that. Raises TransportError."""
        identity = ask_identity(self.host, primary=self.primary_port, dashboard=self.dashboard_port)
        connection = connected(self)
        try:
            agreed = RtdeConnection(connection)
            agreed.request_outputs(REQUIRED, OPTIONAL)
            inputs = agreed.claim_inputs(INPUTS)
            description = UrDescription(
                identity, agreed.version, agreed.frequency, agreed.recipe, inputs
            )
            primary = self._primary()
            try:
                agreed.request_start()
                return UrTransport(connection, primary, agreed, description)
            except BaseException:
                primary.close()
                raise
        except (OSError, TransportClosed) as error:
            connection.close()
            raise no_reply(self, error) from error
        except rtde.InputsInUseError as error:
            connection.close()
            remedy = (
                "close it, or switch EtherNet/IP and PROFINET off; a program that was killed holds "
                "them for some seconds more"
            )
            raise TransportError(self.address, str(error), remedy) from error
        except rtde.RtdeError as error:
            connection.close()
            remedy = "motions need newer software; `hil record` may work nevertheless"
            raise TransportError(self.address, str(error), remedy) from error
        except BaseException:
            connection.close()
            raise

    def _primary(self) -> socket.socket:
        try:
            return socket.create_connection((self.host, self.primary_port), CONNECT_TIMEOUT)
        except OSError as error:
            raise TransportError(
                f"primary interface of {self.host}:{self.primary_port}",
                reason(error),
                "enable it at the controller (Settings, Security, Services)",
            ) from error

    @property
    def needs(self) -> tuple[Need, ...]:
        """A route to the controller, and its server."""
        server = RtdeServer(self.host, self.port)
        return (server,) if self.is_local else (DirectRoute(self.host), server)

    @property
    def address(self) -> str:
        """Kind and address of the link."""
        return link_name(self)

    @property
    def description(self) -> str:
        """Address of the controller."""
        return self.host

    @property
    def is_local(self) -> bool:
        """Whether only a simulated controller on this computer can be at the other end."""
        with suppress(OSError, UnicodeError):
            return socket.gethostbyname(self.host).startswith("127.")
        return False


class UrTransport:
    """An open link; the first packet is the description of the arm.

    A reply is a frame of inputs, with a program behind it if one is to run.

    Args:
        connection: socket of RTDE.
        primary: socket of the primary interface.
        agreed: recipes agreed on that connection.
        description: of the arm.

    Attributes:
        arrived: time at which the kernel received the last frame, on the clock of `now`; None if
            unknown, and of a frame that was read together with a later one.
        notes: optional socket options refused by the system.
        polls_until: time until which `receive` polls instead of sleeping.
    """

    def __init__(
        self,
        connection: socket.socket,
        primary: socket.socket,
        agreed: RtdeConnection,
        description: UrDescription,
    ) -> None:
        self._socket = connection
        self._primary: socket.socket | None = primary
        self._splitter = agreed.splitter
        self._ready: deque[tuple[bytes, float | None]] = deque([(description.encode(), None)])
        self._ready += [
            (rtde.frame(rtde.FrameType(kind), payload), None)
            for _, (kind, payload) in agreed.frames
            if kind in (rtde.FrameType.DATA, rtde.FrameType.TEXT)
        ]
        self._messages = MessageReader()
        self._unsent = bytearray()
        self._program = bytearray()
        self._counts: dict[str, int] = {}
        self._closed = False
        self._clock = ArrivalClock()
        self.arrived: float | None = None
        self.notes = _stamped(connection)
        self.polls_until = float("-inf")
        for each in (connection, primary):
            each.setblocking(False)
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @property
    def now(self) -> float:
        """CLOCK_MONOTONIC, s."""
        return time.monotonic()

    def receive(self, timeout: float) -> bytes | None:
        """Return the next frame, or None after `timeout` s without one.

        Raises:
            TransportClosed: the controller closed the connection, or it was closed here.
        """
        end = time.monotonic() + timeout
        while not self._ready:
            if self._closed:
                raise TransportClosed("the RTDE link was closed")
            left = end - time.monotonic()
            polls = time.monotonic() < self.polls_until
            self._read(0.0 if polls else max(0.0, left))
            if self._ready:
                break
            if left <= 0.0:
                return None
            if polls:
                # To threads of the same priority, as `UdpTransport` does.
                os.sched_yield()
        packet, self.arrived = self._ready.popleft()
        return packet

    def _read(self, timeout: float) -> None:
        """Read what has come on both connections, waiting for the first of it."""
        sockets = [self._socket] if self._primary is None else [self._socket, self._primary]
        try:
            readable = select.select(sockets, (), (), timeout)[0]
        except (OSError, ValueError) as error:
            raise TransportClosed(f"the RTDE link failed: {error}") from error
        if self._primary in readable:
            self._read_primary()
        if self._socket in readable:
            self._read_frames()

    def _read_frames(self) -> None:
        try:
            data, control, _, _ = self._socket.recvmsg(READ_BYTES, CONTROL_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            raise TransportClosed(f"the RTDE link failed: {reason(error)}") from error
        if not data:
            raise TransportClosed("the controller closed the RTDE connection")
        try:
            frames = self._splitter.feed(data)
        except rtde.RtdeError as error:
            raise TransportClosed(str(error)) from error
        arrived = self._clock.arrival(control)
        for k, (kind, payload) in enumerate(frames, 1):
            if kind in (rtde.FrameType.DATA, rtde.FrameType.TEXT):
                # The stamp is that of the last byte: when earlier frames came is not known.
                stamp = arrived if k == len(frames) else None
                self._ready.append((rtde.frame(rtde.FrameType(kind), payload), stamp))

    def _read_primary(self) -> None:
        """Read what the primary interface says; without it, motions end as usual."""
        assert self._primary is not None
        try:
            data = self._primary.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._primary.close()
            self._primary = None
            self._note("the controller closed its primary interface")
            return
        for text in self._messages.feed(data):
            self._note(text)

    def _note(self, text: str) -> None:
        self._ready.append((rtde.text_frame(text), None))

    def wait(self, timeout: float) -> bool:
        """Whether a frame is there within `timeout` s; to the precision of timers."""
        if self._ready or self._closed:
            return True
        try:
            return bool(select.select((self._socket,), (), (), timeout)[0])
        except (OSError, ValueError):
            return True

    @staticmethod
    def loopback() -> _Loopback:
        """Return a link that receives what it sends, by a pair of sockets."""
        return _Loopback()

    def send(self, packet: bytes) -> None:
        """Send a reply; what the network does not take is sent later, or counted as "unsent".

        Raises:
            TransportClosed: the connection is closed.
        """
        if self._closed:
            raise TransportClosed("the RTDE link was closed")
        if not packet:
            return
        length = struct.unpack_from(">H", packet)[0]
        if len(self._unsent) > MAX_UNSENT_BYTES:
            self._counts["unsent"] = self._counts.get("unsent", 0) + 1
        else:
            self._unsent += packet[:length]
        self._flush(self._socket, self._unsent)
        if len(packet) > length:
            self._program[:] = packet[length:]
        if self._program and self._primary is not None:
            self._flush(self._primary, self._program)

    @staticmethod
    def _flush(connection: socket.socket, waiting: bytearray) -> None:
        try:
            sent = connection.send(waiting)
        except BlockingIOError:
            return
        except OSError as error:
            raise TransportClosed(f"the RTDE link failed: {reason(error)}") from error
        del waiting[:sent]

    def rejected(self) -> dict[str, int]:
        """Return the replies dropped since the last call."""
        counts = self._counts
        self._counts = {}
        return counts

    def forget_peer(self) -> None:
        """Do nothing: a connection has one peer."""

    def close(self) -> None:
        """Close both connections; may be called again. The registers are free by that."""
        self._closed = True
        with suppress(OSError):
            self._socket.close()
        if self._primary is not None:
            with suppress(OSError):
                self._primary.close()
            self._primary = None


def _stamped(connection: socket.socket) -> tuple[str, ...]:
    """Have the kernel attach times of arrival; returns the refusal, if it is one."""
    try:
        connection.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    except OSError as error:
        return (f"SO_TIMESTAMPNS = 1 was refused ({error.strerror})",)
    return ()


class _Loopback:
    """A pair of sockets: what one sends the other receives."""

    def __init__(self) -> None:
        self._there, self._here = socket.socketpair()
        self._here.setblocking(False)
        self._there.setblocking(False)

    @property
    def now(self) -> float:
        return time.monotonic()

    def receive(self, timeout: float) -> bytes | None:
        if not select.select((self._here,), (), (), timeout)[0]:
            return None
        return self._here.recv(READ_BYTES)

    def send(self, packet: bytes) -> None:
        with suppress(BlockingIOError):
            self._there.send(packet)

    def rejected(self) -> dict[str, int]:
        return {}

    def forget_peer(self) -> None:
        pass

    def close(self) -> None:
        self._here.close()
        self._there.close()
