"""The supervisor's handle on an exchange process."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from drivers.drive_train import DriveTrain
from drivers.errors import DriverError, RequestError
from drivers.exchange import control, event_log
from drivers.exchange.control import ControlBlock
from drivers.exchange.event_log import EventReader, ExchangeEvent
from drivers.exchange.loop import MAX_LATE
from drivers.exchange.motion_transfer import LONGEST_MESSAGE, READ, WITHDRAWN, hand_over
from drivers.exchange.realtime import RealTimeReport, RealTimeSettings
from drivers.guard import GuardLimits
from drivers.motion_source import MotionSource
from drivers.record import CycleRing, PacketRing, create_memory
from drivers.transports.base import TransportSpec


@dataclass(frozen=True, eq=False)
class ExchangeSettings:
    """Everything the exchange needs; pickles.

    Attributes:
        transport: the link.
        drive_train: of the arm.
        guard_limits: bounds of every set-point.
        period: the controller's cycle, s.
        session: further keyword arguments of `Session`.
        realtime: what to ask the system for.
        ring_capacity: cycle records stored for whoever archives them.
        packets: raw packets stored for whoever archives them; 0: none, and the link is as it is.
        preload: modules imported before the link opens, so that programs made of their classes
            are read quickly.
        needs_archive: whether a motion is accepted and goes on only while the archive process
            lives and has an archive ready.
        max_late: answers in a row that may leave too late in open mode without stopping a motion;
            None takes the session's `max_gap`.
    """

    transport: TransportSpec
    drive_train: DriveTrain
    guard_limits: GuardLimits
    period: float
    session: Mapping[str, Any] = field(default_factory=dict)
    realtime: RealTimeSettings = field(default_factory=RealTimeSettings)
    ring_capacity: int = 20_000
    packets: int = 0
    preload: tuple[str, ...] = ()
    needs_archive: bool = True
    max_late: int | None = None

    @property
    def late_allowed(self) -> int:
        """`max_late`, or what stands for it."""
        if self.max_late is not None:
            return self.max_late
        allowed: int = self.session.get("max_gap", MAX_LATE)
        return allowed


class ExchangeError(DriverError):
    """The exchange process could not be started, does not answer, or is gone."""


class WithdrawnError(RequestError):
    """A motion was handed over, and not wanted any more before it could begin."""


START_TIMEOUT: Final = 60.0
"""s until a process that was started has opened its link; imports may be slow on a cold disk."""
ANSWER_TIMEOUT: Final = 5.0
"""s until a program has been read, and again until it has been accepted or refused."""
_BEAT: Final = 0.1


def _always() -> bool:
    return True


def _nothing() -> None: ...


class ExchangeProcess:
    """An exchange that runs in a process, and a process session, of its own.

    It outlives this process for as long as it takes to stop the arm on its path and to leave
    open mode; it does so when `send_heartbeat` was not called for half a second while a motion is
    requested, five seconds otherwise. Use `start`.

    Attributes:
        pid: of the process.
        realtime: what the system granted it.
        notes: options of the link that the system refused, in words.
        ring_fd: memory of the cycle records, for a `RingReader`.
        packets_fd: memory of the raw packets, for a `PacketReader`; -1 if they are not stored.
        event_fd: memory of the events, for an `EventReader`.
        control_fd: memory of the control block, for a `ControlBlock`.
    """

    def __init__(self, settings: ExchangeSettings) -> None:
        n_joints = settings.drive_train.n_joints
        self.ring_fd = CycleRing.shared(n_joints, settings.ring_capacity).fd
        self.packets_fd = PacketRing.shared(settings.packets).fd if settings.packets else -1
        self.event_fd = event_log.create()
        self.control_fd = control.create()
        self._log_fd = create_memory("hil-exchange-log", 0)
        self._control = ControlBlock(self.control_fd)
        self._events = EventReader(self.event_fd)
        self._offers = 0
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.send_heartbeat()
        settings_fd = create_memory("hil-settings", 0)
        try:
            os.pwrite(settings_fd, pickle.dumps(settings, protocol=5), 0)
            fds = [theirs.fileno(), settings_fd, self.ring_fd, self.event_fd, self.control_fd]
            if settings.packets:
                fds.append(self.packets_fd)
            self._process = _spawn(fds, self._log_fd)
        except OSError as error:
            self.close()
            raise ExchangeError(f"the exchange process cannot be started: {error}") from error
        finally:
            os.close(settings_fd)
            theirs.close()
        self.pid = self._process.pid
        self.realtime: RealTimeReport
        self.notes: tuple[str, ...]

    @classmethod
    def start(cls, settings: ExchangeSettings) -> ExchangeProcess:
        """Start the process and wait until its link is open.

        Raises:
            TransportError: the link cannot be opened.
            ExchangeError: it could not be started, or did not get that far; the message has its
                last words.
        """
        exchange = cls(settings)
        try:
            ready = exchange._answer(START_TIMEOUT)
            if isinstance(ready, BaseException):
                raise ready
        except BaseException:
            exchange.kill()
            exchange.close()
            raise
        exchange.realtime, exchange.notes = ready
        return exchange

    def send_heartbeat(self) -> None:
        """Sign of life; to be given at least every 0.2 s, from any thread."""
        self._control.supervisor_heartbeat = time.monotonic()

    def submit(self, source: MotionSource, wanted: Callable[[], bool] = _always) -> int:
        """Hand a motion over, to be run as soon as every wanted axis is open.

        Its arrays of 4 KiB and more arrive read-only. Reading it takes the exchange about 0.2 ms
        per MB, so that answers may come late meanwhile; axes should be closed. Gives signs of
        life while it waits; a motion that is not accepted in time is withdrawn.

        Args:
            source: the motion.
            wanted: asked once the exchange has read the motion, which may be long after this call,
                and again until it has begun with it; if not, the motion is withdrawn.

        Returns:
            The program's id.

        Raises:
            WithdrawnError: it is not wanted any more; nothing has begun.
            RequestError: the session refuses it.
            ExchangeError: the exchange does not answer.
        """
        # Counted before anything is sent: no two programs may ever have the same id.
        self._offers = identity = self._offers + 1
        try:
            hand_over(self._channel, identity, source)
        except OSError as error:
            raise ExchangeError(f"the exchange process is gone: {error}") from error
        self._control.program_offered = identity
        try:
            reply = self._answer_to(identity)
            if reply == READ:
                self._permit(identity, wanted)
                reply = self._answer_to(identity, lambda: self._permit(identity, wanted))
        except BaseException:
            # Nobody waits for this motion any more: it must not begin after all, nor go on.
            self._control.program_id = -identity
            self.stop()
            raise
        if reply is not None:
            state, reason = reply
            raise (WithdrawnError if reason == WITHDRAWN else RequestError)(state, reason)
        return identity

    def _permit(self, identity: int, wanted: Callable[[], bool]) -> None:
        """Let the program that was read begin, or withdraw it for good."""
        if self._control.program_id != -identity and wanted():
            self.send_heartbeat()  # the next cycle may start it
            self._control.program_id = identity
        else:
            self._control.program_id = -identity

    def stop(self) -> None:
        """Ask for a stop on the path and for the end of open mode."""
        self._control.stop_count += 1

    def override(self, fraction: float) -> None:
        """Ask the motion going on for another fraction of its speed.

        Where it cannot, `OverrideRefused` is among the events.
        """
        self._control.override = fraction
        self._control.override_count += 1

    def hold(self) -> None:
        """Ask the motion going on to rest on its path until `resume`; one that cannot is stopped.

        One that has not begun begins at rest; where there is none, `HoldRefused` is among the
        events, and one handed over later begins as usual.
        """
        self._hold(1)

    def resume(self) -> None:
        """Ask it to go on; where it cannot, `ResumeRefused` is among the events."""
        self._hold(0)

    def _hold(self, held: int) -> None:
        self._control.held = held
        self._control.hold_count += 1

    def finish(self) -> None:
        """Ask it to leave open mode and to end when the axes have been closed for a second."""
        self._control.finish = 1

    def events(self) -> list[ExchangeEvent]:
        """What happened since the last call, in order."""
        return self._events.drain()

    def status(self) -> ControlBlock:
        """Where it stands: what the control block says at this moment."""
        return self._control.copied()

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    @property
    def log(self) -> str:
        """What it wrote to its standard error: nothing, unless something is wrong."""
        size = os.fstat(self._log_fd).st_size
        return os.pread(self._log_fd, size, 0).decode(errors="replace")

    def wait(self, timeout: float) -> int | None:
        """Its exit status, or None if it still runs after `timeout` s; gives signs of life."""
        end = time.monotonic() + timeout
        while True:
            self.send_heartbeat()
            left = end - time.monotonic()
            try:
                return self._process.wait(max(0.0, min(left, _BEAT)))
            except subprocess.TimeoutExpired:
                if left <= _BEAT:
                    return None

    def terminate(self) -> None:
        """Ask for a stop on the path and for the end of the process, by signal."""
        if self.alive:
            self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it at once: an arm in motion is left to the controller's own watch."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """Give up this end, and the memory; a process that still runs stops the arm and ends."""
        self._channel.close()
        for name in ("ring_fd", "packets_fd", "event_fd", "control_fd", "_log_fd"):
            fd, closed = getattr(self, name), -1
            if fd != closed:
                os.close(fd)
                setattr(self, name, closed)

    def _answer_to(self, identity: int, meanwhile: Callable[[], None] = _nothing) -> Any:
        """What is said of this program next; the answer to one given up may still come before."""
        while True:
            answered, reply = self._answer(ANSWER_TIMEOUT, meanwhile)
            if answered == identity:
                return reply

    def _answer(self, timeout: float, meanwhile: Callable[[], None] = _nothing) -> Any:
        """The next message of the exchange; `meanwhile` is called ten times a second."""
        end = time.monotonic() + timeout
        self._channel.settimeout(_BEAT)
        while True:
            self.send_heartbeat()
            try:
                message = self._channel.recv(LONGEST_MESSAGE)
            except TimeoutError:
                if time.monotonic() < end:
                    meanwhile()
                    continue
                raise ExchangeError(f"the exchange process was silent for {timeout:g} s") from None
            except OSError:
                message = b""
            if not message:
                status = self._process.wait()
                words = self.log.strip() or "it said nothing"
                raise ExchangeError(f"the exchange process ended with status {status}: {words}")
            return pickle.loads(message)


_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def _spawn(fds: Sequence[int], log: int) -> subprocess.Popen[bytes]:
    environment = {
        **os.environ,
        # What this process can import, that one can: programs are made of classes.
        "PYTHONPATH": os.pathsep.join(path or str(Path.cwd()) for path in sys.path),
        # A pool of threads would be locked into memory and never used.
        **dict.fromkeys(_THREADS, "1"),
    }
    return subprocess.Popen(
        [sys.executable, "-m", "drivers.exchange", *map(str, fds)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=log,
        pass_fds=fds,
        start_new_session=True,
        env=environment,
    )
