"""python-can's buses: opened by name, with errors in our words; one end of the profile on one."""

from __future__ import annotations

import contextlib
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, Protocol

import can
from can.interfaces.udp_multicast import UdpMulticastBus

from drivers.errors import TransportClosed
from drivers.transports.base import TransportError
from drivers.transports.can.bus_load import BusRates
from drivers.transports.can.layout import SEGMENT_DOWN, SEGMENT_UP, Frame

_REMEDIES = {
    "socketcan": "bring it up: modprobe can_raw && ip link set {channel} up type can {rates}",
    "slcan": "see that the adapter is there and that you may open its port (group dialout)",
    "udp_multicast": "it needs msgpack and a route for multicast: ip route add 239.0.0.0/8 dev lo",
}


def open_bus(
    interface: str, channel: str, rates: BusRates, options: Mapping[str, Any]
) -> can.BusABC:
    """Open a bus of python-can.

    Args:
        interface: python-can's name: socketcan, slcan, pcan, virtual, udp_multicast, ...
        channel: can0, /dev/ttyACM0, ...; a multicast group may have its port behind a slash.
        rates: profile and bit rates; on SocketCAN they are set by `ip link`, not here.
        options: further arguments of that bus.

    Raises:
        TransportError: it cannot be opened.
    """
    link = f"CAN bus {interface}:{channel}"
    try:
        bus = can.Bus(**_arguments(interface, channel, rates), **options)
        if interface == "slcan":
            fast = rates.data_bitrate if rates.profile == "fd" else None
            bus.set_bitrate(rates.bitrate, fast)  # type: ignore[attr-defined]
    except (can.CanError, OSError, ValueError, TypeError, ImportError, RuntimeError) as error:
        _dispose_of_half_made(error)
        remedy = _REMEDIES.get(interface, "see python-can's documentation of this interface")
        wanted = f"bitrate {rates.bitrate}"
        if rates.profile == "fd":
            wanted += f" dbitrate {rates.data_bitrate} fd on"
        remedy = remedy.format(channel=channel, rates=wanted)
        raise TransportError(link, str(error) or type(error).__name__, remedy) from error
    return bus


def _dispose_of_half_made(error: BaseException) -> None:
    """Shut down what python-can had begun to open; left to the collector it complains on stderr."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        for value in list(frame.f_locals.values()):
            if isinstance(value, can.BusABC):
                # It may lack any of its parts: all that counts is that it was tried.
                with contextlib.suppress(Exception):
                    value.shutdown()


def _arguments(interface: str, channel: str, rates: BusRates) -> dict[str, Any]:
    arguments: dict[str, Any] = {"interface": interface, "channel": channel}
    fd = rates.profile == "fd"
    if interface == "virtual":
        arguments["protocol"] = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
    elif interface == "udp_multicast":
        group, _, port = channel.partition("/")
        # Frames stay on this machine: nothing out there is to take them for a robot's.
        arguments.update(channel=group, hop_limit=0, fd=True)
        if port:
            arguments["port"] = int(port)
    elif interface == "socketcan":
        arguments["fd"] = fd
    elif interface != "slcan":
        arguments.update(bitrate=rates.bitrate, fd=fd)
        if fd:
            arguments["data_bitrate"] = rates.data_bitrate
    return arguments


@contextlib.contextmanager
def failing_as_closed(what: str) -> Iterator[None]:
    """Turn what a bus raises into TransportClosed, with its cause."""
    try:
        yield
    except (can.CanError, OSError, ValueError, TypeError) as error:
        raise TransportClosed(f"{what} failed: {error}") from error


def to_message(frame: Frame, *, fd: bool) -> can.Message:
    """The frame as python-can sends it."""
    return can.Message(
        arbitration_id=frame.id,
        data=frame.data,
        is_extended_id=False,
        is_fd=fd,
        bitrate_switch=fd,
        check=False,
    )


def to_frame(message: can.Message, *, fd: bool) -> Frame | None:
    """The data frame of the right kind in a message, None if it is something else."""
    if message.is_extended_id or message.is_remote_frame or bool(message.is_fd) != fd:
        return None
    return Frame(message.arbitration_id, bytes(message.data))


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
