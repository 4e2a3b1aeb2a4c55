"""Reader of the real-time outputs of a controller, that gets every frame.

It only reads: it registers no input, so that any number of programs may run beside it. A thread of
its own empties the socket, so that a slow disk does not fill the controller's buffer: that skips
frames for slow clients, and disconnects those that do not read.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from drivers.errors import TransportClosed
from drivers.ur import rtde
from drivers.ur.connection import (
    CONNECT_TIMEOUT,
    RtdeAddress,
    RtdeConnection,
    connected,
    no_reply,
    reason,
)
from drivers.ur.outputs import OPTIONAL, REQUIRED

SILENCE_TIMEOUT: Final = 2.0
"""Time without a frame after which the controller is lost, s."""
_MAX_WAITING_FRAMES: Final = 200_000
"""Frames that may wait to be fetched, 400 s at 500 Hz."""


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


class RtdeReader(RtdeConnection):
    """Connection that reads all outputs of a recipe, from the first frame on.

    Args:
        connection: to the controller.
        required: outputs without which nothing is read.
        optional: outputs that are read if the controller has them.
        clock: for time-outs [s].
    """

    def __init__(
        self,
        connection: socket.socket,
        *,
        required: Sequence[str] = REQUIRED,
        optional: Sequence[str] = OPTIONAL,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._news = threading.Condition()
        self._ended: Exception | None = None
        self._thread: threading.Thread | None = None
        super().__init__(connection, clock)
        self.request_outputs(required, optional)

    @classmethod
    def connect(cls, to: RtdeAddress) -> Self:
        """Connect to a controller and agree on the outputs; `start` begins them.

        Raises:
            TransportError: there is no controller, or it is another kind of server.
            RtdeError: it refuses the protocol, or lacks a required output.
        """
        connection = connected(to)
        try:
            return cls(connection)
        except (OSError, TransportClosed) as error:
            connection.close()
            raise no_reply(to, error) from error
        except BaseException:
            connection.close()
            raise

    def start(self) -> None:
        """Start the outputs, and the thread that reads them; see `request_start`."""
        self.request_start()
        self._socket.settimeout(SILENCE_TIMEOUT)
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
                lambda: len(self.frames) >= at_least or self._ended is not None, timeout
            )
            fetched = [*self.frames]
            self.frames.clear()
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
            self._thread.join(CONNECT_TIMEOUT)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self.close()

    def _read(self) -> None:
        """Store frames until the connection ends."""
        try:
            while len(self.frames) < _MAX_WAITING_FRAMES:
                frames = self._receive()
                with self._news:
                    self.frames += frames
                    self._news.notify()
            raise TransportClosed("the frames were not fetched: this PC is too slow")
        except TimeoutError:
            silent = TransportClosed(f"the controller was silent for {SILENCE_TIMEOUT:g} s")
            self._end(silent)
        except OSError as error:
            self._end(TransportClosed(f"the connection broke ({reason(error)})"))
        except Exception as error:  # raised where the frames are fetched
            self._end(error)

    def _end(self, ending: Exception) -> None:
        with self._news:
            self._ended = ending
            self._news.notify()
