"""What the exchange process does between two packets: run commands, publish state and events."""

from __future__ import annotations

import math
import os
import pickle
import socket
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Final

import numpy as np

from drivers.cycle_records import MEASURED, CycleRing
from drivers.errors import DriverError, RequestError
from drivers.events import (
    ControllerDescription,
    Event,
    GapSeen,
    LinkLost,
    MotionEnded,
    PacketRejected,
    RepliesLost,
)
from drivers.exchange.control import (
    HEARTBEAT_TIMEOUT,
    IDLE_HEARTBEAT_TIMEOUT,
    OUTCOMES,
    ArchiveState,
    HeartbeatMonitor,
    SharedState,
    bin_of,
)
from drivers.exchange.event_log import (
    NO_ARCHIVE,
    NO_SUPERVISOR,
    NO_SUPERVISOR_AT_REST,
    CommandRefused,
    EventWriter,
    ExchangeEvent,
    Leaving,
)
from drivers.exchange.loop import POLL_PERIOD
from drivers.exchange.motion_transfer import READ, WITHDRAWN, Inbox, unpack
from drivers.motion_source import MotionSource, progress_of
from drivers.punctuality import REPLIED_TO_LATE, Punctuality
from drivers.session import Session
from drivers.states import State
from drivers.transports.base import Transport

EVENT_PERIOD: Final = 0.1
"""Shortest time between two reports of events that are counted, s."""
DETACHED_LINGER: Final = 2.0
"""Time that packets get replies after the axes closed, without a supervisor, s."""
FINISH_LINGER: Final = 1.0
"""The same when the supervisor requested the end, s; without packets for so long, open axes are
assumed to have closed."""
MAX_LINGER: Final = 10.0
"""Time after the axes closed first from which on axes that open again do not delay the end, s."""
MIN_ARM_MOVEMENT: Final = 5e-4
"""Change of a joint position that counts as motion of the arm, rad: more than an encoder's noise,
less than any motion moves in a second."""
ARM_REST_SECONDS: Final = 1.0
"""Time without motion after which the arm is at rest, s."""
_CALLS_PER_SLOW_CHECK: Final = 32
"""Packets between two updates of what need not be updated in each cycle."""
_POSITION: Final = MEASURED.index("position")
_STATES_MAYBE_OPEN: Final = frozenset(
    {State.OPENING, State.OPEN, State.EXITING, State.FREEZING, State.FAULTED}
)
_COUNTERS: Final = ("replied", "missed", "duplicates", "stale", "rejected", "refused")
"""Counters of a session with their own field in the shared state."""
STOPPED: Final = "a stop was requested"
_Countable = PacketRejected | GapSeen | RepliesLost


class EventLimiter:
    """Sums up rejections of each kind, gaps and lost replies, reported once per `EVENT_PERIOD`.

    A sum has the cycle of the last; it is also reported before the end of a motion or of the link.
    Other events pass at once.
    """

    def __init__(self) -> None:
        self._pending: dict[tuple[type, str], _Countable] = {}
        self._next_at = -math.inf

    def filter(self, events: Iterable[Event], now: float) -> list[Event]:
        """Return the events to be reported at this moment, in order."""
        released: list[Event] = []
        for event in events:
            if isinstance(event, PacketRejected | GapSeen | RepliesLost):
                sort = type(event), getattr(event, "kind", "")
                pending = self._pending.get(sort)
                self._pending[sort] = event if pending is None else _sum(pending, event)
                continue
            if isinstance(event, MotionEnded | LinkLost):
                released += self.flush()
            released.append(event)
        if self._pending and now >= self._next_at:
            self._next_at = now + EVENT_PERIOD
            released += self.flush()
        return released

    def flush(self) -> list[Event]:
        """Return all pending sums."""
        pending: list[Event] = list(self._pending.values())
        self._pending.clear()
        return pending


def _sum(earlier: _Countable, later: _Countable) -> _Countable:
    """Return the sum of two events of one sort."""
    name = "missed" if isinstance(later, GapSeen) else "count"
    return replace(later, **{name: getattr(earlier, name) + getattr(later, name)})


class CommandHandler:
    """The end condition of `exchange` in its own process; called after each reply.

    Runs the commands of the supervisor and publishes state and events.

    Args:
        session: that is served.
        transport: its link.
        ring: records of its cycles.
        events: where its events go.
        control: state shared with the supervisor.
        channel: socket of the supervisor.
        terminated: returns whether the process is to end: stop on the path, leave open
            mode, end.
        needs_archive: whether motions are stopped and refused while the archive is not
            written.

    Attributes:
        reason: why the process ends or is about to; empty otherwise.
    """

    def __init__(
        self,
        session: Session,
        transport: Transport,
        ring: CycleRing,
        events: EventWriter,
        control: SharedState,
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
        self._linger = DETACHED_LINGER
        self._calls = 0
        self._replied = 0
        self._replied_at = began = time.monotonic()
        # Time in which the whole computer stood still must not count as silence.
        self._supervisor = HeartbeatMonitor(
            lambda: control.supervisor_heartbeat or began, max_interval=POLL_PERIOD
        )
        self._archive = HeartbeatMonitor(
            lambda: control.archive_heartbeat, max_interval=POLL_PERIOD
        )
        self._archive_silence = 0.0
        self._closed_since = math.inf
        self._closed_first = math.inf
        self._open = False
        self._detached = False
        self._arm = ring.measured[0, _POSITION].copy()
        self._arm_moved_at = -math.inf
        self._limiter = EventLimiter()
        self._offered: MotionSource | None = None
        self._offered_to: ControllerDescription | None = None
        self._source: object = None

    def __call__(self) -> bool:
        """Whether the exchange has to end."""
        now = time.monotonic()
        self._measure_latency()
        self._run_commands(now)
        self._publish(now)
        return bool(self.reason) and self._may_end(now)

    def log(self, event: ExchangeEvent) -> None:
        """Write an event to the event log."""
        self._events.write(event)

    def _measure_latency(self) -> None:
        """Count the time from the arrival of the packet just replied to to this moment."""
        rows = self._ring.written
        if rows == self._rows:
            return
        self._rows = rows
        arrival = float(self._ring.arrival[(rows - 1) % self._ring.capacity])
        latency = self._transport.now - arrival
        self._worst = max(self._worst, latency)
        self._control.latencies[bin_of(latency)] += 1

    def _run_commands(self, now: float) -> None:
        control = self._control
        session = self._session
        self._calls += 1
        self._archive_silence = self._archive.silence()
        if self._calls % _CALLS_PER_SLOW_CHECK == 0 and self._inbox.closed():
            self._detach("the supervisor closed its end")
        if control.stop_count != self._stops:
            self._stops = control.stop_count
            session.stop(STOPPED)
            if self._offered is not None:
                self._answer(RequestError(self._state, STOPPED))
        if control.override_count != self._overrides:
            self._overrides = control.override_count
            fraction = control.override
            self._command(f"override of {fraction:g}", lambda: session.override(fraction))
        if control.hold_count != self._holds:
            self._holds = control.hold_count
            if control.held:
                self._command("hold", session.hold)
            else:
                self._command("resumption", session.resume)
        # Not in the call that read it, so that a stop in between comes first.
        if self._offered is not None:
            self._request(self._offered)
        if control.program_offered != self._inbox.identity:
            self._read_motion(now)
        if session.requested and self._needs_archive:
            fault = self._archive_fault()
            if fault:
                session.stop(fault)
        self._check_supervisor()
        if self.reason:
            session.stop(self.reason)

    def _check_supervisor(self) -> None:
        # Read after `program_id`: the supervisor beats before it writes that.
        silence = self._supervisor.silence()
        if self._terminated():
            self._leave("the exchange process was asked to terminate", DETACHED_LINGER)
        elif self._session.requested and silence > HEARTBEAT_TIMEOUT:
            self._detach(NO_SUPERVISOR)
        elif silence > IDLE_HEARTBEAT_TIMEOUT:
            self._detach(NO_SUPERVISOR_AT_REST)
        elif self._control.finish:
            self._leave("the supervisor requested the end", FINISH_LINGER)

    def _detach(self, reason: str) -> None:
        self._detached = True
        self._leave(reason, DETACHED_LINGER)

    def _leave(self, reason: str, linger: float) -> None:
        if not self.reason:
            self.reason = reason
            self._linger = linger
            self.log(Leaving(reason))

    def _archive_fault(self) -> str:
        if self._control.archive_state != ArchiveState.READY:
            return "the archive cannot be written"
        if not self._control.archive_heartbeat or self._archive_silence > HEARTBEAT_TIMEOUT:
            return NO_ARCHIVE
        return ""

    def _command(self, name: str, command: Callable[[], object]) -> None:
        try:
            command()
        except DriverError as error:
            self.log(CommandRefused(name, str(error)))

    def _read_motion(self, now: float) -> None:
        """Read the motion that was handed over; it may be withdrawn meanwhile."""
        fd = self._inbox.receive()
        if fd is None:
            return  # it has not arrived yet
        self._offered = None
        try:
            if self._withdrawn(self._inbox.identity):
                raise RequestError(self._state, WITHDRAWN)
            self._offered = unpack(fd)
            self._offered_to = self._session.init
        except RequestError as error:
            self._answer(error)
        except Exception as error:  # raised by classes of the motion
            self._answer(RequestError(self._state, f"the motion cannot be read: {error!r}"))
        else:
            self._inbox.answer(READ)
        finally:
            os.close(fd)
        self._control.pickup_us = 1e6 * (time.monotonic() - now)

    def _request(self, source: MotionSource) -> None:
        """Request the motion that was read, once it may begin, and report the outcome."""
        control = self._control
        identity = self._inbox.identity
        try:
            if self._withdrawn(identity):
                raise RequestError(self._state, WITHDRAWN)
            if control.program_id != identity:
                return  # not permitted yet
            self._check_ready()
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

    def _check_ready(self) -> None:
        """Raise RequestError if no motion may begin for a reason outside the session."""
        fault = self.reason
        if not fault and self._needs_archive:
            fault = self._archive_fault()
        if not fault and self._session.init is not self._offered_to:
            fault = "the controller began a new session since this motion was handed over"
        if fault:
            raise RequestError(self._state, fault)

    @property
    def _state(self) -> str:
        return self._session.state.name.lower()

    def _answer(self, refusal: RequestError | None) -> None:
        """Report whether the motion received last was accepted."""
        self._offered = None
        if refusal is None:
            self._control.program_accepted = self._inbox.identity
        else:
            self._control.program_refused = self._inbox.identity
        self._inbox.answer(refusal)

    def _publish(self, now: float) -> None:
        control = self._control
        session = self._session
        control.exchange_heartbeat = now
        for event in self._limiter.filter(session.events(), now):
            self._log_event(event)
        control.state = session.state
        control.cycle = int(self._ring.cycle[(self._rows - 1) % self._ring.capacity])
        control.interval = session.interval
        if self._calls % _CALLS_PER_SLOW_CHECK == 0 or session.counters.replied == self._replied:
            self._publish_counters()
            self._watch_arm(now)
        if session.counters.replied != self._replied:
            self._replied = session.counters.replied
            self._replied_at = now
        self._open = session.state in _STATES_MAYBE_OPEN and now - self._replied_at < FINISH_LINGER
        if self._open:
            self._closed_since = math.inf
        else:
            self._closed_since = min(self._closed_since, now)
            if self.reason:
                self._closed_first = min(self._closed_first, now)

    def _watch_arm(self, now: float) -> None:
        """Record motion of the arm: with closed axes the controller's own program may move it."""
        position = self._ring.measured[(self._rows - 1) % self._ring.capacity, _POSITION]
        if (np.abs(position - self._arm) > MIN_ARM_MOVEMENT).any():
            self._arm_moved_at = now
            np.copyto(self._arm, position)

    def _log_event(self, event: Event) -> None:
        self._events.write(event)
        if isinstance(event, MotionEnded):
            # The count comes last: it makes the others valid.
            self._control.ended_outcome = OUTCOMES.index(event.outcome)
            self._control.ended_interval = event.interval
            self._control.ended_count += 1

    def _publish_counters(self) -> None:
        control = self._control
        counters = self._session.counters
        discarded = counters.discarded
        for name in _COUNTERS:
            setattr(control, name, getattr(counters, name))
        control.overflow = self._ring.overflow
        control.malformed = counters.malformed + discarded.get("malformed", 0)
        control.foreign = discarded.get("foreign", 0)
        punctuality = Punctuality.of(discarded)
        control.replied_late = discarded.get(REPLIED_TO_LATE, 0)
        control.late = punctuality.late_replies
        control.late_packets = punctuality.late_packets
        control.worst_turnaround_us = 1e6 * self._worst
        control.motion_time, control.rate = progress_of(self._source)

    def _may_end(self, now: float) -> bool:
        """Whether replies are no longer needed, once there is a reason to end.

        Without a supervisor packets get replies as long as the arm moves, without limit: there is
        nothing to react to what the controller does without replies.
        """
        if self._open or (self._detached and now - self._arm_moved_at < ARM_REST_SECONDS):
            return False
        lingered = now - self._closed_since >= self._linger
        return lingered or now - self._closed_first >= MAX_LINGER

    def conclude(self) -> None:
        """Publish what is pending."""
        self._publish(time.monotonic())
        for event in self._limiter.flush():
            self._log_event(event)
        self._publish_counters()


def portable(error: BaseException) -> bytes:
    """Return a pickle of the error, or of a `DriverError` with its text if it has none."""
    try:
        body = pickle.dumps(error)
        pickle.loads(body)
    except Exception:
        body = pickle.dumps(DriverError(f"{type(error).__name__}: {error}"))
    return body
