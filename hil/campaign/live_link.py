"""A real link: exchange and archive in processes of their own, supervised from here.

This process only asks: it hands motions and archives over, says every 50 ms that it lives, and
reports. The exchange answers the controller, whatever happens here; the archive process writes what
the exchange leaves in shared memory. Each of the three notices the death of the others, and then
the arm comes to rest on its path.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Self, get_args

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError, RequestError
from drivers.events import MotionEnded, Outcome
from drivers.exchange import ExchangeProcess, ExchangeSettings, RealTimeSettings, RingReader
from drivers.motion_source import MotionSource
from drivers.packet_records import CAPACITY
from drivers.states import State
from drivers.transports.base import TransportSpec
from hil.archive import ArchiveSpec
from hil.archive.commands import Close, Closed, Failed, Open, Opened
from hil.archive.supervised import ArchiveProcessHandle
from hil.cell import Cell
from hil.errors import ControllerFault

from .errors import write_error
from .exchange_view import ExchangeView
from .live_recording import LiveRecording
from .motion_link import Connection, Recorded, Watch, described, drives_in_force, unwatched
from .stop import Stop

Array = NDArray[np.float64]

READY = frozenset((State.CLOSED, State.OPENING, State.OPEN))
"""States with the drive on. A controller may open its axes at once: they are held where they are
until a motion is asked for."""
POLL = 0.02
"""s between two looks at everything while a motion runs."""
BEAT = 0.05
"""s between two heartbeats; the exchange stops the arm after 0.5 s without one."""
OPEN_TIMEOUT = 10.0
"""s within which a file must have been created."""
REST_TIMEOUT = 30.0
"""s for an arm that was told to stop to rest, and for the archive of a motion that has ended."""
END_TIMEOUT = 30.0
"""s within which the exchange must have ended after it was told to."""


@dataclass(eq=False)
class LiveLink:
    """A connection over a real transport, in real time; a `MotionLink` and a `Recording`.

    Use it as a context manager: leaving it, for whatever reason, brings the arm to rest, leaves
    open mode and ends both processes.

    Attributes:
        cell: whose controller is at the far end.
        exchange: the process that answers.
        archive: the process that writes.
        finish: asks the far end to end the session; only a simulated one can be asked.
        view: what is known of the exchange.
        cycles: records archived so far.
        late: answers so far that were late or left out for a newer one's.
        untaken: answers so far that the controller did not take.
    """

    cell: Cell
    exchange: ExchangeProcess
    archive: ArchiveProcessHandle
    finish: Callable[[], None] = field(default=lambda: None)
    cycles: int = 0
    late: int = 0
    untaken: int = 0
    view: ExchangeView = field(init=False)
    _job: int = 0
    _open_path: str = ""
    _closed: bool = False

    def __post_init__(self) -> None:
        self.view = ExchangeView(self.exchange)

    @classmethod
    def open(
        cls,
        cell: Cell,
        *,
        transport: TransportSpec | None = None,
        accept_init: bool = False,
        realtime: RealTimeSettings | None = None,
        finish: Callable[[], None] = lambda: None,
    ) -> LiveLink:
        """Start both processes on the cell's link, or on another `transport` to it.

        Raises:
            CellError: the cell names no real link.
            ControllerFault: the link cannot be opened (port taken, not permitted, no adapter), or
                the system refuses a process.
        """
        settings = ExchangeSettings(
            transport=transport if transport is not None else cell.transport_spec(),
            drive_train=cell.drive_train,
            guard_limits=cell.guard_limits,
            period=cell.period,
            session=cell.session_settings(accept_init=accept_init),
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
        try:
            archive = ArchiveProcessHandle.start(
                exchange, len(cell.joint_names), exchange.packets_fd
            )
        except BaseException as error:
            exchange.finish()
            exchange.close()
            if isinstance(error, OSError):
                raise ControllerFault(f"the archive process cannot be started: {error}") from error
            raise
        link = cls(cell, exchange, archive, finish)
        threading.Thread(target=link._beat, daemon=True).start()
        return link

    @property
    def connection(self) -> Connection:
        """What is known of the controller."""
        return self.view.connection

    @property
    def only_simulated(self) -> bool:
        """Whether nothing but a simulated controller can be at the far end."""
        return self.cell.only_simulated

    def notes(self) -> tuple[str, ...]:
        """What the system refused to the exchange, in sentences; none of it is needed."""
        return (*self.exchange.realtime.refused, *self.exchange.notes)

    def connect(self, stop: Stop, timeout: float = 60.0) -> Array:
        """See `MotionLink.connect`."""
        deadline = time.monotonic() + timeout
        reader = self.reader()
        last: Array | None = None
        while not stop.requested and time.monotonic() < deadline:
            self.view.look()
            self.connection.require_usable()
            records = reader.drain()
            if len(records):
                last = records["target_position"][-1].copy()
            if self.view.state in READY and last is not None:
                return last
            if (failure := self.view.failure()) is not None:
                raise ControllerFault(f"{failure}; the controller gets no answers")
            time.sleep(POLL)
        if stop.requested:
            raise ControllerFault("stopped by the operator before anything moved")
        raise ControllerFault(
            f"the controller did not reach drive-on within {timeout:g} s "
            f"(state {self.view.state.name}); switch the drive on and try again"
        )

    def run(self, source: MotionSource, spec: ArchiveSpec, stop: Stop) -> MotionEnded:
        """See `MotionLink.run`."""
        self.view.forget_motion()
        self.open_archive(spec, from_now=True, until_ended=True)
        try:
            self.exchange.submit(source)
        except RequestError as error:
            self.complete("refused", str(error))
            raise ControllerFault(f"{error}; {spec.path} says so") from error
        except DriverError as error:
            self._raise_failure()
            self.exchange.stop()
            closed = self.complete("void", str(error))
            raise ControllerFault(f"{error}; {spec.path} is {closed.outcome}") from error
        asked, due = False, float("inf")
        while True:
            self.view.look()
            if stop.requested and not asked:
                self.exchange.stop()
                asked = True
            if (idle := self.view.not_begun()) is not None:
                return self._give_up(idle)
            answer = self.archive.answer(POLL, self._job)
            if isinstance(answer, Closed):
                return self._ending(answer)
            if isinstance(answer, Failed):
                self._open_path = ""
                self._come_to_rest()
                raise write_error(answer)
            self._raise_failure()
            if self.view.motion_ended or self.view.failure() is not None:
                due = min(due, time.monotonic() + REST_TIMEOUT)
            if time.monotonic() > due:
                what = f"{spec.path} was not completed within {REST_TIMEOUT:g} s"
                raise ControllerFault(f"the motion is over, but {what}")

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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
        self._job += 1
        self._open_path = str(spec.path)
        self.view.lost = None
        self.archive.send(Open(self._job, spec, drives, from_now, until_ended))
        answer = self.archive.answer(OPEN_TIMEOUT, self._job)
        if isinstance(answer, Opened):
            return
        self._open_path = ""
        if isinstance(answer, Failed):
            raise write_error(answer)
        if (failure := self.archive.failure()) is not None:
            raise ControllerFault(f"{failure}; nothing was sent, and {spec.path} is not recorded")
        # Should it come to it after all, it is to be closed at once.
        self.archive.send(Close(self._job, "void", "nothing was sent: it was opened too late"))
        late = f"did not open {spec.path} within {OPEN_TIMEOUT:g} s"
        raise ControllerFault(f"the archive process {late}; nothing was sent")

    def complete(self, outcome: str, reason: str) -> Closed:
        """Have the archive completed.

        Raises:
            ArchiveWriteError: the disk refuses.
            ControllerFault: the archive process does not answer.
        """
        path = self._open_path
        self.archive.send(Close(self._job, outcome, reason))
        deadline = time.monotonic() + OPEN_TIMEOUT
        while time.monotonic() < deadline:
            answer = self.archive.answer(POLL, self._job)
            if isinstance(answer, Closed):
                self.count(answer)
                return answer
            if isinstance(answer, Failed):
                self._open_path = ""
                raise write_error(answer)
            if (failure := self.archive_failure()) is not None:
                raise ControllerFault(f"{failure}; {path} is not complete ({outcome}: {reason})")
        raise ControllerFault(f"{path} was not completed within {OPEN_TIMEOUT:g} s")

    def failed_write(self) -> Failed | None:
        """What the archive process says of an archive that cannot be written further, if it does.

        Waits `POLL` s for it.
        """
        answer = self.archive.answer(POLL, self._job)
        return answer if isinstance(answer, Failed) else None

    def archive_failure(self) -> str | None:
        """What is wrong with the archive process; whoever asks tells what becomes of the file."""
        failure = self.archive.failure()
        if failure is not None:
            self._open_path = ""
        return failure

    def count(self, closed: Closed) -> None:
        """Add up what an archive holds."""
        self._open_path = ""
        self.cycles += closed.records
        self.late += closed.late
        self.untaken += closed.untaken

    def _beat(self) -> None:
        while not self._closed and self.exchange.alive:
            self.exchange.beat()
            time.sleep(BEAT)

    def _ending(self, closed: Closed) -> MotionEnded:
        self.count(closed)
        self.view.look()
        if self.view.ended is not None:
            return self.view.ended
        if closed.outcome in get_args(Outcome) and self.view.motion_ended:
            outcome: Outcome = closed.outcome  # type: ignore[assignment]
            return MotionEnded(outcome, closed.reason, closed.interval, -1)
        failure = self.view.failure() or closed.reason
        alone = "the controller gets no answers and acts by its own watch"
        raise ControllerFault(f"{failure}; {alone}; the archive ({closed.outcome}) is whole so far")

    def _give_up(self, why: str) -> MotionEnded:
        """A motion that has not begun is dropped; without an archive it cannot begin any more."""
        path, refused = self._open_path, self.view.refused
        outcome = "void" if refused is None else "refused"
        self.complete(outcome, why if refused is None else str(refused.error))
        self.exchange.stop()
        if refused is None:
            raise ControllerFault(f"{why}; nothing was sent ({path})")
        return MotionEnded("refused", str(refused.error), -1, -1)

    def _raise_failure(self) -> None:
        """Raise ControllerFault if the archive process is gone or hangs; the arm rests first."""
        path = self._open_path
        if (failure := self.archive_failure()) is not None:
            rests = "the arm was brought to rest"
            if not self._come_to_rest():
                rests = f"the arm was told to stop, but not seen to rest ({self.view.state.name})"
            raise ControllerFault(f"{failure}; {rests}, and {path} is readable up to its last part")

    def _come_to_rest(self) -> bool:
        """Whether the motion has ended; the exchange stops it by itself, but is told to again."""
        self.exchange.stop()
        deadline = time.monotonic() + REST_TIMEOUT
        while not self.view.motion_ended and time.monotonic() < deadline:
            if self.view.failure() is not None:
                return False
            self.view.look()
            time.sleep(POLL)
        return self.view.motion_ended

    def _shut(self) -> str | None:
        """End both processes; what was wrong with them, None if nothing was."""
        if self._closed:
            return None
        self._closed = True
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
                    f"the exchange process still answers {END_TIMEOUT:g} s after it was told to "
                    "end (an axis is open); it ends when the axes are closed"
                )
        finally:
            failure = self.archive.end()
            if failure is not None and self._open_path:
                trouble = f"{failure}; {self._open_path} is not complete"
            self.exchange.close()
        return trouble
