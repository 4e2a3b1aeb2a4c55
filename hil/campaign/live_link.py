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
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from drivers.announced import compare
from drivers.errors import DriverError, RequestError
from drivers.events import InitReceived, LinkLost, MotionEnded
from drivers.exchange import (
    ExchangeFailed,
    ExchangeProcess,
    ExchangeSettings,
    RealTimeSettings,
    RingReader,
)
from drivers.motion_source import MotionSource
from drivers.states import State
from drivers.transports.base import TransportSpec
from hil.archive import ArchiveSpec
from hil.archive.commands import Answer, Close, Closed, Failed, Open, Opened
from hil.archive.supervised import ArchiveProcessHandle
from hil.cell import Cell
from hil.errors import ArchiveWriteError, ControllerFault

from .motion_link import Connection, Progress, Recorded, Watch, described, unwatched
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
"""s within which an arm that was told to stop must be at rest and its axes closed."""
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
        cycles: records archived so far.
        connection: what is known of the controller.
    """

    cell: Cell
    exchange: ExchangeProcess
    archive: ArchiveProcessHandle
    finish: Callable[[], None] = field(default=lambda: None)
    cycles: int = 0
    connection: Connection = field(default_factory=Connection)
    _lost: LinkLost | None = None
    _ended: MotionEnded | None = None
    _restarts: int = 0
    _trace: str = ""
    _closed: bool = False

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
            ControllerFault: the link cannot be opened (port taken, not permitted, no adapter).
        """
        settings = ExchangeSettings(
            transport=transport if transport is not None else cell.transport_spec(),
            drive_train=cell.drive_train,
            guard_limits=cell.guard_limits,
            period=cell.period,
            session=cell.session_settings(accept_init=accept_init),
            realtime=realtime or RealTimeSettings(),
            preload=("planner",),
        )
        try:
            exchange = ExchangeProcess.start(settings)
        except DriverError as error:
            raise ControllerFault(str(error)) from error
        try:
            archive = ArchiveProcessHandle.start(exchange, len(cell.joint_names))
        except BaseException:
            exchange.finish()
            raise
        link = cls(cell, exchange, archive, finish)
        threading.Thread(target=link._beat, daemon=True).start()
        return link

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
        reader = self._reader()
        last: Array | None = None
        while not stop.requested and time.monotonic() < deadline:
            self._look()
            self.connection.require_usable()
            records = reader.drain()
            if len(records):
                last = records["target_position"][-1].copy()
            if self._state in READY and last is not None:
                return last
            self._require_alive()
            time.sleep(POLL)
        if stop.requested:
            raise ControllerFault("stopped by the operator before anything moved")
        raise ControllerFault(
            f"the controller did not reach drive-on within {timeout:g} s "
            f"(state {self._state.name}); switch the drive on and try again"
        )

    def run(self, source: MotionSource, spec: ArchiveSpec, stop: Stop) -> MotionEnded:
        """See `MotionLink.run`."""
        self._look()
        self._ended = None
        self._open(spec, from_now=True, until_ended=True)
        try:
            self.exchange.submit(source)
        except RequestError as error:
            self._complete("refused", str(error))
            raise ControllerFault(str(error)) from error
        except DriverError as error:
            self._require_alive()
            raise ControllerFault(str(error)) from error
        asked = False
        while True:
            if stop.requested and not asked:
                self.exchange.stop()
                asked = True
            self._look()
            answer = self._answer(POLL)
            if isinstance(answer, Closed):
                return self._ending(answer)
            if isinstance(answer, Failed):
                self._come_to_rest()
                raise _write_error(answer)
            if not self.archive.alive:
                self._come_to_rest()
                raise ControllerFault(
                    f"the archive process ended{self.archive.last_words()}; the arm was brought "
                    "to rest, and what was recorded before is readable"
                )
            if not self.exchange.alive:
                closed = self._answer(OPEN_TIMEOUT)
                if isinstance(closed, Closed):
                    self.cycles += closed.records
                self._require_alive()

    def record(
        self,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        duration: float | None = None,
        watch: Watch = unwatched,
    ) -> Recorded:
        """See `Recording.record`."""
        while self.connection.init is None and not stop.requested:
            self._look()
            self._require_alive()
            watch(Progress(0, 0, self._state))
            time.sleep(POLL)
        if self.connection.init is None:
            raise ControllerFault("the controller did not start a session: nothing was recorded")
        self.connection.require_usable()
        restarts = self._restarts
        self._open(spec, from_now=False, until_ended=False)
        reader = self._reader()
        position: Array | None = None
        while True:
            self._look()
            status = self.exchange.status()
            records = reader.drain()
            if len(records):
                position = records["position"][-1].copy()
            watch(Progress(status.cycle, status.missed, self._state, position))
            ending = self._recording_ends(stop, duration, restarted=self._restarts > restarts)
            if ending is not None:
                closed = self._complete(*ending)
                self.cycles += closed.records
                return Recorded(*ending, closed.records, closed.records_lost)
            answer = self._answer(POLL)
            if isinstance(answer, Failed):
                raise _write_error(answer)
            if not self.archive.alive:
                raise ControllerFault(f"the archive process ended{self.archive.last_words()}")
            self._require_alive()

    def close(self) -> None:
        """End the session where the far end can be asked to, then both processes."""
        if self._closed:
            return
        self._closed = True
        try:
            self.finish()
            self.exchange.finish()
            deadline = time.monotonic() + END_TIMEOUT
            while self.exchange.alive and time.monotonic() < deadline:
                self.exchange.beat()
                time.sleep(POLL)
        finally:
            self.archive.end()
            self.exchange.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None and self.exchange.alive:
            self.exchange.stop()
        self.close()

    def _reader(self) -> RingReader:
        n_joints = len(self.cell.joint_names)
        return RingReader(self.exchange.ring_fd, n_joints, acknowledge=False)

    @property
    def _state(self) -> State:
        return State(self.exchange.status().state)

    def _beat(self) -> None:
        while not self._closed and self.exchange.alive:
            self.exchange.beat()
            time.sleep(BEAT)

    def _look(self) -> None:
        """Take in what the exchange says."""
        for event in self.exchange.events():
            self.connection.note(event)
            if isinstance(event, InitReceived):
                self._restarts += 1
            elif isinstance(event, LinkLost):
                self._lost = event
            elif isinstance(event, MotionEnded):
                self._ended = event
            elif isinstance(event, ExchangeFailed):
                self._trace = event.trace

    def _open(self, spec: ArchiveSpec, *, from_now: bool, until_ended: bool) -> None:
        drives = self.cell.drive_train
        if self.connection.adopted:
            init, arm = self.connection.init, self.cell.controller.arm
            assert init is not None
            drives = compare(drives, self.cell.period, init, arm, accept=True).drive_train
        spec = described(spec, self.connection, drives)
        self._lost = None
        self.archive.send(Open(spec, drives, from_now, until_ended))
        answer = self._answer(OPEN_TIMEOUT)
        if isinstance(answer, Failed):
            raise _write_error(answer)
        if not isinstance(answer, Opened):
            raise ControllerFault(
                f"the archive process did not open {spec.path.name} within {OPEN_TIMEOUT:g} s"
                f"{self.archive.last_words()}"
            )

    def _complete(self, outcome: str, reason: str) -> Closed:
        self.archive.send(Close(outcome, reason))
        answer = self._answer(OPEN_TIMEOUT)
        if isinstance(answer, Failed):
            raise _write_error(answer)
        if not isinstance(answer, Closed):
            raise ControllerFault(f"the archive was not completed{self.archive.last_words()}")
        return answer

    def _answer(self, timeout: float) -> Answer | None:
        return self.archive.answer(timeout)

    def _ending(self, closed: Closed) -> MotionEnded:
        self.cycles += closed.records
        self._look()
        if self._ended is not None:
            return self._ended
        if not self.exchange.alive:
            self._require_alive()
        return MotionEnded("lost", closed.reason, -1, -1)

    def _recording_ends(
        self, stop: Stop, duration: float | None, *, restarted: bool
    ) -> tuple[str, str] | None:
        """Outcome and reason of a recording that is to end now, or None."""
        status = self.exchange.status()
        if restarted:
            return "stopped", "the controller began a new session"
        if self._lost is not None:
            return "lost", "nothing was heard from the controller any more"
        if State(status.state) is State.ENDED:
            return "completed", "the controller ended the session"
        if duration is not None and status.cycle * self.cell.period >= duration:
            return "completed", "as long as was asked for"
        if stop.requested:
            return ("completed" if duration is None else "stopped"), "ended by the operator"
        return None

    def _come_to_rest(self) -> None:
        """Wait until the motion has ended; the exchange stops it by itself."""
        deadline = time.monotonic() + REST_TIMEOUT
        while self._ended is None and self.exchange.alive and time.monotonic() < deadline:
            self._look()
            time.sleep(POLL)

    def _require_alive(self) -> None:
        if self.exchange.alive:
            return
        self._look()
        why = f" ({self._trace.strip().splitlines()[-1]})" if self._trace else ""
        raise ControllerFault(
            f"the exchange process ended{why}; the controller gets no answers and acts by its "
            "own watch"
        )


def _write_error(failed: Failed) -> ArchiveWriteError:
    return ArchiveWriteError(failed.path or None, failed.problem, remedy=failed.remedy)
