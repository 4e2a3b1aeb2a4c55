"""The supervisor's handle on an exchange process."""

from __future__ import annotations

import os
import pickle
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from drivers.child_process import ChildProcess
from drivers.cycle_records import CycleRing, create_memory
from drivers.drive_train import DriveTrain
from drivers.errors import DriverError, RequestError
from drivers.exchange import control, event_log
from drivers.exchange.control import SharedState
from drivers.exchange.event_log import EventReader, ExchangeEvent
from drivers.exchange.motion_transfer import MAX_MESSAGE_BYTES, READ, WITHDRAWN, hand_over
from drivers.exchange.realtime import RealTimeReport, RealTimeSettings
from drivers.guard import GuardLimits
from drivers.motion_source import MotionSource
from drivers.transports.base import TransportSpec
from drivers.wire import state_of


@dataclass(frozen=True, eq=False)
class ExchangeSettings:
    """Settings of an exchange process; pickles.

    Attributes:
        period: the controller's cycle, s.
        session: further keyword arguments of `Session`.
        realtime: requested permissions.
        ring_capacity: cycle records buffered for the archive.
        preload: modules imported before the link opens, so that motions of their classes are read
            quickly.
        needs_archive: whether motions require an archive process that is ready.
        max_late: consecutive late replies that do not stop a motion; None for the session's
            `max_gap`.
    """

    transport: TransportSpec
    drive_train: DriveTrain
    guard_limits: GuardLimits
    period: float
    session: Mapping[str, Any] = field(default_factory=dict)
    realtime: RealTimeSettings = field(default_factory=RealTimeSettings)
    ring_capacity: int = 20_000
    preload: tuple[str, ...] = ()
    needs_archive: bool = True
    max_late: int | None = None


class ExchangeError(DriverError):
    """The exchange process could not be started, does not answer, or has ended."""


class WithdrawnError(RequestError):
    """A motion was withdrawn before it could begin."""


START_TIMEOUT: Final = 60.0
"""Time until the process has opened its link, s; imports may be slow on a cold disk."""
ANSWER_TIMEOUT: Final = 5.0
"""Time until a motion has been read, and again until it is accepted or refused, s."""
_POLL_PERIOD: Final = 0.1


class ExchangeProcess:
    """An exchange in its own process and process session; see `start`.

    Without `send_heartbeat` for half a second while a motion is requested, five seconds
    otherwise, and after the death of this process, it stops the arm on its path, leaves open mode
    and ends.

    Attributes:
        realtime: permissions granted by the system.
        notes: options of the link that the system refused.
        ring_fd: memory of the cycle records, for a `RingReader`.
        event_fd, control_fd: memory for an `EventReader` and a `SharedState`.
    """

    def __init__(self, settings: ExchangeSettings) -> None:
        n_joints = settings.drive_train.n_joints
        state = state_of(settings.session)
        self.ring_fd = CycleRing.shared(n_joints, settings.ring_capacity, state).fd
        self.event_fd = event_log.create()
        self.control_fd = control.create()
        self._control = SharedState(self.control_fd)
        self._events = EventReader(self.event_fd)
        self._offers = 0
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.send_heartbeat()
        settings_fd = create_memory("hil-settings", 0)
        try:
            os.pwrite(settings_fd, pickle.dumps(settings, protocol=5), 0)
            fds = [theirs.fileno(), settings_fd, self.ring_fd, self.event_fd, self.control_fd]
            # Thread pools would be locked into memory and never used.
            self._process = ChildProcess(
                ("-m", _MODULE, *map(str, fds)),
                descriptors=fds,
                environment=dict.fromkeys(_THREADS, "1"),
            )
        except OSError as error:
            self._close_memory()
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
            ExchangeError: the process could not be started, or ended; with its error output.
        """
        exchange = cls(settings)
        try:
            ready = exchange._receive(START_TIMEOUT)
            if isinstance(ready, BaseException):
                raise ready
        except BaseException:
            exchange.kill()
            exchange.close()
            raise
        exchange.realtime, exchange.notes = ready
        return exchange

    def send_heartbeat(self) -> None:
        """Update the heartbeat; to be called at least every 0.2 s, from any thread."""
        self._control.supervisor_heartbeat = time.monotonic()

    def submit(self, source: MotionSource, confirm: Callable[[], bool] = lambda: True) -> int:
        """Hand a motion over, to be run as soon as all its axes are open; return its id.

        Its arrays of 4 KiB and more arrive read-only. Reading it takes the exchange about 0.2 ms
        per MB, so that replies may be late; axes should be closed. Sends heartbeats while it
        waits. A motion that is not accepted in time is withdrawn.

        `confirm` is called when the exchange has read the motion, which may take long, and then
        until it has requested it; False withdraws the motion.

        Raises:
            WithdrawnError: `confirm` returned False; nothing has begun.
            RequestError: the session refuses it.
            ExchangeError: the exchange does not answer.
        """
        # Incremented before anything is sent, so that no two motions have the same id.
        self._offers = identity = self._offers + 1
        try:
            hand_over(self._channel, identity, source)
        except OSError as error:
            raise ExchangeError(f"the exchange process is gone: {error}") from error
        self._control.program_offered = identity
        try:
            reply = self._answer_to(identity)
            if reply == READ:
                self._permit(identity, confirm)
                reply = self._answer_to(identity, lambda: self._permit(identity, confirm))
        except BaseException:
            # The caller does not wait for this motion: it must not begin later, nor continue.
            self._control.program_id = -identity
            self.stop()
            raise
        if reply is not None:
            state, reason = reply
            raise (WithdrawnError if reason == WITHDRAWN else RequestError)(state, reason)
        return identity

    def _permit(self, identity: int, confirm: Callable[[], bool]) -> None:
        """Permit the motion that was read, or withdraw it."""
        if self._control.program_id != -identity and confirm():
            self.send_heartbeat()  # the cycle that requests it needs a recent one
            self._control.program_id = identity
        else:
            self._control.program_id = -identity

    def stop(self) -> None:
        """Request a stop on the path and the end of open mode."""
        self._control.stop_count += 1

    def override(self, fraction: float) -> None:
        """Change the speed of the present motion; `CommandRefused` if it cannot be changed."""
        self._control.override = fraction
        self._control.override_count += 1

    def hold(self) -> None:
        """Hold the present motion on its path until `resume`; one that cannot be held is stopped.

        A motion that has not begun begins at rest; without one there is a `CommandRefused` event.
        """
        self._hold(1)

    def resume(self) -> None:
        """Resume the motion held; `CommandRefused` if that is impossible."""
        self._hold(0)

    def _hold(self, held: int) -> None:
        self._control.held = held
        self._control.hold_count += 1

    def finish(self) -> None:
        """Request the end of open mode, and of the process when the axes were closed for 1 s."""
        self._control.finish = 1

    def events(self) -> list[ExchangeEvent]:
        """Return the events since the last call, in order."""
        return self._events.drain()

    def status(self) -> SharedState:
        """Return a copy of the shared state."""
        return SharedState.from_buffer_copy(self._control)

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.alive

    @property
    def log(self) -> str:
        """Its standard error; empty unless something failed."""
        return self._process.errors

    def wait(self, timeout: float) -> int | None:
        """Return its exit status, None if it still runs after `timeout` s; sends heartbeats."""
        end = time.monotonic() + timeout
        while True:
            self.send_heartbeat()
            remaining = end - time.monotonic()
            status = self._process.wait(max(0.0, min(remaining, _POLL_PERIOD)))
            if status is not None or remaining <= _POLL_PERIOD:
                return status

    def terminate(self) -> None:
        """Request a stop on the path and the end of the process, by signal."""
        self._process.terminate()

    def kill(self) -> None:
        """Kill it: the controller's own monitoring has to stop an arm in motion."""
        self._process.kill()

    def close(self) -> None:
        """Close socket and memory; a process that still runs stops the arm and ends."""
        self._process.close()
        self._close_memory()

    def _close_memory(self) -> None:
        self._channel.close()
        for name in ("ring_fd", "event_fd", "control_fd"):
            fd = getattr(self, name)
            closed = -1
            if fd != closed:
                os.close(fd)
                setattr(self, name, closed)

    def _answer_to(self, identity: int, poll: Callable[[], None] = lambda: None) -> Any:
        """Receive the next message about this motion; messages about earlier ones are dropped."""
        while True:
            answered, reply = self._receive(ANSWER_TIMEOUT, poll)
            if answered == identity:
                return reply

    def _receive(self, timeout: float, poll: Callable[[], None] = lambda: None) -> Any:
        """Receive the next message of the exchange; `poll` is called ten times a second."""
        end = time.monotonic() + timeout
        self._channel.settimeout(_POLL_PERIOD)
        while True:
            self.send_heartbeat()
            try:
                message = self._channel.recv(MAX_MESSAGE_BYTES)
            except TimeoutError:
                if time.monotonic() < end:
                    poll()
                    continue
                raise ExchangeError(
                    f"the exchange process did not answer within {timeout:g} s"
                ) from None
            except OSError:
                message = b""
            if not message:
                status = self._process.wait()
                output = self.log.strip() or "no error output"
                raise ExchangeError(f"the exchange process ended with status {status}: {output}")
            return pickle.loads(message)


def is_exchange(pid: int) -> bool:
    """Return whether a process is the exchange of a run of `hil`."""
    try:
        arguments = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return False
    return b"-m" in arguments and _MODULE.encode() in arguments


_MODULE: Final = "drivers.exchange"
_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
