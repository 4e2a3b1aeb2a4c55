"""State machine of the program on the simulated controller.

The program starts the link, switches the drive on, opens the axes one after the other, waits for
the end of open mode, closes the axes and opens them again. Its input is the content of one reply
per cycle.

    START -> DRIVE_OFF -> DRIVING_ON -> CLOSED -> OPENING -> OPEN -> CLOSING -+
                  ^           ^           ^                                   |
                  |           |           +-----------------------------------+
    TRIPPED (drive lost, axes still open for some cycles) -> DRIVE_OFF
    PAUSED (modes 500 or 502 for some cycles) -> CLOSED
    finish() or the last interval: CLOSED -> SHUTDOWN -> ENDING (504) -> ENDED
    a motion of the controller's own, with closed axes: CLOSED -> MOVING -> CLOSED -> SHUTDOWN
"""

from __future__ import annotations

from enum import IntEnum, auto
from math import ceil
from typing import NamedTuple

from sim_fixtures.settings import ControllerSettings, SettingError


class Phase(IntEnum):
    """State of the program; from DRIVING_ON to CLOSING the drive is on."""

    START = auto()
    DRIVE_OFF = auto()
    DRIVING_ON = auto()
    CLOSED = auto()
    MOVING = auto()
    PAUSED = auto()
    OPENING = auto()
    OPEN = auto()
    CLOSING = auto()
    TRIPPED = auto()
    SHUTDOWN = auto()
    ENDING = auto()
    ENDED = auto()


POWERED = frozenset(phase for phase in Phase if Phase.DRIVING_ON <= phase <= Phase.CLOSING)
UNBRAKED = POWERED - {Phase.DRIVING_ON}
STILL_OPEN = frozenset({Phase.CLOSING, Phase.TRIPPED})
"""Phases whose first cycles report the previous modes."""
HAS_OPEN_AXES = frozenset({Phase.OPENING, Phase.OPEN, Phase.CLOSING})
LISTENING = frozenset({Phase.OPENING, Phase.OPEN})


class StartStep(IntEnum):
    """Kind of a packet of the start."""

    SYNC = auto()
    INIT = auto()


COLD_START = (*[StartStep.SYNC] * 9, StartStep.INIT, StartStep.SYNC, StartStep.SYNC)
WARM_START = (StartStep.INIT,)


def _cycles(count: int) -> str:
    return "1 cycle" if count == 1 else f"{count} cycles"


class Answer(NamedTuple):
    """Requests in one reply of the PC.

    A `valid` reply has the right number and length; `exit` requests the end of open mode (status
    byte 1), `drive_off` is mode 505 on some axis, `following_error` mode 508.
    """

    valid: bool = False
    exit: bool = False
    drive_off: bool = False
    following_error: bool = False


MISSING = Answer()


class LoopProgram:
    """Phase of the controller, cycle by cycle.

    The program opens `wanted_axes` (n,); `open_axes` (n,) are in open mode in the packet of this
    cycle, and their targets are read from the PC while it is `listening`. `reason` is that of the
    last loss of the drive or of the end of the session. `intervals` counts the openings of all
    wanted axes, `openings_lost` consecutive ones that ended by missing replies or 508; the session
    ends because of too many of these if `gave_up`.
    """

    def __init__(self, n_axes: int, settings: ControllerSettings) -> None:
        self._settings = settings
        self._n_axes = n_axes
        only = settings.only_axis
        if only is not None and only > n_axes:
            raise SettingError("only_axis", only, f"1..{n_axes}")
        self.wanted_axes = [only in (None, axis + 1) for axis in range(n_axes)]
        self._start = COLD_START if settings.cold_start else WARM_START
        self._age = 0
        self._missed = 0
        self._missed_open = 0
        self._reopens_at = 0
        self._stays_off = False
        self._finishing = False
        self._moves = bool(settings.own_motion) and not settings.corrected
        self._own_motion_over = False
        self._gone: set[int] = set()
        self._pause_cycles = 0
        self.pause_mode = 0
        self.reason = ""
        self.intervals = 0
        self.openings_lost = 0
        self.gave_up = False
        self._enter(Phase.START)

    @property
    def start_step(self) -> StartStep:
        """Kind of the present packet in phase START."""
        return self._start[self._age]

    def finish(self) -> None:
        """End the session, at once or when open axes are at rest."""
        self._finishing = True

    def drive_on(self) -> None:
        """Press the drive-on button after the drive was lost."""
        self._stays_off = False

    def trip(self, reason: str) -> None:
        """Lose the drive now, as at a following error or an emergency stop."""
        if self.powered:
            self.reason = reason
            self.openings_lost = 0
            self._stays_off = True
            self._own_motion_over = self._own_motion_over or self.phase is Phase.MOVING
            opened = self.phase in HAS_OPEN_AXES
            self._enter(Phase.TRIPPED if opened else Phase.DRIVE_OFF)

    def axis_leaves(self, axis: int) -> None:
        """Close one axis (0-based) while the others stay open."""
        if self.phase in HAS_OPEN_AXES:
            self._gone.add(axis)
            self.open_axes[axis] = False

    def pause(self, mode: int, cycles: int) -> None:
        """Report a pause, mode 500 or 502, for some cycles if the drive is on."""
        if self.powered and self.phase is not Phase.DRIVING_ON:
            self.pause_mode, self._pause_cycles = mode, cycles
            self._enter(Phase.PAUSED)

    def restarted(self, settings: ControllerSettings) -> LoopProgram:
        """Return the program after a restart, with the drive off."""
        program = LoopProgram(self._n_axes, settings)
        program._stays_off = True
        program.reason = "the controller was restarted"
        return program

    def advance(self, answer: Answer, at_rest: bool, own_motion_done: bool = False) -> None:
        """End the cycle; `at_rest` means that the targets of all axes are at rest."""
        self._age += 1
        self._missed = 0 if answer.valid else self._missed + 1
        if self._missed >= self._settings.silence_limit and self.phase < Phase.SHUTDOWN:
            self.reason = f"no valid reply in {self._missed} cycles"
            self._enter(Phase.SHUTDOWN)
        elif self.phase is Phase.START:
            self._advance_start(answer)
        elif self.listening:
            self._advance_open(answer, at_rest)
        elif self.phase is Phase.MOVING:
            if own_motion_done:
                self._own_motion_over = True
                self._enter(Phase.CLOSED)
        else:
            self._advance_timed(at_rest)

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self.powered = phase in POWERED
        self.braked = phase not in UNBRAKED
        self.listening = phase in LISTENING
        self._age = 0
        if phase is Phase.OPENING:
            self._missed_open = 0
            self._gone.clear()
            self._open_due_axes()
        elif phase not in STILL_OPEN:
            self.open_axes = [phase is Phase.OPEN and wanted for wanted in self.wanted_axes]

    def _open_due_axes(self) -> None:
        """Open one axis after the other."""
        stagger, wanted = self._settings.opening_stagger, self.wanted_axes
        self.open_axes = [
            wanted[axis] and axis not in self._gone and self._age >= sum(wanted[:axis]) * stagger
            for axis in range(self._n_axes)
        ]

    def _close_due_axes(self) -> None:
        """Close one axis after the other."""
        settings, age = self._settings, self._age
        self.open_axes = [
            is_open and age < settings.closing_cycles + i * settings.closing_stagger
            for i, is_open in enumerate(self.open_axes)
        ]

    def _advance_start(self, answer: Answer) -> None:
        """Advance through the packets of the start; an init packet without answer ends it."""
        if self._start[self._age - 1] is StartStep.INIT and not answer.valid:
            self.reason = "the init packet was not answered"
            self._enter(Phase.ENDED)
        elif self._age == len(self._start):
            self._enter(Phase.DRIVE_OFF)

    def _advance_open(self, answer: Answer, at_rest: bool) -> None:
        """Process a reply while axes are open or opening."""
        settings = self._settings
        self._missed_open = 0 if answer.valid else self._missed_open + 1
        if answer.drive_off:
            self.openings_lost = 0
            self.reason = "the PC asked for drive off (505)"
            self._stays_off = True
            self._enter(Phase.DRIVE_OFF)
        elif answer.following_error:
            self._lose_opening("the PC reported a following error (508)")
        elif self._missed >= settings.missed_replies:
            self._miss_replies()
        elif answer.exit or (self._finishing and at_rest):
            self.openings_lost = 0
            self._enter(Phase.CLOSING)
        elif self.phase is Phase.OPENING:
            if self.open_axes == self.wanted_axes:
                self.intervals += 1
                self._enter(Phase.OPEN)
            else:
                self._open_due_axes()

    def _miss_replies(self) -> None:
        """End open mode because replies are missing."""
        reason = f"no valid reply in {_cycles(self._missed)} of open mode"
        if self._missed_open < self._missed:
            reason = (
                f"no valid reply in {_cycles(self._missed)} in a row, "
                f"the last {self._missed_open} of them in open mode"
            )
        if self._settings.while_silent == "drive_off":
            self.trip(reason)
        else:
            self._lose_opening(reason)

    def _lose_opening(self, reason: str) -> None:
        """End open mode; open again later, unless that happened too often."""
        settings = self._settings
        self.openings_lost += 1
        if settings.lost_openings is not None and self.openings_lost >= settings.lost_openings:
            self.gave_up = True
            reason = f"open mode was lost {self.openings_lost} times in a row: {reason}"
        self.reason = reason
        self._enter(Phase.CLOSED)
        self._reopens_at = ceil(settings.reopening_time / settings.period)

    def _advance_closed(self) -> None:
        """Leave phase CLOSED."""
        settings = self._settings
        limit = settings.open_intervals
        done = limit is not None and self.intervals >= limit
        if self._finishing or done or self._own_motion_over or self.gave_up:
            self._enter(Phase.SHUTDOWN)
        elif self._age >= self._reopens_at:
            self._reopens_at = 0
            self._enter(Phase.MOVING if self._moves else Phase.OPENING)

    def _advance_timed(self, at_rest: bool) -> None:
        """Leave the phases that last a number of cycles."""
        settings = self._settings
        phase, age = self.phase, self._age
        if phase is Phase.DRIVE_OFF and age >= settings.drive_off_cycles:
            if self._finishing or self.gave_up:
                self._enter(Phase.ENDING)
            elif not self._stays_off:
                self._enter(Phase.DRIVING_ON)
        elif phase is Phase.DRIVING_ON and age >= settings.driving_on_cycles:
            self._enter(Phase.CLOSED)
        elif phase is Phase.CLOSED and age >= settings.closed_cycles and at_rest:
            self._advance_closed()
        elif phase is Phase.PAUSED and age >= self._pause_cycles:
            self._enter(Phase.CLOSED)
        elif phase is Phase.CLOSING:
            self._close_due_axes()
            if not any(self.open_axes):
                self._enter(Phase.CLOSED)
        elif phase is Phase.TRIPPED and age >= settings.closing_cycles:
            self._enter(Phase.DRIVE_OFF)
        elif phase is Phase.SHUTDOWN and age >= settings.drive_off_cycles:
            self._enter(Phase.ENDING)
        elif phase is Phase.ENDING:
            self._enter(Phase.ENDED)
