"""One end of the profile on a bus: what the PC's and the controller's side have in common."""

from __future__ import annotations

import contextlib
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Final, Protocol

import can
from can.interfaces.udp_multicast import UdpMulticastBus

from drivers.errors import TransportClosed
from drivers.transports.can.bus import failing_as_closed, to_frame, to_message
from drivers.transports.can.layout import SEGMENT_DOWN, SEGMENT_UP, Frame

SEND_PATIENCE: Final = 0.05
"""s that a full send queue is waited for; what is not accepted by then is lost."""
SEGMENT_PATIENCE: Final = 0.5
"""s for a segment: many come at once, and nothing moves yet."""
LOOKS: Final = 1000
"""Frames looked at after the time is over: those that wait, but no endless flood."""
_ECHOES_REMEMBERED: Final = 256


class End(Protocol):
    """`PcEnd` or `ControllerEnd`."""

    discarded: Counter[str]

    def receive(self, frame: Frame, time: float) -> bytes | None:
        """Take a frame; the packet, if that completes one."""
        ...


class Port:
    """Frames in, packets out.

    Args:
        bus: python-can's; closed with the port.
        end: what the frames mean.
        fd: whether frames are FD frames.
        clock: s, the arrival of frames that the bus does not stamp.

    Attributes:
        discarded: counts of the end, and "bus_error" (error frames) and "unsent" (frames that the
            bus did not take).
    """

    def __init__(
        self, bus: can.BusABC, end: End, *, fd: bool, clock: Callable[[], float] = time.time
    ) -> None:
        self.discarded = end.discarded
        self._bus = bus
        self._end = end
        self._fd = fd
        self._clock = clock
        self._closed = False
        self._waiting: deque[can.Message] = deque()
        # python-can's multicast bus hands every frame back to its sender.
        echoes = isinstance(bus, UdpMulticastBus)
        self._own: deque[Frame] | None = deque(maxlen=_ECHOES_REMEMBERED) if echoes else None

    def receive(self, timeout: float) -> bytes | None:
        """The next packet, or None after `timeout` s without one.

        Raises:
            TransportClosed: closed, or the bus failed.
            CanError: a session that this bus cannot carry.
        """
        self._require_open()
        end = time.monotonic() + timeout
        left = timeout
        looks = LOOKS
        while True:
            message = self._next(max(0.0, left))
            if message is not None:
                packet = self._take(message)
                if packet is not None:
                    return packet
            left = end - time.monotonic()
            if left <= 0.0:
                looks -= 1
                if message is None or looks == 0:
                    return None

    def _next(self, timeout: float) -> can.Message | None:
        if self._waiting:
            return self._waiting.popleft()
        with failing_as_closed("the CAN bus"):
            return self._bus.recv(timeout)

    def _fetch(self) -> None:
        """Empty the bus's queue, which echoes of long packets would fill."""
        with failing_as_closed("the CAN bus"):
            while (message := self._bus.recv(0.0)) is not None:
                self._waiting.append(message)

    def _take(self, message: can.Message) -> bytes | None:
        if message.is_error_frame:
            self.discarded["bus_error"] += 1
            return None
        frame = to_frame(message, fd=self._fd)
        if frame is None:
            self.discarded["foreign"] += 1
            return None
        if self._own is not None and frame in self._own:
            self._own.remove(frame)
            return None
        # When it was on the bus matters, not when this program came to read it.
        return self._end.receive(frame, message.timestamp or self._clock())

    def send(self, frames: Sequence[Frame]) -> None:
        """Send frames in order; a set whose frame the bus does not take is given up, and counted.

        Raises:
            TransportClosed: closed, or the bus failed.
        """
        self._require_open()
        for frame in frames:
            segment = frame.id in (SEGMENT_UP, SEGMENT_DOWN)
            patience = SEGMENT_PATIENCE if segment else SEND_PATIENCE
            try:
                with failing_as_closed("the CAN bus"):
                    self._bus.send(to_message(frame, fd=self._fd), patience)
            except TransportClosed as error:
                # A full queue, or nobody who acknowledges. Whether the bus is gone for good is
                # for `receive` to find out.
                if not isinstance(error.__cause__, can.CanOperationError | can.CanTimeoutError):
                    raise
                self.discarded["unsent"] += 1
                return
            if self._own is not None:
                self._own.append(frame)
                self._fetch()

    def close(self) -> None:
        """Give the bus up. Closing twice changes nothing."""
        if not self._closed:
            self._closed = True
            with contextlib.suppress(TransportClosed), failing_as_closed("the CAN bus"):
                self._bus.shutdown()

    def _require_open(self) -> None:
        if self._closed:
            raise TransportClosed("the CAN link was closed")
