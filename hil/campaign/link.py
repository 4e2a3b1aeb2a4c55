"""One connection to a controller, and how an interval of motion is run and recorded on it.

Exchange and archive share one thread here, which is right in virtual time, where the controller
waits for the PC, and only there: on a real link a slow disk must not delay a reply.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import DriveTrain
from drivers.errors import RequestError
from drivers.events import (
    Event,
    GapSeen,
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    PacketRejected,
    Refused,
    StateChanged,
)
from drivers.exchange import exchange
from drivers.guard import Guard
from drivers.motion_source import MotionSource
from drivers.record import CycleRing
from drivers.session import Session
from drivers.states import State
from drivers.transports import SimulatedTransport
from hil.archive import ArchiveWriter, Level
from hil.cell import Cell
from hil.errors import ControllerFault

Array = NDArray[np.float64]
Records = NDArray[np.void]
DRAIN_CYCLES = 100
"""Records go to the archive this many cycles at a time: 100 ms at 1 kHz, the flush period."""
AFTERMATH_CYCLES = 500
"""What the arm does after a motion was refused or lost is recorded for so long."""


@dataclass
class Stop:
    """Set by Ctrl-C; the link then brings the arm to rest on its path."""

    requested: bool = False


@contextmanager
def stop_on_interrupt() -> Iterator[Stop]:
    """Turn SIGINT into a request to stop on the path.

    A second one is the ordinary interrupt: it ends the program at once, and the controller is on
    its own.
    """
    stop = Stop()

    def request(signum: int, frame: FrameType | None) -> None:
        if stop.requested:
            signal.default_int_handler(signum, frame)
        stop.requested = True

    previous = signal.signal(signal.SIGINT, request)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, previous)


@dataclass(eq=False)
class Link:
    """Session, transport and recorder of one connection.

    Attributes:
        transport: moves bytes and time, virtual time (see above).
        session: answers every packet.
        ring: the session's records, drained here.
        drive_train: turns target currents into joint torques.
        finish: asks the far end to end the session (only a simulated one listens).
        cycles: records archived so far.
    """

    transport: SimulatedTransport
    session: Session
    ring: CycleRing
    drive_train: DriveTrain
    finish: Callable[[], None] = field(default=lambda: None)
    cycles: int = 0

    @classmethod
    def over(
        cls, transport: SimulatedTransport, cell: Cell, finish: Callable[[], None] = lambda: None
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
        session = Session(
            cell.drive_train,
            Guard(cell.guard_limits, cell.period),
            ring,
            mode=cell.controller.mode,
            settle_cycles=max(1, round(cell.campaign.settle_s / cell.period)),
        )
        return cls(transport, session, ring, cell.drive_train, finish)

    def connect(self, stop: Stop, timeout: float = 60.0) -> Array:
        """Exchange until the drive is on and the axes are closed; the target position then (n,).

        Raises:
            ControllerFault: the controller did not get there within `timeout` of its own time,
                cannot be used, or a stop was asked for.
        """
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
        for event in self.session.events():
            if isinstance(event, InitReceived) and event.unusable is not None:
                raise ControllerFault(f"the controller cannot be used: {event.unusable}")
        if stop.requested:
            raise ControllerFault("stopped by the operator before anything moved")
        if self.session.state is not State.CLOSED or last is None:
            raise ControllerFault(
                f"the controller did not reach drive-on within {timeout:g} s "
                f"(state {self.session.state.name}); switch the drive on and try again"
            )
        return last

    def run(self, source: MotionSource, writer: ArchiveWriter, stop: Stop) -> MotionEnded:
        """Run one motion and archive every cycle of it; say how it ended.

        Should archiving fail, the arm is brought to rest on its path before the error is raised.

        Raises:
            ControllerFault: the session cannot promise the motion; nothing moved.
            Exception: what archiving failed with; the motion was stopped.
        """
        recorder = _Recorder(self, writer)
        self.ring.drain()
        try:
            self.session.request(source)
        except RequestError as error:
            raise ControllerFault(str(error)) from error
        until_drain, aftermath = DRAIN_CYCLES, AFTERMATH_CYCLES

        def over() -> bool:
            nonlocal until_drain, aftermath
            if stop.requested:
                self.session.stop("stopped by the operator")
            until_drain -= 1
            if until_drain == 0 or not (self.session.requested or recorder.ended):
                until_drain = DRAIN_CYCLES
                recorder.take()
            if recorder.ended is None:
                return False
            aftermath -= 1
            return recorder.ended.outcome in ("completed", "stopped") or aftermath < 0

        exchange(self.transport, self.session, until=over)
        recorder.take()
        if recorder.failure is not None:
            raise recorder.failure
        return recorder.ended or MotionEnded("lost", "the link ended", -1, -1)

    def close(self) -> None:
        """Ask the far end to end the session and answer until it does."""
        self.finish()

        def drop() -> bool:
            self.ring.drain()
            return False

        exchange(self.transport, self.session, until=drop)


class _Recorder:
    """Moves records and events of one interval into its archive."""

    def __init__(self, link: Link, writer: ArchiveWriter) -> None:
        self._link, self._writer = link, writer
        self._overflow = link.ring.overflow
        self.ended: MotionEnded | None = None
        self.failure: Exception | None = None

    def take(self) -> None:
        """Archive what has come since the last call; a failure stops the motion on its path."""
        events = self._link.session.events()
        for event in events:
            if isinstance(event, MotionEnded):
                self.ended = event
        records = self._link.ring.drain()
        if self.failure is not None:
            return
        try:
            self._archive(records, events)
        except Exception as error:  # whatever it is, the arm comes to rest first
            self.failure = error
            self._link.session.stop("the archive cannot be written")

    def _archive(self, records: Records, events: list[Event]) -> None:
        link, writer = self._link, self._writer
        if len(records):
            link.cycles += len(records)
            writer.write(records, link.drive_train.joint_torque(records["target_current"]))
        for event in events:
            cycle = getattr(event, "cycle", None)
            writer.event(cycle, type(event).__name__, describe(event), level=_level(event))
        if link.ring.overflow > self._overflow:
            lost = link.ring.overflow - self._overflow
            self._overflow = link.ring.overflow
            writer.event(None, "RecordsLost", f"{lost} records overwritten", level=Level.ERROR)


def describe(event: Event) -> str:
    """One line for a person."""
    match event:
        case StateChanged():
            return f"{event.before.name} -> {event.after.name} in cycle {event.cycle}"
        case GapSeen():
            return f"{event.missed} packets missed before cycle {event.cycle}"
        case MotionStarted():
            return f"first set-point in cycle {event.cycle}"
        case MotionEnded():
            return f"{event.outcome} in cycle {event.cycle}: {event.reason}"
        case PacketRejected():
            return f"{event.count} {event.kind} packets got no answer"
        case Refused():
            return str(event.error)
        case LinkLost():
            return f"nothing heard for {event.silence:.3f} s in state {event.state.name}"
        case InitReceived():
            return event.unusable or "the controller started a session"


def _level(event: Event) -> Level:
    if isinstance(event, Refused | LinkLost):
        return Level.ERROR
    return Level.WARN if isinstance(event, GapSeen | PacketRejected) else Level.INFO
