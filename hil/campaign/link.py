"""Connections to a controller: run motions on it, or record those of its own program.

`VirtualLink` is a `MotionLink` in virtual time, where exchange and archive share one thread;
`hil.campaign.live_link` is that in real time.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import TURN, DriveTrain
from drivers.errors import RequestError
from drivers.events import Event, InitReceived, MotionEnded, MotionStarted, Refused
from drivers.exchange.event_log import ExchangeEvent
from drivers.exchange.loop import exchange
from drivers.exchange.process import ExchangeProcess, WithdrawnError
from drivers.guard import Guard
from drivers.init_check import float32_text, is_narrower
from drivers.motion_source import MotionSource, progress_of
from drivers.packets import DRIVE_ON, InitPacket
from drivers.record import CycleRing
from drivers.session import Session
from drivers.states import HAS_SET_POINTS, State
from drivers.transports.base import Transport
from drivers.transports.simulated import SimulatedTransport
from hil.archive import ArchiveSpec, ArchiveWriter, Recorder
from hil.archive.recorder import Recorded
from hil.cell import Cell
from hil.errors import ArchiveWriteError, ControllerFault, OperatorStopError
from hil.motion_checks import MotionChecks

from .errors import refusal_text
from .operator import REFUSED, MotionProgress, MotionWatch, Stop, unwatched_motion

Array = NDArray[np.float64]

START_TIMEOUT: Final = 60.0  # s within which an accepted motion must have started
OFF_TIMEOUT: Final = 2.0  # s with the drive off after which an accepted motion is dropped
END_TIMEOUT: Final = 30.0  # s within which a session must end after that was requested
NOT_STARTED: Final = "it had not begun"
"""Reason of a motion that was stopped before it was requested."""
_WITHOUT_DRIVE: Final = (State.SYNC, State.INIT, State.DRIVE_OFF, State.FAULTED, State.ENDED)


class StartTimeout:
    """Detects that a motion accepted at `now` [s of any monotonic clock] will not start."""

    def __init__(self, now: float) -> None:
        self._requested = self._drive_on = now

    def no_start(self, state: State, now: float) -> str | None:
        """Return why a motion that has not started will not start; None while it may."""
        if state not in _WITHOUT_DRIVE:
            self._drive_on = now
        if now - self._drive_on > OFF_TIMEOUT:
            event = "a refusal came" if state is State.FAULTED else "the drive went off"
            return f"{event} before the motion began"
        if now - self._requested > START_TIMEOUT:
            return f"the motion did not begin within {START_TIMEOUT:g} s ({state.name})"
        return None


REQUEST_PERIOD: Final = 0.02  # Period of reading the operator's request during a hold, s
SHOW_PERIOD: Final = 0.1  # Period of showing the motion, s

Counts = tuple[int, int, int, int]
"""Packets of a session that got a reply, were missed, got it late, and whose reply was not
accepted; see `drivers.events.Counters`."""


class Steering:
    """Applies the requests of a motion's watch to the motion, and shows the motion to it.

    Args:
        most: largest fraction of the planned speed, whatever is requested.
        counts: returns the present packet counts.

    Attributes:
        fraction: applied to the motion last.
        held: whether a hold was applied last.

    Raises:
        ValueError: `most` is not in 0..1.
    """

    def __init__(
        self, source: MotionSource, watch: MotionWatch, most: float, counts: Callable[[], Counts]
    ) -> None:
        if not 0.0 < most <= 1.0:
            raise ValueError(f"an override of {most!r} is not above 0 and at most 1")
        self.source, self._watch, self._most, self._counts = source, watch, most, counts
        duration = getattr(source, "duration", None)
        self._duration = float(duration) if isinstance(duration, int | float) else None
        self.fraction, self.held = most, False
        self._before = counts()
        self._last: NDArray[np.void] | None = None
        self._due = -math.inf

    def begin(self, stop: Stop, meanwhile: Callable[[], object]) -> bool:
        """Set the requested speed and wait while a hold is requested; return False after a stop.

        Raises:
            ControllerFault: it is to be slower than planned and supports no override.
        """
        request = self._watch.request()
        while request.held and not stop.requested:
            meanwhile()
            time.sleep(REQUEST_PERIOD)
            request = self._watch.request()
        if stop.requested:
            return False
        self.fraction = min(self._most, request.override)
        change = getattr(self.source, "override", None)
        if callable(change):
            change(self.fraction)
        elif self.fraction < 1.0:
            raise ControllerFault(
                f"a {type(self.source).__name__} supports no override and cannot be run at "
                f"{100.0 * self.fraction:.0f} %; nothing was sent"
            )
        self._before = self._counts()
        return True

    def unchanged(self, stop: Stop) -> bool:
        """Return whether the motion may begin as `begin` left it: no stop, hold or lower speed."""
        request = self._watch.request()
        return not (stop.requested or request.held or request.override < self.fraction)

    def follow(self, motion: Session | ExchangeProcess) -> None:
        """Apply the present request. A motion held before it began begins at rest."""
        request = self._watch.request()
        fraction = min(self._most, request.override)
        with suppress(RequestError):  # the motion has ended
            if fraction != self.fraction:
                self.fraction = fraction
                motion.override(fraction)
        with suppress(RequestError):
            if request.held is not self.held:
                self.held = request.held
                (motion.hold if request.held else motion.resume)()

    @property
    def due(self) -> bool:
        """Whether the motion is to be shown again."""
        return time.monotonic() >= self._due

    def add_records(self, records: NDArray[np.void]) -> None:
        """Add cycle records; the last one is shown."""
        if len(records):
            self._last = records[-1:].copy()

    def show(
        self, drives: DriveTrain, guard: Guard, state: State, motion_time: float, rate: float
    ) -> None:
        """Show the motion at `motion_time` s, at `rate` of the planned speed (NaN if unknown).

        Shares are of the active limits of `drives` and `guard`.
        """
        self._due = time.monotonic() + SHOW_PERIOD
        replied, missed, late, not_accepted = np.subtract(self._counts(), self._before).tolist()
        arrays: dict[str, Array] = {}
        if self._last is not None:
            last = self._last[0]
            arrays = {"position": last["position"].copy()}
            if last["status"] == DRIVE_ON:  # else the controller has neither target nor current
                error = last["target_position"] - last["position"]
                turns = np.abs(error @ drives.motor_from_joint.T) / TURN
                arrays |= {
                    "following_error": error,
                    "following_share": turns / guard.following_error,
                    "current": last["target_current"].copy(),
                    "current_share": np.abs(last["target_current"]) / guard.current,
                }
        self._watch.show(
            MotionProgress(
                motion_time=None if math.isnan(motion_time) else motion_time,
                duration=self._duration,
                cycles=replied,
                missed=missed,
                late=late,
                not_accepted=not_accepted,
                state=state,
                override=self.fraction,
                rate=None if math.isnan(rate) else rate,
                held=self.held,
                **arrays,
            )
        )


@dataclass(frozen=True, eq=False)
class Progress:
    """Progress of a recording.

    Attributes:
        cycles: archived so far.
        missed, late, not_accepted: see `Recorded`.
        position: (n,) rad, measured last; None before the first record.
        waiting: what was received until a packet of the controller was replied to; "" since then.
        over: why nothing is recorded any more while replies continue; "" during the recording.
    """

    cycles: int
    missed: int
    state: State
    position: Array | None = None
    late: int = 0
    not_accepted: int = 0
    waiting: str = ""
    over: str = ""


Watch = Callable[[Progress], object]


@dataclass(eq=False)
class Connection:
    """State of the controller since the link was opened.

    Attributes:
        unusable: why the arm cannot be moved, None if it can.
        differences: figures in which it differs from the cell.
        refused: the last refusal since a motion was requested.
        report: receives a line for each refusal at once.
        cell: of the link, for these lines.
    """

    init: InitPacket | None = None
    unusable: str | None = None
    differences: tuple[str, ...] = ()
    refused: Refused | None = None
    report: Callable[[str], object] = str
    cell: Cell | None = None

    def update(self, event: ExchangeEvent) -> None:
        """Update the state with an event."""
        if isinstance(event, InitReceived):
            self.init, self.unusable = event.init, event.unusable
            self.differences = event.differences
        elif isinstance(event, Refused):
            self.refused = event
            text = str(event.error) if self.cell is None else refusal_text(self.cell, event.error)
            self.report(f"{REFUSED}: {text}; {event.error.remedy}")

    def require_usable(self) -> None:
        """Raise ControllerFault if the controller is not the cell's."""
        if self.unusable is not None:
            remedy = "; correct the cell file, or the controller" if self.differences else ""
            raise ControllerFault(f"the controller cannot be used: {self.unusable}{remedy}")


def not_ready(state: State, waited: float) -> ControllerFault:
    """Return the error of a controller that was not ready for a motion after `waited` s."""
    after, restart = f"within {waited:.3g} s", "restart the program on the controller"
    match state:
        case State.SYNC:
            problem = (
                f"did not begin a session {after} (state SYNC): it is silent, or still in one that "
                f"began before this program; {restart} and try again"
            )
        case State.ENDED:
            problem = f"ended the session {after} before its drive was on; {restart} and try again"
        case _:
            problem = f"did not reach drive-on {after} (state {state.name}); switch the drive on"
            problem += " and try again"
    return ControllerFault(f"the controller {problem}")


class MotionLink(ABC):
    """Connection to a controller: runs motions and archives every cycle of them.

    Attributes:
        cycles: records archived so far.
        only_simulated: whether only a simulated controller can be connected.
    """

    cell: Cell
    connection: Connection
    cycles: int
    only_simulated: bool
    _READY: ClassVar[frozenset[State]]

    def connect(self, stop: Stop, timeout: float = 60.0) -> Array:
        """Exchange packets until the drive is on; return the target position (n,) [rad].

        Raises:
            ControllerFault: the controller was not ready within `timeout` s of the link's time,
                cannot be used, or a stop was requested.
        """
        began = self._now()
        target: Array | None = None

        def finished() -> bool:
            nonlocal target
            self._poll()
            self.connection.require_usable()
            if len(records := self._new_records()):
                target = records["target_position"][-1].copy()
            ready = target is not None and self._state() in self._READY
            return ready or stop.requested or self._now() - began > timeout

        self._exchange_until(finished, "the controller gets no replies")
        self._poll()
        self.connection.require_usable()
        if stop.requested:
            raise ControllerFault("stopped by the operator before anything moved")
        if target is None or self._state() not in self._READY:
            raise not_ready(self._state(), self._now() - began)
        return target

    def run(
        self,
        source: MotionSource,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        override: float = 1.0,
        watch: MotionWatch = unwatched_motion,
    ) -> MotionEnded:
        """Run one motion, archive every cycle of it, and return how it ended.

        If archiving fails, the arm is brought to rest on its path before the error is raised.

        Args:
            source: the motion.
            spec: its archive.
            stop: requests a stop on the path.
            override: the largest fraction of the planned speed, from the first cycle on.
            watch: is shown the motion, and may slow, hold and release it; none starts in a hold.

        Raises:
            ControllerFault: the motion was not accepted (nothing moved), or the link broke; or it
                is to be slowed and supports no override.
            ArchiveWriteError: the archive cannot be written; the motion was stopped.
        """
        steering, self.connection.refused = Steering(source, watch, override, self._counts), None
        steering.begin(stop, self._poll)  # no archive is open during a hold
        self._poll()
        with self.open_archive(spec, own_motion=False):
            # Opening it may last seconds: the requests are read again.
            while self._may_start(steering, stop):
                self._new_records()
                try:
                    self._submit(source, lambda: steering.unchanged(stop))
                except WithdrawnError:
                    continue  # stopped, held or slowed meanwhile, or a new session began
                except RequestError as error:
                    self.complete("refused", str(error))
                    raise ControllerFault(f"{error}; see the outcome of {spec.path}") from error
                ended, refused = self._supervise(spec, steering, stop), self.connection.refused
                if refused is not None and ended.reason == str(refused.error):
                    return replace(ended, reason=refusal_text(self.cell, refused.error))
                return ended
            self.complete("stopped", NOT_STARTED)
            return MotionEnded("stopped", NOT_STARTED, -1, -1)

    def record(
        self,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        duration: float | None = None,
        wait: float | None = None,
        watch: Watch = lambda _: None,
    ) -> Recorded:
        """Reply without commanding anything, in real time until rest; archive every cycle.

        Raises:
            ControllerFault: the controller cannot be read, or began no session within `wait` s.
            OperatorStopError: a stop was requested before it began one.
            ArchiveWriteError: the archive cannot be written.
        """
        self._await_session(stop, math.inf if wait is None else wait, watch)
        self.connection.require_usable()
        with self.open_archive(spec, own_motion=True):
            try:
                recorded = self._record(spec, stop, duration, watch)
            except (ArchiveWriteError, ControllerFault) as error:
                self._reply_until_rest(stop, watch, f"the recording failed ({error})")
                raise
        self._reply_until_rest(stop, watch, "recording complete")
        return recorded

    @abstractmethod
    def close(self) -> None:
        """End the connection; ControllerFault if it did not end properly."""

    @abstractmethod
    def open_archive(self, spec: ArchiveSpec, *, own_motion: bool) -> AbstractContextManager[None]:
        """Open an archive, of one motion or of the controller's own; nothing moves before."""

    @abstractmethod
    def complete(self, outcome: str, reason: str) -> Recorded:
        """Complete the archive that is open, and return what it contains."""

    def _may_start(self, steering: Steering, stop: Stop) -> bool:
        """Wait for the end of a hold; return whether the motion may be requested now."""
        try:
            return steering.begin(stop, self._poll)
        except ControllerFault as error:
            self.complete("void", str(error))
            raise
        finally:
            self._poll()

    def _await_session(self, stop: Stop, wait: float, watch: Watch) -> None:
        """Exchange packets until the controller's init packet came."""
        deadline = self._now() + wait

        def finished() -> bool:
            self._poll()
            self._show_recording(watch)
            late = self._now() > deadline
            return self.connection.init is not None or stop.requested or late

        self._exchange_until(finished, "nothing was recorded")
        if self.connection.init is None and stop.requested:
            raise OperatorStopError("ended before the controller came: nothing was recorded")
        if self.connection.init is None:
            raise ControllerFault(f"{self._no_session(wait)}: nothing was recorded")

    # --- what the two kinds of link do differently

    def _show_recording(self, watch: Watch, over: str = "") -> None:
        """Show the state of a recording; in virtual time only when records are archived."""
        del watch, over

    def _reply_until_rest(self, stop: Stop, watch: Watch, reason: str) -> None:
        """Continue to reply until the arm rests; in virtual time it may be left at once."""
        del stop, watch, reason

    @abstractmethod
    def _now(self) -> float:
        """Return the time of the link, s."""

    @abstractmethod
    def _state(self) -> State:
        """Return the state of the session."""

    @abstractmethod
    def _poll(self) -> Sequence[ExchangeEvent]:
        """Receive events, update the connection with them, and return them."""

    @abstractmethod
    def _new_records(self) -> NDArray[np.void]:
        """Return the cycle records since the last call."""

    @abstractmethod
    def _counts(self) -> Counts:
        """Return the packet counts of the session."""

    @abstractmethod
    def _exchange_until(self, finished: Callable[[], bool], consequence: str, /) -> None:
        """Exchange packets until `finished()`; `consequence` ends the message of a failure."""

    @abstractmethod
    def _submit(self, source: MotionSource, wanted: Callable[[], bool], /) -> None:
        """Request a motion; withdraw it where it is not `wanted()` when it could start.

        Raises:
            RequestError: it was not accepted, or withdrawn (WithdrawnError).
        """

    @abstractmethod
    def _supervise(self, spec: ArchiveSpec, steering: Steering, stop: Stop) -> MotionEnded:
        """Wait for the end of the requested motion and of its archive; pass on requests."""

    @abstractmethod
    def _record(
        self, spec: ArchiveSpec, stop: Stop, duration: float | None, watch: Watch
    ) -> Recorded:
        """Record until an end is found, and complete the archive."""

    @abstractmethod
    def _no_session(self, wait: float, /) -> str:
        """Return the problem of a controller that began no session within `wait` s."""


def recording_end(
    *,
    restarted: bool,
    complete: bool,
    ended: bool,
    lost: str,
    stopped: bool,
    limited: bool,
    refused: Refused | None,
) -> tuple[str, str] | None:
    """Return outcome and reason of a recording that is to end now, None while it continues.

    `lost` is how the link was lost, or ""; `limited` whether a duration was requested; the last
    refusal `refused` becomes the reason of any end.
    """
    ends = (
        (restarted, "stopped", "the controller began a new session"),
        (complete, "completed", "as long as was asked for"),
        (ended, "completed", "the controller ended the session"),
        (bool(lost), "lost", lost),
        (stopped, "stopped" if limited else "completed", "ended by the operator"),
    )
    end = next(((outcome, reason) for true, outcome, reason in ends if true), None)
    return ("refused", str(refused.error)) if end is not None and refused is not None else end


def described(spec: ArchiveSpec, connection: Connection) -> ArchiveSpec:
    """Return the archive with the init packet."""
    if connection.init is None:
        return spec
    packet = {"init_packet.bin": connection.init.encode()}
    return replace(spec, attachments={**spec.attachments, **packet})


def active_guard(cell: Cell, init: InitPacket | None) -> Guard:
    """Return a guard with the narrower limits of the cell and the controller."""
    guard = Guard(cell.guard_limits, cell.period)
    if init is not None:
        current = np.fmin(_stated(cell, init, "current_limit"), cell.drive_train.current_limit)
        guard.narrow(_stated(cell, init, "following_error"), current)
    return guard


def active_checks(
    cell: Cell, connection: Connection, checks: MotionChecks | None = None
) -> MotionChecks:
    """Return checks with the narrower current limits of cell and controller.

    `checks` itself is returned where both are the cell's.
    """
    checks = MotionChecks.of(cell) if checks is None else checks
    if connection.init is None:
        return checks
    return checks.within(_stated(cell, connection.init, "current_limit"))


Limit = Literal["current_limit", "following_error"]


def narrower_limits(cell: Cell, connection: Connection, limit: Limit) -> tuple[str, ...]:
    """Return a sentence for each limit of the controller that is below the cell's.

    No model predicts the following error of a servo: motions cannot be checked against it.
    """
    if connection.init is None:
        return ()
    stated, own = _stated(cell, connection.init, limit), getattr(cell.drive_table, limit)
    unit = "A" if limit == "current_limit" else "motor revolutions"
    return tuple(
        f"{cell.joint_names[joint]}: {float32_text(stated[joint])} {unit} in the controller, "
        f"{own[joint]:.9g} in the cell file"
        for joint in np.flatnonzero(is_narrower(stated, np.array(own)))
    )


def _stated(cell: Cell, init: InitPacket, limit: Limit) -> Array:
    """Return a limit of the cell's arm in an init packet (n,), NaN where it has none."""
    values = getattr(init, limit)[cell.controller.arm - 1, : len(cell.joint_names)]
    return np.asarray(values, dtype=np.float64)


DRAIN_CYCLES: Final = 100
"""Cycles after which records are archived: 100 ms at 1 kHz, the flush period."""
AFTERMATH_CYCLES: Final = 1000
"""Most cycles until the archive of a refused or lost motion is complete."""


@dataclass(eq=False, repr=False)
class VirtualLink(MotionLink):
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

    def __post_init__(self) -> None:
        self.connection.cell = self.cell

    @classmethod
    def over(
        cls,
        transport: SimulatedTransport,
        cell: Cell,
        finish: Callable[[], None] = lambda: None,
        *,
        only_axis: int | None = None,
    ) -> VirtualLink:
        """Return a link to the simulated controller of `cell` (TypeError for a real transport)."""
        if not isinstance(transport, SimulatedTransport):
            raise TypeError(
                f"{type(transport).__name__} is not virtual time: on a real link the exchange "
                "must not share a thread with the archive"
            )
        ring = CycleRing(len(cell.joint_names), capacity=10 * DRAIN_CYCLES)
        guard = Guard(cell.guard_limits, cell.period)
        settings = cell.session_settings(only_axis=only_axis)
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

        exchange(self.transport, self.session, ends_when=finished)
        if self.session.state in HAS_SET_POINTS:
            raise ControllerFault(
                f"an axis is still open {END_TIMEOUT:g} s after the controller was asked to end"
            )

    @contextmanager
    def open_archive(self, spec: ArchiveSpec, *, own_motion: bool) -> Iterator[None]:
        """See `MotionLink.open_archive`; records of before belong to a recording only."""
        spec = described(spec, self.connection)
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

        exchange(self.transport, self.session, ends_when=finished)
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

        exchange(self.transport, self.session, ends_when=finished)
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
        exchange(self.transport, self.session, ends_when=finished)

    def _counts(self) -> Counts:
        counters = self.session.counters
        late = counters.discarded.get("late", 0) + counters.discarded.get("replied to late", 0)
        return counters.replied, counters.missed, late, counters.rejected


class _Archiving:
    """Moves records and events from the session into an archive, and to `steering`."""

    def __init__(self, link: VirtualLink, writer: ArchiveWriter) -> None:
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
