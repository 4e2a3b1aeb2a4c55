"""The link to a controller: runs motions on it, or records motions of its own program.

A `MotionLink` steers over a `ControllerPort`: `hil.control.virtual_link` has one in virtual time,
`hil.control.live_link` one in real time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Final, get_args

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError, RequestError
from drivers.events import MotionEnded, Refused
from drivers.exchange.control import HEARTBEAT_TIMEOUT, HeartbeatMonitor
from drivers.exchange.event_log import NO_ARCHIVE
from drivers.exchange.process_handle import WithdrawnError
from drivers.exchange.serving import MIN_ARM_MOVEMENT
from drivers.motion_source import MotionSource
from drivers.states import STATES_WITH_SET_POINTS, Outcome, State
from hil.archive import ArchiveSpec
from hil.archive.live import LiveView
from hil.archive.process_handle import NO_TIME
from hil.archive.recorder import Recorded, describe
from hil.base.arrays import Array
from hil.base.errors import ArchiveWriteError, ControllerError, OperatorStopError
from hil.base.terminal_text import with_joint_names
from hil.cell import Cell
from hil.control.errors import refusal_text
from hil.control.motion_watch import MotionWatch, Stop, unwatched_motion

from .connection import (
    READY_STATES,
    Connection,
    StartTimeout,
    active_guard,
    described,
    words_of,
)
from .operator_control import REQUEST_PERIOD, OperatorControl
from .port import ControllerPort

REST_TIMEOUT: Final = 30.0
"""s for an arm to come to rest, and for the archive of a motion that has ended."""
SESSION_END_TIMEOUT: Final = 30.0  # s within which a session must end after that was requested
CLOSE_TIMEOUT: Final = 1.0  # s for the axes to close after the motion of a failed archive
SLOW_FLUSH_SECONDS: Final = 1.0  # Duration of one flush that is reported as a fault of the disk, s
NOT_STARTED: Final = "it had not started"
"""Reason of a motion that was stopped before it was requested."""
STOPPED: Final = "stopped by the operator"
WAIT_REPORT_DELAY: Final = 2.0  # s after which a controller that is not ready is reported


@dataclass(frozen=True, eq=False)
class Progress:
    """Progress of a recording.

    Attributes:
        cycles: archived so far.
        missed, late_packets, late, not_accepted: see `Recorded`.
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
    late_packets: int = 0
    waiting: str = ""
    over: str = ""


Watch = Callable[[Progress], object]


class MotionLink:
    """Connection to a controller: runs motions and archives every cycle of them.

    Attributes:
        cell: the cell.
        port: of its controller.
        connection: state of the controller.
        cycles: records of the archives that were completed.
    """

    def __init__(self, cell: Cell, port: ControllerPort) -> None:
        self.cell = cell
        self.port = port
        self.cycles = 0
        self.connection = Connection(cell=cell)
        self._inits = 0  # until the controller was connected
        self._reported: tuple[State, str] | None = None
        self._ended_before = 0
        self._position: Array | None = None

    @property
    def is_virtual(self) -> bool:
        """Whether time is simulated."""
        return self.port.is_virtual

    @property
    def only_simulated(self) -> bool:
        """Whether only a simulated controller can be connected."""
        return self.port.only_simulated

    def notes(self) -> tuple[str, ...]:
        """Return what the system refused, in sentences; nothing of it is essential."""
        return self.port.notes()

    @property
    def live(self) -> LiveView | None:
        """Where viewers connect, None if nowhere."""
        return self.port.live

    def close(self) -> None:
        """End the connection; ControllerError if it did not end properly."""
        self.port.close()

    def connect(self, stop: Stop, timeout: float = 60.0) -> Array:
        """Exchange packets until the drive is on; return the target position (n,) [rad].

        Raises:
            ControllerError: the controller was not ready within `timeout` s of the link's time,
                cannot be used, or a stop was requested.
        """
        port = self.port
        port.prepare(stop)
        began = port.now
        target: Array | None = None

        def finished() -> bool:
            nonlocal target
            self._poll()
            self.connection.require_usable()
            if len(records := port.new_records()):
                target = records["target_position"][-1].copy()
            state = port.status().state
            ready = target is not None and state in READY_STATES
            waited = port.now - began
            if not ready and waited > WAIT_REPORT_DELAY:
                self._report_waiting(state, timeout)
            return ready or stop.requested or waited > timeout

        self._exchange_until(finished, "the controller receives no replies")
        self._poll()
        self.connection.require_usable()
        if stop.requested:
            raise ControllerError("ended by the operator before anything moved")
        if target is None or port.status().state not in READY_STATES:
            waited, why_off = port.now - began, self.connection.why_off
            raise words_of(self.cell).not_ready(port.status().state, waited, why_off)
        self._inits = self.connection.inits
        return target

    def _report_waiting(self, state: State, timeout: float) -> None:
        """Report once why no motion can begin yet, and what the operator does about it."""
        text = words_of(self.cell).waiting(state, self._waiting() if state is State.SYNC else "")
        reported = state, self.connection.no_reply  # packets that are more are no other reason
        if text and reported != self._reported:
            self._reported = reported
            self.connection.report(f"waiting up to {timeout:g} s for the controller: {text}")

    # --- one motion; nothing here delays a reply

    def run(
        self,
        source: MotionSource,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        override: float = 1.0,
        watch: MotionWatch = unwatched_motion,
    ) -> MotionEnded:
        """Run one motion, archive its every cycle, and return how it ended.

        If archiving fails, the arm is brought to rest on its path before the error is raised.

        Args:
            source: the motion.
            spec: its archive.
            stop: requests a stop on the path.
            override: the largest fraction of the planned speed, from the first cycle on.
            watch: is shown the motion, and may slow, hold and release it; none starts in a hold.

        Raises:
            ControllerError: the motion was not accepted (nothing moved), or the link broke; or it
                is to be slowed and supports no override.
            ArchiveWriteError: the archive cannot be written; the motion was stopped.
        """
        control = OperatorControl(source, watch, self.port, override)
        self.connection.refused = None
        control.begin(stop, self._poll)  # no archive is open during a hold
        self._poll()
        with self._open_archive(spec, own_motion=False):
            # Opening it may last seconds: the requests are read again.
            while self._may_start(control, stop):
                with self.port.supervision():
                    try:
                        self._submit(source, spec, lambda: control.unchanged(stop))
                    except WithdrawnError:
                        continue  # stopped, held or slowed meanwhile, or a new session began
                    ended = _Supervision(self, spec, control, stop).end()
                refused = self.connection.refused
                if refused is not None and ended.reason == str(refused.error):
                    return replace(ended, reason=refusal_text(self.cell, refused.error))
                return replace(ended, reason=self._named(ended.reason))
            self.complete("stopped", NOT_STARTED)
            return MotionEnded("stopped", NOT_STARTED, -1, -1)

    def _named(self, text: str) -> str:
        """Return a text of the drivers with the names of the joints."""
        return with_joint_names(text, self.cell.joint_names)

    def complete(self, outcome: str, reason: str) -> Recorded:
        """Complete the archive that is open, and return what it contains."""
        self._poll()
        return self._add_records(self.port.close_archive(outcome, reason))

    def _add_records(self, recorded: Recorded) -> Recorded:
        self.cycles += recorded.records
        return recorded

    def _open_archive(
        self, spec: ArchiveSpec, *, own_motion: bool
    ) -> AbstractContextManager[object]:
        self.connection.lost = None
        return self.port.open_archive(described(spec, self.connection), own_motion=own_motion)

    def _may_start(self, control: OperatorControl, stop: Stop) -> bool:
        """Wait for the end of a hold; return whether the motion may be requested now."""
        try:
            return control.begin(stop, self._poll)
        except ControllerError as error:
            self.complete("void", str(error))
            raise
        finally:
            self._poll()

    def _submit(self, source: MotionSource, spec: ArchiveSpec, wanted: Callable[[], bool]) -> None:
        """Request a motion; raise WithdrawnError where it is not `wanted` when it could start."""
        if self.connection.inits > self._inits:  # with limits that no motion was checked against
            reason = "the controller began a new session since it was connected"
            self.complete("void", reason)
            raise ControllerError(
                f"{reason}; nothing was sent, run again: its limits are checked again"
            )
        self._poll()
        self.port.new_records()
        self.connection.reset_motion()
        self._ended_before = self.port.status().ended_count

        def still_wanted() -> bool:
            self._poll()
            return self.connection.inits == self._inits and wanted()

        try:
            self.port.submit(source, still_wanted)
        except WithdrawnError:
            raise
        except RequestError as error:
            self.complete("refused", str(error))
            raise ControllerError(f"{error}; see the outcome of {spec.path}") from error
        except DriverError as error:
            self.require_archive(spec)
            self.port.stop(str(error))
            self._poll()
            reason = self.port.failure() or str(error)
            recorded = self.complete("void", reason)
            raise ControllerError(f"{reason}; {spec.path} is {recorded.outcome}") from error

    @property
    def motion_ended(self) -> bool:
        """Whether the motion requested last has ended; its event may have been lost."""
        ended = self.connection.ended is not None
        return ended or self.port.status().ended_count != self._ended_before

    def require_archive(self, spec: ArchiveSpec) -> None:
        """Raise ControllerError if the archive process is gone or hangs; the arm rests first."""
        if (failure := self.port.archive_failure()) is not None:
            rests = "the arm was brought to rest"
            if not self.come_to_rest():
                state = self.port.status().state.name
                rests = f"the arm was asked to stop, but was not seen at rest ({state})"
            readable = f"{spec.path} is readable up to its last part"
            raise ControllerError(f"{failure}; {rests}, and {readable}")

    def come_to_rest(self) -> bool:
        """Stop a motion that is not archived any more; return whether its end was seen."""
        port = self.port
        state = self.port.status
        port.stop("the archive cannot be written")
        deadline = port.now + REST_TIMEOUT
        closed_by = math.inf

        def finished() -> bool:
            nonlocal closed_by
            self._poll()
            if not self.motion_ended:
                return port.now > deadline
            closed_by = min(closed_by, port.now + CLOSE_TIMEOUT)
            return state().state not in STATES_WITH_SET_POINTS or port.now > closed_by

        self.exchange(finished)
        return self.motion_ended

    # --- one recording

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

        Args:
            spec: of the archive.
            stop: request of the operator.
            duration: of the controller's time [s]; without one until the session ends.
            wait: longest time until the controller begins a session [s].
            watch: of the recording.

        Raises:
            ControllerError: the controller cannot be read, or began no session within `wait` s.
            OperatorStopError: a stop was requested before it began one.
            ArchiveWriteError: the archive cannot be written.
        """
        self._await_session(stop, math.inf if wait is None else wait, watch)
        self.connection.require_usable()
        with self._open_archive(spec, own_motion=True):
            try:
                recorded = self._record(spec, stop, duration, watch)
            except (ArchiveWriteError, ControllerError) as error:
                self._reply_until_rest(stop, watch, f"the recording failed ({error})")
                raise
        self._reply_until_rest(stop, watch, "recording complete")
        return replace(recorded, reason=self._named(recorded.reason))

    def _await_session(self, stop: Stop, wait: float, watch: Watch) -> None:
        """Exchange packets until the controller's init packet came."""
        port = self.port
        connection = self.connection
        deadline = port.now + wait

        def finished() -> bool:
            self._poll()
            if port.due():
                self._show_recording(watch)
            return connection.init is not None or stop.requested or port.now > deadline

        self._exchange_until(finished, "nothing was recorded")
        if connection.init is None and stop.requested:
            raise OperatorStopError("ended before the controller came: nothing was recorded")
        if connection.init is None:
            problem = "the controller did not start a session"
            if math.isfinite(wait):
                problem = f"no init packet within {wait:g} s; {self._waiting()}"
            raise ControllerError(f"{problem}: nothing was recorded")

    def _record(
        self, spec: ArchiveSpec, stop: Stop, duration: float | None, watch: Watch
    ) -> Recorded:
        """Record until an end is found, and complete the archive."""
        port = self.port
        connection = self.connection
        inits = self.connection.inits
        limit = math.inf if duration is None else round(duration / self.cell.period)
        ending: tuple[str, str] | None = None

        def finished() -> bool:
            nonlocal ending
            due = port.due()
            complete = port.status().cycle + 1 >= limit
            if not (due or complete or stop.requested):
                return False
            # First the process: its last message and the last state of the session are known then.
            failure = port.failure()
            self._poll()
            status = port.status()
            lost = connection.lost
            ending = recording_end(
                restarted=connection.inits > inits,
                complete=status.cycle + 1 >= limit,
                ended=status.state is State.ENDED,
                lost=failure or ("" if lost is None else describe(lost)),
                stopped=stop.requested,
                limited=duration is not None,
                refused=connection.refused,
            )
            self._show_recording(watch)
            if ending is None:
                port.archived()
                if (failure := port.archive_failure()) is not None:
                    raise ControllerError(f"{failure}; {spec.path} is readable up to its last part")
            return ending is not None

        if not port.exchange_until(finished):
            finished()
        return self.complete(*(ending or ("completed", "the controller ended the session")))

    def _reply_until_rest(self, stop: Stop, watch: Watch, reason: str) -> None:
        """Reply until the arm has rested for a second or no session is left.

        The controller's own program continues after a recording, and its reaction to a silent PC
        during a motion is not known. The operator may insist on an earlier end. In virtual time it
        may be left at once.
        """
        port = self.port
        if port.is_virtual:
            return
        stopped = stop.requested
        still = Standstill(self.cell.period)
        drive_on = port.now
        received = 1
        monitor = HeartbeatMonitor(lambda: received, max_interval=MAX_LOOK_INTERVAL)
        port.prepare(stop)
        port.new_records()

        def finished() -> bool:
            nonlocal drive_on, received
            if stop.insisted or (stop.requested and not stopped):
                return True
            state = port.status().state
            now = port.now
            if state is not State.DRIVE_OFF:
                drive_on = now
            if state in STATES_WITHOUT_SESSION or now - drive_on > DRIVE_OFF_SECONDS:
                return True
            self._poll()
            records = port.new_records()
            received += len(records) > 0
            if still.add(records) or monitor.silence() > SILENCE_TIMEOUT:
                return True
            self._show_recording(watch, over=reason, records=records)
            return False

        port.exchange_until(finished)

    def _show_recording(
        self, watch: Watch, over: str = "", records: NDArray[np.void] | None = None
    ) -> None:
        records = self.port.new_records() if records is None else records
        if len(records):
            self._position = records["position"][-1].copy()
        status = self.port.status()
        watch(
            Progress(
                status.cycle,
                status.missed,
                status.state,
                self._position,
                late=status.late,
                not_accepted=status.not_accepted,
                late_packets=status.late_packets,
                waiting="" if status.replied else self._waiting(),
                over=over,
            )
        )

    def _waiting(self) -> str:
        """Return what was received from a controller without a session."""
        spec = self.cell.link_spec
        problem = self.connection.not_understood
        who = "the controller" if spec is None else spec.description
        what = f"{who}: {problem}" if problem else f"no packet from {who}"
        return f"{what} ({self.port.status().foreign} packets from other addresses)"

    # --- both

    def _poll(self) -> None:
        """Receive events, and update the connection with them."""
        for event in self.port.poll():
            self.connection.update(event)

    def exchange(self, finished: Callable[[], bool]) -> bool:
        """Exchange packets until `finished()`; False if the exchange ended before.

        Events and records that came since `finished` was last called are then archived, too.
        """
        done = self.port.exchange_until(finished)
        if not done:
            self._poll()
        return done

    def _exchange_until(self, finished: Callable[[], bool], consequence: str) -> None:
        """Exchange packets until `finished()`; `consequence` ends the message of a failure."""
        if not self.exchange(finished) and (failure := self.port.failure()) is not None:
            raise ControllerError(f"{failure}; {consequence}")


class _Supervision:
    """Waits for the end of a motion that was requested, and of its archive; passes on requests."""

    def __init__(
        self, link: MotionLink, spec: ArchiveSpec, control: OperatorControl, stop: Stop
    ) -> None:
        self._link = link
        self._port = link.port
        self._connection = link.connection
        self._spec = spec
        self._control = control
        self._stop = stop
        self._start = StartTimeout(link.port.now)
        self._guard = active_guard(link.cell, link.connection.init)
        self._no_start: str | None = None
        self._recorded: Recorded | None = None
        self._due = math.inf

    def end(self) -> MotionEnded:
        """Return how the motion ended, once its archive is complete.

        Raises:
            ControllerError: it did not begin, or the link broke.
            ArchiveWriteError: the archive cannot be written; the arm is at rest.
        """
        if not self._link.exchange(self._finished):
            self._await_archive()
        if self._recorded is None:
            return self._give_up()
        return self._ended(self._recorded)

    def _finished(self) -> bool:
        port = self._port
        connection = self._connection
        due = port.due()
        if self._stop.requested:
            port.stop(STOPPED)
        if not due:
            return False
        self._link._poll()
        self._steer()
        if not (connection.started or self._link.motion_ended):
            self._no_start = self._start.no_start(port.status().state, port.now)
        return self._no_start is not None or self._is_archived()

    def _steer(self) -> None:
        """Show the motion and apply requests.

        A simulated controller in virtual time waits for its reply: a hold takes no simulated time.
        """
        port = self._port
        control = self._control
        while True:
            if control.due:
                control.show(self._link.cell.drive_train, self._guard, port.status())
            if self._link.motion_ended:
                return  # nothing is left to be released
            control.follow()
            rests = port.is_virtual and control.held and port.status().rate == 0.0
            if not rests or self._stop.requested:
                return
            time.sleep(REQUEST_PERIOD)

    def _is_archived(self) -> bool:
        """Return whether the archive is complete; the arm rests before any archive error."""
        try:
            recorded = self._port.archived()
        except Exception:
            self._link.come_to_rest()
            raise
        if recorded is not None:
            self._recorded = self._link._add_records(recorded)
            return True
        self._link.require_archive(self._spec)
        if self._link.motion_ended or self._port.failure() is not None:
            self._due = min(self._due, self._port.now + REST_TIMEOUT)
        if self._port.now > self._due:
            late = f"{self._spec.path} was not completed within {REST_TIMEOUT:g} s"
            raise ControllerError(f"the motion has ended, but {late}")
        return False

    def _await_archive(self) -> None:
        """Wait for the archive after the last reply: nothing else is left to be done."""
        while not self._is_archived():
            time.sleep(REQUEST_PERIOD)

    def _ended(self, recorded: Recorded) -> MotionEnded:
        """Return how the motion of a completed archive ended."""
        self._link._poll()
        ended = self._connection.ended
        if ended is None and recorded.outcome in get_args(Outcome) and self._link.motion_ended:
            outcome: Outcome = recorded.outcome  # type: ignore[assignment]
            ended = MotionEnded(outcome, recorded.reason, recorded.interval, -1)
        if ended is None:
            failure = self._port.failure() or recorded.reason
            raise ControllerError(
                f"{failure}; the controller receives no replies and acts by its own watchdog; "
                f"the archive ({recorded.outcome}) is complete up to then"
            )
        if ended.reason == NO_ARCHIVE:
            return replace(ended, reason=archive_silence(recorded.disk_waited))
        return ended

    def _give_up(self) -> MotionEnded:
        """Drop a motion that has not started; without an archive it cannot start any more."""
        refused = self._connection.refused
        reason = self._no_start or NOT_STARTED
        reason = reason if refused is None else str(refused.error)
        self._link.complete("void" if refused is None else "refused", reason)
        self._port.stop(reason)
        if refused is None:
            why = f" ({why_off})" if (why_off := self._connection.why_off) else ""
            raise ControllerError(f"{reason}{why}; nothing was sent ({self._spec.path})")
        return MotionEnded("refused", reason, -1, -1)


def archive_silence(disk_waited: float) -> str:
    """Return why a motion was stopped without heartbeats of the archive process, with a remedy.

    `disk_waited` is the longest time that it waited for its disk [s].
    """
    if disk_waited > SLOW_FLUSH_SECONDS:
        cause = f"it waited for its disk for {disk_waited:.1f} s: check that disk"
    else:
        cause = NO_TIME
    return f"{NO_ARCHIVE}, for more than {HEARTBEAT_TIMEOUT:g} s ({cause})"


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

    Args:
        restarted: whether the controller began another session.
        complete: whether the duration is over.
        ended: whether the session has ended.
        lost: how the link was lost, or "".
        stopped: whether a stop was requested.
        limited: whether a duration was requested.
        refused: last refusal, which becomes the reason of any end.
    """
    ends = (
        (restarted, "stopped", "the controller began a new session"),
        (complete, "completed", "for the requested time"),
        (ended, "completed", "the controller ended the session"),
        (bool(lost), "lost", lost),
        (stopped, "stopped" if limited else "completed", "ended by the operator"),
    )
    end = next(((outcome, reason) for true, outcome, reason in ends if true), None)
    return ("refused", str(refused.error)) if end is not None and refused is not None else end


# s without a packet after which the controller is assumed to have gone
SILENCE_TIMEOUT: Final = 1.0
MAX_LOOK_INTERVAL: Final = 0.1  # Longest time between two looks that counts as such a silence, s
# States without a session
STATES_WITHOUT_SESSION: Final = frozenset((State.SYNC, State.INIT, State.ENDED))
MIN_TARGET_CHANGE: Final = 1e-5  # rad; a target at rest does not change, but its rounding may
# s of the controller's time without motion after which the arm is at rest
REST_SECONDS: Final = 1.0
DRIVE_OFF_SECONDS: Final = 1.0
"""s with the drive off after which replies end; a session that is being ended has ended by then."""


class Standstill:
    """Detects rest of target and arm, with `period` s; unknown positions count as moving."""

    def __init__(self, period: float) -> None:
        self._cycles = round(REST_SECONDS / period)
        self._still: NDArray[np.void] | None = None

    def add(self, records: NDArray[np.void]) -> bool:
        """Return whether the arm has been at rest for `REST_SECONDS` at the end of records (k,)."""
        for record in records:
            last = self._still
            if (
                last is None
                or not record["cycle"] > last["cycle"]
                or not _close(record, last, "target_position", MIN_TARGET_CHANGE)
                or not _close(record, last, "position", MIN_ARM_MOVEMENT)
            ):
                self._still = record.copy()
        if self._still is None or not len(records):
            return False
        return int(records["cycle"][-1]) - int(self._still["cycle"]) >= self._cycles


def _close(record: NDArray[np.void], other: NDArray[np.void], name: str, bound: float) -> bool:
    return bool(np.all(np.abs(record[name] - other[name]) <= bound))
