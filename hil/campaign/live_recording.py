"""Recording the controller's own motion on a real link, and answering until the arm rests."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.exchange import RingReader
from drivers.exchange.liveness import Pulse
from drivers.states import State
from hil.archive import ArchiveSpec
from hil.archive.recorder import describe
from hil.errors import ArchiveWriteError, ControllerFault, OperatorStopError

from .errors import write_error
from .motion_link import Progress, Recorded, Watch
from .stop import Stop

if TYPE_CHECKING:
    from .live_link import LiveLink

Array = NDArray[np.float64]

POLL = 0.02
"""s between two looks at everything."""
SILENCE = 1.0
"""s without a packet after which nobody is there to be answered."""
NOBODY = frozenset((State.SYNC, State.INIT, State.ENDED))
"""States in which no session is going on."""
TARGET_MOVED = 1e-5
"""rad; a target at rest does not change at all, but its rounding may."""
ARM_MOVED = 5e-4
"""rad; more than an encoder's noise, less than any motion makes in a second."""
REST = 1.0
"""s of the controller's time without motion after which the arm is at rest."""
OFF = 1.0
"""s with the drive off after which answers end; a session that is being ended is ended by then."""


class Standstill:
    """Looks at records for the last motion of target or arm. A joint not known counts as moving.

    Args:
        period: cycle of the controller, s.
    """

    def __init__(self, period: float) -> None:
        self._cycles = round(REST / period)
        self._target: NDArray[np.float64] | None = None
        self._position: NDArray[np.float64] | None = None
        self._since = 0

    def take(self, records: NDArray[np.void]) -> bool:
        """Whether the arm has been at rest for `REST` at the end of the next records (k,)."""
        if not len(records):
            return False
        for record in records:
            target, position, cycle = record["target_position"], record["position"], record["cycle"]
            still = (
                self._target is not None
                and self._position is not None
                and cycle > self._since
                and bool(np.all(np.abs(target - self._target) <= TARGET_MOVED))
                and bool(np.all(np.abs(position - self._position) <= ARM_MOVED))
            )
            if not still:
                self._target, self._position = target.copy(), position.copy()
                self._since = int(cycle)
        return int(records["cycle"][-1]) - self._since >= self._cycles


class LiveRecording:
    """One recording on a `LiveLink`.

    The controller's own program goes on when a recording ends, for whatever reason, and what it
    does with a PC that falls silent in the middle of a motion is not known. So answers go on until
    the arm has stood still for a second, the drive is off, the session has ended or nothing is
    heard any more; or until the operator insists.
    """

    def __init__(self, link: LiveLink, stop: Stop, watch: Watch) -> None:
        self._link, self._stop, self._watch = link, stop, watch
        self._view = link.view
        self._reader: RingReader = link.reader()
        self._position: Array | None = None

    def run(self, spec: ArchiveSpec, duration: float | None, wait: float | None) -> Recorded:
        """Wait for the controller, record, and answer until the arm rests."""
        self._await_controller(wait)
        self._link.connection.require_usable(self._link.cell)
        inits = self._view.inits
        self._link.open_archive(spec, from_now=False, until_ended=False)
        self._reader = self._link.reader()
        try:
            recorded = self._record(spec, duration, inits)
        except (ArchiveWriteError, ControllerFault) as error:
            self._answer_until_rest(f"the recording failed ({error})")
            raise
        self._answer_until_rest("recording complete")
        return recorded

    def _await_controller(self, wait: float | None) -> None:
        until = None if wait is None else time.monotonic() + wait
        while self._link.connection.init is None:
            self._view.look()
            self._show(over="")
            if self._stop.requested:
                raise OperatorStopError("ended before the controller came: nothing was recorded")
            if (failure := self._view.failure()) is not None:
                raise ControllerFault(f"{failure}: nothing was recorded")
            if until is not None and time.monotonic() > until:
                status = self._view.status
                table = self._link.cell.controller
                who = table.host if table.transport == "udp" else "the controller"
                some = status.answered > 0 or self._view.not_understood
                what = "no init packet" if some else "nothing"
                also = f"; {self._view.not_understood}" if self._view.not_understood else ""
                raise ControllerFault(
                    f"{what} heard from {who} within {wait:g} s ({status.foreign} packets from "
                    f"elsewhere{also}): nothing was recorded"
                )
            time.sleep(POLL)

    def _record(self, spec: ArchiveSpec, duration: float | None, inits: int) -> Recorded:
        while True:
            ending = self._ends(duration, restarted=self._view.inits > inits)
            self._take()
            self._show(over="")
            if ending is not None:
                break
            if (failed := self._link.failed_write()) is not None:
                raise write_error(failed)
            if (failure := self._link.archive_failure()) is not None:
                raise ControllerFault(f"{failure}; {spec.path} is readable up to its last part")
        seconds = (self._view.status.cycle + 1) * self._link.cell.period
        closed = self._link.complete(*ending)
        return Recorded(
            closed.outcome,
            closed.reason,
            closed.records,
            closed.records_lost,
            seconds=seconds,
            events_lost=closed.events_lost,
            missed=closed.missed,
            late=closed.late,
            untaken=closed.untaken,
        )

    def _ends(self, duration: float | None, *, restarted: bool) -> tuple[str, str] | None:
        """Outcome and reason of a recording that is to end now, or None."""
        # The process first: what it said and how the session stood at its end is known then.
        failure = self._view.failure()
        self._view.look()
        status, period = self._view.status, self._link.cell.period
        over = (
            restarted,
            status.state is State.ENDED,
            failure,
            self._view.lost,
            self._stop.requested,
        )
        asked = duration is not None and (status.cycle + 1) * period >= duration
        if self._view.refused is not None and (asked or any(over)):
            return "refused", str(self._view.refused.error)
        if restarted:
            return "stopped", "the controller began a new session"
        if duration is not None and (status.cycle + 1) * period >= duration:
            return "completed", "as long as was asked for"
        if status.state is State.ENDED:
            return "completed", "the controller ended the session"
        if failure is not None:
            return "lost", failure
        if self._view.lost is not None:
            return "lost", describe(self._view.lost)
        if self._stop.requested:
            return ("completed" if duration is None else "stopped"), "ended by the operator"
        return None

    def _answer_until_rest(self, why: str) -> None:
        """Do nothing, for as long as the exchange should go on answering."""
        stopped, still = self._stop.requested, Standstill(self._link.cell.period)
        reader, driven, heard = self._link.reader(), time.monotonic(), 1
        pulse = Pulse(lambda: heard, longest_look=5 * POLL)
        reader.drain()
        while not (self._stop.insisted or (self._stop.requested and not stopped)):
            failure, state, now = self._view.failure(), self._view.state, time.monotonic()
            if state is not State.DRIVE_OFF:
                driven = now
            if failure is not None or state in NOBODY or now - driven > OFF:
                return
            self._view.look()
            records = reader.drain()
            if len(records):
                heard += 1
                self._position = records["position"][-1].copy()
            if still.take(records) or pulse.quiet() > SILENCE:
                return
            self._show(over=why)
            time.sleep(POLL)

    def _take(self) -> None:
        records = self._reader.drain()
        if len(records):
            self._position = records["position"][-1].copy()

    def _show(self, *, over: str) -> None:
        status = self._view.status
        self._watch(
            Progress(
                status.cycle,
                status.missed,
                status.state,
                self._position,
                late=status.late,
                untaken=status.unanswered,
                foreign=status.foreign,
                heard=status.answered > 0,
                not_understood=self._view.not_understood,
                over=over,
            )
        )
