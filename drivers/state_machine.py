"""State, interval and requested motion of a session, and the events of their changes."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from drivers.errors import AxisNotInMode, RequestError
from drivers.events import (
    AnswersLost,
    Counters,
    Event,
    GapSeen,
    HoldChanged,
    MotionEnded,
    MotionStarted,
    Outcome,
    OverrideChanged,
    StateChanged,
)
from drivers.execution import Execution
from drivers.motion_source import Array
from drivers.packets import Mode
from drivers.replies import Reading
from drivers.states import HAS_SET_POINTS, TRANSITIONS, Input, State, keeps_request

_LOSS: Final = {
    Input.SYNC: "the controller started anew",
    Input.INIT: "the controller started over",
    Input.OFF: "the drive went off",
    Input.DRIVING_ON: "the drive was switched on again",
    Input.CLOSED: "the controller closed open mode",
    Input.PARTLY_OPEN: "axes were open before the controller reported them closed",
    Input.OPEN: "axes were open before the controller reported them closed",
    Input.PAUSE: "the controller paused the exchange",
    Input.UNAVAILABLE: "the controller reports a mode that is not known here",
    Input.END: "the controller ended the session",
    Input.SILENCE: "nothing was heard from the controller",
}


_NONE: Final = "no motion was requested"

LOSS_WINDOW: Final = 100
"""Cycles over which lost answers are added up."""


class StateMachine:
    """Walks the state table and says what that does to the motion.

    Args:
        counters: where missed packets and lost answers are counted.

    Attributes:
        state: where the session stands.
        cycle: the controller's cycle, for events.
        entered_at: the cycle in which the state was entered.
        interval: index of the last interval in open mode, -1 before the first.
        in_interval: whether that interval goes on.
        entering: open mode was reached and the first set-point is still to be taken.
        execution: the motion requested, None without one.
        stop_reason: why open mode is to be left, None while it is not.
        offending: joint whose following error was reported, None where drive-off is asked for.
        events: since they were last drained.
    """

    def __init__(self, counters: Counters) -> None:
        self.counters = counters
        self.state = State.SYNC
        self.cycle = 0
        self.entered_at = 0
        self.interval = -1
        self.in_interval = False
        self.entering = False
        self.execution: Execution | None = None
        self.stop_reason: str | None = None
        self.offending: int | None = None
        self.events: list[Event] = []
        self._losses: deque[tuple[int, int]] = deque()
        self._first_interval = 0

    def request(self, execution: Execution, unusable: str | None) -> None:
        """Keep a motion for the next time in open mode.

        Raises:
            RequestError: none can be promised now.
        """
        reason = None
        if self.execution is not None:
            reason = "another motion was requested before and has not ended"
        elif self.state is State.ENDED:
            reason = "the controller ended the session; make a new one"
        elif self.state is State.FAULTED:
            reason = "the controller has to report its axes closed first"
        elif self.state is State.EXITING or self.stop_reason is not None:
            reason = "open mode is being left; wait for closed axes"
        elif unusable is not None:
            reason = unusable
        if reason is not None:
            raise RequestError(self.state.name.lower(), reason)
        self.execution = execution
        # Axes may still be open in an interval that was another motion's.
        self._first_interval = self.interval + (self.state is not State.OPEN)

    def stop(self, reason: str) -> None:
        """Leave open mode, after coming to rest; drop a motion that has not begun."""
        if self.execution is not None and not self.execution.started:
            self.end("stopped", reason)
        if self.state in (State.OPENING, State.OPEN):
            self.stop_reason = self.stop_reason or reason

    def override(self, fraction: float) -> None:
        """Run the requested motion at this fraction of its speed.

        Raises:
            RequestError: there is none, or it cannot.
        """
        execution = self.execution
        before = None if execution is None else execution.fraction
        reason = _NONE if execution is None else execution.override(fraction)
        if reason is not None:
            raise RequestError(self.state.name.lower(), reason, "change of override")
        if fraction != before:
            self.events.append(OverrideChanged(float(fraction), self.cycle))

    def hold(self) -> None:
        """Come to rest on the path and wait there; a stop where the source cannot.

        A motion not begun begins at rest.

        Raises:
            RequestError: there is none. Nothing is kept for one to come.
        """
        execution = self.execution
        if execution is None:
            raise RequestError(self.state.name.lower(), _NONE, "hold")
        if self.stop_reason is not None:
            return
        before, reason = execution.held, execution.hold(self.cycle)
        if reason is not None:
            self.stop(reason)
        elif execution.held is not before:
            self.events.append(HoldChanged(True, self.cycle))

    def resume(self) -> None:
        """Go on after a hold.

        Raises:
            RequestError: there is no motion, or it cannot.
        """
        execution = self.execution
        before = execution is not None and execution.held
        reason = _NONE if execution is None else execution.resume()
        if reason is not None:
            raise RequestError(self.state.name.lower(), reason, "resumption")
        if before:
            self.events.append(HoldChanged(False, self.cycle))

    def note_lost(self, lost: int, max_gap: int) -> None:
        """So many of our last answers did not reach the controller, or it did not take them.

        More than `max_gap` of them in `LOSS_WINDOW` cycles end a motion on its path: the target
        comes in leaps then, each of which a controller might put up with.
        """
        if not lost:
            return
        self.counters.unanswered += lost
        self.events.append(AnswersLost(lost, self.cycle))
        self._losses.append((self.cycle, lost))
        while self._losses[0][0] <= self.cycle - LOSS_WINDOW:
            self._losses.popleft()
        count = sum(number for _, number in self._losses)
        if count > max_gap and self.state is State.OPEN and self.execution:
            self.stop(f"{count} answers were lost in {LOSS_WINDOW} cycles")

    def record_gap(self, missed: int, unanswered: int, max_gap: int) -> None:
        """`missed` packets never arrived; `unanswered` above `max_gap` end a motion on its path."""
        if missed:
            self.counters.missed += missed
            self.events.append(GapSeen(missed, self.cycle))
        if unanswered > max_gap and self.state is State.OPEN and self.execution:
            self.stop(f"{unanswered} packets were missed in a row")

    def require_axes(self, reading: Reading, mode: int) -> None:
        """A motion needs every wanted axis in its mode, from its beginning to its end.

        Raises:
            AxisNotInMode: one is not.
        """
        execution = self.execution
        if execution is None or not reading.powered:
            return
        joint = reading.strayed
        if execution.started and self.state is State.OPEN and reading.input is not Input.OPEN:
            joint = int(np.argmin(reading.ready))
        if joint is not None:
            found = int(reading.modes[joint])
            raise AxisNotInMode(joint, found, Mode.CLOSED if found == mode else mode, self.cycle)

    def begin_motion(self, position: Array) -> None:
        """The first set-point of the motion is `position`, (n,) rad.

        Raises:
            SourceFailed: it cannot begin there.
        """
        assert self.execution is not None
        self.execution.begin(position, self.cycle)
        self.events.append(MotionStarted(self.interval, self.cycle))

    def take(self, what: Input, why: str = "") -> None:
        """Go to the state that follows, and end a motion that does not survive it.

        Args:
            what: happened.
            why: more exactly, in words; "" for the words that every such input has.
        """
        before, after = self.state, TRANSITIONS[self.state][what]
        if after is not before:
            self._enter(before, after)
        if what in (Input.INIT, Input.SILENCE):
            self.in_interval = False
        execution = self.execution
        if execution is None or what is Input.REFUSAL:
            return
        if not execution.started:
            # Whatever a controller does that was silent for so long, nobody waits for it now.
            if what is Input.SILENCE or not keeps_request(before, after):
                self.end("lost", why or _LOSS[what])
        elif after not in HAS_SET_POINTS:
            if execution.leaving:
                self.end(execution.outcome, execution.reason)
            else:
                self.end("lost", why or _LOSS[what])

    def _enter(self, before: State, after: State) -> None:
        self.state = after
        self.entered_at = self.cycle
        self.events.append(StateChanged(before, after, self.cycle))
        if after is State.OPEN:
            self._losses.clear()
            self.entering = True
            self.in_interval = True
            self.interval += 1
        if after not in HAS_SET_POINTS:
            self.stop_reason = None
        self.offending = None

    def forget_request(self) -> None:
        """The controller that a motion was to wait for was started over."""
        self.end("lost", _LOSS[Input.INIT])

    def end(self, outcome: Outcome, reason: str) -> None:
        """The requested motion, if there is one, is over."""
        if self.execution is None:
            return
        # A motion refused at its first set-point was in the interval without having begun.
        reached = self.in_interval and self.interval >= self._first_interval
        interval = self.interval if self.execution.started or reached else -1
        self.execution = None
        self.events.append(MotionEnded(outcome, reason, interval, self.cycle))
