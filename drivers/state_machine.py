"""State, interval and requested motion of a session, with the commands of its user."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from drivers.errors import AxisNotInMode, RequestError
from drivers.events import (
    Counters,
    Event,
    GapSeen,
    HoldChanged,
    MotionEnded,
    MotionStarted,
    Outcome,
    OverrideChanged,
    RepliesLost,
    StateChanged,
)
from drivers.execution import Execution
from drivers.motion_source import Array
from drivers.packets import Mode
from drivers.replies import Reading
from drivers.states import HAS_SET_POINTS, TRANSITIONS, Input, State, keeps_request

_LOSS: Final = {
    Input.SYNC: "the controller restarted: it sent a sync packet",
    Input.INIT: "the controller restarted: it sent an init packet",
    Input.OFF: "the drive went off",
    Input.DRIVING_ON: "the drive was switched on again",
    Input.CLOSED: "the controller closed open mode",
    Input.PARTLY_OPEN: "axes were open before the controller reported them closed",
    Input.OPEN: "axes were open before the controller reported them closed",
    Input.PAUSE: "the controller paused the exchange",
    Input.UNAVAILABLE: "the controller reports an unknown mode",
    Input.END: "the controller ended the session",
    Input.SILENCE: "nothing was received from the controller",
}
"""Reason for the loss of a motion."""
_NO_MOTION: Final = "no motion was requested"
LOSS_WINDOW: Final = 100
"""Cycles over which lost replies are added up."""


class StateMachine:
    """Follows the state table and ends the motion where a transition requires it.

    Attributes:
        state: current state.
        counters: packets by what became of them.
        cycle: of the controller since its init packet, up to the packet replied to last.
        entered_at: the cycle in which the state was entered.
        interval: index of the last interval in open mode, -1 before the first.
        in_interval: whether that interval continues.
        entering: open mode was reached and the first set-point is still to be sent.
        execution: the requested motion, or None.
        stop_reason: why open mode is to be left, or None.
        offending: joint whose following error was reported, None where drive-off is requested.
    """

    def __init__(self, max_gap: int) -> None:
        self.state = State.SYNC
        self.counters = Counters()
        self.cycle = 0
        self.entered_at = 0
        self.interval = -1
        self.in_interval = False
        self.entering = False
        self.execution: Execution | None = None
        self.stop_reason: str | None = None
        self.offending: int | None = None
        self._max_gap = max_gap
        self._events: list[Event] = []
        self._losses: deque[tuple[int, int]] = deque()
        self._first_interval = 0

    @property
    def requested(self) -> bool:
        """Whether a motion was requested and has not ended."""
        return self.execution is not None

    def _accept(self, execution: Execution, unusable: str | None) -> None:
        """Store a motion for the next time in open mode; raises RequestError."""
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
            raise self._request_error(reason)
        self.execution = execution
        # Axes may still be open in the interval of an earlier motion.
        self._first_interval = self.interval + (self.state is not State.OPEN)

    def _request_error(self, reason: str, what: str = "motion") -> RequestError:
        return RequestError(self.state.name.lower(), reason, what)

    def stop(self, reason: str = "a stop was requested") -> None:
        """Bring the motion to rest on its path and leave open mode; drop one not begun yet."""
        if self.execution is not None and not self.execution.started:
            self.end("stopped", reason)
        if self.state in (State.OPENING, State.OPEN):
            self.stop_reason = self.stop_reason or reason

    def override(self, fraction: float) -> None:
        """Run the requested motion at this fraction (0..1) of its speed from now on.

        Raises:
            RequestError: there is none, it is being stopped, or its source has no override.
        """
        execution = self.execution
        before = None if execution is None else execution.fraction
        reason = _NO_MOTION if execution is None else execution.override(fraction)
        if reason is not None:
            raise self._request_error(reason, "change of override")
        if fraction != before:
            self._events.append(OverrideChanged(float(fraction), self.cycle))

    def hold(self) -> None:
        """Rest on the path until `resume`; a motion that cannot is stopped.

        A motion that has not begun will begin at rest and wait there.

        Raises:
            RequestError: there is no motion.
        """
        execution = self.execution
        if execution is None:
            raise self._request_error(_NO_MOTION, "hold")
        if self.stop_reason is not None:
            return
        before, reason = execution.held, execution.hold(self.cycle)
        if reason is not None:
            self.stop(reason)
        elif execution.held is not before:
            self._events.append(HoldChanged(True, self.cycle))

    def resume(self) -> None:
        """Continue after `hold`.

        Raises:
            RequestError: there is no motion, it is being stopped, or it cannot hold and resume.
        """
        execution = self.execution
        before = execution is not None and execution.held
        reason = _NO_MOTION if execution is None else execution.resume()
        if reason is not None:
            raise self._request_error(reason, "resumption")
        if before:
            self._events.append(HoldChanged(False, self.cycle))

    def record_lost(self, lost: int) -> None:
        """Count `lost` replies that the controller did not accept.

        Too many of them in `LOSS_WINDOW` cycles stop a motion on its path, because the controller's
        target then moves in jumps.
        """
        if not lost:
            return
        self.counters.not_accepted += lost
        self._events.append(RepliesLost(lost, self.cycle))
        self._losses.append((self.cycle, lost))
        while self._losses[0][0] <= self.cycle - LOSS_WINDOW:
            self._losses.popleft()
        count = sum(number for _, number in self._losses)
        if count > self._max_gap and self.state is State.OPEN and self.execution:
            self.stop(f"{count} replies were lost in {LOSS_WINDOW} cycles")

    def record_gap(self, missed: int, without_reply: int) -> None:
        """Count `missed` packets; too many `without_reply` ones in a row stop a motion."""
        if missed:
            self.counters.missed += missed
            self._events.append(GapSeen(missed, self.cycle))
        if without_reply > self._max_gap and self.state is State.OPEN and self.execution:
            self.stop(f"{without_reply} packets were missed in a row")

    def require_axes(self, reading: Reading, mode: int) -> None:
        """Require every wanted axis in its mode during a motion; raises AxisNotInMode."""
        execution = self.execution
        if execution is None or not reading.powered:
            return
        joint = reading.unwanted
        if execution.started and self.state is State.OPEN and reading.input is not Input.OPEN:
            joint = int(np.argmin(reading.ready))
        if joint is not None:
            found = int(reading.modes[joint])
            wanted = int(Mode.CLOSED if found == mode else mode)
            message = f"joint {joint + 1} is in mode {found}; the motion needs {wanted}"
            raise AxisNotInMode(message, self.cycle)

    def begin_motion(self, position: Array) -> None:
        """Begin the motion at its first set-point, (n,) rad; raises SourceFailed."""
        assert self.execution is not None
        self.execution.begin(position, self.cycle)
        self._events.append(MotionStarted(self.interval, self.cycle))

    def apply(self, cause: Input, reason: str = "") -> None:
        """Change to the next state, and end a motion that the transition does not allow.

        `reason` is that of the loss of the motion; "" for that of the input.
        """
        before, after = self.state, TRANSITIONS[self.state][cause]
        if after is not before:
            self._enter(before, after)
        if cause in (Input.INIT, Input.SILENCE):
            self.in_interval = False
        execution = self.execution
        if execution is None or cause is Input.REFUSAL:
            return
        if not execution.started:
            # After such a silence the request may be outdated, whatever the controller does next.
            if cause is Input.SILENCE or not keeps_request(before, after):
                self.end("lost", reason or _LOSS[cause])
        elif after not in HAS_SET_POINTS:
            if execution.leaving:
                self.end(execution.outcome, execution.reason)
            else:
                self.end("lost", reason or _LOSS[cause])

    def _enter(self, before: State, after: State) -> None:
        self.state = after
        self.entered_at = self.cycle
        self._events.append(StateChanged(before, after, self.cycle))
        if after is State.OPEN:
            self._losses.clear()
            self.entering = True
            self.in_interval = True
            self.interval += 1
        if after not in HAS_SET_POINTS:
            self.stop_reason = None
        self.offending = None

    def end(self, outcome: Outcome, reason: str) -> None:
        """End the requested motion, if there is one."""
        if self.execution is None:
            return
        # A motion refused at its first set-point was in the interval without having begun.
        reached = self.in_interval and self.interval >= self._first_interval
        interval = self.interval if self.execution.started or reached else -1
        self.execution = None
        self._events.append(MotionEnded(outcome, reason, interval, self.cycle))
