"""One motion on a real link: asked for, watched, steered, and followed to its archive."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final, get_args

from drivers.errors import DriverError, RequestError
from drivers.events import MotionEnded, Outcome
from drivers.exchange import NO_ARCHIVE, WithdrawnError
from drivers.motion_source import MotionSource
from hil.archive import ArchiveSpec
from hil.archive.supervised import Closed, Failed
from hil.errors import ControllerFault

from .errors import write_error
from .motion_link import drives_in_force
from .operator import MotionWatch
from .steering import (
    NOT_BEGUN,
    PacketCounts,
    ProgressDisplay,
    Steering,
    duration_of,
    guard_in_force,
)
from .stop import Stop

if TYPE_CHECKING:
    from .live_link import LiveLink

POLL: Final = 0.02
"""s between two looks at everything while a motion runs."""
SLOW_DISK: Final = 1.0
"""s at once that a disk takes for a flush when something is wrong with it."""
REST_TIMEOUT: Final = 30.0
"""s for an arm that was asked to stop to rest, and for the archive of a motion that has ended."""


class LiveMotion:
    """One motion on a `LiveLink`.

    Whatever happens here delays no answer: the exchange is asked through shared memory.
    """

    def __init__(self, link: LiveLink, stop: Stop, watch: MotionWatch, override: float) -> None:
        self._link, self._stop, self._watch = link, stop, watch
        self._view, self._exchange = link.view, link.exchange
        self._steering = Steering(watch, override)
        self._reader = link.reader()
        self._stop_passed = False

    def run(self, source: MotionSource, spec: ArchiveSpec) -> MotionEnded:
        """See `MotionLink.run`."""
        self._wait_for_begin(source)  # no archive is opened while a hold stands
        self._link.open_archive(spec, from_now=True, until_ended=True)
        # That may have taken seconds: nothing is asked for that is no longer wanted.
        while self._wanted(source):
            self._require_same_session()
            self._view.forget_motion()
            display = self._display(source)
            self._link.heart.begin()
            try:
                self._submit(source, spec)
                return self._supervised(display, spec)
            except WithdrawnError:
                continue  # it was stopped, held or slowed meanwhile, or a new session began
            finally:
                self._link.heart.rest()
        self._link.complete("stopped", NOT_BEGUN)
        return MotionEnded("stopped", NOT_BEGUN, -1, -1)

    def _supervised(self, display: ProgressDisplay, spec: ArchiveSpec) -> MotionEnded:
        """How the motion that was asked for ended."""
        due = math.inf
        while True:
            self._look(display)
            if (idle := self._view.not_begun()) is not None:
                return self._give_up(idle)
            answer = self._link.archive.answer(POLL, self._link.job)
            if isinstance(answer, Closed):
                return self._ending(answer)
            if isinstance(answer, Failed):
                self._link.open_path = ""
                self._come_to_rest()
                raise write_error(answer)
            self._raise_failure()
            if self._view.motion_ended or self._view.failure() is not None:
                due = min(due, time.monotonic() + REST_TIMEOUT)
            if time.monotonic() > due:
                what = f"{spec.path} was not completed within {REST_TIMEOUT:g} s"
                raise ControllerFault(f"the motion is over, but {what}")

    def _wanted(self, source: MotionSource) -> bool:
        """Whether the motion is still to begin; waits while it is held."""
        try:
            return self._wait_for_begin(source)
        except ControllerFault as error:
            self._link.complete("void", str(error))
            raise

    def _wait_for_begin(self, source: MotionSource) -> bool:
        """See `Steering.begin`; what the exchange says meanwhile is not lost."""
        begins = self._steering.begin(source, self._stop, self._view.look)
        self._view.look()
        return begins

    def _still_wanted(self) -> bool:
        """Whether it may begin the next moment, as it was handed over."""
        self._link.heart.turn()
        self._view.look()
        same_session = self._view.inits == self._link.inits
        return same_session and self._steering.unchanged(self._stop)

    def _require_same_session(self) -> None:
        """A controller that began anew may announce limits that no motion was checked against."""
        self._view.look()
        if self._view.inits > self._link.inits:
            why = "the controller began a new session since it was connected"
            self._link.complete("void", why)
            raise ControllerFault(
                f"{why}; nothing was sent, run again: its limits are checked anew"
            )

    def _submit(self, source: MotionSource, spec: ArchiveSpec) -> None:
        try:
            self._exchange.submit(source, self._still_wanted)
        except WithdrawnError:
            raise
        except RequestError as error:
            self._link.complete("refused", str(error))
            why = self._link.heart.explained(str(error))
            raise ControllerFault(f"{why}; {spec.path} says so") from error
        except DriverError as error:
            self._raise_failure()
            self._exchange.stop()
            self._view.look()
            why = self._view.failure() or str(error)
            closed = self._link.complete("void", why)
            raise ControllerFault(f"{why}; {spec.path} is {closed.outcome}") from error

    def _look(self, display: ProgressDisplay) -> None:
        """Take in what is new, pass requests on, and show it if that is due."""
        self._link.heart.turn()
        display.note(self._view.look())
        if self._stop.requested and not self._stop_passed:
            self._exchange.stop()
            self._stop_passed = True
        if not self._view.motion_ended:
            self._steering.follow(self._exchange, display.messages)
        if display.due:
            display.take(self._reader.drain())
            status = self._view.status
            display.show(self._watch, status.state, self._counts(), status.motion_time, status.rate)

    def _display(self, source: MotionSource) -> ProgressDisplay:
        connection, cell = self._link.connection, self._link.cell
        drives = drives_in_force(cell, connection)
        guard = guard_in_force(cell, drives, connection.init)
        self._reader.drain()
        return ProgressDisplay(drives, guard, self._steering, duration_of(source), self._counts())

    def _counts(self) -> PacketCounts:
        status = self._view.status
        return PacketCounts(
            status.answered,
            status.missed,
            status.late,
            status.unanswered,
            status.latencies,
            1e-6 * status.worst_turnaround_us,
        )

    def _ending(self, closed: Closed) -> MotionEnded:
        self._link.count(closed)
        self._view.look()
        if self._view.ended is not None:
            ended = self._view.ended
            return replace(ended, reason=self._explained(ended.reason, closed))
        if closed.outcome in get_args(Outcome) and self._view.motion_ended:
            outcome: Outcome = closed.outcome  # type: ignore[assignment]
            reason = self._explained(closed.reason, closed)
            return MotionEnded(outcome, reason, closed.interval, -1)
        failure = self._view.failure() or closed.reason
        alone = "the controller gets no answers and acts by its own watch"
        raise ControllerFault(f"{failure}; {alone}; the archive ({closed.outcome}) is whole so far")

    def _explained(self, reason: str, closed: Closed) -> str:
        """Why a motion ended, with the cause where a process of ours did not get on."""
        if reason == NO_ARCHIVE and closed.disk_waited > SLOW_DISK:
            waited = f"it waited for its disk for {closed.disk_waited:.1f} s"
            return f"{reason} ({waited}: look after that disk)"
        return self._link.heart.explained(reason)

    def _give_up(self, why: str) -> MotionEnded:
        """A motion that has not begun is dropped; without an archive it cannot begin any more."""
        path, refused = self._link.open_path, self._view.refused
        outcome = "void" if refused is None else "refused"
        self._link.complete(outcome, why if refused is None else str(refused.error))
        self._exchange.stop()
        if refused is None:
            raise ControllerFault(f"{why}; nothing was sent ({path})")
        return MotionEnded("refused", str(refused.error), -1, -1)

    def _raise_failure(self) -> None:
        """Raise ControllerFault if the archive process is gone or hangs; the arm rests first."""
        path = self._link.open_path
        if (failure := self._link.archive_failure()) is not None:
            rests = "the arm was brought to rest"
            if not self._come_to_rest():
                state = self._view.state.name
                rests = f"the arm was asked to stop, but was not seen at rest ({state})"
            raise ControllerFault(f"{failure}; {rests}, and {path} is readable up to its last part")

    def _come_to_rest(self) -> bool:
        """Whether the motion has ended; the exchange stops it by itself, but is asked to again."""
        self._exchange.stop()
        deadline = time.monotonic() + REST_TIMEOUT
        while not self._view.motion_ended and time.monotonic() < deadline:
            if self._view.failure() is not None:
                return False
            self._link.heart.turn()
            self._view.look()
            time.sleep(POLL)
        return self._view.motion_ended
