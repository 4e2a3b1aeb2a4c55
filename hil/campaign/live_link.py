"""A real link: exchange and archive in processes of their own, supervised from here.

This process only asks: it hands motions and archives over, says every 50 ms that it lives (as long
as the loop that supervises a motion turns), and reports. The exchange answers the controller,
whatever happens here; the archive process writes what the exchange leaves in shared memory. Each of
the three notices the death of the others, and then the arm comes to rest on its path.
"""

from __future__ import annotations

import ctypes
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError
from drivers.events import MotionEnded
from drivers.exchange import (
    NO_SUPERVISOR,
    ExchangeProcess,
    ExchangeSettings,
    RealTimeSettings,
    RingReader,
)
from drivers.motion_source import MotionSource
from drivers.packet_records import CAPACITY
from drivers.states import State
from drivers.transports.base import TransportSpec
from hil.archive import ArchiveSpec
from hil.archive.live import LiveView, LiveViewError, Serve
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
from hil.cell.link import stays_here
from hil.errors import ControllerFault

from .errors import write_error
from .exchange_view import ExchangeView
from .live_motion import LiveMotion
from .live_recording import LiveRecording
from .motion_link import (
    END_TIMEOUT,
    Connection,
    Recorded,
    Watch,
    described,
    drives_in_force,
    not_ready,
    unwatched,
)
from .operator import MotionWatch, unwatched_motion
from .stop import Stop

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
