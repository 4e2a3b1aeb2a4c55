"""A connection to the real-time data exchange of a controller, and what both ends agree on."""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, Protocol

from drivers.errors import TransportClosed
from drivers.transports.base import TransportError
from drivers.ur import rtde

CONNECT_TIMEOUT: Final = 5.0
"""Longest wait for a connection, and for a reply to a request, s."""
_RATE_OF_MAJOR_VERSION: Final = {3: 125.0}
"""Frames per second by major version of the software (CB3)."""
_E_SERIES_RATE: Final = 500.0
READ_BYTES: Final = 1 << 16


class RtdeAddress(Protocol):
    """Where a controller serves RTDE."""

    @property
    def host(self) -> str:
        """Address or name of the controller."""

    @property
    def port(self) -> int:
        """Its port of RTDE."""


def connected(to: RtdeAddress) -> socket.socket:
    """Return a connection to the RTDE port of a controller, or raise TransportError."""
    try:
        return socket.create_connection((to.host, to.port), CONNECT_TIMEOUT)
    except (OSError, UnicodeError) as error:
        remedy = (
            "check address and cable, and that RTDE is enabled at the controller (Settings, "
            "Security, Services)"
        )
        raise TransportError(link_name(to), reason(error), remedy) from error


def no_reply(to: RtdeAddress, error: BaseException) -> TransportError:
    """Return the error of a server that does not speak RTDE."""
    remedy = f"make sure that {to.port} is its port of RTDE ({rtde.PORT})"
    return TransportError(link_name(to), f"no reply ({reason(error)})", remedy)


def link_name(to: RtdeAddress) -> str:
    """Return kind and address of the link."""
    return f"RTDE of {to.host}:{to.port}"


def reason(error: BaseException) -> str:
    """Return why the system refused something."""
    return str(getattr(error, "strerror", None) or error)


class RtdeConnection:
    """Requests to a controller and their replies; other frames wait in `frames`.

    Attributes:
        version: of the controller's software.
        frequency: frames per second that are requested.
        recipe: outputs that come.
        absent: outputs that this version does not have.
        frames: that came meanwhile, with the time of arrival.
        splitter: of the stream.
    """

    recipe: rtde.OutputRecipe
    absent: tuple[str, ...]

    def __init__(
        self, connection: socket.socket, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._socket = connection
        self.splitter = rtde.FrameSplitter()
        self._clock = clock
        self.frames: deque[tuple[float, rtde.RtdeFrame]] = deque()
        connection.settimeout(CONNECT_TIMEOUT)
        self._negotiate()
        self.frequency = _RATE_OF_MAJOR_VERSION.get(self.version.major, _E_SERIES_RATE)

    def _negotiate(self) -> None:
        self._send(rtde.version_request())
        if not rtde.accepted(self._reply(rtde.FrameType.VERSION)):
            problem = "the controller does not have version 2 of RTDE (from 3.10 and 5.4 on)"
            raise rtde.RtdeError(problem)
        self._send(rtde.frame(rtde.FrameType.CONTROLLER_VERSION))
        reply = self._reply(rtde.FrameType.CONTROLLER_VERSION)
        self.version = rtde.controller_version(reply)

    def request_outputs(self, required: Sequence[str], optional: Sequence[str]) -> None:
        """Request all outputs, then without the optional ones that the controller lacks.

        Raises:
            RtdeError: it lacks a required one.
        """
        names = [*required, *optional]
        absent: tuple[str, ...] = ()
        while True:
            self._send(rtde.outputs_request(self.frequency, names))
            reply = self._reply(rtde.FrameType.OUTPUTS)
            try:
                self.recipe, self.absent = rtde.OutputRecipe.confirmed(names, reply), absent
                return
            except rtde.OutputsMissingError as missing:
                if absent or not set(missing.names) <= set(optional):
                    raise
                absent = missing.names
                names = [name for name in names if name not in absent]

    def claim_inputs(self, names: Sequence[str]) -> int:
        """Claim inputs until the connection ends, and return the number of their recipe.

        Raises:
            InputsInUseError: another client writes some of them.
            RtdeError: the controller lacks some of them.
        """
        self._send(rtde.inputs_request(names))
        return rtde.confirmed_inputs(names, self._reply(rtde.FrameType.INPUTS))

    def request_start(self) -> None:
        """Start the outputs.

        Raises:
            RtdeError: the controller refuses.
            TransportClosed: it closed the connection, or did not reply in time.
        """
        # Data frames may overtake the reply, which is waited for as well.
        self._send(rtde.frame(rtde.FrameType.START))
        if not rtde.accepted(self._reply(rtde.FrameType.START)):
            raise rtde.RtdeError("the controller refuses to start its outputs")

    def _send(self, data: bytes) -> None:
        self._socket.sendall(data)

    def _reply(self, kind: rtde.FrameType) -> bytes:
        """Return the payload of the next frame of a kind; others are stored in `frames`."""
        deadline = self._clock() + CONNECT_TIMEOUT
        while self._clock() < deadline:
            arrived = self._receive()
            replies = [frame for _, frame in arrived if frame.kind == kind]
            self.frames += [(at, frame) for at, frame in arrived if frame.kind != kind]
            if replies:
                return replies[0].payload
        raise TransportClosed(f"no reply to the request {chr(kind)!r} within {CONNECT_TIMEOUT:g} s")

    def _receive(self) -> list[tuple[float, rtde.RtdeFrame]]:
        """Return the frames of the next piece of the stream, with the time of its arrival."""
        data = self._socket.recv(READ_BYTES)
        now = self._clock()
        if not data:
            cut = self.splitter.unfinished
            within = f" within a frame, {cut} bytes of which came" if cut else ""
            raise TransportClosed(f"the controller closed the connection{within}")
        return [(now, frame) for frame in self.splitter.feed(data)]
