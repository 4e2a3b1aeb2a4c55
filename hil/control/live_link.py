"""Link over a real transport: exchange and archive in processes of their own.

This process requests motions and sends a heartbeat while its supervising loop runs. Each of the
three detects the death of the others, and then the arm comes to rest on its path.
"""

from __future__ import annotations

import ctypes
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Final, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.cycle_records import RingReader
from drivers.errors import DriverError
from drivers.exchange.control import HeartbeatMonitor, SharedState
from drivers.exchange.event_log import (
    NO_SUPERVISOR,
    NO_SUPERVISOR_AT_REST,
    SESSION_ENDED,
    ExchangeEnded,
    ExchangeEvent,
    ExchangeFailed,
    Leaving,
)
from drivers.exchange.process_handle import ExchangeProcess, ExchangeSettings, is_exchange
from drivers.exchange.realtime import RealTimeSettings
from drivers.motion_source import MotionSource
from drivers.states import State
from drivers.transports.base import LinkInUseError, TransportSpec
from hil.archive import ArchiveSpec
from hil.archive.live import LiveView, LiveViewError, Serve
from hil.archive.process_handle import (
    Answer,
    ArchiveProcessHandle,
    Close,
    Closed,
    Command,
    Failed,
    Open,
    Opened,
    Serving,
    silent_for,
)
from hil.archive.recorder import Recorded
from hil.base.errors import ArchiveWriteError, ControllerError
from hil.cell import Cell
from hil.control.connection import words_of
from hil.control.link import SESSION_END_TIMEOUT
from hil.control.motion_watch import Stop

from .link import MotionLink
from .port import PortStatus

T = TypeVar("T")

SUPERVISOR_HEARTBEAT_PERIOD: Final = 0.05
"""s; the exchange stops the arm after 0.5 s without a heartbeat."""
STALL_TIMEOUT: Final = 1.0  # Longest time between two turns of the loop that supervises a motion, s
EXCHANGE_HUNG_TIMEOUT: Final = 5.0
"""s without a heartbeat after which an exchange process is killed: the controller, without replies
for so long, has acted by its own watchdog."""
EARLIER_EXCHANGE_TIMEOUT: Final = 30.0
"""s to wait for the exchange of an earlier run: longer than one without a supervisor needs to bring
the arm to rest and to end."""
SUPERVISION_PERIOD: Final = 0.02  # Period of the supervising loop, s
OPEN_TIMEOUT = 10.0  # s within which a file must have been created, or completed
_M_MMAP_THRESHOLD: Final = -3
MMAP_THRESHOLD_BYTES: Final = 128 * 1024  # Bytes; glibc's own value, before it adapts


def return_large_arrays() -> None:
    """Have arrays of `MMAP_THRESHOLD_BYTES` and more returned to the system when they are freed.

    Otherwise glibc takes them from its heap once one was freed, and the heap grows over hours.
    """
    with suppress(OSError, AttributeError, TypeError):  # another C library
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, MMAP_THRESHOLD_BYTES)


class Heartbeat:
    """Heartbeat of this process to the exchange; it pauses while the supervising loop stalls."""

    def __init__(
        self, beat: Callable[[], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._beat = beat
        self._clock = clock
        self._turned: float | None = None
        self._ended = False

    def start(self) -> None:
        """Beat in a thread until `end`."""

        def beat() -> None:
            while not self._ended:
                self.update()
                time.sleep(SUPERVISOR_HEARTBEAT_PERIOD)

        threading.Thread(target=beat, daemon=True).start()

    def end(self) -> None:
        """End the thread."""
        self._ended = True

    def turn(self) -> None:
        """The supervising loop turned; it must again within `STALL_TIMEOUT` s, until `rest`."""
        self._turned = self._clock()

    def rest(self) -> None:
        """No motion is supervised: other work may take any time."""
        self._turned = None

    @property
    def supervises(self) -> bool:
        """Whether a motion is supervised."""
        return self._turned is not None

    def update(self) -> None:
        """Beat, unless the supervising loop stalls."""
        now = self._clock()
        turned = self._turned
        if turned is None or now - turned <= STALL_TIMEOUT:
            self._beat()


_REMEDIES: Final = {
    SESSION_ENDED: "; start its Open program again, then run the same command",
    NO_SUPERVISOR: "; check the arm, then run the same command again",
    NO_SUPERVISOR_AT_REST: "; run the same command again",
}
"""What to do about an exchange process that ended, by its reason."""


class ExchangeMonitor:
    """Detects that an exchange process ended or hangs, and why.

    Attributes:
        ended_for: why the process was killed; "" if it was not.
    """

    def __init__(self, exchange: ExchangeProcess) -> None:
        self.exchange = exchange
        self.ended_for = ""
        self._last_message = ""
        control = SharedState(exchange.control_fd)
        self._monitor = HeartbeatMonitor(lambda: control.exchange_heartbeat)
        self._events: list[ExchangeEvent] = []

    def poll(self) -> list[ExchangeEvent]:
        """Return the events of the exchange since the last call."""
        self._read()
        events = self._events
        self._events = []
        return events

    def failure(self) -> str | None:
        """Return why the process no longer replies, None while it does; kill one that hangs."""
        if self.exchange.alive and self._monitor.silence() > EXCHANGE_HUNG_TIMEOUT:
            self.exchange.kill()
            self.ended_for = silent_for(EXCHANGE_HUNG_TIMEOUT)
        if self.exchange.alive:
            return None
        self._read()
        remedy = _REMEDIES.get(self._last_message, "")
        message = f" ({self._last_message}{remedy})" if self._last_message else ""
        return f"the exchange process {self.ended_for or 'ended' + message}"

    def _read(self) -> None:
        for event in self.exchange.events():
            self._events.append(event)
            match event:
                case ExchangeFailed():
                    self._last_message = event.trace.strip().splitlines()[-1]
                case Leaving() | ExchangeEnded() if not self._last_message:
                    self._last_message = event.reason


class LivePort:
    """An exchange process and an archive process; see `ControllerPort`.

    Args:
        cell: of the controller.
        exchange: the exchange process.
        archive: the archive process.
        heart: heartbeat of this process.
        finish: asks the controller to end the session.
        only_simulated: whether only a simulated arm can move.

    Attributes:
        heart: heartbeat of this process.
        finish: asks the controller to end the session; only a simulated one can be asked.
        job: number of the archive opened last.
        open_path: of the archive that is open; "" if none is.
        live: where viewers connect, None if nowhere.
    """

    is_virtual = False

    def __init__(
        self,
        cell: Cell,
        exchange: ExchangeProcess,
        archive: ArchiveProcessHandle,
        heart: Heartbeat,
        finish: Callable[[], None] = lambda: None,
        *,
        only_simulated: bool = False,
    ) -> None:
        self.cell = cell
        self.exchange = exchange
        self.archive = archive
        self.heart = heart
        self.finish = finish
        self.only_simulated = only_simulated
        self.live: LiveView | None = None
        self.job = 0
        self.open_path = ""
        self._monitor = ExchangeMonitor(exchange)
        self._answer: Answer | None = None
        self._late_path = ""
        self._closed = False
        self._restart_reader()

    # --- the session

    @property
    def now(self) -> float:
        """See `ControllerPort.now`."""
        return time.monotonic()

    def status(self) -> PortStatus:
        """See `ControllerPort.status`."""
        status = self.exchange.status()
        return PortStatus(
            state=State(status.state),
            cycle=status.cycle,
            replied=status.replied,
            missed=status.missed,
            late=status.late,
            not_accepted=status.rejected,
            foreign=status.foreign,
            ended_count=status.ended_count,
            motion_time=status.motion_time,
            rate=status.rate,
            late_packets=status.late_packets,
        )

    def failure(self) -> str | None:
        """See `ControllerPort.failure`; an exchange process that hangs is killed."""
        return self._monitor.failure()

    def notes(self) -> tuple[str, ...]:
        """See `ControllerPort.notes`."""
        return (*self.exchange.realtime.refused, *self.exchange.notes)

    def prepare(self, stop: Stop) -> None:
        """See `ControllerPort.prepare`: an archive opened too late is closed, and its name free."""
        deadline = time.monotonic() + OPEN_TIMEOUT
        while self._late_path and not stop.requested:
            answer = self.archive.answer(SUPERVISION_PERIOD, self.job)
            if isinstance(answer, Closed | Failed):
                self._late_path = ""
            elif (failure := self.archive.failure()) is not None:
                raise ControllerError(f"{failure}; nothing was sent")
            elif time.monotonic() > deadline:
                waits = f"the archive process still waits for the disk to open {self._late_path}"
                raise ControllerError(f"{waits}; nothing was sent, check that disk")
        self._restart_reader()

    def poll(self) -> list[ExchangeEvent]:
        """See `ControllerPort.poll`."""
        if self.heart.supervises:
            self.heart.turn()
        return self._monitor.poll()

    def new_records(self) -> NDArray[np.void]:
        """See `ControllerPort.new_records`."""
        return self._reader.drain()

    def exchange_until(self, finished: Callable[[], bool], /) -> bool:
        """See `ControllerPort.exchange_until`."""
        while not finished():
            if self.failure() is not None:
                return False
            if self.open_path and self._answer is None:
                self._answer = self.archive.answer(SUPERVISION_PERIOD, self.job)
            else:
                time.sleep(SUPERVISION_PERIOD)
        return True

    def due(self) -> bool:
        """See `ControllerPort.due`."""
        return True

    def submit(self, source: MotionSource, wanted: Callable[[], bool], /) -> None:
        """See `ControllerPort.submit`."""
        self.exchange.submit(source, wanted)

    @contextmanager
    def supervision(self) -> Iterator[None]:
        """See `ControllerPort.supervision`."""
        self.heart.turn()
        try:
            yield
        finally:
            self.heart.rest()

    def stop(self, reason: str) -> None:
        """See `ControllerPort.stop`; the exchange states a reason of its own."""
        del reason
        self.exchange.stop()

    def override(self, fraction: float) -> None:
        """See `ControllerPort.override`."""
        self.exchange.override(fraction)

    def hold(self) -> None:
        """See `ControllerPort.hold`."""
        self.exchange.hold()

    def resume(self) -> None:
        """See `ControllerPort.resume`."""
        self.exchange.resume()

    def close(self) -> None:
        """End the session where the controller can be asked to, then both processes.

        Raises:
            ControllerError: one of them did not end properly.
        """
        problem = self._shut()
        if problem is not None:
            raise ControllerError(problem)

    def abort(self, error: BaseException) -> None:
        """Stop the arm, end both processes, and note at the error what was wrong with them."""
        if self.exchange.alive:
            self.exchange.stop()
        if (problem := self._shut()) is not None:
            error.add_note(problem)

    def _restart_reader(self) -> None:
        """Read the records that are still in the ring; the archive process reads independently."""
        n_joints = len(self.cell.joint_names)
        self._reader = RingReader(self.exchange.ring_fd, n_joints, acknowledge=False)

    def _shut(self) -> str | None:
        """End both processes; return what was wrong with them, None if nothing was."""
        if self._closed:
            return None
        self._closed = True
        self.heart.end()
        problem: str | None = None
        try:
            self.finish()
            self.exchange.finish()
            deadline = time.monotonic() + SESSION_END_TIMEOUT
            while self.failure() is None and time.monotonic() < deadline:
                self.exchange.send_heartbeat()
                time.sleep(SUPERVISION_PERIOD)
            if self._monitor.ended_for:
                problem = f"the exchange process {self._monitor.ended_for}"
            if self.exchange.alive:
                problem = (
                    f"the exchange process still replies {SESSION_END_TIMEOUT:g} s after it was "
                    f"asked to end: {words_of(self.cell).not_ended}"
                )
        finally:
            failure = self.archive.end()
            if failure is not None and self.open_path:
                problem = f"{failure}; {self.open_path} is not complete"
            self.exchange.close()
        return problem

    # --- archives

    @contextmanager
    def open_archive(self, spec: ArchiveSpec, *, own_motion: bool) -> Iterator[None]:
        """See `ControllerPort.open_archive`; one still open at an error is closed with the link."""
        drives = self.cell.drive_train
        self.job += 1
        self.open_path = str(spec.path)
        self._answer = None
        command = Open(self.job, spec, drives, not own_motion, not own_motion)
        unsent = f"nothing was sent, and {spec.path} is not recorded"
        if self._request(command, Opened, unsent) is None:
            # Should it be opened after all, it is to be closed at once.
            self.archive.send(Close(self.job, "void", "nothing was sent: it was opened too late"))
            self.open_path = ""
            self._late_path = str(spec.path)
            late = f"did not open {spec.path} within {OPEN_TIMEOUT:g} s"
            raise ControllerError(f"the archive process {late}; nothing was sent")
        self._late_path = ""  # commands are executed in order
        self._restart_reader()
        yield

    def archived(self) -> Recorded | None:
        """See `ControllerPort.archived`."""
        answer = self._answer
        self._answer = None
        answer = answer or self.archive.answer(0.0, self.job)
        if isinstance(answer, Failed):
            self.open_path = ""
            raise write_error(answer)
        if not isinstance(answer, Closed):
            return None
        self.open_path = ""
        return answer.recorded

    def archive_failure(self) -> str | None:
        """See `ControllerPort.archive_failure`; the caller reports the open file."""
        failure = self.archive.failure()
        if failure is not None:
            self.open_path = ""
        return failure

    def close_archive(self, outcome: str, reason: str) -> Recorded:
        """See `ControllerPort.close_archive`."""
        self.heart.rest()  # the motion has ended, or never began
        path = self.open_path
        incomplete = f"{path} is not complete ({outcome}: {reason})"
        closed = self._request(Close(self.job, outcome, reason), Closed, incomplete)
        if closed is None:
            raise ControllerError(f"{path} was not completed within {OPEN_TIMEOUT:g} s")
        self.open_path = ""
        return closed.recorded

    def _request(self, command: Command, answer: type[T], consequence: str) -> T | None:
        """Return the answer to a command to the archive process; None after `OPEN_TIMEOUT` s.

        ArchiveWriteError if the disk refuses, ControllerError if the process is gone or hangs.
        """
        self.archive.send(command)
        deadline = time.monotonic() + OPEN_TIMEOUT
        while time.monotonic() < deadline:
            message = self._answer or self.archive.answer(SUPERVISION_PERIOD, self.job)
            self._answer = None
            if isinstance(message, answer):
                return message
            if isinstance(message, Failed):
                self._late_path = self.open_path = ""
                raise write_error(message)
            if (failure := self.archive_failure()) is not None:
                raise ControllerError(f"{failure}; {consequence}")
        return None

    def _serve(self, view: LiveView) -> None:
        """Have the archive process serve viewers."""
        cell = self.cell
        self.job += 1
        command = Serve(self.job, view, cell.joint_names, cell.period, cell.drive_train)
        try:
            answer = self._request(command, Serving, "nothing was sent")
        except ArchiveWriteError as error:
            raise LiveViewError(None, error.problem, remedy=error.remedy) from error
        if answer is None:
            raise ControllerError("the archive process does not answer; nothing was sent")
        self.live = replace(view, port=answer.port)


class LiveLink(MotionLink):
    """A `MotionLink` over a real transport, in real time.

    A context manager: leaving it, also by an error, brings the arm to rest, leaves open mode and
    ends both processes.
    """

    port: LivePort

    @classmethod
    def open(
        cls,
        cell: Cell,
        *,
        transport: TransportSpec | None = None,
        only_axis: int | None = None,
        realtime: RealTimeSettings | None = None,
        finish: Callable[[], None] = lambda: None,
        live: LiveView | None = None,
        report: Callable[[str], object] = str,
        stop: Stop | None = None,
    ) -> Self:
        """Start exchange and archive process on the cell's link, or on another `transport` to it.

        From here on large arrays of this process return to the system when they are freed. The end
        of an exchange that an earlier run has left is waited for.

        Args:
            cell: the cell.
            transport: in place of the cell's own.
            only_axis: the only axis, from 1, that is opened; None for all.
            realtime: what the exchange requests from the system.
            finish: asks the controller to end the session.
            live: where viewers may connect.
            report: receives what is waited for.
            stop: ends the wait.

        Raises:
            LiveViewError: the live view cannot be served.
            CellError: the cell names no real link.
            ControllerError: the link cannot be opened, or the system refuses a process.
        """
        return_large_arrays()
        spec = transport if transport is not None else cell.transport_spec()
        settings = _settings(cell, spec, only_axis, realtime)
        exchange = _started(settings, report, stop or Stop())
        # At once: the archive process may take longer to start than the exchange waits for a beat.
        heart = Heartbeat(exchange.send_heartbeat)
        heart.start()
        try:
            archive = ArchiveProcessHandle.start(exchange, len(cell.joint_names))
        except BaseException as error:
            heart.end()
            exchange.finish()
            exchange.close()
            if isinstance(error, OSError):
                raise ControllerError(f"the archive process cannot be started: {error}") from error
            raise
        port = LivePort(cell, exchange, archive, heart, finish, only_simulated=cell.simulates(spec))
        if live is not None:
            try:
                port._serve(live)
            except BaseException:
                port._shut()
                raise
        return cls(cell, port)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            self.close()
        else:
            self.port.abort(error)


def _settings(
    cell: Cell, transport: TransportSpec, only_axis: int | None, realtime: RealTimeSettings | None
) -> ExchangeSettings:
    return ExchangeSettings(
        transport=transport,
        drive_train=cell.drive_train,
        guard_limits=cell.guard_limits,
        period=cell.period,
        session=cell.session_settings(only_axis=only_axis),
        realtime=realtime or RealTimeSettings(),
        preload=("planner",),
    )


def _started(
    settings: ExchangeSettings, report: Callable[[str], object], stop: Stop
) -> ExchangeProcess:
    """Start an exchange process, after the end of one that an earlier run has left on the link.

    A run that was killed leaves it: it replies until the arm has come to rest.

    Raises:
        ControllerError: it cannot be started, another run still has the link, or a stop was
            requested.
    """
    until = time.monotonic() + EARLIER_EXCHANGE_TIMEOUT
    reported = 0
    while True:
        try:
            return ExchangeProcess.start(settings)
        except LinkInUseError as error:
            holder = error.holder
            if holder is None or not is_exchange(holder):
                raise ControllerError(str(error)) from error
            link = error.link
        except DriverError as error:
            raise ControllerError(str(error)) from error
        except OSError as error:
            raise ControllerError(f"the exchange process cannot be started: {error}") from error
        whose = f"{link} is held by the exchange of another run of hil (process {holder})"
        if reported != holder:
            reported = holder
            report(
                f"{whose}: if that run was killed, its exchange replies to the controller until "
                f"the arm is at rest, and then ends; waiting for that, up to "
                f"{EARLIER_EXCHANGE_TIMEOUT:g} s"
            )
        while is_exchange(holder):
            if stop.requested:
                raise ControllerError("ended by the operator before anything moved")
            if time.monotonic() > until:
                raise ControllerError(
                    f"{whose} and was not released within {EARLIER_EXCHANGE_TIMEOUT:g} s; wait for "
                    "the end of that run, or stop it by Ctrl-C in its terminal, and run again. Do "
                    "not kill the exchange: it replies to the controller"
                )
            time.sleep(SUPERVISION_PERIOD)


def write_error(failed: Failed) -> ArchiveWriteError:
    """Return the error of an archive process that cannot write."""
    error = ArchiveWriteError(failed.path or None, failed.problem, remedy=failed.remedy)
    if failed.errno is not None:
        error.__cause__ = OSError(failed.errno, os.strerror(failed.errno))
    return error
