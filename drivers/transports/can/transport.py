"""The link over CAN: the PC's end on a bus of python-can."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import tempfile
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import can
import numpy as np
from can.interfaces.udp_multicast import UdpMulticastBus
from numpy.typing import NDArray

from drivers.errors import TransportClosed
from drivers.packets import Mode
from drivers.transports.base import TransportError
from drivers.transports.can.bus_load import (
    BusRates,
    CanAxesError,
    CanError,
    CanModeError,
    ProfileName,
)
from drivers.transports.can.ends import End, PcEnd
from drivers.transports.can.layout import MAX_AXES, SEGMENT_DOWN, SEGMENT_UP, Frame

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
def _failing_as_closed() -> Iterator[None]:
    """Turn what a bus raises into TransportClosed, with its cause."""
    try:
        yield
    except (can.CanError, OSError, ValueError, TypeError) as error:
        raise TransportClosed(f"the CAN bus failed: {error}") from error


SEND_PATIENCE: Final = 0.05
"""s that a full send queue is waited for; what is not accepted by then is lost."""
SEGMENT_PATIENCE: Final = 0.5
"""s for a segment: many come at once, and nothing moves yet."""
LOOKS: Final = 1000
"""Frames looked at after the time is over: those that wait, but no endless flood."""
_ECHOES_REMEMBERED: Final = 256


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
        with _failing_as_closed():
            return self._bus.recv(timeout)

    def _fetch(self) -> None:
        """Empty the bus's queue, which echoes of long packets would fill."""
        with _failing_as_closed():
            while (message := self._bus.recv(0.0)) is not None:
                self._waiting.append(message)

    def _take(self, message: can.Message) -> bytes | None:
        if message.is_error_frame:
            self.discarded["bus_error"] += 1
            return None
        if message.is_extended_id or message.is_remote_frame or bool(message.is_fd) != self._fd:
            self.discarded["foreign"] += 1
            return None
        frame = Frame(message.arbitration_id, bytes(message.data))
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
                with _failing_as_closed():
                    self._bus.send(self._message(frame), patience)
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

    def _message(self, frame: Frame) -> can.Message:
        return can.Message(
            arbitration_id=frame.id,
            data=frame.data,
            is_extended_id=False,
            is_fd=self._fd,
            bitrate_switch=self._fd,
            check=False,
        )

    def close(self) -> None:
        """Give the bus up. Closing twice changes nothing."""
        if not self._closed:
            self._closed = True
            with contextlib.suppress(TransportClosed), _failing_as_closed():
                self._bus.shutdown()

    def _require_open(self) -> None:
        if self._closed:
            raise TransportClosed("the CAN link was closed")


_WITHIN_THIS_PROCESS: Final = "virtual"
"""python-can's bus that no other program can open."""


class BusLock:
    """Keeps other programs of ours off a bus; whoever dies lets go of it.

    Advisory, as that of a campaign's folder: programs that do not ask for it are not excluded.

    Raises:
        TransportError: another program has the bus, or the lock cannot be made.
    """

    def __init__(self, interface: str, channel: str) -> None:
        self._fd = -1
        if interface == _WITHIN_THIS_PROCESS:
            return
        link = f"CAN bus {interface}:{channel}"
        path = _path(interface, channel)
        try:
            self._fd = _opened(path)
        except OSError as error:
            remedy = f"remove {path}, or make it writable"
            reason = f"its lock {path} cannot be opened ({error.strerror})"
            raise TransportError(link, reason, remedy) from error
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.pread(self._fd, 20, 0).decode("ascii", "replace").strip()
            self.release()
            raise TransportError(
                link,
                f"another program has it (process {holder or 'unknown'})",
                "wait for its end, or stop it",
            ) from error
        os.ftruncate(self._fd, 0)
        os.pwrite(self._fd, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        """Let go of the bus. Twice changes nothing."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _path(interface: str, channel: str) -> Path:
    """Of the lock; the same for each name of one serial port."""
    if channel.startswith("/"):
        channel = str(Path(channel).resolve())
    name = re.sub(r"[^0-9A-Za-z.]+", "_", f"{interface}_{channel}")
    return Path(tempfile.gettempdir()) / f"hil-can-{name}.lock"


def _opened(path: Path) -> int:
    """The file, for every user of this computer.

    The file stays: removing it would let two programs hold locks on two files of one name. In a
    folder that all may write to, one that lies there may not be opened as if it were to be made.
    """
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
    with contextlib.suppress(FileExistsError):
        made = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)
        os.fchmod(made, 0o666)
        return made
    return os.open(path, flags)


MOVABLE = frozenset((Mode.POSITION, Mode.POSITION_RELATIVE, Mode.DELTA_POSITION))
"""Open modes whose set-points the frames can carry."""


class CanTransport:
    """The PC's end of the CAN profile on an open bus.

    What cannot be carried is never bent into shape: an answer that the frames have no room for is
    replaced by a request for drive-off, and the link closes with the reason.

    Args:
        bus: python-can's; closed with the transport.
        rates: profile and bit rates.
        clock: s, the arrival of frames that the bus does not stamp.
        lock: of the bus, where it has one; let go of when the transport is closed.
    """

    def __init__(
        self,
        bus: can.BusABC,
        rates: BusRates,
        *,
        clock: Callable[[], float] = time.time,
        lock: BusLock | None = None,
    ) -> None:
        self._lock = lock
        self._end = PcEnd(rates)
        self._port = Port(bus, self._end, fd=rates.profile == "fd", clock=clock)

    @property
    def now(self) -> float:
        """CLOCK_MONOTONIC in s."""
        return time.monotonic()

    @property
    def ages(self) -> NDArray[np.uint16] | None:
        """(n_axes, 8) cycles since each value of the last cyclic packet was sent."""
        return self._end.ages

    def receive(self, timeout: float) -> bytes | None:
        """The next packet, or None after `timeout` s without one.

        Raises:
            TransportClosed: closed, the bus failed, or the controller began a session that this
                bus cannot carry (its cause is the `CanError`).
        """
        try:
            return self._port.receive(timeout)
        except CanError as error:
            self.close()
            raise TransportClosed(str(error)) from error

    def send(self, packet: bytes) -> None:
        """Answer the packet received last.

        Raises:
            TransportClosed: closed, the bus failed, or the answer cannot be carried (its cause is
                the `CanError`; drive-off was asked for instead).
        """
        try:
            frames = self._end.reply(packet)
        except CanError as error:
            self._port.send(self._end.drive_off())
            self.close()
            raise TransportClosed(str(error)) from error
        self._port.send(frames)

    def rejected(self) -> dict[str, int]:
        """Frames and sets discarded since the last call, by kind; see `PcEnd` and `Port`."""
        counts = dict(self._port.discarded)
        self._port.discarded.clear()
        return counts

    def forget_peer(self) -> None:
        """The session was lost: no slow value is known any more."""
        self._end.forget()

    def close(self) -> None:
        """Give the bus up. Closing twice changes nothing."""
        try:
            self._port.close()
        finally:
            if self._lock is not None:
                self._lock.release()


@dataclass(frozen=True)
class CanSpec:
    """A CAN link, to be opened.

    Attributes:
        interface: python-can's name of it: "socketcan", "slcan", "pcan", "udp_multicast", ...
        channel: "can0", "/dev/ttyACM0", ...
        profile: "fd" or "classic".
        bitrate: bit/s; None for 1 Mbit/s.
        data_bitrate: bit/s of the data phase on FD; None for 5 Mbit/s.
        period: cycle in s.
        n_axes: axes of the robot.
        options: further arguments of the python-can bus.
    """

    interface: str
    channel: str
    profile: ProfileName = "fd"
    bitrate: int | None = None
    data_bitrate: int | None = None
    period: float = field(kw_only=True)
    n_axes: int = field(default=MAX_AXES, kw_only=True)
    options: Mapping[str, bool | int | float | str] = field(
        default_factory=dict, kw_only=True, hash=False
    )

    @property
    def rates(self) -> BusRates:
        """Profile and bit rates.

        Raises:
            ValueError: no such profile, or a rate that is not positive.
        """
        standard = BusRates(self.profile)
        return BusRates(
            self.profile,
            standard.bitrate if self.bitrate is None else self.bitrate,
            standard.data_bitrate if self.data_bitrate is None else self.data_bitrate,
        )

    def check(self, mode: int | None = None) -> None:
        """See that this bus can carry the session, before anything is opened.

        Args:
            mode: open mode in which the robot is to be moved; None if it is not.

        Raises:
            CanAxesError: more axes than the frames have places for.
            CanBusLoadError: the cycle is too short for the frames.
            CanModeError: a mode whose set-points the frames cannot carry.
        """
        if not 1 <= self.n_axes <= MAX_AXES:
            raise CanAxesError(f"the robot has {self.n_axes} axes")
        self.rates.require_load(self.n_axes, self.period)
        if mode is not None and mode not in MOVABLE:
            raise CanModeError(f"motion in mode {mode} does not fit the frames")

    def open(self) -> CanTransport:
        """Open the bus.

        Raises:
            TransportError: it cannot be opened, another program has it, or (`CanError`) it could
                not carry the session.
        """
        self.check()
        lock = BusLock(self.interface, self.channel)
        try:
            bus = open_bus(self.interface, self.channel, self.rates, self.options)
        except BaseException:
            lock.release()
            raise
        return CanTransport(bus, self.rates, lock=lock)
