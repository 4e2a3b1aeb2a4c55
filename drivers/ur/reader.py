"""Reader of the real-time outputs of a controller, that gets every frame.

It only reads: it registers no input, so that any number of programs may run beside it. A thread of
its own empties the socket, so that a slow disk does not fill the controller's buffer: that skips
frames for slow clients, and disconnects those that do not read.
"""

from __future__ import annotations

import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from drivers.errors import TransportClosed
from drivers.transports.base import Transport, TransportError, TransportSpec
from drivers.ur import rtde
from drivers.ur.outputs import OPTIONAL, REQUIRED

TIMEOUT: Final = 5.0
"""Longest wait for a connection, and for a reply to a request, s."""
SILENCE: Final = 2.0
"""Time without a frame after which the controller is lost, s."""
_FASTEST: Final = {3: 125.0}
"""Frames per second by major version of the software (CB3)."""
_E_SERIES: Final = 500.0
_MOST_WAITING: Final = 200_000
"""Frames that may wait to be fetched, 400 s at 500 Hz."""
_PIECE: Final = 1 << 16


@dataclass(frozen=True)
class RtdeSpec(TransportSpec):
    """Settings of a link to a Universal Robots controller, which is only listened to.

    Attributes:
        host: address or name of the controller.
        port: of its real-time data exchange.
    """

    host: str
    port: int = rtde.PORT

    def open(self) -> Transport:
        """Raise TransportError: this link carries no motion."""
        raise self._refusal()

    def check(self, mode: int | None = None) -> None:
        """Raise TransportError: this link carries no motion."""
        del mode
        raise self._refusal()

    def _refusal(self) -> TransportError:
        return TransportError(
            self.address,
            "motions of a Universal Robots arm cannot be commanded yet",
            "record those of its own program with `hil record`",
        )

    @property
    def address(self) -> str:
        """Kind and address of the link."""
        return f"RTDE of {self.host}:{self.port}"

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


class OutputFrames(NamedTuple):
    """Data frames that arrived since the last call.

    Attributes:
        values: of the outputs (k,), by name.
        arrival: clock of this PC when each arrived (k,) [s], for diagnosis only.
        texts: lines of text that the controller sent meanwhile.
    """

    values: NDArray[np.void]
    arrival: NDArray[np.float64]
    texts: tuple[rtde.ControllerText, ...]


class RtdeReader:
    """Connection that reads all outputs of a recipe, from the first frame on.

    Attributes:
        version: of the controller's software.
        frequency: frames per second that were requested.
        recipe: outputs that come.
        absent: outputs that this version does not have.
    """

    def __init__(
        self,
        connection: socket.socket,
        *,
        required: Sequence[str] = REQUIRED,
        optional: Sequence[str] = OPTIONAL,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._socket = connection
        self._splitter = rtde.FrameSplitter()
        self._clock = clock
        self._frames: deque[tuple[float, rtde.RtdeFrame]] = deque()
        self._news = threading.Condition()
        self._ended: Exception | None = None
        self._thread: threading.Thread | None = None
        connection.settimeout(TIMEOUT)
        self._negotiate()
        self.frequency = _FASTEST.get(self.version.major, _E_SERIES)
        self.recipe, self.absent = self._set_up([*required], [*optional])

    @classmethod
    def connect(cls, spec: RtdeSpec) -> Self:
        """Connect to a controller and agree on the outputs; `start` begins them.

        Raises:
            TransportError: there is no controller, or it is another kind of server.
            RtdeError: it refuses the protocol, or lacks a required output.
        """
        try:
            connection = socket.create_connection((spec.host, spec.port), TIMEOUT)
        except (OSError, UnicodeError) as error:
            remedy = (
                "check address and cable, and that RTDE is enabled at the controller (Settings, "
                "Security, Services)"
            )
            raise TransportError(spec.address, _reason(error), remedy) from error
        try:
            return cls(connection)
        except (OSError, TransportClosed) as error:
            connection.close()
            remedy = f"make sure that {spec.port} is its port of RTDE ({rtde.PORT})"
            raise TransportError(spec.address, f"no reply ({_reason(error)})", remedy) from error
        except BaseException:
            connection.close()
            raise

    def start(self) -> None:
        """Start the outputs, and the thread that reads them.

        Raises:
            RtdeError: the controller refuses.
            TransportClosed: it closed the connection, or did not reply in time.
        """
        # Data frames may overtake the reply, which the thread waits for as well.
        self._send(rtde.frame(rtde.FrameType.START))
        if not rtde.accepted(self._reply(rtde.FrameType.START)):
            raise rtde.RtdeError("the controller refuses to start its outputs")
        self._socket.settimeout(SILENCE)
        self._thread = threading.Thread(target=self._read, name="rtde", daemon=True)
        self._thread.start()

    def fetch(self, timeout: float, at_least: int = 1) -> OutputFrames:
        """Return all frames that arrived, waiting up to `timeout` s for so many.

        Raises:
            TransportClosed: the connection has ended, and all its frames were fetched.
            RtdeError, PacketError: the controller sent something else.
        """
        with self._news:
            self._news.wait_for(
                lambda: len(self._frames) >= at_least or self._ended is not None, timeout
            )
            fetched = [*self._frames]
            self._frames.clear()
            ended = self._ended
        if not fetched and ended is not None:
            raise ended
        data = [(at, frame) for at, frame in fetched if frame.kind == rtde.FrameType.DATA]
        texts = [frame for _, frame in fetched if frame.kind == rtde.FrameType.TEXT]
        return OutputFrames(
            self.recipe.values([frame.payload for _, frame in data]),
            np.array([at for at, _ in data]),
            tuple(rtde.controller_text(frame.payload) for frame in texts),
        )

    def close(self) -> None:
        """Close the connection; may be called again."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        if self._thread is not None:
            self._thread.join(TIMEOUT)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self.close()

    def _negotiate(self) -> None:
        self._send(rtde.version_request())
        if not rtde.accepted(self._reply(rtde.FrameType.VERSION)):
            problem = "the controller does not have version 2 of RTDE (from 3.10 and 5.4 on)"
            raise rtde.RtdeError(problem)
        self._send(rtde.frame(rtde.FrameType.CONTROLLER_VERSION))
        reply = self._reply(rtde.FrameType.CONTROLLER_VERSION)
        self.version = rtde.controller_version(reply)

    def _set_up(
        self, required: list[str], optional: list[str]
    ) -> tuple[rtde.OutputRecipe, tuple[str, ...]]:
        """Request all outputs, and without those that the controller lacks."""
        names = required + optional
        absent: tuple[str, ...] = ()
        while True:
            self._send(rtde.outputs_request(self.frequency, names))
            reply = self._reply(rtde.FrameType.OUTPUTS)
            try:
                return rtde.OutputRecipe.confirmed(names, reply), absent
            except rtde.OutputsMissingError as missing:
                if absent or not set(missing.names) <= set(optional):
                    raise
                absent = missing.names
                names = [name for name in names if name not in absent]

    def _send(self, data: bytes) -> None:
        self._socket.sendall(data)

    def _reply(self, kind: rtde.FrameType) -> bytes:
        """Return the payload of the next frame of a kind; others are stored for `fetch`."""
        deadline = self._clock() + TIMEOUT
        while self._clock() < deadline:
            arrived = self._receive()
            replies = [frame for _, frame in arrived if frame.kind == kind]
            self._frames += [(at, frame) for at, frame in arrived if frame.kind != kind]
            if replies:
                return replies[0].payload
        raise TransportClosed(f"no reply to the request {chr(kind)!r} within {TIMEOUT:g} s")

    def _receive(self) -> list[tuple[float, rtde.RtdeFrame]]:
        """Return the frames of the next piece of the stream, with the time of its arrival."""
        data = self._socket.recv(_PIECE)
        now = self._clock()
        if not data:
            cut = self._splitter.unfinished
            within = f" within a frame, {cut} bytes of which came" if cut else ""
            raise TransportClosed(f"the controller closed the connection{within}")
        return [(now, frame) for frame in self._splitter.feed(data)]

    def _read(self) -> None:
        """Store frames until the connection ends."""
        try:
            while len(self._frames) < _MOST_WAITING:
                frames = self._receive()
                with self._news:
                    self._frames += frames
                    self._news.notify()
            raise TransportClosed("the frames were not fetched: this PC is too slow")
        except TimeoutError:
            silent = TransportClosed(f"the controller was silent for {SILENCE:g} s")
            self._end(silent)
        except OSError as error:
            self._end(TransportClosed(f"the connection broke ({_reason(error)})"))
        except Exception as error:  # raised where the frames are fetched
            self._end(error)

    def _end(self, reason: Exception) -> None:
        with self._news:
            self._ended = reason
            self._news.notify()


def _reason(error: BaseException) -> str:
    return str(getattr(error, "strerror", None) or error)
