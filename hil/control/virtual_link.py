"""The port in virtual time: exchange and archive share one thread with the simulated controller."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.cycle_records import CycleRing
from drivers.events import Event, MotionEnded
from drivers.exchange.loop import exchange
from drivers.guard import Guard
from drivers.motion_source import MotionSource, progress_of
from drivers.punctuality import Punctuality
from drivers.session import Session
from drivers.states import STATES_WITH_SET_POINTS
from drivers.transports.base import Transport
from drivers.transports.simulated import SimulatedTransport
from drivers.wire import state_of
from hil.archive import ArchiveSpec, Recorder
from hil.archive.live import LiveView
from hil.archive.recorder import Recorded
from hil.base.errors import ControllerError
from hil.cell import Cell
from hil.control.link import SESSION_END_TIMEOUT
from hil.control.motion_watch import Stop

from .link import MotionLink
from .port import PortStatus

DRAIN_CYCLES: Final = 100
"""Cycles after which records are archived: 100 ms at 1 kHz, the flush period."""
AFTERMATH_CYCLES: Final = 1000
"""Most cycles until the archive of a refused or lost motion is complete."""
_LINK_ENDED: Final = "the link ended"


class VirtualPort:
    """A session on a transport with its recorder; see `ControllerPort`.

    Args:
        transport: in virtual time.
        session: on it.
        ring: records of its cycles.
        finish: asks the controller to end the session.

    Attributes:
        finish: asks the controller to end the session.
    """

    is_virtual = True
    only_simulated = True
    live: LiveView | None = None

    def __init__(
        self,
        transport: Transport,
        session: Session,
        ring: CycleRing,
        finish: Callable[[], None] = lambda: None,
    ) -> None:
        self.transport = transport
        self.session = session
        self.ring = ring
        self.finish = finish
        self._archiving: _Archiving | None = None
        self._source: object = None
        self._ended_count = 0
        self._until_due = DRAIN_CYCLES
        self._over = False

    @property
    def now(self) -> float:
        """See `ControllerPort.now`."""
        return self.transport.now

    def status(self) -> PortStatus:
        """See `ControllerPort.status`."""
        counters = self.session.counters
        ring = self.ring
        discarded = counters.discarded
        punctuality = Punctuality.of(discarded)
        motion_time, rate = progress_of(self._source)
        return PortStatus(
            state=self.session.state,
            cycle=int(ring.cycle[(ring.written - 1) % ring.capacity]),
            replied=counters.replied,
            missed=counters.missed,
            late=punctuality.late_replies,
            not_accepted=counters.rejected,
            foreign=discarded.get("foreign", 0),
            ended_count=self._ended_count,
            motion_time=motion_time,
            rate=rate,
            late_packets=punctuality.late_packets,
        )

    def failure(self) -> str | None:
        """See `ControllerPort.failure`; a session that ended is its controller's affair."""
        return None

    def notes(self) -> tuple[str, ...]:
        """See `ControllerPort.notes`."""
        return ()

    def prepare(self, stop: Stop) -> None:
        """See `ControllerPort.prepare`."""
        del stop

    def poll(self) -> Sequence[Event]:
        """See `ControllerPort.poll`; a failure of the archive stops the motion on its path."""
        events = self.session.events()
        self._ended_count += sum(isinstance(event, MotionEnded) for event in events)
        if self._archiving is not None:
            failed = self._archiving.failure is not None
            self._archiving.update(events, self.ring)
            if not failed and self._archiving.failure is not None:
                self.session.stop("the archive cannot be written")
        return events

    def new_records(self) -> NDArray[np.void]:
        """See `ControllerPort.new_records`."""
        return self.ring.drain() if self._archiving is None else self._archiving.take_newest()

    def exchange_until(self, finished: Callable[[], bool], /) -> bool:
        """See `ControllerPort.exchange_until`."""
        done = False

        def ends_when() -> bool:
            nonlocal done
            done = finished()
            return done

        self._over = False
        exchange(self.transport, self.session, ends_when=ends_when)
        self._over = not done
        return done

    def due(self) -> bool:
        """See `ControllerPort.due`: every `DRAIN_CYCLES`, and at once at the end of a motion."""
        self._until_due -= 1
        archiving = self._archiving
        pending = False
        if archiving is not None and archiving.until_ended:
            ended = archiving.recorder.ended is not None
            archiving.patience -= ended
            pending = self._is_complete(archiving) or not (self.session.requested or ended)
        if self._until_due > 0 and not pending:
            return False
        self._until_due = DRAIN_CYCLES
        return True

    def submit(self, source: MotionSource, wanted: Callable[[], bool], /) -> None:
        """See `ControllerPort.submit`."""
        del wanted
        self.session.request(source)
        self._source = source
        self._until_due = 1  # requests apply from the first cycle on

    def supervision(self) -> AbstractContextManager[None]:
        """See `ControllerPort.supervision`."""
        return nullcontext()

    def stop(self, reason: str) -> None:
        """See `ControllerPort.stop`."""
        self.session.stop(reason)

    def override(self, fraction: float) -> None:
        """See `ControllerPort.override`; RequestError if that is impossible."""
        self.session.override(fraction)

    def hold(self) -> None:
        """See `ControllerPort.hold`; RequestError without a motion."""
        self.session.hold()

    def resume(self) -> None:
        """See `ControllerPort.resume`; RequestError if that is impossible."""
        self.session.resume()

    @contextmanager
    def open_archive(self, spec: ArchiveSpec, *, own_motion: bool) -> Iterator[None]:
        """See `ControllerPort.open_archive`."""
        with spec.open() as writer:
            recorder = Recorder(writer, self.session.drive_train)
            if not own_motion:
                self.ring.drain()
            self._archiving = _Archiving(recorder, self.ring.overflow, until_ended=not own_motion)
            self._until_due = DRAIN_CYCLES
            try:
                yield
            finally:
                self._archiving = None

    def archived(self) -> Recorded | None:
        """See `ControllerPort.archived`."""
        archiving = self._open
        if archiving.failure is not None:
            raise archiving.failure
        if not archiving.until_ended or not (self._over or self._is_complete(archiving)):
            return None
        ended = archiving.recorder.ended
        if ended is None:
            self._ended_count += 1
            return archiving.recorder.close("lost", _LINK_ENDED)
        return archiving.recorder.close(ended.outcome, ended.reason)

    def archive_failure(self) -> str | None:
        """See `ControllerPort.archive_failure`."""
        return None

    def close_archive(self, outcome: str, reason: str) -> Recorded:
        """See `ControllerPort.close_archive`."""
        archiving = self._open
        if archiving.failure is not None:
            raise archiving.failure
        return archiving.recorder.close(outcome, reason)

    def close(self) -> None:
        """Ask the controller to end the session, and reply until it does.

        At most `SESSION_END_TIMEOUT` s. A restarted controller was not asked, and continues with
        closed axes.

        Raises:
            ControllerError: an axis is still open after that time.
        """
        self.finish()
        deadline = self.now + SESSION_END_TIMEOUT

        def finished() -> bool:
            self.ring.drain()
            return self.now > deadline

        self.exchange_until(finished)
        if self.session.state in STATES_WITH_SET_POINTS:
            raise ControllerError(
                f"an axis is still open {SESSION_END_TIMEOUT:g} s after the controller was asked"
                " to end"
            )

    @property
    def _open(self) -> _Archiving:
        assert self._archiving is not None, "no archive is open"
        return self._archiving

    def _is_complete(self, archiving: _Archiving) -> bool:
        """Return whether a motion has ended, and its archive has everything.

        A motion stopped while its axes opened has not started; they have to close.
        """
        closed = self.session.state not in STATES_WITH_SET_POINTS
        return (archiving.recorder.complete and closed) or archiving.patience < 0


class _Archiving:
    """Moves records and events into an archive.

    Attributes:
        until_ended: whether it is complete at the end of a motion.
        patience: cycles left for the aftermath of a motion that has ended.
        failure: why the archive cannot be written; of any kind, as the arm comes to rest first.
    """

    def __init__(self, recorder: Recorder, overflow: int, *, until_ended: bool) -> None:
        self.recorder = recorder
        self.until_ended = until_ended
        self.patience = AFTERMATH_CYCLES
        self.failure: Exception | None = None
        self._overflow = overflow
        self._newest: list[NDArray[np.void]] = []

    def update(self, events: Sequence[Event], ring: CycleRing) -> None:
        """Archive these events, and the records that came since the last call."""
        records = ring.drain()
        earlier = self._overflow
        self._overflow = ring.overflow
        if len(records):
            self._newest = [records]
        if self.failure is not None:
            self.recorder.update(events)
            return
        try:
            self.recorder.record(records, events, self._overflow - earlier)
        except Exception as error:
            self.failure = error

    def take_newest(self) -> NDArray[np.void]:
        """Return the records archived last, none if they were returned before."""
        newest = self._newest
        self._newest = []
        return newest[0] if newest else np.zeros(0, np.dtype(np.void))


class VirtualLink(MotionLink):
    """A `MotionLink` over a session and its transport in virtual time.

    Args:
        transport: in virtual time.
        session: on it.
        ring: records of its cycles.
        cell: of the controller.
        finish: asks the controller to end the session.
    """

    port: VirtualPort

    def __init__(
        self,
        transport: Transport,
        session: Session,
        ring: CycleRing,
        cell: Cell,
        finish: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(cell, VirtualPort(transport, session, ring, finish))

    @classmethod
    def over(
        cls,
        transport: SimulatedTransport,
        cell: Cell,
        finish: Callable[[], None] = lambda: None,
        *,
        only_axis: int | None = None,
    ) -> VirtualLink:
        """Return a link to the simulated controller of a cell.

        Args:
            transport: of the simulated controller.
            cell: that is simulated.
            finish: called when the link is closed.
            only_axis: the only axis, from 1, that is opened; None for all.

        Raises:
            TypeError: the transport is real.
        """
        if not isinstance(transport, SimulatedTransport):
            raise TypeError(
                f"{type(transport).__name__} is not virtual time: on a real link the exchange "
                "must not share a thread with the archive"
            )
        settings = cell.session_settings(only_axis=only_axis)
        ring = CycleRing(
            len(cell.joint_names), capacity=10 * DRAIN_CYCLES, state=state_of(settings)
        )
        guard = Guard(cell.guard_limits, cell.period)
        return cls(
            transport, Session(cell.drive_train, guard, ring, **settings), ring, cell, finish
        )
