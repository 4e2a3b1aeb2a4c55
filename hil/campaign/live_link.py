"""Link over a real transport: exchange and archive in processes of their own.

This process requests motions and sends a heartbeat while its supervising loop runs. Each of the
three detects the death of the others, and then the arm comes to rest on its path.
"""

from __future__ import annotations

import ctypes
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final, Self, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError, RequestError
from drivers.events import (
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    PacketRejected,
    Refused,
)
from drivers.exchange.control import HEARTBEAT_TIMEOUT, ControlBlock, HeartbeatMonitor
from drivers.exchange.event_log import (
    NO_ARCHIVE,
    EventsLost,
    ExchangeEnded,
    ExchangeEvent,
    ExchangeFailed,
    Leaving,
)
from drivers.exchange.process import ExchangeProcess, ExchangeSettings
from drivers.exchange.realtime import RealTimeSettings
from drivers.exchange.serving import ARM_MOVED
from drivers.motion_source import MotionSource
from drivers.record import RingReader
from drivers.states import Outcome, State
from drivers.transports.base import TransportSpec
from hil.archive import ArchiveSpec
from hil.archive.live import LiveView, LiveViewError, Serve
from hil.archive.recorder import Recorded, describe
from hil.archive.supervised import (
    ArchiveProcessHandle,
    Close,
    Closed,
    Command,
    Failed,
    Open,
    Opened,
    Serving,
)
from hil.cell import Cell
from hil.errors import ArchiveWriteError, ControllerFault
from hil.terminal_text import plural

from .link import (
    END_TIMEOUT,
    Connection,
    Counts,
    MotionLink,
    Progress,
    StartTimeout,
    Steering,
    Watch,
    active_guard,
    described,
    recording_end,
)
from .operator import Stop

Array = NDArray[np.float64]
T = TypeVar("T")

HEARTBEAT_PERIOD: Final = 0.05  # s; the exchange stops the arm after 0.5 s without a heartbeat
STALL: Final = 1.0  # Longest time between two turns of the loop that supervises a motion, s
HUNG: Final = 5.0
"""s without a heartbeat after which an exchange process is killed: the controller, without replies
for so long, has acted by its own watchdog."""
POLL: Final = 0.02  # Period of the supervising loop, s
OPEN_TIMEOUT = 10.0  # s within which a file must have been created, or completed
SLOW_DISK: Final = 1.0  # Duration of one flush that is reported as a fault of the disk, s
REST_TIMEOUT: Final = 30.0
"""s for an arm to come to rest, and for the archive of a motion that has ended."""
_M_MMAP_THRESHOLD: Final = -3
LARGE: Final = 128 * 1024  # Bytes; glibc's own value, before it adapts


def return_large_arrays() -> None:
    """Have arrays of `LARGE` bytes and more returned to the system when they are freed.

    Otherwise glibc takes them from its heap once one was freed, and the heap grows over hours.
    """
    with suppress(OSError, AttributeError, TypeError):  # another C library
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, LARGE)


class Heartbeat:
    """Heartbeat of this process to the exchange; it pauses while the supervising loop stalls."""

    def __init__(
        self, beat: Callable[[], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._beat, self._clock = beat, clock
        self._turned: float | None = None
        self._ended = False

    def start(self) -> None:
        """Beat in a thread until `end`."""

        def beat() -> None:
            while not self._ended:
                self.update()
                time.sleep(HEARTBEAT_PERIOD)

        threading.Thread(target=beat, daemon=True).start()

    def end(self) -> None:
        """End the thread."""
        self._ended = True

    def turn(self) -> None:
        """The supervising loop turned; it must again within `STALL` s, until `rest`."""
        self._turned = self._clock()

    def rest(self) -> None:
        """No motion is supervised: other work may take any time."""
        self._turned = None

    def update(self) -> None:
        """Beat, unless the supervising loop stalls."""
        now, turned = self._clock(), self._turned
        if turned is None or now - turned <= STALL:
            self._beat()


@dataclass(eq=False)
class ExchangeView:
    """State of the exchange process and of the motion requested last, from its events.

    Attributes:
        lost: the last loss of the link.
        ended: the end of the motion, if its event came.
        inits: init packets so far.
        refused: the refusal since the motion was requested.
        not_understood: number and cause of packets without a reply; "" for none.
        started: whether the motion has sent anything, or may have.
        ended_for: why the process was killed; "" if it was not.
    """

    exchange: ExchangeProcess
    connection: Connection = field(default_factory=Connection)
    lost: LinkLost | None = None
    ended: MotionEnded | None = None
    inits: int = 0
    started: bool = False
    refused: Refused | None = None
    not_understood: str = ""
    ended_for: str = ""
    _start: StartTimeout = field(default_factory=lambda: StartTimeout(time.monotonic()))
    _rejected: int = 0
    _last_message: str = ""
    _ended_before: int = 0
    _monitor: HeartbeatMonitor = field(init=False)

    def __post_init__(self) -> None:
        control = ControlBlock(self.exchange.control_fd)
        self._monitor = HeartbeatMonitor(lambda: control.exchange_heartbeat)

    def poll(self) -> list[ExchangeEvent]:
        """Receive the events of the exchange, update the state with them, and return them."""
        events = self.exchange.events()
        for event in events:
            self.connection.update(event)
            match event:
                case InitReceived():
                    self.inits += 1
                case LinkLost():
                    self.lost = event
                case MotionEnded():
                    self.ended = event
                case Refused():
                    self.refused = event
                case PacketRejected() if event.reason:
                    self._rejected += event.count
                    packets = plural(self._rejected, "packet")
                    self.not_understood = f"{packets} came and got no reply: {event.reason}"
                case MotionStarted() | EventsLost():
                    self.started = True
                case ExchangeFailed():
                    self._last_message = event.trace.strip().splitlines()[-1]
                case Leaving() | ExchangeEnded() if not self._last_message:
                    self._last_message = event.reason
        return events

    def reset_motion(self) -> None:
        """Forget the last motion: another one is about to be requested."""
        self.poll()
        self.ended, self.refused, self.started = None, None, False
        self._start = StartTimeout(time.monotonic())
        self._ended_before = self.status.ended_count

    def no_start(self) -> str | None:
        """Return why the motion will not start; None while it may, and once it has."""
        found = self._start.no_start(self.state, time.monotonic())
        return None if self.started or self.motion_ended else found

    @property
    def motion_ended(self) -> bool:
        """Whether the motion has ended; its event may have been lost."""
        return self.ended is not None or self.status.ended_count != self._ended_before

    @property
    def status(self) -> ControlBlock:
        """The exchange's fields of the control block."""
        return self.exchange.status()

    @property
    def state(self) -> State:
        """State of the session."""
        return State(self.status.state)

    def failure(self) -> str | None:
        """Return why the process no longer replies, None while it does; kill one that hangs."""
        if self.exchange.alive and self._monitor.silence() > HUNG:
            self.exchange.kill()
            self.ended_for = f"sent no heartbeat for {HUNG:g} s and was ended"
        if self.exchange.alive:
            return None
        self.poll()
        message = f" ({self._last_message})" if self._last_message else ""
        return f"the exchange process {self.ended_for or 'ended' + message}"


def archive_silence(disk_waited: float) -> str:
    """Return why a motion was stopped without heartbeats of the archive process, with a remedy.

    `disk_waited` is the longest time that it waited for its disk [s].
    """
    if disk_waited > SLOW_DISK:
        cause = f"it waited for its disk for {disk_waited:.1f} s: check that disk"
    else:
        cause = (
            "it was suspended, or this PC gave it no processor time: end other programs, and "
            "check this PC with `hil doctor`"
        )
    return f"{NO_ARCHIVE}, for more than {HEARTBEAT_TIMEOUT:g} s ({cause})"


@dataclass(eq=False)
class LiveLink(MotionLink):
    """Connection over a real transport, in real time.

    A context manager: leaving it, also by an error, brings the arm to rest, leaves open mode and
    ends both processes.

    Attributes:
        heart: heartbeat of this process.
        finish: asks the controller to end the session; only a simulated one can be asked.
        inits: init packets until the controller was connected.
        job: number of the archive opened last.
        open_path: of the archive that is open; "" if none is.
        live: where viewers connect, None if nowhere.
    """

    cell: Cell
    exchange: ExchangeProcess
    archive: ArchiveProcessHandle
    heart: Heartbeat
    finish: Callable[[], None] = field(default=lambda: None)
    inits: int = 0
    cycles: int = 0
    live: LiveView | None = None
    only_simulated: bool = False
    connection: Connection = field(init=False)
    view: ExchangeView = field(init=False)
    job: int = 0
    open_path: str = ""
    _reader: RingReader = field(init=False)
    _position: Array | None = None
    _late_path: str = ""
    _closed: bool = False
    # With the drive on. A controller may open its axes at once: they are held where they are
    # until a motion is requested.
    _READY: ClassVar[frozenset[State]] = frozenset((State.CLOSED, State.OPENING, State.OPEN))

    def __post_init__(self) -> None:
        self.view = ExchangeView(self.exchange)
        self.connection = self.view.connection
        self.connection.cell = self.cell
        self._restart_reader()

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
    ) -> LiveLink:
        """Start both processes on the cell's link, or on another `transport` to it.

        From here on large arrays of this process return to the system when they are freed.

        Args:
            cell: the cell.
            transport: in place of the cell's own.
            only_axis: the only axis, from 1, that is opened; None for all.
            realtime: what the exchange requests from the system.
            finish: asks the controller to end the session.
            live: where viewers may connect.

        Raises:
            LiveViewError: the live view cannot be served.
            CellError: the cell names no real link.
            ControllerFault: the link cannot be opened, or the system refuses a process.
        """
        return_large_arrays()
        spec = transport if transport is not None else cell.transport_spec()
        settings = ExchangeSettings(
            transport=spec,
            drive_train=cell.drive_train,
            guard_limits=cell.guard_limits,
            period=cell.period,
            session=cell.session_settings(only_axis=only_axis),
            realtime=realtime or RealTimeSettings(),
            preload=("planner",),
        )
        try:
            exchange = ExchangeProcess.start(settings)
        except DriverError as error:
            raise ControllerFault(str(error)) from error
        except OSError as error:
            raise ControllerFault(f"the exchange process cannot be started: {error}") from error
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
                raise ControllerFault(f"the archive process cannot be started: {error}") from error
            raise
        link = cls(cell, exchange, archive, heart, finish, only_simulated=spec.is_local)
        if live is not None:
            try:
                link._serve(live)
            except BaseException:
                link._shut()
                raise
        return link

    def notes(self) -> tuple[str, ...]:
        """Return what the system refused to the exchange, in sentences; none of it is needed."""
        return (*self.exchange.realtime.refused, *self.exchange.notes)

    def close(self) -> None:
        """End the session where the controller can be asked to, then both processes.

        Raises:
            ControllerFault: one of them did not end properly.
        """
        problem = self._shut()
        if problem is not None:
            raise ControllerFault(problem)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            self.close()
            return
        if self.exchange.alive:
            self.exchange.stop()
        if (problem := self._shut()) is not None:
            error.add_note(problem)

    # --- archives

    @contextmanager
    def open_archive(self, spec: ArchiveSpec, *, own_motion: bool) -> Iterator[None]:
        """See `MotionLink.open_archive`; what is still open at an error is closed with the link."""
        drives, spec = self.cell.drive_train, described(spec, self.connection)
        self.view.lost = None
        self.job += 1
        self.open_path = str(spec.path)
        command = Open(self.job, spec, drives, not own_motion, not own_motion)
        unsent = f"nothing was sent, and {spec.path} is not recorded"
        if self._request(command, Opened, unsent) is None:
            # Should it be opened after all, it is to be closed at once.
            self.archive.send(Close(self.job, "void", "nothing was sent: it was opened too late"))
            self.open_path, self._late_path = "", str(spec.path)
            late = f"did not open {spec.path} within {OPEN_TIMEOUT:g} s"
            raise ControllerFault(f"the archive process {late}; nothing was sent")
        self._late_path = ""  # commands are executed in order
        self._restart_reader()
        yield

    def complete(self, outcome: str, reason: str) -> Recorded:
        """See `MotionLink.complete`; ArchiveWriteError if the disk refuses."""
        self.heart.rest()  # the motion has ended, or never began
        path = self.open_path
        incomplete = f"{path} is not complete ({outcome}: {reason})"
        closed = self._request(Close(self.job, outcome, reason), Closed, incomplete)
        if closed is None:
            raise ControllerFault(f"{path} was not completed within {OPEN_TIMEOUT:g} s")
        self._add_counts(closed.recorded)
        return closed.recorded

    def _add_counts(self, recorded: Recorded) -> None:
        self.open_path = ""
        self.cycles += recorded.records

    def _write_failed(self, failed: Failed) -> ArchiveWriteError:
        self.open_path = ""
        return write_error(failed)

    def _archive_failure(self) -> str | None:
        """Return what is wrong with the archive process; the caller reports the open file."""
        failure = self.archive.failure()
        if failure is not None:
            self.open_path = ""
        return failure

    def _request(self, command: Command, answer: type[T], consequence: str) -> T | None:
        """Return the answer to a command to the archive process; None after `OPEN_TIMEOUT` s.

        ArchiveWriteError if the disk refuses, ControllerFault if the process is gone or hangs.
        """
        self.archive.send(command)
        deadline = time.monotonic() + OPEN_TIMEOUT
        while time.monotonic() < deadline:
            found = self.archive.answer(POLL, self.job)
            if isinstance(found, answer):
                return found
            if isinstance(found, Failed):
                self._late_path = ""
                raise self._write_failed(found)
            if (failure := self._archive_failure()) is not None:
                raise ControllerFault(f"{failure}; {consequence}")
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
            raise ControllerFault("the archive process does not answer; nothing was sent")
        self.live = replace(view, port=answer.port)

    # --- exchange

    def connect(self, stop: Stop, timeout: float = 60.0) -> Array:
        """See `MotionLink.connect`."""
        self._await_late_archive(stop)
        self._restart_reader()
        target = super().connect(stop, timeout)
        self.inits = self.view.inits
        return target

    def _await_late_archive(self, stop: Stop) -> None:
        """Wait until an archive that was opened too late is closed: its name is in use then."""
        deadline = time.monotonic() + OPEN_TIMEOUT
        while self._late_path and not stop.requested:
            answer = self.archive.answer(POLL, self.job)
            if isinstance(answer, Closed | Failed):
                self._late_path = ""
            elif (failure := self.archive.failure()) is not None:
                raise ControllerFault(f"{failure}; nothing was sent")
            elif time.monotonic() > deadline:
                waits = f"the archive process still waits for the disk to open {self._late_path}"
                raise ControllerFault(f"{waits}; nothing was sent, check that disk")

    def _exchange_until(self, finished: Callable[[], bool], consequence: str) -> None:
        while not finished():
            if (failure := self.view.failure()) is not None:
                raise ControllerFault(f"{failure}; {consequence}")
            time.sleep(POLL)

    def _now(self) -> float:
        return time.monotonic()

    def _state(self) -> State:
        return self.view.state

    def _poll(self) -> list[ExchangeEvent]:
        return self.view.poll()

    def _restart_reader(self) -> None:
        """Read the records that are still in the ring; the archive process reads independently."""
        n_joints = len(self.cell.joint_names)
        self._reader = RingReader(self.exchange.ring_fd, n_joints, acknowledge=False)

    def _new_records(self) -> NDArray[np.void]:
        records = self._reader.drain()
        if len(records):
            self._position = records["position"][-1].copy()
        return records

    def _counts(self) -> Counts:
        status = self.view.status
        return status.replied, status.missed, status.late, status.rejected

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
            deadline = time.monotonic() + END_TIMEOUT
            while self.view.failure() is None and time.monotonic() < deadline:
                self.exchange.send_heartbeat()
                time.sleep(POLL)
            if self.view.ended_for:
                problem = f"the exchange process {self.view.ended_for}"
            if self.exchange.alive:
                problem = (
                    f"the exchange process still replies {END_TIMEOUT:g} s after it was asked to "
                    "end (an axis is open); it ends when the axes are closed"
                )
        finally:
            failure = self.archive.end()
            if failure is not None and self.open_path:
                problem = f"{failure}; {self.open_path} is not complete"
            self.exchange.close()
        return problem

    # --- one motion; nothing here delays a reply: the exchange is asked through shared memory

    def _submit(self, source: MotionSource, wanted: Callable[[], bool], /) -> None:
        path = self.open_path
        if self.view.inits > self.inits:  # with limits that no motion was checked against
            reason = "the controller began a new session since it was connected"
            self.complete("void", reason)
            raise ControllerFault(
                f"{reason}; nothing was sent, run again: its limits are checked again"
            )
        self.view.reset_motion()
        self.heart.turn()

        def still_wanted() -> bool:
            self.heart.turn()
            self.view.poll()
            return self.view.inits == self.inits and wanted()

        accepted = False
        try:
            self.exchange.submit(source, still_wanted)
            accepted = True
        except RequestError:
            raise
        except DriverError as error:
            self._require_archive(path)
            self.exchange.stop()
            self.view.poll()
            reason = self.view.failure() or str(error)
            recorded = self.complete("void", reason)
            raise ControllerFault(f"{reason}; {path} is {recorded.outcome}") from error
        finally:
            if not accepted:
                self.heart.rest()

    def _supervise(self, spec: ArchiveSpec, steering: Steering, stop: Stop) -> MotionEnded:
        try:
            return self._await_end(spec, steering, stop)
        finally:
            self.heart.rest()

    def _await_end(self, spec: ArchiveSpec, steering: Steering, stop: Stop) -> MotionEnded:
        view, due, stop_sent = self.view, math.inf, False
        drives, guard = self.cell.drive_train, active_guard(self.cell, self.connection.init)
        while True:
            self.heart.turn()
            view.poll()
            if stop.requested and not stop_sent:
                self.exchange.stop()
                stop_sent = True
            if not view.motion_ended:
                steering.follow(self.exchange)
            if steering.due:
                steering.add_records(self._new_records())
                status = view.status
                steering.show(drives, guard, view.state, status.motion_time, status.rate)
            if (reason := view.no_start()) is not None:
                return self._give_up(spec, reason)
            answer = self.archive.answer(POLL, self.job)
            if isinstance(answer, Closed):
                return self._ended(answer.recorded)
            if isinstance(answer, Failed):
                error = self._write_failed(answer)
                self._come_to_rest()
                raise error
            self._require_archive(str(spec.path))
            if view.motion_ended or view.failure() is not None:
                due = min(due, time.monotonic() + REST_TIMEOUT)
            if time.monotonic() > due:
                late = f"{spec.path} was not completed within {REST_TIMEOUT:g} s"
                raise ControllerFault(f"the motion has ended, but {late}")

    def _ended(self, recorded: Recorded) -> MotionEnded:
        """Return how the motion of a completed archive ended."""
        view = self.view
        self._add_counts(recorded)
        view.poll()
        ended = view.ended
        if ended is None and recorded.outcome in get_args(Outcome) and view.motion_ended:
            outcome: Outcome = recorded.outcome  # type: ignore[assignment]
            ended = MotionEnded(outcome, recorded.reason, recorded.interval, -1)
        if ended is None:
            failure = view.failure() or recorded.reason
            raise ControllerFault(
                f"{failure}; the controller gets no replies and acts by its own watchdog; "
                f"the archive ({recorded.outcome}) is complete up to then"
            )
        if ended.reason == NO_ARCHIVE:
            return replace(ended, reason=archive_silence(recorded.disk_waited))
        return ended

    def _give_up(self, spec: ArchiveSpec, reason: str) -> MotionEnded:
        """Drop a motion that has not started; without an archive it cannot start any more."""
        refused = self.view.refused
        reason = reason if refused is None else str(refused.error)
        self.complete("void" if refused is None else "refused", reason)
        self.exchange.stop()
        if refused is None:
            raise ControllerFault(f"{reason}; nothing was sent ({spec.path})")
        return MotionEnded("refused", reason, -1, -1)

    def _require_archive(self, path: str) -> None:
        """Raise ControllerFault if the archive process is gone or hangs; the arm rests first."""
        if (failure := self._archive_failure()) is not None:
            rests = "the arm was brought to rest"
            if not self._come_to_rest():
                state = self.view.state.name
                rests = f"the arm was asked to stop, but was not seen at rest ({state})"
            readable = f"{path} is readable up to its last part"
            raise ControllerFault(f"{failure}; {rests}, and {readable}")

    def _come_to_rest(self) -> bool:
        """Ask the exchange to stop, as it does on its own; return whether the motion ended."""
        self.exchange.stop()
        deadline = time.monotonic() + REST_TIMEOUT
        while not self.view.motion_ended and time.monotonic() < deadline:
            if self.view.failure() is not None:
                return False
            self.heart.turn()
            self.view.poll()
            time.sleep(POLL)
        return self.view.motion_ended

    # --- one recording

    def _no_session(self, wait: float) -> str:
        return f"no init packet within {wait:g} s; {self._waiting()}"

    def _waiting(self) -> str:
        """Return what was received from a controller without a session."""
        spec, problem = self.cell.link_spec, self.view.not_understood
        who = "the controller" if spec is None else spec.description
        what = f"{who}: {problem}" if problem else f"no packet from {who}"
        return f"{what} ({self.view.status.foreign} packets from other addresses)"

    def _record(
        self, spec: ArchiveSpec, stop: Stop, duration: float | None, watch: Watch
    ) -> Recorded:
        inits, period = self.view.inits, self.cell.period
        while True:
            # First the process: its last message and the last state of the session are known then.
            failure = self.view.failure()
            self.view.poll()
            status, lost = self.view.status, self.view.lost
            ending = recording_end(
                restarted=self.view.inits > inits,
                complete=duration is not None and (status.cycle + 1) * period >= duration,
                ended=status.state == State.ENDED,
                lost=failure or ("" if lost is None else describe(lost)),
                stopped=stop.requested,
                limited=duration is not None,
                refused=self.view.refused,
            )
            self._new_records()
            self._show_recording(watch)
            if ending is not None:
                seconds = (status.cycle + 1) * period
                return replace(self.complete(*ending), seconds=seconds)
            if isinstance(answer := self.archive.answer(POLL, self.job), Failed):
                raise write_error(answer)
            if (failure := self._archive_failure()) is not None:
                raise ControllerFault(f"{failure}; {spec.path} is readable up to its last part")

    def _reply_until_rest(self, stop: Stop, watch: Watch, reason: str) -> None:
        """Let the exchange reply until the arm has rested for a second or no session is left.

        The controller's own program continues after a recording, and its reaction to a silent PC
        during a motion is not known. The operator may insist on an earlier end.
        """
        stopped, still = stop.requested, Standstill(self.cell.period)
        drive_on, received = time.monotonic(), 1
        monitor = HeartbeatMonitor(lambda: received, max_interval=5 * POLL)
        self._restart_reader()
        self._new_records()
        while not (stop.insisted or (stop.requested and not stopped)):
            failure, state, now = self.view.failure(), self.view.state, time.monotonic()
            if state is not State.DRIVE_OFF:
                drive_on = now
            if failure is not None or state in NO_SESSION or now - drive_on > OFF:
                return
            self.view.poll()
            records = self._new_records()
            received += len(records) > 0
            if still.add(records) or monitor.silence() > SILENCE:
                return
            self._show_recording(watch, over=reason)
            time.sleep(POLL)

    def _show_recording(self, watch: Watch, over: str = "") -> None:
        status = self.view.status
        watch(
            Progress(
                status.cycle,
                status.missed,
                State(status.state),
                self._position,
                late=status.late,
                not_accepted=status.rejected,
                waiting="" if status.replied else self._waiting(),
                over=over,
            )
        )


SILENCE: Final = 1.0  # s without a packet after which the controller is assumed to have gone
NO_SESSION: Final = frozenset((State.SYNC, State.INIT, State.ENDED))  # States without a session
TARGET_MOVED: Final = 1e-5  # rad; a target at rest does not change, but its rounding may
REST: Final = 1.0  # s of the controller's time without motion after which the arm is at rest
OFF: Final = 1.0
"""s with the drive off after which replies end; a session that is being ended has ended by then."""


class Standstill:
    """Detects rest of target and arm, with `period` s; unknown positions count as moving."""

    def __init__(self, period: float) -> None:
        self._cycles = round(REST / period)
        self._still: NDArray[np.void] | None = None

    def add(self, records: NDArray[np.void]) -> bool:
        """Return whether the arm has been at rest for `REST` at the end of these records (k,)."""
        for record in records:
            last = self._still
            if (
                last is None
                or not record["cycle"] > last["cycle"]
                or not _close(record, last, "target_position", TARGET_MOVED)
                or not _close(record, last, "position", ARM_MOVED)
            ):
                self._still = record.copy()
        if self._still is None or not len(records):
            return False
        return int(records["cycle"][-1]) - int(self._still["cycle"]) >= self._cycles


def _close(record: NDArray[np.void], other: NDArray[np.void], name: str, bound: float) -> bool:
    return bool(np.all(np.abs(record[name] - other[name]) <= bound))


def write_error(failed: Failed) -> ArchiveWriteError:
    """Return the error of an archive process that cannot write."""
    error = ArchiveWriteError(failed.path or None, failed.problem, remedy=failed.remedy)
    if failed.errno is not None:
        error.__cause__ = OSError(failed.errno, os.strerror(failed.errno))
    return error
