"""A real link: exchange and archive in processes of their own, supervised from here.

This process only asks: it hands motions and archives over, says every 50 ms that it lives (as long
as the loop that supervises a motion turns), and reports. The exchange answers the controller,
whatever happens here; the archive process writes what the exchange leaves in shared memory. Each of
the three notices the death of the others, and then the arm comes to rest on its path.
"""

from __future__ import annotations

import ctypes
import math
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final, Self, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError, RequestError
from drivers.events import (
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    Outcome,
    PacketRejected,
    Refused,
)
from drivers.exchange.control import ControlBlock, HeartbeatMonitor
from drivers.exchange.event_log import (
    NO_ARCHIVE,
    NO_SUPERVISOR,
    EventsLost,
    ExchangeEnded,
    ExchangeEvent,
    ExchangeFailed,
    Leaving,
)
from drivers.exchange.process import ExchangeProcess, ExchangeSettings, WithdrawnError
from drivers.exchange.realtime import RealTimeSettings
from drivers.motion_source import MotionSource
from drivers.record import CAPACITY, RingReader
from drivers.states import State
from drivers.transports.base import TransportSpec
from hil.archive import ArchiveSpec
from hil.archive.live import LiveView, LiveViewError, Serve
from hil.archive.recorder import describe
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
from hil.cell.cell import stays_here
from hil.errors import ArchiveWriteError, ControllerFault, OperatorStopError
from hil.terminal_text import plural

from .motion_link import (
    END_TIMEOUT,
    Beginning,
    Connection,
    Progress,
    Recorded,
    Watch,
    described,
    drives_in_force,
    guard_in_force,
    not_ready,
    unwatched,
)
from .operator import MotionWatch, Stop, unwatched_motion
from .steering import NOT_BEGUN, PacketCounts, Steering

Array = NDArray[np.float64]
T = TypeVar("T")

BEAT: Final = 0.05
"""s between two heartbeats; the exchange stops the arm after 0.5 s without one."""
STALL: Final = 1.0
"""s within which the loop that supervises a motion must have turned."""
_STARVED: Final = 0.4
"""s between two beats that are reported: the exchange may have missed them."""
HUNG: Final = 5.0
"""s without a sign of life after which an exchange process is ended: the controller, unanswered
for so long, has acted by its own watch."""
READY: Final = frozenset((State.CLOSED, State.OPENING, State.OPEN))
"""States with the drive on. A controller may open its axes at once: they are held where they are
until a motion is asked for."""
POLL: Final = 0.02
"""s between two looks at everything while a motion runs."""
OPEN_TIMEOUT = 10.0
"""s within which a file must have been created, or completed."""
SLOW_DISK: Final = 1.0
"""s at once that a disk takes for a flush when something is wrong with it."""
REST_TIMEOUT: Final = 30.0
"""s for an arm that was asked to stop to rest, and for the archive of a motion that has ended."""
_M_MMAP_THRESHOLD: Final = -3
LARGE: Final = 128 * 1024
"""Bytes; glibc's own value, before it adapts."""


def return_large_arrays() -> None:
    """Have arrays of `LARGE` bytes and more returned to the system when they are freed.

    glibc takes larger and larger ones from its heap, once such have been freed. They come to lie
    between small ones that stay, and over hours the heap grows around the holes.
    """
    with suppress(OSError, AttributeError, TypeError):  # another C library
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, LARGE)


class Heartbeat:
    """Beats for a link."""

    def __init__(
        self, beat: Callable[[], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._beat, self._clock = beat, clock
        self._turned: float | None = None
        self._stalled = self._starved = 0.0
        self._last = clock()
        self._over = False

    def start(self) -> None:
        """Beat in a thread until `end`."""

        def beat() -> None:
            while not self._over:
                self.look()
                time.sleep(BEAT)

        threading.Thread(target=beat, daemon=True).start()

    def end(self) -> None:
        """Beat no more."""
        self._over = True

    def begin(self) -> None:
        """A motion is asked for: what went before is no cause of what happens to it."""
        self._stalled = self._starved = 0.0
        self.turn()

    def turn(self) -> None:
        """The loop that supervises a motion turns; it must again within `STALL` s, until `rest`."""
        self._turned = self._clock()

    def rest(self) -> None:
        """No motion is supervised any more: other work may take as long as it likes."""
        self._turned = None

    def look(self) -> None:
        """Beat, unless the supervision stands still."""
        now, turned = self._clock(), self._turned
        self._starved, self._last = max(self._starved, now - self._last), now
        stalled = 0.0 if turned is None else now - turned
        if stalled > STALL:
            self._stalled = max(self._stalled, stalled)
        else:
            self._beat()

    def explained(self, text: str) -> str:
        """What the exchange says, with the cause where it missed our signs of life."""
        starved = max(self._starved, self._clock() - self._last)
        if NO_SUPERVISOR not in text:
            return text
        if self._stalled:
            cause = (
                f"whatever looks at the motion (show, request) did not return for "
                f"{self._stalled:.1f} s, and nobody could have passed on a stop"
            )
        elif starved > _STARVED:
            cause = (
                f"this program got no processor time for {starved:.1f} s, load average "
                f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} processors: end what else runs here"
            )
        else:
            return text
        return text.replace(NO_SUPERVISOR, f"{NO_SUPERVISOR} ({cause})")


@dataclass(eq=False)
class ExchangeView:
    """What the supervising process knows of its exchange process.

    Attributes:
        exchange: the process.
        explained: adds the cause to what the process says, where it is known here.
        connection: what is known of the controller.
        lost: the last loss of the link.
        ended: the end of the motion asked for last, if its event came.
        inits: init packets so far.
        refused: the refusal since a motion was asked for last.
        not_understood: of packets that came last and got no answer, how many and why.
        began: whether the motion asked for last has sent anything, or may have.
        ended_for: what a process that had to be ended was ended for; "" for none.
    """

    exchange: ExchangeProcess
    explained: Callable[[str], str] = str
    connection: Connection = field(default_factory=Connection)
    lost: LinkLost | None = None
    ended: MotionEnded | None = None
    inits: int = 0
    began: bool = False
    refused: Refused | None = None
    not_understood: str = ""
    ended_for: str = ""
    _beginning: Beginning = field(default_factory=lambda: Beginning(time.monotonic()))
    _rejected: int = 0
    _said: str = ""
    _ended_before: int = 0
    _monitor: HeartbeatMonitor = field(init=False)

    def __post_init__(self) -> None:
        control = ControlBlock(self.exchange.control_fd)
        self._monitor = HeartbeatMonitor(lambda: control.exchange_heartbeat)

    def look(self) -> list[ExchangeEvent]:
        """Take in what the exchange says, and return it."""
        events = self.exchange.events()
        for event in events:
            self.connection.note(event)
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
                    self.not_understood = f"{packets} came and got no answer: {event.reason}"
                case MotionStarted() | EventsLost():
                    self.began = True
                case ExchangeFailed():
                    self._said = event.trace.strip().splitlines()[-1]
                case Leaving() | ExchangeEnded() if not self._said:
                    self._said = self.explained(event.reason)
        return events

    def forget_motion(self) -> None:
        """Another motion is about to be asked for."""
        self.look()
        self.ended, self.refused, self.began = None, None, False
        self._beginning = Beginning(time.monotonic())
        self._ended_before = self.status.ended_count

    def not_begun(self) -> str | None:
        """Why the motion asked for will not begin any more, in words; None while it may."""
        found = self._beginning.hopeless(self.state, time.monotonic())
        return None if self.began or self.motion_ended else found

    @property
    def motion_ended(self) -> bool:
        """Whether the motion asked for has ended; the event that says so may have been lost."""
        return self.ended is not None or self.status.ended_count != self._ended_before

    @property
    def status(self) -> ControlBlock:
        """The exchange's fields of the control block."""
        return self.exchange.status()

    @property
    def state(self) -> State:
        """Of the session."""
        return State(self.status.state)

    def failure(self) -> str | None:
        """Why no answers come any more, in words; None as long as they do.

        A process that hangs is ended.
        """
        if self.exchange.alive and self._monitor.silence() > HUNG:
            self.exchange.kill()
            self.ended_for = f"sent no heartbeat for {HUNG:g} s and was ended"
        if self.exchange.alive:
            return None
        self.look()
        said = f" ({self._said})" if self._said else ""
        return f"the exchange process {self.ended_for or 'ended' + said}"


@dataclass(eq=False)
class LiveLink:
    """A connection over a real transport, in real time; a `MotionLink`.

    Use it as a context manager: leaving it, for whatever reason, brings the arm to rest, leaves
    open mode and ends both processes.

    Attributes:
        cell: whose controller is at the far end.
        exchange: the process that answers.
        archive: the process that writes.
        heart: tells the exchange that this process lives.
        finish: asks the far end to end the session; only a simulated one can be asked.
        view: what is known of the exchange.
        inits: init packets until the controller was connected.
        cycles: records archived so far.
        late: answers so far that were late or left out for a newer one's.
        not_accepted: answers so far that the controller did not take.
        job: number of the archive opened last.
        open_path: of the archive that is open; "" if none is.
        live: where viewers may look, None if nowhere.
        only_simulated: whether the transport really opened ends on this computer, so that nothing
            but a simulated controller can be at the far end.
    """

    cell: Cell
    exchange: ExchangeProcess
    archive: ArchiveProcessHandle
    heart: Heartbeat
    finish: Callable[[], None] = field(default=lambda: None)
    inits: int = 0
    cycles: int = 0
    late: int = 0
    not_accepted: int = 0
    live: LiveView | None = None
    only_simulated: bool = False
    view: ExchangeView = field(init=False)
    job: int = 0
    open_path: str = ""
    _late_path: str = ""
    _closed: bool = False

    def __post_init__(self) -> None:
        self.view = ExchangeView(self.exchange, explained=self.heart.explained)

    @classmethod
    def open(
        cls,
        cell: Cell,
        *,
        transport: TransportSpec | None = None,
        accept_init: bool = False,
        only_axis: int | None = None,
        realtime: RealTimeSettings | None = None,
        finish: Callable[[], None] = lambda: None,
        live: LiveView | None = None,
    ) -> LiveLink:
        """Start both processes on the cell's link, or on another `transport` to it.

        From here on large arrays of this process go back to the system when they are freed.

        Args:
            cell: the cell.
            transport: in place of the cell's own.
            accept_init: use the controller's figures where they differ from the cell's.
            only_axis: the axis, from 1, that alone is to be open; None for all.
            realtime: what the exchange asks of the system.
            finish: asks the far end to end the session.
            live: lets viewers look at what is recorded.

        Raises:
            LiveViewError: the live view cannot be served as asked for.
            CellError: the cell names no real link.
            ControllerFault: the link cannot be opened (port in use, not permitted, no adapter), or
                the system refuses a process.
        """
        return_large_arrays()
        spec = transport if transport is not None else cell.transport_spec()
        settings = ExchangeSettings(
            transport=spec,
            drive_train=cell.drive_train,
            guard_limits=cell.guard_limits,
            period=cell.period,
            session=cell.session_settings(accept_init=accept_init, only_axis=only_axis),
            realtime=realtime or RealTimeSettings(),
            preload=("planner",),
            packets=CAPACITY if cell.controller.packets else 0,
        )
        try:
            exchange = ExchangeProcess.start(settings)
        except DriverError as error:
            raise ControllerFault(str(error)) from error
        except OSError as error:
            raise ControllerFault(f"the exchange process cannot be started: {error}") from error
        # At once: the archive process may take longer to start than the exchange waits for a sign.
        heart = Heartbeat(exchange.send_heartbeat)
        heart.start()
        try:
            archive = ArchiveProcessHandle.start(
                exchange, len(cell.joint_names), exchange.packets_fd
            )
        except BaseException as error:
            heart.end()
            exchange.finish()
            exchange.close()
            if isinstance(error, OSError):
                raise ControllerFault(f"the archive process cannot be started: {error}") from error
            raise
        link = cls(cell, exchange, archive, heart, finish, only_simulated=stays_here(spec))
        if live is not None:
            try:
                link._serve(live)
            except BaseException:
                link._shut()
                raise
        return link

    @property
    def connection(self) -> Connection:
        """What is known of the controller."""
        return self.view.connection

    def notes(self) -> tuple[str, ...]:
        """What the system refused to the exchange, in sentences; none of it is needed."""
        return (*self.exchange.realtime.refused, *self.exchange.notes)

    def connect(self, stop: Stop, timeout: float = 60.0) -> Array:
        """See `MotionLink.connect`."""
        deadline = time.monotonic() + timeout
        self._await_late(stop)
        reader = self.reader()
        last: Array | None = None
        while not stop.requested and time.monotonic() < deadline:
            self.view.look()
            self.connection.require_usable(self.cell)
            records = reader.drain()
            if len(records):
                last = records["target_position"][-1].copy()
            if self.view.state in READY and last is not None:
                self.inits = self.view.inits
                return last
            if (failure := self.view.failure()) is not None:
                raise ControllerFault(f"{failure}; the controller gets no answers")
            time.sleep(POLL)
        if stop.requested:
            raise ControllerFault("stopped by the operator before anything moved")
        raise not_ready(self.view.state, timeout)

    def run(
        self,
        source: MotionSource,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        override: float = 1.0,
        watch: MotionWatch = unwatched_motion,
    ) -> MotionEnded:
        """See `MotionLink.run`."""
        return _LiveMotion(self, source, spec, stop, watch, override).run()

    def record(
        self,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        duration: float | None = None,
        wait: float | None = None,
        watch: Watch = unwatched,
    ) -> Recorded:
        """See `MotionLink.record`."""
        return _LiveRecording(self, stop, watch).run(spec, duration, wait)

    def close(self) -> None:
        """End the session where the far end can be asked to, then both processes.

        Raises:
            ControllerFault: one of them did not end by itself.
        """
        trouble = self._shut()
        if trouble is not None:
            raise ControllerFault(trouble)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            self.close()
            return
        if self.exchange.alive:
            self.exchange.stop()
        self._shut()

    def reader(self) -> RingReader:
        """A reader of the records that does not stand in the archive process's way."""
        n_joints = len(self.cell.joint_names)
        return RingReader(self.exchange.ring_fd, n_joints, acknowledge=False)

    def open_archive(self, spec: ArchiveSpec, *, from_now: bool, until_ended: bool) -> None:
        """Have an archive opened; nothing may move before that.

        Raises:
            ArchiveWriteError: it cannot be created.
            ControllerFault: the archive process does not answer.
        """
        drives = drives_in_force(self.cell, self.connection)
        spec = described(spec, self.connection, drives)
        spec = replace(spec, packets=self.cell.controller.packets)
        self.view.lost = None
        self.job += 1
        self.open_path = str(spec.path)
        command = Open(self.job, spec, drives, from_now, until_ended)
        unsent = f"nothing was sent, and {spec.path} is not recorded"
        if self._asked(command, Opened, unsent) is not None:
            self._late_path = ""  # commands are obeyed in order
            return
        # Should it come to it after all, it is to be closed at once.
        self.archive.send(Close(self.job, "void", "nothing was sent: it was opened too late"))
        self.open_path, self._late_path = "", str(spec.path)
        late = f"did not open {spec.path} within {OPEN_TIMEOUT:g} s"
        raise ControllerFault(f"the archive process {late}; nothing was sent")

    def complete(self, outcome: str, reason: str) -> Closed:
        """Have the archive completed.

        Raises:
            ArchiveWriteError: the disk refuses.
            ControllerFault: the archive process does not answer.
        """
        self.heart.rest()  # what was supervised is over, or never began
        path = self.open_path
        incomplete = f"{path} is not complete ({outcome}: {reason})"
        closed = self._asked(Close(self.job, outcome, reason), Closed, incomplete)
        if closed is None:
            raise ControllerFault(f"{path} was not completed within {OPEN_TIMEOUT:g} s")
        self.count(closed)
        return closed

    def write_failed(self, failed: Failed) -> ArchiveWriteError:
        """The error of an archive that cannot be written further."""
        self.open_path = ""
        return write_error(failed)

    def archive_failure(self) -> str | None:
        """What is wrong with the archive process; whoever asks tells what becomes of the file."""
        failure = self.archive.failure()
        if failure is not None:
            self.open_path = ""
        return failure

    def count(self, closed: Closed) -> None:
        """Add up what an archive holds."""
        self.open_path = ""
        self.cycles += closed.records
        self.late += closed.late
        self.not_accepted += closed.not_accepted

    def _asked(self, command: Command, wanted: type[T], otherwise: str) -> T | None:
        """The answer to a command to the archive process; None if none came in `OPEN_TIMEOUT` s.

        Raises:
            ArchiveWriteError: the disk refuses.
            ControllerFault: the process is gone, or hangs.
        """
        self.archive.send(command)
        deadline = time.monotonic() + OPEN_TIMEOUT
        while time.monotonic() < deadline:
            answer = self.archive.answer(POLL, self.job)
            if isinstance(answer, wanted):
                return answer
            if isinstance(answer, Failed):
                self._late_path = ""
                raise self.write_failed(answer)
            if (failure := self.archive_failure()) is not None:
                raise ControllerFault(f"{failure}; {otherwise}")
        return None

    def _await_late(self, stop: Stop) -> None:
        """Until an archive that was opened too late is closed; only then are free names known."""
        deadline = time.monotonic() + OPEN_TIMEOUT
        while self._late_path and not stop.requested:
            answer = self.archive.answer(POLL, self.job)
            if isinstance(answer, Closed | Failed):
                self._late_path = ""
            elif (failure := self.archive.failure()) is not None:
                raise ControllerFault(f"{failure}; nothing was sent")
            elif time.monotonic() > deadline:
                waits = f"the archive process still waits for the disk to open {self._late_path}"
                raise ControllerFault(f"{waits}; nothing was sent, look after that disk")

    def _serve(self, view: LiveView) -> None:
        """Have the archive process let viewers look."""
        cell = self.cell
        self.job += 1
        command = Serve(self.job, view, cell.joint_names, cell.period, cell.drive_train)
        try:
            answer = self._asked(command, Serving, "nothing was sent")
        except ArchiveWriteError as error:
            raise LiveViewError(None, error.problem, remedy=error.remedy) from error
        if answer is None:
            raise ControllerFault("the archive process does not answer; nothing was sent")
        self.live = replace(view, port=answer.port)

    def _shut(self) -> str | None:
        """End both processes; what was wrong with them, None if nothing was."""
        if self._closed:
            return None
        self._closed = True
        self.heart.end()
        trouble: str | None = None
        try:
            self.finish()
            self.exchange.finish()
            deadline = time.monotonic() + END_TIMEOUT
            while self.view.failure() is None and time.monotonic() < deadline:
                self.exchange.send_heartbeat()
                time.sleep(POLL)
            if self.view.ended_for:
                trouble = f"the exchange process {self.view.ended_for}"
            if self.exchange.alive:
                trouble = (
                    f"the exchange process still answers {END_TIMEOUT:g} s after it was asked to "
                    "end (an axis is open); it ends when the axes are closed"
                )
        finally:
            failure = self.archive.end()
            if failure is not None and self.open_path:
                trouble = f"{failure}; {self.open_path} is not complete"
            self.exchange.close()
        return trouble


class _LiveMotion:
    """One motion on a `LiveLink`.

    Whatever happens here delays no answer: the exchange is asked through shared memory.
    """

    def __init__(
        self,
        link: LiveLink,
        source: MotionSource,
        spec: ArchiveSpec,
        stop: Stop,
        watch: MotionWatch,
        override: float,
    ) -> None:
        self._link, self._source, self._path, self._stop = link, source, spec.path, stop
        self._spec = spec
        self._view, self._exchange, self._reader = link.view, link.exchange, link.reader()
        self._steering = Steering(source, watch, override, self._counts)
        self._stop_passed = False

    def run(self) -> MotionEnded:
        """See `MotionLink.run`."""
        link, view = self._link, self._view
        self._begins()  # no archive is opened while a hold stands
        link.open_archive(self._spec, from_now=True, until_ended=True)
        # That may have taken seconds: nothing is asked for that is no longer wanted.
        while self._begins():
            if view.inits > link.inits:  # with limits that no motion was checked against
                why = "the controller began a new session since it was connected"
                link.complete("void", why)
                raise ControllerFault(
                    f"{why}; nothing was sent, run again: its limits are checked anew"
                )
            view.forget_motion()
            self._reader.drain()
            link.heart.begin()
            try:
                self._submit()
                return self._supervised()
            except WithdrawnError:
                continue  # it was stopped, held or slowed meanwhile, or a new session began
            finally:
                link.heart.rest()
        link.complete("stopped", NOT_BEGUN)
        return MotionEnded("stopped", NOT_BEGUN, -1, -1)

    def _begins(self) -> bool:
        """See `Steering.begin`; what the exchange says meanwhile is not lost."""
        try:
            return self._steering.begin(self._stop, self._view.look)
        except ControllerFault as error:
            if self._link.open_path:
                self._link.complete("void", str(error))
            raise
        finally:
            self._view.look()

    def _still_wanted(self) -> bool:
        """Whether it may begin the next moment, as it was handed over."""
        self._link.heart.turn()
        self._view.look()
        same_session = self._view.inits == self._link.inits
        return same_session and self._steering.unchanged(self._stop)

    def _submit(self) -> None:
        try:
            self._exchange.submit(self._source, self._still_wanted)
        except WithdrawnError:
            raise
        except RequestError as error:
            self._link.complete("refused", str(error))
            why = self._link.heart.explained(str(error))
            raise ControllerFault(f"{why}; {self._path} says so") from error
        except DriverError as error:
            self._require_archive()
            self._exchange.stop()
            self._view.look()
            why = self._view.failure() or str(error)
            closed = self._link.complete("void", why)
            raise ControllerFault(f"{why}; {self._path} is {closed.outcome}") from error

    def _supervised(self) -> MotionEnded:
        """How the motion that was asked for ended."""
        link, view, due = self._link, self._view, math.inf
        drives = drives_in_force(link.cell, link.connection)
        guard = guard_in_force(link.cell, drives, link.connection.init)
        while True:
            link.heart.turn()
            self._steering.note(view.look())
            if self._stop.requested and not self._stop_passed:
                self._exchange.stop()
                self._stop_passed = True
            if not view.motion_ended:
                self._steering.follow(self._exchange)
            if self._steering.due:
                self._steering.take(self._reader.drain())
                status = view.status
                self._steering.show(drives, guard, view.state, status.motion_time, status.rate)
            if (idle := view.not_begun()) is not None:
                return self._given_up(idle)
            answer = link.archive.answer(POLL, link.job)
            if isinstance(answer, Closed):
                return self._ending(answer)
            if isinstance(answer, Failed):
                error = link.write_failed(answer)
                self._come_to_rest()
                raise error
            self._require_archive()
            if view.motion_ended or view.failure() is not None:
                due = min(due, time.monotonic() + REST_TIMEOUT)
            if time.monotonic() > due:
                what = f"{self._path} was not completed within {REST_TIMEOUT:g} s"
                raise ControllerFault(f"the motion is over, but {what}")

    def _counts(self) -> PacketCounts:
        status = self._view.status
        return PacketCounts(
            status.answered,
            status.missed,
            status.late,
            status.unanswered,
            tuple(status.latencies),
            1e-6 * status.worst_turnaround_us,
        )

    def _ending(self, closed: Closed) -> MotionEnded:
        view = self._view
        self._link.count(closed)
        view.look()
        ended = view.ended
        if ended is None and closed.outcome in get_args(Outcome) and view.motion_ended:
            outcome: Outcome = closed.outcome  # type: ignore[assignment]
            ended = MotionEnded(outcome, closed.reason, closed.interval, -1)
        if ended is None:
            failure = view.failure() or closed.reason
            raise ControllerFault(
                f"{failure}; the controller gets no answers and acts by its own watch; "
                f"the archive ({closed.outcome}) is whole so far"
            )
        if ended.reason == NO_ARCHIVE and closed.disk_waited > SLOW_DISK:
            waited = f"it waited for its disk for {closed.disk_waited:.1f} s"
            return replace(ended, reason=f"{NO_ARCHIVE} ({waited}: look after that disk)")
        return replace(ended, reason=self._link.heart.explained(ended.reason))

    def _given_up(self, why: str) -> MotionEnded:
        """A motion that has not begun is dropped; without an archive it cannot begin any more."""
        refused = self._view.refused
        reason = why if refused is None else str(refused.error)
        self._link.complete("void" if refused is None else "refused", reason)
        self._exchange.stop()
        if refused is None:
            raise ControllerFault(f"{why}; nothing was sent ({self._path})")
        return MotionEnded("refused", reason, -1, -1)

    def _require_archive(self) -> None:
        """Raise ControllerFault if the archive process is gone or hangs; the arm rests first."""
        if (failure := self._link.archive_failure()) is not None:
            rests = "the arm was brought to rest"
            if not self._come_to_rest():
                state = self._view.state.name
                rests = f"the arm was asked to stop, but was not seen at rest ({state})"
            readable = f"{self._path} is readable up to its last part"
            raise ControllerFault(f"{failure}; {rests}, and {readable}")

    def _come_to_rest(self) -> bool:
        """Whether the motion has ended; the exchange stops it by itself, but is asked to again."""
        self._exchange.stop()
        deadline = time.monotonic() + REST_TIMEOUT
        while not self._view.motion_ended and time.monotonic() < deadline:
            if self._view.failure() is not None:
                return False
            self._link.heart.turn()
            self._view.look()
            time.sleep(POLL)
        return self._view.motion_ended


SILENCE: Final = 1.0
"""s without a packet after which nobody is there to be answered."""
NOBODY: Final = frozenset((State.SYNC, State.INIT, State.ENDED))
"""States in which no session is going on."""
TARGET_MOVED: Final = 1e-5
"""rad; a target at rest does not change at all, but its rounding may."""
ARM_MOVED: Final = 5e-4
"""rad; more than an encoder's noise, less than any motion makes in a second."""
REST: Final = 1.0
"""s of the controller's time without motion after which the arm is at rest."""
OFF: Final = 1.0
"""s with the drive off after which answers end; a session that is being ended is ended by then."""


class Standstill:
    """Looks at records for the last motion of target or arm. A joint not known counts as moving.

    Args:
        period: cycle of the controller, s.
    """

    def __init__(self, period: float) -> None:
        self._cycles = round(REST / period)
        self._still: NDArray[np.void] | None = None

    def take(self, records: NDArray[np.void]) -> bool:
        """Whether the arm has been at rest for `REST` at the end of the next records (k,)."""
        for record in records:
            last = self._still
            if (
                last is None
                or not record["cycle"] > last["cycle"]
                or not _near(record, last, "target_position", TARGET_MOVED)
                or not _near(record, last, "position", ARM_MOVED)
            ):
                self._still = record.copy()
        if self._still is None or not len(records):
            return False
        return int(records["cycle"][-1]) - int(self._still["cycle"]) >= self._cycles


def _near(record: NDArray[np.void], other: NDArray[np.void], name: str, bound: float) -> bool:
    return bool(np.all(np.abs(record[name] - other[name]) <= bound))


class _LiveRecording:
    """One recording on a `LiveLink`.

    The controller's own program goes on when a recording ends, for whatever reason, and what it
    does with a PC that falls silent in the middle of a motion is not known. So answers go on until
    the arm has stood still for a second, the drive is off, the session has ended or nothing is
    heard any more; or until the operator insists.
    """

    def __init__(self, link: LiveLink, stop: Stop, watch: Watch) -> None:
        self._link, self._stop, self._watch = link, stop, watch
        self._view, self._reader = link.view, link.reader()
        self._position: Array | None = None

    def run(self, spec: ArchiveSpec, duration: float | None, wait: float | None) -> Recorded:
        """Wait for the controller, record, and answer until the arm rests."""
        self._await_controller(wait)
        self._link.connection.require_usable(self._link.cell)
        inits = self._view.inits
        self._link.open_archive(spec, from_now=False, until_ended=False)
        self._reader = self._link.reader()
        try:
            recorded = self._record(spec, duration, inits)
        except (ArchiveWriteError, ControllerFault) as error:
            self._answer_until_rest(f"the recording failed ({error})")
            raise
        self._answer_until_rest("recording complete")
        return recorded

    def _await_controller(self, wait: float | None) -> None:
        until = math.inf if wait is None else time.monotonic() + wait
        while self._link.connection.init is None:
            self._view.look()
            self._show()
            if self._stop.requested:
                raise OperatorStopError("ended before the controller came: nothing was recorded")
            if (failure := self._view.failure()) is not None:
                raise ControllerFault(f"{failure}: nothing was recorded")
            if time.monotonic() > until:
                status = self._view.status
                table = self._link.cell.controller
                who = table.host if table.transport == "udp" else "the controller"
                some = status.answered > 0 or self._view.not_understood
                what = "no init packet" if some else "nothing"
                also = f"; {self._view.not_understood}" if self._view.not_understood else ""
                raise ControllerFault(
                    f"{what} heard from {who} within {wait:g} s ({status.foreign} packets from "
                    f"elsewhere{also}): nothing was recorded"
                )
            time.sleep(POLL)

    def _record(self, spec: ArchiveSpec, duration: float | None, inits: int) -> Recorded:
        link = self._link
        while True:
            ending = self._ends(duration, restarted=self._view.inits > inits)
            self._records()
            self._show()
            if ending is not None:
                seconds = (self._view.status.cycle + 1) * link.cell.period
                closed = link.complete(*ending)
                return Recorded.of(closed.outcome, closed.reason, seconds, closed)
            if isinstance(answer := link.archive.answer(POLL, link.job), Failed):
                raise write_error(answer)
            if (failure := link.archive_failure()) is not None:
                raise ControllerFault(f"{failure}; {spec.path} is readable up to its last part")

    def _ends(self, duration: float | None, *, restarted: bool) -> tuple[str, str] | None:
        """Outcome and reason of a recording that is to end now, or None."""
        # The process first: what it said and how the session stood at its end is known then.
        failure = self._view.failure()
        self._view.look()
        status = self._view.status
        ending = None
        if restarted:
            ending = "stopped", "the controller began a new session"
        elif duration is not None and (status.cycle + 1) * self._link.cell.period >= duration:
            ending = "completed", "as long as was asked for"
        elif status.state == State.ENDED:
            ending = "completed", "the controller ended the session"
        elif failure is not None:
            ending = "lost", failure
        elif self._view.lost is not None:
            ending = "lost", describe(self._view.lost)
        elif self._stop.requested:
            outcome = "completed" if duration is None else "stopped"
            ending = outcome, "ended by the operator"
        if ending is not None and self._view.refused is not None:
            return "refused", str(self._view.refused.error)
        return ending

    def _answer_until_rest(self, why: str) -> None:
        """Do nothing, for as long as the exchange should go on answering."""
        stopped, still = self._stop.requested, Standstill(self._link.cell.period)
        driven, heard = time.monotonic(), 1
        pulse = HeartbeatMonitor(lambda: heard, max_interval=5 * POLL)
        self._reader = self._link.reader()
        self._reader.drain()
        while not (self._stop.insisted or (self._stop.requested and not stopped)):
            failure, state, now = self._view.failure(), self._view.state, time.monotonic()
            if state is not State.DRIVE_OFF:
                driven = now
            if failure is not None or state in NOBODY or now - driven > OFF:
                return
            self._view.look()
            records = self._records()
            heard += len(records) > 0
            if still.take(records) or pulse.silence() > SILENCE:
                return
            self._show(over=why)
            time.sleep(POLL)

    def _records(self) -> NDArray[np.void]:
        """Records since the last call; the last position is shown."""
        records = self._reader.drain()
        if len(records):
            self._position = records["position"][-1].copy()
        return records

    def _show(self, over: str = "") -> None:
        status = self._view.status
        self._watch(
            Progress(
                status.cycle,
                status.missed,
                State(status.state),
                self._position,
                late=status.late,
                not_accepted=status.unanswered,
                foreign=status.foreign,
                heard=status.answered > 0,
                not_understood=self._view.not_understood,
                over=over,
            )
        )


def write_error(failed: Failed) -> ArchiveWriteError:
    """What is raised where the archive process cannot write."""
    error = ArchiveWriteError(failed.path or None, failed.problem, remedy=failed.remedy)
    if failed.errno is not None:
        error.__cause__ = OSError(failed.errno, os.strerror(failed.errno))
    return error
