"""Link to a simulated controller in virtual time; exchange and archive share one thread."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from drivers.events import Event, MotionEnded, MotionStarted
from drivers.exchange.loop import exchange
from drivers.guard import Guard
from drivers.motion_source import MotionSource, progress_of
from drivers.record import CycleRing
from drivers.session import Session
from drivers.states import HAS_SET_POINTS, State
from drivers.transports.base import Transport
from drivers.transports.simulated import SimulatedTransport
from hil.archive import ArchiveSpec, ArchiveWriter, Recorder
from hil.archive.recorder import Recorded
from hil.cell import Cell
from hil.errors import ControllerFault

from .motion_link import (
    END_TIMEOUT,
    REQUEST_PERIOD,
    Connection,
    Counts,
    MotionLink,
    Progress,
    StartTimeout,
    Steering,
    Watch,
    described,
    recording_end,
)
from .operator import Stop

DRAIN_CYCLES: Final = 100
"""Cycles after which records are archived: 100 ms at 1 kHz, the flush period."""
AFTERMATH_CYCLES: Final = 1000
"""Most cycles until the archive of a refused or lost motion is complete."""


@dataclass(eq=False, repr=False)
class Link(MotionLink):
    """Session, transport and recorder of one connection in virtual time.

    Attributes:
        guard: the session's, with the active limits.
        finish: asks the controller to end the session.
    """

    transport: Transport
    session: Session
    ring: CycleRing
    guard: Guard
    cell: Cell
    finish: Callable[[], None] = field(default=lambda: None)
    cycles: int = 0
    connection: Connection = field(default_factory=Connection)
    only_simulated: bool = True
    _archiving: _Archiving | None = None
    _READY: ClassVar[frozenset[State]] = frozenset((State.CLOSED,))

    @classmethod
    def over(
        cls,
        transport: SimulatedTransport,
        cell: Cell,
        finish: Callable[[], None] = lambda: None,
        *,
        accept_init: bool = False,
        only_axis: int | None = None,
    ) -> Link:
        """Return a link to the simulated controller of `cell` (TypeError for a real transport)."""
        if not isinstance(transport, SimulatedTransport):
            raise TypeError(
                f"{type(transport).__name__} is not virtual time: on a real link the exchange "
                "must not share a thread with the archive"
            )
        ring = CycleRing(len(cell.joint_names), capacity=10 * DRAIN_CYCLES)
        guard = Guard(cell.guard_limits, cell.period)
        settings = cell.session_settings(accept_init=accept_init, only_axis=only_axis)
        session = Session(cell.drive_train, guard, ring, **settings)
        return cls(transport, session, ring, guard, cell, finish)

    def close(self) -> None:
        """Ask the controller to end the session, and reply until it does, at most `END_TIMEOUT` s.

        A restarted controller was not asked, and continues with closed axes.

        Raises:
            ControllerFault: an axis is still open after that time.
        """
        self.finish()
        deadline = self.transport.now + END_TIMEOUT

        def finished() -> bool:
            self.ring.drain()
            return self.transport.now > deadline

        exchange(self.transport, self.session, until=finished)
        if self.session.state in HAS_SET_POINTS:
            raise ControllerFault(
                f"an axis is still open {END_TIMEOUT:g} s after the controller was asked to end"
            )

    @contextmanager
    def open_archive(self, spec: ArchiveSpec, *, own_motion: bool) -> Iterator[None]:
        """See `MotionLink.open_archive`; records of before belong to a recording only."""
        spec = described(spec, self.connection, self.session.drive_train)
        with spec.open() as writer:
            self._archiving = _Archiving(self, writer)
            if not own_motion:
                self.ring.drain()
                self._poll()
            try:
                yield
            finally:
                self._archiving = None  # which refers to this link

    def complete(self, outcome: str, reason: str) -> Recorded:
        """See `MotionLink.complete`."""
        return self._open_archiving.recorder.close(outcome, reason)

    @property
    def _open_archiving(self) -> _Archiving:
        assert self._archiving is not None, "no archive is open"
        return self._archiving

    def _submit(self, source: MotionSource, _wanted: Callable[[], bool], /) -> None:
        self.session.request(source)

    def _supervise(self, spec: ArchiveSpec, steering: Steering, stop: Stop) -> MotionEnded:
        archiving = self._open_archiving
        archiving.steering = steering
        recorder, start, no_start = archiving.recorder, StartTimeout(self.transport.now), None
        until_drain, patience = 1, AFTERMATH_CYCLES  # requests apply from the first cycle on

        def finished() -> bool:
            nonlocal until_drain, patience, no_start
            if stop.requested:
                self.session.stop("stopped by the operator")
            until_drain -= 1
            if until_drain == 0 or not (self.session.requested or recorder.ended):
                until_drain = DRAIN_CYCLES
                archiving.update()
                self._steer(steering, stop)
                if not archiving.started:
                    no_start = start.no_start(self.session.state, self.transport.now)
            patience -= recorder.ended is not None
            # A motion stopped while its axes opened has not started; they have to close.
            complete = recorder.complete and self.session.state not in HAS_SET_POINTS
            return complete or patience < 0 or no_start is not None

        exchange(self.transport, self.session, until=finished)
        if no_start is not None:
            self.session.stop(no_start)
        archiving.finish()
        if no_start is not None:
            self.complete("void", no_start)
            raise ControllerFault(f"{no_start}; nothing was sent ({spec.path})")
        ended = recorder.ended or MotionEnded("lost", "the link ended", -1, -1)
        self.complete(ended.outcome, ended.reason)
        return ended

    def _steer(self, steering: Steering, stop: Stop) -> None:
        """Show the motion and apply requests; return when no hold is active.

        The simulated controller waits for its reply: a hold takes no simulated time.
        """
        while True:
            motion_time, rate = progress_of(steering.source)
            if steering.due:
                drives, state = self.session.drive_train, self.session.state
                steering.show(drives, self.guard, state, motion_time, rate)
            steering.follow(self.session)
            rests = progress_of(steering.source)[1] == 0.0
            if not (steering.held and rests) or stop.requested:
                return
            time.sleep(REQUEST_PERIOD)

    def _record(
        self, spec: ArchiveSpec, stop: Stop, duration: float | None, watch: Watch
    ) -> Recorded:
        archiving = self._open_archiving
        recorder, until_drain = archiving.recorder, DRAIN_CYCLES
        limit = np.inf if duration is None else round(duration / spec.period)

        def finished() -> bool:
            nonlocal until_drain
            until_drain -= 1
            if until_drain == 0:
                until_drain = DRAIN_CYCLES
                archiving.update()
                newest = self.ring.last(1)
                position = newest["position"][0] if len(newest) else None
                missed, state = self.session.counters.missed, self.session.state
                watch(Progress(recorder.records, missed, state, position))
            full = recorder.records + DRAIN_CYCLES - until_drain >= limit
            return full or stop.requested or recorder.restarted or recorder.link_lost

        exchange(self.transport, self.session, until=finished)
        archiving.finish()
        end = recording_end(
            restarted=recorder.restarted,
            complete=recorder.records >= limit,
            ended=self.session.state is State.ENDED,
            lost="no packet arrives from the controller any more" if recorder.link_lost else "",
            stopped=stop.requested,
            limited=duration is not None,
            refused=recorder.refused,
        ) or ("completed", "the controller ended the session")
        return self.complete(*end)

    def _no_session(self, _wait: float, /) -> str:
        return "the controller did not start a session"

    def _now(self) -> float:
        return self.transport.now

    def _state(self) -> State:
        return self.session.state

    def _poll(self) -> list[Event]:
        events = self.session.events()
        for event in events:
            self.connection.update(event)
        return events

    def _new_records(self) -> NDArray[np.void]:
        return self.ring.drain()

    def _exchange_until(self, finished: Callable[[], bool], _consequence: str, /) -> None:
        exchange(self.transport, self.session, until=finished)

    def _counts(self) -> Counts:
        counters = self.session.counters
        late = counters.discarded.get("late", 0) + counters.discarded.get("answered late", 0)
        return counters.answered, counters.missed, late, counters.not_accepted


class _Archiving:
    """Moves records and events from the session into an archive, and to `steering`."""

    def __init__(self, link: Link, writer: ArchiveWriter) -> None:
        self.recorder = Recorder(writer, link.session.drive_train)
        self.started = False
        self.steering: Steering | None = None
        self._failure: Exception | None = None
        self._link = link
        self._overflow = link.ring.overflow

    def update(self) -> None:
        """Archive what came since the last call; a failure stops the motion on its path."""
        link, recorder = self._link, self.recorder
        events, records, before = link._poll(), link.ring.drain(), recorder.records
        self.started |= any(isinstance(one, MotionStarted | MotionEnded) for one in events)
        earlier = self._overflow
        self._overflow = link.ring.overflow
        if self.steering is not None:
            self.steering.add_records(records)
        if self._failure is not None:
            recorder.update(events)
            return
        try:
            recorder.record(records, events, self._overflow - earlier)
        except Exception as error:  # of any kind: the arm comes to rest first
            self._failure = error
            link.session.stop("the archive cannot be written")
        link.cycles += recorder.records - before

    def finish(self) -> None:
        """Archive the rest, and raise what failed before."""
        self.update()
        if self._failure is not None:
            raise self._failure
