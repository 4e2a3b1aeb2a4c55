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
from typing import Final, Self, get_args

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError, RequestError
from drivers.events import MotionEnded, Outcome
from drivers.exchange.control import Pulse
from drivers.exchange.event_log import NO_ARCHIVE, NO_SUPERVISOR
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
    Failed,
    Open,
    Opened,
    Serving,
)
from hil.cell import Cell
from hil.cell.cell import stays_here
from hil.errors import ArchiveWriteError, ControllerFault, OperatorStopError

from .exchange_view import ExchangeView
from .motion_link import (
    END_TIMEOUT,
    Connection,
    Progress,
    Recorded,
    Watch,
    described,
    drives_in_force,
    not_ready,
    unwatched,
)
from .operator import MotionWatch, Stop, unwatched_motion
from .steering import (
    NOT_BEGUN,
    PacketCounts,
    ProgressDisplay,
    Steering,
    duration_of,
    guard_in_force,
)

BEAT: Final = 0.05
"""s between two heartbeats; the exchange stops the arm after 0.5 s without one."""
STALL: Final = 1.0
"""s within which the loop that supervises a motion must have turned."""
_STARVED: Final = 0.4
"""s between two beats that are reported: the exchange may have missed them."""


class Heartbeat:
    """Beats for a link.

    Args:
        beat: gives one sign of life.
        clock: s, monotonic.
    """

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
        threading.Thread(target=self._go_on, daemon=True).start()

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
        if NO_SUPERVISOR not in text:
            return text
        if self._stalled:
            cause = (
                f"whatever looks at the motion (show, request) did not return for "
                f"{self._stalled:.1f} s, and nobody could have passed on a stop"
            )
        elif (starved := max(self._starved, self._clock() - self._last)) > _STARVED:
            cause = (
                f"this program got no processor time for {starved:.1f} s, load average "
                f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} processors: end what else runs here"
            )
        else:
            return text
        return text.replace(NO_SUPERVISOR, f"{NO_SUPERVISOR} ({cause})")

    def _go_on(self) -> None:
        while not self._over:
            self.look()
            time.sleep(BEAT)


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


Array = NDArray[np.float64]

READY = frozenset((State.CLOSED, State.OPENING, State.OPEN))
"""States with the drive on. A controller may open its axes at once: they are held where they are
until a motion is asked for."""
POLL = 0.02
"""s between two looks at everything while a motion runs."""
OPEN_TIMEOUT = 10.0
"""s within which a file must have been created."""


@dataclass(eq=False)
class LiveLink:
    """A connection over a real transport, in real time; a `MotionLink` and a `Recording`.

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
        untaken: answers so far that the controller did not take.
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
    untaken: int = 0
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
        heart = Heartbeat(exchange.beat)
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
        return LiveMotion(self, stop, watch, override).run(source, spec)

    def record(
        self,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        duration: float | None = None,
        wait: float | None = None,
        watch: Watch = unwatched,
    ) -> Recorded:
        """See `Recording.record`."""
        return LiveRecording(self, stop, watch).run(spec, duration, wait)

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
        self.job += 1
        self.open_path = str(spec.path)
        self.view.lost = None
        self.archive.send(Open(self.job, spec, drives, from_now, until_ended))
        answer = self.archive.answer(OPEN_TIMEOUT, self.job)
        if answer is not None:
            self._late_path = ""  # commands are obeyed in order
        if isinstance(answer, Opened):
            return
        self.open_path = ""
        if isinstance(answer, Failed):
            raise write_error(answer)
        if (failure := self.archive.failure()) is not None:
            raise ControllerFault(f"{failure}; nothing was sent, and {spec.path} is not recorded")
        # Should it come to it after all, it is to be closed at once.
        self.archive.send(Close(self.job, "void", "nothing was sent: it was opened too late"))
        self._late_path = str(spec.path)
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
        self.archive.send(Close(self.job, outcome, reason))
        deadline = time.monotonic() + OPEN_TIMEOUT
        while time.monotonic() < deadline:
            answer = self.archive.answer(POLL, self.job)
            if isinstance(answer, Closed):
                self.count(answer)
                return answer
            if isinstance(answer, Failed):
                self.open_path = ""
                raise write_error(answer)
            if (failure := self.archive_failure()) is not None:
                raise ControllerFault(f"{failure}; {path} is not complete ({outcome}: {reason})")
        raise ControllerFault(f"{path} was not completed within {OPEN_TIMEOUT:g} s")

    def failed_write(self) -> Failed | None:
        """What the archive process says of an archive that cannot be written further, if it does.

        Waits `POLL` s for it.
        """
        answer = self.archive.answer(POLL, self.job)
        return answer if isinstance(answer, Failed) else None

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
        self.untaken += closed.untaken

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
        self.archive.send(Serve(self.job, view, cell.joint_names, cell.period, cell.drive_train))
        answer = self.archive.answer(OPEN_TIMEOUT, self.job)
        if isinstance(answer, Failed):
            raise LiveViewError(None, answer.problem, remedy=answer.remedy)
        if not isinstance(answer, Serving):
            failure = self.archive.failure() or "the archive process does not answer"
            raise ControllerFault(f"{failure}; nothing was sent")
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
                self.exchange.beat()
                time.sleep(POLL)
            trouble = self.view.trouble
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


SLOW_DISK: Final = 1.0
"""s at once that a disk takes for a flush when something is wrong with it."""
REST_TIMEOUT: Final = 30.0
"""s for an arm that was asked to stop to rest, and for the archive of a motion that has ended."""


class LiveMotion:
    """One motion on a `LiveLink`.

    Whatever happens here delays no answer: the exchange is asked through shared memory.
    """

    def __init__(self, link: LiveLink, stop: Stop, watch: MotionWatch, override: float) -> None:
        self._link, self._stop, self._watch = link, stop, watch
        self._view, self._exchange = link.view, link.exchange
        self._steering = Steering(watch, override)
        self._reader = link.reader()
        self._stop_passed = False

    def run(self, source: MotionSource, spec: ArchiveSpec) -> MotionEnded:
        """See `MotionLink.run`."""
        self._wait_for_begin(source)  # no archive is opened while a hold stands
        self._link.open_archive(spec, from_now=True, until_ended=True)
        # That may have taken seconds: nothing is asked for that is no longer wanted.
        while self._wanted(source):
            self._require_same_session()
            self._view.forget_motion()
            display = self._display(source)
            self._link.heart.begin()
            try:
                self._submit(source, spec)
                return self._supervised(display, spec)
            except WithdrawnError:
                continue  # it was stopped, held or slowed meanwhile, or a new session began
            finally:
                self._link.heart.rest()
        self._link.complete("stopped", NOT_BEGUN)
        return MotionEnded("stopped", NOT_BEGUN, -1, -1)

    def _supervised(self, display: ProgressDisplay, spec: ArchiveSpec) -> MotionEnded:
        """How the motion that was asked for ended."""
        due = math.inf
        while True:
            self._look(display)
            if (idle := self._view.not_begun()) is not None:
                return self._give_up(idle)
            answer = self._link.archive.answer(POLL, self._link.job)
            if isinstance(answer, Closed):
                return self._ending(answer)
            if isinstance(answer, Failed):
                self._link.open_path = ""
                self._come_to_rest()
                raise write_error(answer)
            self._raise_failure()
            if self._view.motion_ended or self._view.failure() is not None:
                due = min(due, time.monotonic() + REST_TIMEOUT)
            if time.monotonic() > due:
                what = f"{spec.path} was not completed within {REST_TIMEOUT:g} s"
                raise ControllerFault(f"the motion is over, but {what}")

    def _wanted(self, source: MotionSource) -> bool:
        """Whether the motion is still to begin; waits while it is held."""
        try:
            return self._wait_for_begin(source)
        except ControllerFault as error:
            self._link.complete("void", str(error))
            raise

    def _wait_for_begin(self, source: MotionSource) -> bool:
        """See `Steering.begin`; what the exchange says meanwhile is not lost."""
        begins = self._steering.begin(source, self._stop, self._view.look)
        self._view.look()
        return begins

    def _still_wanted(self) -> bool:
        """Whether it may begin the next moment, as it was handed over."""
        self._link.heart.turn()
        self._view.look()
        same_session = self._view.inits == self._link.inits
        return same_session and self._steering.unchanged(self._stop)

    def _require_same_session(self) -> None:
        """A controller that began anew may announce limits that no motion was checked against."""
        self._view.look()
        if self._view.inits > self._link.inits:
            why = "the controller began a new session since it was connected"
            self._link.complete("void", why)
            raise ControllerFault(
                f"{why}; nothing was sent, run again: its limits are checked anew"
            )

    def _submit(self, source: MotionSource, spec: ArchiveSpec) -> None:
        try:
            self._exchange.submit(source, self._still_wanted)
        except WithdrawnError:
            raise
        except RequestError as error:
            self._link.complete("refused", str(error))
            why = self._link.heart.explained(str(error))
            raise ControllerFault(f"{why}; {spec.path} says so") from error
        except DriverError as error:
            self._raise_failure()
            self._exchange.stop()
            self._view.look()
            why = self._view.failure() or str(error)
            closed = self._link.complete("void", why)
            raise ControllerFault(f"{why}; {spec.path} is {closed.outcome}") from error

    def _look(self, display: ProgressDisplay) -> None:
        """Take in what is new, pass requests on, and show it if that is due."""
        self._link.heart.turn()
        display.note(self._view.look())
        if self._stop.requested and not self._stop_passed:
            self._exchange.stop()
            self._stop_passed = True
        if not self._view.motion_ended:
            self._steering.follow(self._exchange, display.messages)
        if display.due:
            display.take(self._reader.drain())
            status = self._view.status
            display.show(
                self._watch, self._view.state, self._counts(), status.motion_time, status.rate
            )

    def _display(self, source: MotionSource) -> ProgressDisplay:
        connection, cell = self._link.connection, self._link.cell
        drives = drives_in_force(cell, connection)
        guard = guard_in_force(cell, drives, connection.init)
        self._reader.drain()
        return ProgressDisplay(drives, guard, self._steering, duration_of(source), self._counts())

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
        self._link.count(closed)
        self._view.look()
        if self._view.ended is not None:
            ended = self._view.ended
            return replace(ended, reason=self._explained(ended.reason, closed))
        if closed.outcome in get_args(Outcome) and self._view.motion_ended:
            outcome: Outcome = closed.outcome  # type: ignore[assignment]
            reason = self._explained(closed.reason, closed)
            return MotionEnded(outcome, reason, closed.interval, -1)
        failure = self._view.failure() or closed.reason
        alone = "the controller gets no answers and acts by its own watch"
        raise ControllerFault(f"{failure}; {alone}; the archive ({closed.outcome}) is whole so far")

    def _explained(self, reason: str, closed: Closed) -> str:
        """Why a motion ended, with the cause where a process of ours did not get on."""
        if reason == NO_ARCHIVE and closed.disk_waited > SLOW_DISK:
            waited = f"it waited for its disk for {closed.disk_waited:.1f} s"
            return f"{reason} ({waited}: look after that disk)"
        return self._link.heart.explained(reason)

    def _give_up(self, why: str) -> MotionEnded:
        """A motion that has not begun is dropped; without an archive it cannot begin any more."""
        path, refused = self._link.open_path, self._view.refused
        outcome = "void" if refused is None else "refused"
        self._link.complete(outcome, why if refused is None else str(refused.error))
        self._exchange.stop()
        if refused is None:
            raise ControllerFault(f"{why}; nothing was sent ({path})")
        return MotionEnded("refused", str(refused.error), -1, -1)

    def _raise_failure(self) -> None:
        """Raise ControllerFault if the archive process is gone or hangs; the arm rests first."""
        path = self._link.open_path
        if (failure := self._link.archive_failure()) is not None:
            rests = "the arm was brought to rest"
            if not self._come_to_rest():
                state = self._view.state.name
                rests = f"the arm was asked to stop, but was not seen at rest ({state})"
            raise ControllerFault(f"{failure}; {rests}, and {path} is readable up to its last part")

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


SILENCE = 1.0
"""s without a packet after which nobody is there to be answered."""
NOBODY = frozenset((State.SYNC, State.INIT, State.ENDED))
"""States in which no session is going on."""
TARGET_MOVED = 1e-5
"""rad; a target at rest does not change at all, but its rounding may."""
ARM_MOVED = 5e-4
"""rad; more than an encoder's noise, less than any motion makes in a second."""
REST = 1.0
"""s of the controller's time without motion after which the arm is at rest."""
OFF = 1.0
"""s with the drive off after which answers end; a session that is being ended is ended by then."""


class Standstill:
    """Looks at records for the last motion of target or arm. A joint not known counts as moving.

    Args:
        period: cycle of the controller, s.
    """

    def __init__(self, period: float) -> None:
        self._cycles = round(REST / period)
        self._target: NDArray[np.float64] | None = None
        self._position: NDArray[np.float64] | None = None
        self._since = 0

    def take(self, records: NDArray[np.void]) -> bool:
        """Whether the arm has been at rest for `REST` at the end of the next records (k,)."""
        if not len(records):
            return False
        for record in records:
            target, position, cycle = record["target_position"], record["position"], record["cycle"]
            still = (
                self._target is not None
                and self._position is not None
                and cycle > self._since
                and bool(np.all(np.abs(target - self._target) <= TARGET_MOVED))
                and bool(np.all(np.abs(position - self._position) <= ARM_MOVED))
            )
            if not still:
                self._target, self._position = target.copy(), position.copy()
                self._since = int(cycle)
        return int(records["cycle"][-1]) - self._since >= self._cycles


class LiveRecording:
    """One recording on a `LiveLink`.

    The controller's own program goes on when a recording ends, for whatever reason, and what it
    does with a PC that falls silent in the middle of a motion is not known. So answers go on until
    the arm has stood still for a second, the drive is off, the session has ended or nothing is
    heard any more; or until the operator insists.
    """

    def __init__(self, link: LiveLink, stop: Stop, watch: Watch) -> None:
        self._link, self._stop, self._watch = link, stop, watch
        self._view = link.view
        self._reader: RingReader = link.reader()
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
        until = None if wait is None else time.monotonic() + wait
        while self._link.connection.init is None:
            self._view.look()
            self._show(over="")
            if self._stop.requested:
                raise OperatorStopError("ended before the controller came: nothing was recorded")
            if (failure := self._view.failure()) is not None:
                raise ControllerFault(f"{failure}: nothing was recorded")
            if until is not None and time.monotonic() > until:
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
        while True:
            ending = self._ends(duration, restarted=self._view.inits > inits)
            self._take()
            self._show(over="")
            if ending is not None:
                break
            if (failed := self._link.failed_write()) is not None:
                raise write_error(failed)
            if (failure := self._link.archive_failure()) is not None:
                raise ControllerFault(f"{failure}; {spec.path} is readable up to its last part")
        seconds = (self._view.status.cycle + 1) * self._link.cell.period
        closed = self._link.complete(*ending)
        return Recorded(
            closed.outcome,
            closed.reason,
            closed.records,
            closed.records_lost,
            seconds=seconds,
            events_lost=closed.events_lost,
            missed=closed.missed,
            late=closed.late,
            untaken=closed.untaken,
        )

    def _ends(self, duration: float | None, *, restarted: bool) -> tuple[str, str] | None:
        """Outcome and reason of a recording that is to end now, or None."""
        # The process first: what it said and how the session stood at its end is known then.
        failure = self._view.failure()
        self._view.look()
        status, period = self._view.status, self._link.cell.period
        over = (
            restarted,
            status.state == State.ENDED,
            failure,
            self._view.lost,
            self._stop.requested,
        )
        asked = duration is not None and (status.cycle + 1) * period >= duration
        if self._view.refused is not None and (asked or any(over)):
            return "refused", str(self._view.refused.error)
        if restarted:
            return "stopped", "the controller began a new session"
        if duration is not None and (status.cycle + 1) * period >= duration:
            return "completed", "as long as was asked for"
        if status.state == State.ENDED:
            return "completed", "the controller ended the session"
        if failure is not None:
            return "lost", failure
        if self._view.lost is not None:
            return "lost", describe(self._view.lost)
        if self._stop.requested:
            return ("completed" if duration is None else "stopped"), "ended by the operator"
        return None

    def _answer_until_rest(self, why: str) -> None:
        """Do nothing, for as long as the exchange should go on answering."""
        stopped, still = self._stop.requested, Standstill(self._link.cell.period)
        reader, driven, heard = self._link.reader(), time.monotonic(), 1
        pulse = Pulse(lambda: heard, longest_look=5 * POLL)
        reader.drain()
        while not (self._stop.insisted or (self._stop.requested and not stopped)):
            failure, state, now = self._view.failure(), self._view.state, time.monotonic()
            if state is not State.DRIVE_OFF:
                driven = now
            if failure is not None or state in NOBODY or now - driven > OFF:
                return
            self._view.look()
            records = reader.drain()
            if len(records):
                heard += 1
                self._position = records["position"][-1].copy()
            if still.take(records) or pulse.quiet() > SILENCE:
                return
            self._show(over=why)
            time.sleep(POLL)

    def _take(self) -> None:
        records = self._reader.drain()
        if len(records):
            self._position = records["position"][-1].copy()

    def _show(self, *, over: str) -> None:
        status = self._view.status
        self._watch(
            Progress(
                status.cycle,
                status.missed,
                State(status.state),
                self._position,
                late=status.late,
                untaken=status.unanswered,
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
