"""The link over CAN: the PC's end on a bus of python-can."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import re
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import can
from can.interfaces.slcan import slcanBus
from can.interfaces.udp_multicast import UdpMulticastBus

from drivers.errors import TransportClosed
from drivers.transports.base import CanBus, LinkInUseError, TransportError, TransportSpec
from drivers.transports.can.frames import DOWN, BusRates, CanEndpoint, CanError, Frame

logging.getLogger("can").addHandler(logging.NullHandler())  # our errors have its reasons

_WITHIN_THIS_COMPUTER: Final = frozenset(("virtual", "udp_multicast"))
"""Interfaces of python-can without an adapter."""
_REMEDIES = {
    "socketcan": "bring it up: modprobe can_raw && ip link set {channel} up type can {rates}",
    "slcan": "check that the adapter is connected and its port may be opened (group dialout)",
    "udp_multicast": "it needs msgpack and a route for multicast: ip route add 239.0.0.0/8 dev lo",
}


_CLOCK_HZ: Final = 80_000_000  # Hz
_SAMPLE_POINT_PERCENT: Final = 80.0  # %


def open_bus(
    interface: str, channel: str, rates: BusRates, options: Mapping[str, Any]
) -> can.BusABC:
    """Open a bus of python-can.

    Args:
        interface: of python-can.
        channel: can0, /dev/ttyACM0, ...; a multicast group may have its port behind a slash.
        rates: of the bits; on SocketCAN these are set by `ip link`, not here.
        options: further arguments of the interface.

    Raises:
        TransportError: it cannot be opened.
    """
    try:
        if interface == "slcan":
            return _SlcanBus(channel, **_slcan_rates(rates), **options)
        return can.Bus(**_arguments(interface, channel, rates), **options)
    except (can.CanError, OSError, ValueError, TypeError, ImportError, RuntimeError) as error:
        remedy = _REMEDIES.get(interface, "see python-can's documentation of this interface")
        wanted = f"bitrate {rates.bitrate} dbitrate {rates.data_bitrate} fd on"
        remedy = remedy.format(channel=channel, rates=wanted)
        link = f"CAN bus {interface}:{channel}"
        raise TransportError(link, str(error) or type(error).__name__, remedy) from error


class _SlcanBus(slcanBus):
    """An adapter whose port is closed if it cannot be opened."""

    def __init__(self, channel: str, **options: Any) -> None:
        try:
            super().__init__(channel, **options)
        except BaseException:
            if (port := getattr(self, "serialPortOrig", None)) is not None:
                port.close()
            raise


def _slcan_rates(rates: BusRates) -> dict[str, Any]:
    """Return the arguments with which python-can sets the rates before it opens the adapter.

    An adapter that is opened first is on the bus with the rates of its last use.
    """
    # Only the rates are sent to the adapter, not the sample points.
    timing = can.BitTimingFd.from_sample_point(
        f_clock=_CLOCK_HZ,
        nom_bitrate=rates.bitrate,
        nom_sample_point=_SAMPLE_POINT_PERCENT,
        data_bitrate=rates.data_bitrate,
        data_sample_point=_SAMPLE_POINT_PERCENT,
    )
    return {"timing": timing}


def _arguments(interface: str, channel: str, rates: BusRates) -> dict[str, Any]:
    arguments: dict[str, Any] = {"interface": interface, "channel": channel}
    if interface == "virtual":
        arguments["protocol"] = can.CanProtocol.CAN_FD
    elif interface == "udp_multicast":
        group, _, port = channel.partition("/")
        # Frames must not leave this computer.
        arguments.update(channel=group, hop_limit=0, fd=True)
        if port:
            arguments["port"] = int(port)
    elif interface == "socketcan":
        arguments["fd"] = True
    else:
        arguments.update(bitrate=rates.bitrate, fd=True, data_bitrate=rates.data_bitrate)
    return arguments


@contextlib.contextmanager
def _failing_as_closed() -> Iterator[None]:
    """Convert the errors of a bus to TransportClosed, with their cause."""
    try:
        yield
    except (can.CanError, OSError, ValueError, TypeError) as error:
        raise TransportClosed(f"the CAN bus failed: {error}") from error


SEND_TIMEOUT: Final = 0.05
"""Longest wait for a full send queue, s; a packet not accepted by then is lost."""
START_TIMEOUT: Final = 0.5
"""The same before the session has cyclic packets, s: there are many frames, and nothing moves."""
MAX_QUEUED_FRAMES: Final = 1000
"""Frames read after the time-out."""
_MAX_ECHOES: Final = 256


class CanLink:
    """One end of the profile on an open bus, which is closed with it.

    `clock` gives the time of arrival of frames without a time stamp, s. `discarded` has the counts
    of the end, and "bus_error" (error frames) and "unsent" (frames not accepted by the bus).
    """

    def __init__(self, bus: can.BusABC, end: CanEndpoint, *, clock: Callable[[], float]) -> None:
        self.discarded = end.discarded
        self._bus = bus
        self._frames = end
        self._clock = clock
        self._closed = False
        self._waiting: deque[can.Message] = deque()
        # python-can's multicast bus returns every frame to its sender.
        echoes = isinstance(bus, UdpMulticastBus)
        self._echoes: deque[Frame] | None = deque(maxlen=_MAX_ECHOES) if echoes else None

    def receive(self, timeout: float) -> bytes | None:
        """Return the next packet, or None after `timeout` s without one.

        Raises:
            TransportClosed: closed, or the bus failed.
            CanError: the bus cannot carry the session.
        """
        self._require_open()
        end = time.monotonic() + timeout
        remaining = timeout
        queued = MAX_QUEUED_FRAMES
        while True:
            message = self._next(max(0.0, remaining))
            if message is not None:
                packet = self._decode(message)
                if packet is not None:
                    return packet
            remaining = end - time.monotonic()
            if remaining <= 0.0:
                queued -= 1
                if message is None or queued == 0:
                    return None

    def _next(self, timeout: float) -> can.Message | None:
        if self._waiting:
            return self._waiting.popleft()
        with _failing_as_closed():
            return self._bus.recv(timeout)

    def _fetch(self) -> None:
        """Empty the queue of the bus, which echoes of long packets would fill."""
        with _failing_as_closed():
            while (message := self._bus.recv(0.0)) is not None:
                self._waiting.append(message)

    def _decode(self, message: can.Message) -> bytes | None:
        if message.is_error_frame:
            self.discarded["bus_error"] += 1
            return None
        if message.is_extended_id or message.is_remote_frame or not message.is_fd:
            self.discarded["foreign"] += 1
            return None
        frame = Frame(message.arbitration_id, bytes(message.data))
        if self._echoes is not None and frame in self._echoes:
            self._echoes.remove(frame)
            return None
        # The time on the bus matters, not that of reading.
        return self._frames.receive(frame, message.timestamp or self._clock())

    def send(self, packet: bytes) -> None:
        """Send one packet; if the bus does not accept a frame, the rest is dropped and counted.

        Raises:
            TransportClosed: closed, or the bus failed.
            CanError: the bus cannot carry the session.
        """
        self._require_open()
        is_cyclic = len(packet) == self._frames.cyclic_length
        timeout = SEND_TIMEOUT if is_cyclic else START_TIMEOUT
        for frame in self._frames.frames(packet):
            try:
                with _failing_as_closed():
                    self._bus.send(
                        can.Message(
                            arbitration_id=frame.id,
                            data=frame.data,
                            is_extended_id=False,
                            is_fd=True,
                            bitrate_switch=True,
                            check=False,
                        ),
                        timeout,
                    )
            except TransportClosed as error:
                # A full queue, or no node that acknowledges; `receive` detects a failed bus.
                if not isinstance(error.__cause__, can.CanOperationError | can.CanTimeoutError):
                    raise
                self.discarded["unsent"] += 1
                return
            if self._echoes is not None:
                self._echoes.append(frame)
                self._fetch()

    def close(self) -> None:
        """Close the bus; may be called again."""
        if not self._closed:
            self._closed = True
            with contextlib.suppress(TransportClosed), _failing_as_closed():
                self._bus.shutdown()

    def _require_open(self) -> None:
        if self._closed:
            raise TransportClosed("the CAN link was closed")


_IN_PROCESS: Final = "virtual"
"""Interface of python-can within one process."""


def lock_bus(interface: str, channel: str) -> int | None:
    """Lock a bus among programs of hil; return the descriptor to close, None within one process.

    The file is never removed, else two programs could lock two files of one name. O_CREAT is
    refused for files of other users in a folder writable by all, so an existing file is opened
    without it.

    Raises:
        TransportError: another program has it.
    """
    if interface == _IN_PROCESS:
        return None
    # The same for all names of one serial port.
    device = str(Path(channel).resolve()) if channel.startswith("/") else channel
    name = re.sub(r"[^0-9A-Za-z.]+", "_", f"{interface}_{device}")
    path = Path(tempfile.gettempdir()) / f"hil-can-{name}.lock"
    link = f"CAN bus {interface}:{channel}"
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        try:
            lock = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)
            os.fchmod(lock, 0o666)
        except FileExistsError:
            lock = os.open(path, flags)
    except OSError as error:
        remedy = f"remove {path} or make it writable"
        reason = f"its lock {path} cannot be opened ({error.strerror})"
        raise TransportError(link, reason, remedy) from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        holder = os.pread(lock, 20, 0).decode("ascii", "replace").strip()
        os.close(lock)
        process = int(holder) if holder.isdecimal() else None
        raise LinkInUseError(link, process, "wait for it to end, or stop it") from error
    os.ftruncate(lock, 0)
    os.pwrite(lock, f"{os.getpid()}\n".encode(), 0)
    return lock


class CanTransport(CanLink):
    """The PC's end of the CAN profile on an open bus.

    Args:
        bus: open; closed with the link.
        rates: of the bus.
        clock: of `CanLink`.
        lock: descriptor of the bus's lock, closed with the link.
    """

    def __init__(
        self,
        bus: can.BusABC,
        rates: BusRates,
        *,
        clock: Callable[[], float] = time.time,
        lock: int | None = None,
    ) -> None:
        self._lock = lock
        super().__init__(bus, CanEndpoint(rates, DOWN), clock=clock)

    @property
    def now(self) -> float:
        """CLOCK_MONOTONIC, s."""
        return time.monotonic()

    def receive(self, timeout: float) -> bytes | None:
        """Return the next packet, or None after `timeout` s without one.

        Raises:
            TransportClosed: closed, the bus failed, or it cannot carry the session.
        """
        try:
            return super().receive(timeout)
        except CanError as error:
            self.close()
            raise TransportClosed(str(error)) from error

    def send(self, packet: bytes) -> None:
        """Send the reply to the packet received last.

        Raises:
            TransportClosed: closed, the bus failed, or it cannot carry the session.
        """
        try:
            super().send(packet)
        except CanError as error:
            self.close()
            raise TransportClosed(str(error)) from error

    def rejected(self) -> dict[str, int]:
        """Return frames and packets discarded since the last call, by kind."""
        counts = dict(self.discarded)
        self.discarded.clear()
        return counts

    def forget_peer(self) -> None:
        """Do nothing: a bus has no addresses."""

    def close(self) -> None:
        """Close the bus; may be called again."""
        try:
            super().close()
        finally:
            if self._lock is not None:
                os.close(self._lock)
                self._lock = None


@dataclass(frozen=True)
class CanSpec(TransportSpec):
    """Settings of a CAN link.

    Attributes:
        interface: python-can's name of it: "socketcan", "slcan", "pcan", "udp_multicast", ...
        channel: "can0", "/dev/ttyACM0", ...
        bitrate: bit/s of the arbitration phase; None for 1 Mbit/s.
        data_bitrate: bit/s of the data phase; None for 5 Mbit/s.
        period: cycle in s.
        options: further arguments of the python-can bus.
    """

    interface: str
    channel: str
    bitrate: int | None = None
    data_bitrate: int | None = None
    period: float = field(kw_only=True)
    n_axes: int = field(default=6, kw_only=True)
    options: Mapping[str, bool | int | float | str] = field(
        default_factory=dict, kw_only=True, hash=False
    )

    @property
    def rates(self) -> BusRates:
        """Bit rates."""
        standard = BusRates()
        data_bitrate = self.data_bitrate or standard.data_bitrate
        return BusRates(self.bitrate or standard.bitrate, data_bitrate)

    @property
    def description(self) -> str:
        """Interface and channel."""
        return f"{self.interface}:{self.channel}"

    @property
    def is_local(self) -> bool:
        """Whether frames do not leave this computer."""
        return self.interface in _WITHIN_THIS_COMPUTER

    @property
    def needs(self) -> tuple[CanBus]:
        """The interface at its bit rates."""
        return (CanBus(self.interface, self.channel, self.bitrate, self.data_bitrate),)

    def check(self, mode: int | None = None) -> None:
        """Check that a cycle is long enough for the frames, which carry any mode.

        Raises:
            CanBusLoadError: it is not.
        """
        del mode
        self.rates.require_load(self.n_axes, self.period)

    def open(self) -> CanTransport:
        """Open the bus.

        Raises:
            TransportError: it cannot be opened, another program uses it, or (`CanError`) it cannot
                carry the session.
        """
        self.check()
        lock = lock_bus(self.interface, self.channel)
        try:
            bus = open_bus(self.interface, self.channel, self.rates, self.options)
        except BaseException:
            if lock is not None:
                os.close(lock)
            raise
        return CanTransport(bus, self.rates, lock=lock)
