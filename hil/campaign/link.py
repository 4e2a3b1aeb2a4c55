"""One connection to a simulated controller, and how an interval of motion is run and recorded.

Exchange and archive share one thread here, which is right in virtual time, where the controller
waits for the PC, and only there: on a real link a slow disk must not delay a reply
(`hil.campaign.live_link`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from drivers.errors import RequestError
from drivers.events import Event, MotionEnded, MotionStarted
from drivers.exchange.loop import exchange
from drivers.guard import Guard
from drivers.motion_source import MotionSource, progress_of
from drivers.record import CycleRing, PacketRing
from drivers.session import Session
from drivers.states import HAS_SET_POINTS, State
from drivers.transports.base import Transport
from drivers.transports.simulated import SimulatedTransport
from drivers.transports.tapped import TappedTransport
from hil.archive import ArchiveSpec, ArchiveWriter, Recorder
from hil.cell import Cell
from hil.errors import ControllerFault, OperatorStopError

from .motion_link import (
    END_TIMEOUT,
    Beginning,
    Connection,
    Progress,
    Recorded,
    Watch,
    described,
    not_ready,
    unwatched,
)
from .operator import MotionWatch, Stop, unwatched_motion
from .steering import ASKED_EVERY, NOT_BEGUN, PacketCounts, Steering

Array = NDArray[np.float64]
DRAIN_CYCLES = 100
"""Records go to the archive this many cycles at a time: 100 ms at 1 kHz, the flush period."""
AFTERMATH_CYCLES = 1000
"""So long a motion that was refused or lost is waited for, at most, until its archive is full."""


@dataclass(eq=False, repr=False)
class Link:
    """Session, transport and recorder of one connection in virtual time; a `MotionLink`.

    Attributes:
        transport: moves bytes and time, virtual time (see above).
        session: answers every packet.
        ring: the session's records, drained here.
        guard: the session's; has the limits in force.
        finish: asks the far end to end the session.
        cycles: records archived so far.
        packets: the raw packets, where archives keep them.
        cell: whose controller is at the far end, where it is known.
        only_simulated: True: virtual time reaches nothing else.
    """

    transport: Transport
    session: Session
    ring: CycleRing
    guard: Guard
    finish: Callable[[], None] = field(default=lambda: None)
    cycles: int = 0
    connection: Connection = field(default_factory=Connection)
    packets: PacketRing | None = None
    cell: Cell | None = None
    only_simulated: bool = True

    def __repr__(self) -> str:
        whose = "" if self.cell is None else f"{self.cell!r}, "
        return f"Link({whose}{self.cycles} cycles archived)"

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
        """A link to the simulated controller of `cell` over `transport`.

        Raises:
            TypeError: the transport is a real one, which this loop is not fit for.
        """
        if not isinstance(transport, SimulatedTransport):
            raise TypeError(
                f"{type(transport).__name__} is not virtual time: on a real link the exchange "
                "must not share a thread with the archive"
            )
        ring = CycleRing(len(cell.joint_names), capacity=10 * DRAIN_CYCLES)
        guard = Guard(cell.guard_limits, cell.period)
        settings = cell.session_settings(accept_init=accept_init, only_axis=only_axis)
        session = Session(cell.drive_train, guard, ring, **settings)
        link = cls(transport, session, ring, guard, finish, cell=cell)
        if cell.controller.packets:
            link.packets = PacketRing(20 * DRAIN_CYCLES)
            link.transport = TappedTransport(transport, link.packets, lambda: session.cycle)
        return link

    def connect(self, stop: Stop, timeout: float = 60.0) -> Array:
        """See `MotionLink.connect`; the timeout counts the controller's own time."""
        deadline = self.transport.now + timeout
        last: Array | None = None

        def ready() -> bool:
            nonlocal last
            records = self.ring.drain()
            if len(records):
                last = records["target_position"][-1]
            late = self.transport.now > deadline
            return self.session.state is State.CLOSED or late or stop.requested

        exchange(self.transport, self.session, until=ready)
        self.events()
        self.connection.require_usable(self.cell)
        if stop.requested:
            raise ControllerFault("stopped by the operator before anything moved")
        if self.session.state is not State.CLOSED or last is None:
            raise not_ready(self.session.state, timeout + self.transport.now - deadline)
        return last

    def run(
        self,
        source: MotionSource,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        override: float = 1.0,
        watch: MotionWatch = unwatched_motion,
    ) -> MotionEnded:
        """See `MotionLink.run`; while a hold stands, the simulated controller waits too."""
        steering = Steering(source, watch, override, self._counts)
        steering.begin(stop)  # so that no archive stays open while a hold stands
        with self._open(spec) as writer:
            taking = _Taking(self, writer, steering)
            self.ring.drain()
            self.drain_packets()
            self.events()
            if not steering.begin(stop):
                taking.recorder.close("stopped", NOT_BEGUN)
                return MotionEnded("stopped", NOT_BEGUN, -1, -1)
            try:
                self.session.request(source)
            except RequestError as error:
                raise ControllerFault(str(error)) from error
            recorder, beginning, hopeless = taking.recorder, Beginning(self.transport.now), None
            until_drain, patience = 1, AFTERMATH_CYCLES  # a request counts from the first cycle

            def over() -> bool:
                nonlocal until_drain, patience, hopeless
                if stop.requested:
                    self.session.stop("stopped by the operator")
                until_drain -= 1
                if until_drain == 0 or not (self.session.requested or recorder.ended):
                    until_drain = DRAIN_CYCLES
                    taking.take()
                    self._look(source, steering, stop)
                    if not taking.began:
                        hopeless = beginning.hopeless(self.session.state, self.transport.now)
                patience -= recorder.ended is not None
                # One that was stopped while its axes opened has not begun; they have to close.
                over = recorder.complete and self.session.state not in HAS_SET_POINTS
                return over or patience < 0 or hopeless is not None

            exchange(self.transport, self.session, until=over)
            if hopeless is not None:
                self.session.stop(hopeless)
            taking.finish()
            if hopeless is not None:
                recorder.close("void", hopeless)
                raise ControllerFault(f"{hopeless}; nothing was sent ({spec.path})")
            ended = recorder.ended or MotionEnded("lost", "the link ended", -1, -1)
            recorder.close(ended.outcome, ended.reason)
            return ended

    def record(
        self,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        duration: float | None = None,
        wait: float | None = None,
        watch: Watch = unwatched,
    ) -> Recorded:
        """See `MotionLink.record`; `wait` counts the controller's own time."""
        waits_until = inf if wait is None else self.transport.now + wait

        def known() -> bool:
            self.events()
            late = self.transport.now > waits_until
            return self.connection.init is not None or stop.requested or late

        exchange(self.transport, self.session, until=known)
        if self.connection.init is None:
            if stop.requested:
                raise OperatorStopError("ended before the controller came: nothing was recorded")
            raise ControllerFault("the controller did not start a session: nothing was recorded")
        self.connection.require_usable(self.cell)
        limit = None if duration is None else round(duration / spec.period)
        until_drain = DRAIN_CYCLES
        with self._open(spec) as writer:
            taking = _Taking(self, writer)
            recorder = taking.recorder

            def over() -> bool:
                nonlocal until_drain
                until_drain -= 1
                if until_drain == 0:
                    until_drain = DRAIN_CYCLES
                    taking.take()
                    newest = self.ring.last(1)
                    position = newest["position"][0] if len(newest) else None
                    missed, state = self.session.counters.missed, self.session.state
                    watch(Progress(recorder.records, missed, state, position))
                full = limit is not None and recorder.records + DRAIN_CYCLES - until_drain >= limit
                return full or stop.requested or recorder.restarted or recorder.link_lost

            exchange(self.transport, self.session, until=over)
            taking.finish()
            outcome, reason = how_recording_ended(recorder, stop, limit)
            recorder.close(outcome, reason)
        return Recorded.of(outcome, reason, (recorder.newest + 1) * spec.period, recorder)

    def close(self) -> None:
        """Ask the far end to end the session, and answer until it does or `END_TIMEOUT` s are over.

        A controller that was started anew meanwhile was never asked, and goes on with closed axes.

        Raises:
            ControllerFault: after that time open axes still need set-points.
        """
        self.finish()
        deadline = self.transport.now + END_TIMEOUT

        def over() -> bool:
            self.ring.drain()
            self.drain_packets()
            return self.transport.now > deadline

        exchange(self.transport, self.session, until=over)
        if self.session.state in HAS_SET_POINTS:
            raise ControllerFault(
                f"an axis is still open {END_TIMEOUT:g} s after the controller was asked to end"
            )

    def drain_packets(self) -> NDArray[np.void] | None:
        """Raw packets since the last call; None if they are not stored."""
        if self.packets is None or not isinstance(self.transport, TappedTransport):
            return None
        self.transport.flush()
        return self.packets.drain()

    def events(self) -> list[Event]:
        """What the session said since the last call."""
        events = self.session.events()
        for event in events:
            self.connection.note(event)
        return events

    def _open(self, spec: ArchiveSpec) -> ArchiveWriter:
        spec = described(spec, self.connection, self.session.drive_train)
        return replace(spec, packets=self.packets is not None).open()

    def _look(self, source: MotionSource, steering: Steering, stop: Stop) -> None:
        """Show the motion if that is due, and pass requests on; returns when no hold stands.

        A simulated controller waits for its answer, so that a hold costs no simulated time.
        """
        while True:
            motion_time, rate = progress_of(source)
            if steering.due:
                drives, state = self.session.drive_train, self.session.state
                steering.show(drives, self.guard, state, motion_time, rate)
            steering.follow(self.session)
            rests = progress_of(source)[1] == 0.0
            if not (steering.held and rests) or stop.requested:
                return
            time.sleep(ASKED_EVERY)

    def _counts(self) -> PacketCounts:
        counters = self.session.counters
        late = counters.discarded.get("late", 0) + counters.discarded.get("answered late", 0)
        return PacketCounts(counters.answered, counters.missed, late, counters.unanswered)


def how_recording_ended(recorder: Recorder, stop: Stop, limit: int | None) -> tuple[str, str]:
    """Outcome and reason of a recording; `limit` is how many records were asked for."""
    if recorder.refused is not None:
        return "refused", str(recorder.refused.error)
    if recorder.restarted:
        return "stopped", "the controller began a new session"
    if recorder.link_lost:
        return "lost", "nothing was heard from the controller any more"
    if limit is not None and recorder.records >= limit:
        return "completed", "as long as was asked for"
    if stop.requested:
        return ("completed" if limit is None else "stopped"), "ended by the operator"
    return "completed", "the controller ended the session"


class _Taking:
    """Takes records and events from the session into an archive, and shows them to `steering`."""

    def __init__(self, link: Link, writer: ArchiveWriter, steering: Steering | None = None) -> None:
        self.recorder = Recorder(writer, link.session.drive_train)
        self.began = False
        self._failure: Exception | None = None
        self._link, self._steering = link, steering
        self._overflow, self._packets_overflow = self._overflows()

    def take(self) -> None:
        """Archive what has come since the last call; a failure stops the motion on its path."""
        link, recorder = self._link, self.recorder
        packets = link.drain_packets()
        events, records, before = link.events(), link.ring.drain(), recorder.records
        self.began |= any(isinstance(one, MotionStarted | MotionEnded) for one in events)
        earlier = self._overflow, self._packets_overflow
        self._overflow, self._packets_overflow = self._overflows()
        if self._steering is not None:
            self._steering.note(events)
            self._steering.take(records)
        if self._failure is not None:
            recorder.update(events)
            return
        try:
            if packets is not None:
                recorder.record_packets(packets, self._packets_overflow - earlier[1])
            recorder.record(records, events, self._overflow - earlier[0])
        except Exception as error:  # whatever it is, the arm comes to rest first
            self._failure = error
            link.session.stop("the archive cannot be written")
        link.cycles += recorder.records - before

    def finish(self) -> None:
        """Take the rest, and raise what went wrong on the way."""
        self.take()
        if self._failure is not None:
            raise self._failure

    def _overflows(self) -> tuple[int, int]:
        packets = self._link.packets
        return self._link.ring.overflow, 0 if packets is None else packets.overflow
