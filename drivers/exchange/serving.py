"""What the exchange process does between two packets: orders in, state and events out."""

from __future__ import annotations

import math
import os
import pickle
import socket
import time
from collections.abc import Callable, Iterable
from typing import Final

import numpy as np

from drivers.errors import DriverError, RequestError
from drivers.events import AnswersLost, Event, GapSeen, LinkLost, MotionEnded, PacketRejected
from drivers.exchange.control import (
    PATIENCE,
    STALE,
    ArchiveState,
    ControlBlock,
    Ended,
    HeartbeatMonitor,
    bin_of,
)
from drivers.exchange.event_log import (
    NO_ARCHIVE,
    NO_SUPERVISOR,
    EventWriter,
    ExchangeEvent,
    HoldRefused,
    Leaving,
    OverrideRefused,
    ResumeRefused,
)
from drivers.exchange.loop import POLL
from drivers.exchange.motion_transfer import WITHDRAWN, Inbox, unpack
from drivers.motion_source import MotionSource, progress_of
from drivers.packets import InitPacket
from drivers.record import MEASURED, CycleRing
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import Transport

EVERY: Final = 0.1
"""s between two events of the same sort."""
_Mergeable = PacketRejected | GapSeen | AnswersLost


class Digest:
    """Lets one rejection of each kind, one gap and one loss of answers through each 0.1 s.

    Those that follow sooner are added up; their sum, with the cycle of the last, comes when the
    time is over. Everything else passes at once. Before the end of a motion or of the link comes
    what was held back till then.
    """

    def __init__(self) -> None:
        self._held: dict[str, _Mergeable] = {}
        self._quiet_until: dict[str, float] = {}

    def take(self, events: Iterable[Event], now: float) -> list[Event]:
        """What is to be reported at this moment, in order."""
        released: list[Event] = []
        for event in events:
            if isinstance(event, PacketRejected | GapSeen | AnswersLost):
                sort = _sort(event)
                held = self._held.get(sort)
                self._held[sort] = event if held is None else _sum(held, event)
                self._release(sort, now, released)
            else:
                if isinstance(event, MotionEnded | LinkLost):
                    released += self.rest()
                released.append(event)
        for sort in tuple(self._held):
            self._release(sort, now, released)
        return released

    def rest(self) -> list[Event]:
        """All that is held back."""
        held: list[Event] = list(self._held.values())
        self._held.clear()
        return held

    def _release(self, sort: str, now: float, released: list[Event]) -> None:
        if now >= self._quiet_until.get(sort, -math.inf):
            released.append(self._held.pop(sort))
            self._quiet_until[sort] = now + EVERY


def _sort(event: _Mergeable) -> str:
    return f"rejected: {event.kind}" if isinstance(event, PacketRejected) else type(event).__name__


def _sum(earlier: _Mergeable, later: _Mergeable) -> _Mergeable:
    """Of two of the same sort."""
    if isinstance(earlier, PacketRejected) and isinstance(later, PacketRejected):
        return PacketRejected(later.kind, earlier.count + later.count, later.reason)
    if isinstance(earlier, GapSeen) and isinstance(later, GapSeen):
        return GapSeen(earlier.missed + later.missed, later.cycle)
    assert isinstance(earlier, AnswersLost) and isinstance(later, AnswersLost)
    return AnswersLost(earlier.count + later.count, later.cycle)


STOPPED: Final = "the supervisor asked for a stop"
ORPHAN_LINGER: Final = 2.0
"""s that packets are answered, after the axes were closed, for nobody."""
FINISH_LINGER: Final = 1.0
"""s that packets are answered, after the axes were closed, when the supervisor wants to end."""
ARM_MOVED: Final = 5e-4
"""rad; more than an encoder's noise, less than any motion makes in `ARM_RESTS`."""
ARM_RESTS: Final = 1.0
"""s without motion after which an arm is assumed to be at rest."""
_POSITION: Final = MEASURED.index("position")
_SLOW_EVERY: Final = 32
"""Packets between two looks at what need not be looked at in each cycle."""
LONGEST_LINGER: Final = 10.0
"""s after the axes were closed first, from which on a controller that opens them again and again
does not put off the end any more."""
_MAY_BE_OPEN: Final = frozenset(
    {State.OPENING, State.OPEN, State.EXITING, State.FREEZING, State.FAULTED}
)


class ControlServer:
    """The `until` of `exchange` in a process of its own; called after each answer.

    Args:
        terminated: whether the process was asked to end: stop on the path, leave open mode, end.

    Attributes:
        reason: why it ended or is about to, in words.
    """

    def __init__(
        self,
        session: Session,
        transport: Transport,
        ring: CycleRing,
        events: EventWriter,
        control: ControlBlock,
        channel: socket.socket,
        *,
        terminated: Callable[[], bool],
        needs_archive: bool,
    ) -> None:
        self._terminated = terminated
        self.reason = ""
        self._session = session
        self._transport = transport
        self._ring = ring
        self._events = events
        self._control = control
        self._inbox = Inbox(channel)
        self._needs_archive = needs_archive
        self._rows = ring.written
        self._worst = 0.0
        self._overrides = control.override_count
        self._holds = control.hold_count
        self._stops = control.stop_count
        self._linger = ORPHAN_LINGER
        self._calls = 0
        self._answered = 0
        self._heard = began = time.monotonic()
        # Of time in which the whole machine stood still nothing is to be concluded.
        self._supervisor = HeartbeatMonitor(
            lambda: control.supervisor_heartbeat or began, max_interval=POLL
        )
        self._archive = HeartbeatMonitor(lambda: control.archive_heartbeat, max_interval=POLL)
        self._archive_silent = 0.0
        self._closed_since = math.inf
        self._closed_first = math.inf
        self._open = False
        self._orphaned = False
        self._arm = ring.measured[0, _POSITION].copy()
        self._arm_moved_at = -math.inf
        self._digest = Digest()
        self._offered: MotionSource | None = None
        self._offered_to: InitPacket | None = None
        self._source: object = None

    def __call__(self) -> bool:
        """Whether the exchange is to end."""
        now = time.monotonic()
        self._measure()
        self._orders(now)
        self._report(now)
        return bool(self.reason) and self._over(now)

    def say(self, event: ExchangeEvent) -> None:
        """Put something into the event log."""
        self._events.write(event)

    def _measure(self) -> None:
        """How long the packet just answered took, from `now` of its record to this moment."""
        rows = self._ring.written
        if rows == self._rows:
            return
        self._rows = rows
        arrival = float(self._ring.arrival[(rows - 1) % self._ring.capacity])
        took = self._transport.now - arrival
        self._worst = max(self._worst, took)
        self._control.latencies[bin_of(took)] += 1

    def _orders(self, now: float) -> None:
        control, session = self._control, self._session
        self._calls += 1
        self._archive_silent = self._archive.silence()
        if self._calls % _SLOW_EVERY == 0 and self._inbox.hung_up():
            self._detach("the supervisor closed its end")
        if control.stop_count != self._stops:
            self._stops = control.stop_count
            session.stop(STOPPED)
            if self._offered is not None:
                self._answer(RequestError(self._state, STOPPED))
        if control.override_count != self._overrides:
            self._overrides = control.override_count
            self._change_override(control.override)
        if control.hold_count != self._holds:
            self._holds = control.hold_count
            self._change_hold(bool(control.held))
        # In a later call than it was read, so that a stop in between is seen first.
        if self._offered is not None:
            self._take_program(self._offered)
        if control.program_offered != self._inbox.identity:
            self._read_program(now)
        if session.requested and self._needs_archive:
            trouble = self._archive_trouble()
            if trouble:
                session.stop(trouble)
        self._reasons_to_leave()
        if self.reason:
            session.stop(self.reason)

    def _reasons_to_leave(self) -> None:
        # Read after `program_id`, which the supervisor writes after a beat: this is never older.
        silent = self._supervisor.silence()
        if self._terminated():
            self._leave("the exchange process was asked to terminate", ORPHAN_LINGER)
        elif silent > (STALE if self._session.requested else PATIENCE):
            self._detach(NO_SUPERVISOR)
        elif self._control.finish:
            self._leave("the supervisor wants to end", FINISH_LINGER)

    def _detach(self, reason: str) -> None:
        self._orphaned = True
        self._leave(reason, ORPHAN_LINGER)

    def _leave(self, reason: str, linger: float) -> None:
        if not self.reason:
            self.reason, self._linger = reason, linger
            self.say(Leaving(reason))

    def _archive_trouble(self) -> str:
        if self._control.archive_state != ArchiveState.READY:
            return "the archive cannot be written"
        if not self._control.archive_heartbeat or self._archive_silent > STALE:
            return NO_ARCHIVE
        return ""

    def _change_override(self, fraction: float) -> None:
        try:
            self._session.override(fraction)
        except DriverError as error:
            self.say(OverrideRefused(fraction, str(error)))

    def _change_hold(self, held: bool) -> None:
        try:
            if held:
                self._session.hold()
            else:
                self._session.resume()
        except DriverError as error:
            self.say((HoldRefused if held else ResumeRefused)(str(error)))

    def _read_program(self, now: float) -> None:
        """Read the program that was handed over. That takes time, in which it may be withdrawn."""
        fd = self._inbox.take()
        if fd is None:
            return  # it is still on the way
        self._offered = None
        try:
            if self._withdrawn(self._inbox.identity):
                raise RequestError(self._state, WITHDRAWN)
            self._offered = unpack(fd)
            self._offered_to = self._session.init
        except RequestError as error:
            self._answer(error)
        except Exception as error:  # whatever the classes of a foreign program raise
            self._answer(RequestError(self._state, f"the program cannot be read: {error!r}"))
        else:
            self._inbox.read()
        finally:
            os.close(fd)
        self._control.pickup_us = 1e6 * (time.monotonic() - now)

    def _take_program(self, source: MotionSource) -> None:
        """Request the program that was read, once it may begin, and say what became of it."""
        control, identity = self._control, self._inbox.identity
        try:
            if self._withdrawn(identity):
                raise RequestError(self._state, WITHDRAWN)
            if control.program_id != identity:
                return  # the supervisor has not said yet
            self._require_time_for_motions()
            self._session.request(source)
            self._source = source
            control.motion_time, control.rate = progress_of(source)
        except RequestError as error:
            self._answer(error)
        else:
            self._answer(None)

    def _withdrawn(self, identity: int) -> bool:
        control = self._control
        return control.program_id == -identity or control.program_offered != identity

    def _require_time_for_motions(self) -> None:
        """Raise RequestError if no motion may begin now, whatever the session says."""
        trouble = self.reason
        if not trouble and self._needs_archive:
            trouble = self._archive_trouble()
        if not trouble and self._session.init is not self._offered_to:
            trouble = "the controller began a new session since this motion was handed over"
        if trouble:
            raise RequestError(self._state, trouble)

    @property
    def _state(self) -> str:
        return self._session.state.name.lower()

    def _answer(self, refusal: RequestError | None) -> None:
        """Say what became of the program taken last."""
        self._offered = None
        if refusal is None:
            self._control.program_accepted = self._inbox.identity
        else:
            self._control.program_refused = self._inbox.identity
        self._inbox.answer(refusal)

    def _report(self, now: float) -> None:
        control, session = self._control, self._session
        control.exchange_heartbeat = now
        for event in self._digest.take(session.events(), now):
            self._put(event)
        control.state = session.state
        control.cycle = int(self._ring.cycle[(self._rows - 1) % self._ring.capacity])
        control.interval = session.interval
        if self._calls % _SLOW_EVERY == 0 or session.counters.answered == self._answered:
            self._report_counters()
            self._watch_arm(now)
        if session.counters.answered != self._answered:
            self._answered = session.counters.answered
            self._heard = now
        self._open = session.state in _MAY_BE_OPEN and now - self._heard < FINISH_LINGER
        if self._open:
            self._closed_since = math.inf
        else:
            self._closed_since = min(self._closed_since, now)
            if self.reason:
                self._closed_first = min(self._closed_first, now)

    def _watch_arm(self, now: float) -> None:
        """With its axes closed the arm may still move, by the controller's own program."""
        position = self._ring.measured[(self._rows - 1) % self._ring.capacity, _POSITION]
        if (np.abs(position - self._arm) > ARM_MOVED).any():
            self._arm_moved_at = now
            np.copyto(self._arm, position)

    def _put(self, event: Event) -> None:
        self._events.write(event)
        if isinstance(event, MotionEnded):
            # The count comes last: who sees it can read the others.
            self._control.ended_outcome = Ended[event.outcome.upper()]
            self._control.ended_interval = event.interval
            self._control.ended_count += 1

    def _report_counters(self) -> None:
        control, counters = self._control, self._session.counters
        discarded = counters.discarded
        control.overflow = self._ring.overflow
        control.answered = counters.answered
        control.missed = counters.missed
        control.duplicates = counters.duplicates
        control.stale = counters.stale
        control.malformed = counters.malformed + discarded.get("malformed", 0)
        control.foreign = discarded.get("foreign", 0)
        control.answered_late = discarded.get("answered late", 0)
        control.late = discarded.get("late", 0) + control.answered_late
        control.unanswered = counters.unanswered
        control.refused = counters.refused
        control.worst_turnaround_us = 1e6 * self._worst
        control.motion_time, control.rate = progress_of(self._source)

    def _over(self, now: float) -> bool:
        """Whether nobody needs answers any more, once there is a reason to end.

        Without a supervisor it answers as long as the arm moves, whoever moves it, without limit:
        nobody is left to see what the controller does when answers end.
        """
        if self._open or (self._orphaned and now - self._arm_moved_at < ARM_RESTS):
            return False
        lingered = now - self._closed_since >= self._linger
        return lingered or now - self._closed_first >= LONGEST_LINGER

    def conclude(self) -> None:
        """Put out what happened last."""
        self._report(time.monotonic())
        for event in self._digest.rest():
            self._put(event)
        self._report_counters()


def portable(error: BaseException) -> bytes:
    """An error as bytes that another process can read, whatever it holds."""
    try:
        body = pickle.dumps(error)
        pickle.loads(body)
    except Exception:
        body = pickle.dumps(DriverError(f"{type(error).__name__}: {error}"))
    return body
