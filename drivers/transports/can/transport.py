"""The link over CAN: the PC's end on a bus of python-can."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import can
import numpy as np
from numpy.typing import NDArray

from drivers.errors import TransportClosed
from drivers.packets import Mode
from drivers.transports.base import TransportError
from drivers.transports.can.bus import Port, open_bus
from drivers.transports.can.bus_load import BusRates, ProfileName
from drivers.transports.can.ends import PcEnd
from drivers.transports.can.errors import CanAxesError, CanError, CanModeError
from drivers.transports.can.layout import MAX_AXES

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
            raise CanModeError(mode, None, f"motion in mode {mode} does not fit the frames")

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
