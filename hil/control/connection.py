"""State of a controller by its events, and the limits that count with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from drivers.events import (
    ControllerDescription,
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    PacketRejected,
    Refused,
    StateChanged,
)
from drivers.exchange.event_log import EventsLost, ExchangeEvent
from drivers.guard import Guard
from drivers.init_check import is_narrower
from drivers.states import State
from hil.archive import ArchiveSpec
from hil.base.arrays import Array
from hil.base.errors import ControllerError
from hil.base.terminal_text import plural
from hil.cell import Cell
from hil.control.errors import refusal_text
from hil.control.motion_checks import MotionChecks
from hil.control.motion_refusals import Limit, LowerLimit
from hil.control.motion_watch import REFUSED

START_TIMEOUT: Final = 60.0  # s within which an accepted motion must have started
OFF_TIMEOUT: Final = 2.0  # s with the drive off after which an accepted motion is dropped
READY_STATES: Final = frozenset((State.CLOSED, State.OPENING, State.OPEN))
"""States with the drive on. A controller may open its axes at once: they are held where they are
until a motion is requested."""
_STATES_WITHOUT_DRIVE: Final = (State.SYNC, State.INIT, State.DRIVE_OFF, State.FAULTED, State.ENDED)


@dataclass(eq=False)
class Connection:
    """State of the controller since the link was opened, and of the motion requested last.

    Attributes:
        inits: init packets so far.
        unusable: why the arm cannot be moved, None if it can.
        differences: figures in which it differs from the cell.
        lost: the last loss of the link since an archive was opened.
        not_understood: number and cause of packets without a reply; "" for none.
        no_reply: the cause alone.
        refused: the last refusal since a motion was requested.
        switched_off: the last refusal since the drive was on: this PC asked for drive-off (505).
        started: whether the motion has sent anything, or may have.
        ended: the end of the motion, if its event came.
        report: receives a line for each refusal at once.
        cell: of the link, for these lines.
    """

    init: ControllerDescription | None = None
    inits: int = 0
    unusable: str | None = None
    differences: tuple[str, ...] = ()
    lost: LinkLost | None = None
    not_understood: str = ""
    no_reply: str = ""
    refused: Refused | None = None
    switched_off: Refused | None = None
    started: bool = False
    ended: MotionEnded | None = None
    report: Callable[[str], object] = str
    cell: Cell | None = None
    _rejected: int = 0

    def update(self, event: ExchangeEvent) -> None:
        """Update the state with an event."""
        match event:
            case InitReceived():
                self.init = event.init
                self.unusable = event.unusable
                self.differences = event.differences
                self.inits += 1
            case StateChanged() if event.after in READY_STATES:
                self.switched_off = None
            case Refused():
                self.refused = event
                self.switched_off = event
                self._report(event)
            case LinkLost():
                self.lost = event
            case MotionStarted() | EventsLost():
                self.started = True
            case MotionEnded():
                self.ended = event
            case PacketRejected() if event.reason:
                self._rejected += event.count
                packets = plural(self._rejected, "packet")
                self.no_reply = event.reason
                self.not_understood = f"{packets} arrived and got no reply: {event.reason}"

    def reset_motion(self) -> None:
        """Forget the last motion: another one is about to be requested."""
        self.ended = None
        self.refused = None
        self.started = False

    def require_usable(self) -> None:
        """Raise ControllerError if the controller is not the cell's."""
        if self.unusable is not None:
            remedy = "; correct the cell file, or the controller" if self.differences else ""
            raise ControllerError(f"the controller cannot be used: {self.unusable}{remedy}")

    @property
    def why_off(self) -> str:
        """Why this PC had the drive switched off since it was on last, with the remedy, or ""."""
        event = self.switched_off
        if event is None:
            return ""
        requested = "the controller for drive-off (505)"
        if self.cell is not None and self.cell.is_ur:
            requested = "the program on the controller to stop"
        return f"this PC asked {requested}: {self._sentence(event)}"

    def _sentence(self, event: Refused) -> str:
        text = str(event.error) if self.cell is None else refusal_text(self.cell, event.error)
        return f"{text}; {event.error.remedy}"

    def _report(self, event: Refused) -> None:
        self.report(f"{REFUSED}: {self._sentence(event)}")


class StartTimeout:
    """Detects that a motion accepted at `now` [s of any monotonic clock] will not start."""

    def __init__(self, now: float) -> None:
        self._requested = self._drive_on = now

    def no_start(self, state: State, now: float) -> str | None:
        """Return why a motion that has not started will not start; None while it may."""
        if state not in _STATES_WITHOUT_DRIVE:
            self._drive_on = now
        if now - self._drive_on > OFF_TIMEOUT:
            event = "a refusal came" if state is State.FAULTED else "the drive went off"
            return f"{event} before the motion began"
        if now - self._requested > START_TIMEOUT:
            return f"the motion did not begin within {START_TIMEOUT:g} s ({state.name})"
        return None


@dataclass(frozen=True)
class ControllerWords:
    """What to do at a controller that is not ready.

    Attributes:
        begin, again: to have it begin a session, and one more.
        restart: what helps if it does neither.
        no_drive: that the arm has no drive.
        drive_on: the state that it lacks then.
        switch_on: what an operator does about it.
        not_ended: why replies are still needed after a motion, and until when.
    """

    begin: str
    again: str
    restart: str
    no_drive: str
    drive_on: str
    switch_on: str
    not_ended: str

    def waiting(self, state: State, received: str) -> str:
        """Return what keeps the controller from moving, with a remedy; "" while it gets ready.

        `received` is what came from a controller without a session.
        """
        match state:
            case State.SYNC:
                return f"{received}; {self.begin}"
            case State.DRIVE_OFF | State.FAULTED:
                return f"{self.no_drive}; {self.switch_on}"
            case State.ENDED:
                return f"it has ended its session; {self.again}"
            case _:
                return ""

    def not_ready(self, state: State, waited: float, why_off: str = "") -> ControllerError:
        """Return the error of a controller that was not ready for a motion after `waited` s.

        `why_off` is why this PC had its drive switched off, or "".
        """
        after = f"within {waited:.3g} s"
        match state:
            case State.SYNC:
                problem = (
                    f"did not begin a session {after} (state SYNC): it is silent, or is still in "
                    f"a session that began before this program; {self.restart} and try again"
                )
            case State.ENDED:
                problem = f"ended the session {after} before its {self.drive_on}"
                problem += f"; {self.restart} and try again"
            case _:
                because = f": {why_off}" if why_off else ""
                problem = f"was not ready {after} (state {state.name}): {self.no_drive}{because}; "
                problem += f"{self.switch_on} and try again"
        return ControllerError(f"the controller {problem}")


C4G_WORDS: Final = ControllerWords(
    begin="start its Open program",
    again="start its Open program again",
    restart="restart the program on the controller",
    no_drive="its drive is off",
    drive_on="drive was on",
    switch_on="switch it on",
    not_ended="an axis is open; it ends when the axes are closed",
)
UR_WORDS: Final = ControllerWords(
    begin="make sure that it is on and its RTDE enabled (Settings, Security, Services)",
    again="run the same command again",
    restart="switch the controller off and on",
    no_drive="the arm is off, held by its brakes, or stopped",
    drive_on="arm ran",
    switch_on="end the stop, switch the arm on, release its brakes at the pendant (hil does not)",
    not_ended="its program on the controller is paused; both end, without moving the arm, when an "
    "operator ends the stop and resumes the program, or stops it",
)


def words_of(cell: Cell) -> ControllerWords:
    """Return the words for the controller of a cell."""
    return UR_WORDS if cell.is_ur else C4G_WORDS


def described(spec: ArchiveSpec, connection: Connection) -> ArchiveSpec:
    """Return the archive with what the controller stated of itself."""
    if connection.init is None:
        return spec
    stated = {connection.init.attachment: connection.init.encode()}
    return replace(spec, attachments={**spec.attachments, **stated})


def active_guard(cell: Cell, init: ControllerDescription | None) -> Guard:
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


def lower_limits(cell: Cell, connection: Connection, limit: Limit) -> tuple[LowerLimit, ...]:
    """Return the limits of the controller that are below the cell's.

    No model predicts the following error of a servo: motions cannot be checked against it.
    """
    if connection.init is None:
        return ()
    stated = _stated(cell, connection.init, limit)
    cell_limit = getattr(cell.drive_table, limit)
    return tuple(
        LowerLimit(cell.joint_names[joint], limit, float(stated[joint]), float(cell_limit[joint]))
        for joint in np.flatnonzero(is_narrower(stated, np.array(cell_limit)))
    )


def _stated(cell: Cell, init: ControllerDescription, limit: Limit) -> Array:
    """Return a limit of the cell's arm that its controller states (n,), NaN where it has none."""
    return init.stated(limit, cell.controller.arm, len(cell.joint_names))
