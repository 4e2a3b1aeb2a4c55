"""What `hil simulate` tells its operator while it runs, without ever holding the cycle up."""

from __future__ import annotations

import os
import time
from select import select
from typing import Final

from sim_fixtures import ControllerSettings, SimulatedController
from sim_fixtures.program import Phase
from sim_fixtures.tally import Tally

REFRESH: Final = 0.25
WIDTH: Final = 110

WORDS: Final = {
    Phase.START: "starting: sync and init packets",
    Phase.DRIVE_OFF: "drive off",
    Phase.DRIVING_ON: "driving on (501)",
    Phase.CLOSED: "drive on, axes closed (mode 0)",
    Phase.MOVING: "the controller's own program moves the arm (mode 0)",
    Phase.PAUSED: "pause",
    Phase.OPENING: "axes opening",
    Phase.OPEN: "all axes open: the PC moves the arm",
    Phase.CLOSING: "the PC asked for the end of open mode",
    Phase.TRIPPED: "drive lost",
    Phase.SHUTDOWN: "switching off",
    Phase.ENDING: "end of session (504)",
    Phase.ENDED: "ended",
}


_REPEATED: Final = frozenset({Phase.CLOSED, Phase.OPENING, Phase.OPEN})
"""Phases that an opening lost again and again goes through."""


class Status:
    """One line for each change of phase and, on a terminal, one that is written over.

    Where open mode is lost again and again, one line for the 2nd, 4th, 8th ... time.

    A line is written only if the terminal or pipe can take it at once; a reader that has stopped
    reading loses lines, the PC program loses nothing.

    Args:
        place: where the PC program is expected.
        settings: of the controller.
        quiet: say nothing.
        stretch: s by which a cycle may be made longer to wait for its answer.
        descriptor: file descriptor to write to.
    """

    def __init__(
        self,
        place: str,
        settings: ControllerSettings,
        *,
        quiet: bool,
        stretch: float = 0.0,
        descriptor: int = 1,
    ) -> None:
        self._stretch = stretch
        self._place = place
        self._settings = settings
        self._quiet = quiet
        self._out = descriptor
        self._terminal = not quiet and os.isatty(descriptor)
        self._began = time.monotonic()
        self._refresh_at = 0.0
        self._phase: Phase | None = None
        self._reason = ""
        self._cycles = -1

    def introduce(self, name: str) -> None:
        """Say what this is, and what it is not."""
        settings = self._settings
        self.say(
            f"{name}: a SIMULATED controller for {self._place}; nothing moves.\n"
            f"cycle {1e3 * settings.period:g} ms, mode {settings.open_mode}, "
            f"{'cold' if settings.cold_start else 'warm'} start, open mode ends after "
            f"{settings.missed_replies} missing "
            f"{'reply' if settings.missed_replies == 1 else 'replies'}, process {os.getpid()}"
            + (
                f"\ncycles are made longer by up to {self._stretch:g} s to wait for an answer; "
                "no real controller does that"
                if self._stretch
                else ""
            )
        )

    def watch(self, controller: SimulatedController, tally: Tally) -> None:
        """Show what has changed since the last cycle."""
        if self._quiet:
            return
        phase = controller.phase
        if phase is not self._phase or tally.cycles < self._cycles:
            self._phase = phase
            self._say_change(controller)
        self._cycles = tally.cycles
        if self._terminal and (now := time.monotonic()) >= self._refresh_at:
            self._refresh_at = now + REFRESH
            self._write("\r\x1b[K" + self._line(tally)[:WIDTH])

    def say(self, text: str) -> None:
        """Write a line that stays."""
        if not self._quiet:
            self._write(("\r\x1b[K" if self._terminal else "") + text + "\n")

    def clear(self) -> None:
        """Take the line that is written over away."""
        if self._terminal:
            self._write("\r\x1b[K")

    def _say_change(self, controller: SimulatedController) -> None:
        lost = controller.openings_lost
        if lost <= 1 or controller.gave_up or controller.phase not in _REPEATED:
            self.say(self._change(controller))
        elif controller.phase is Phase.CLOSED and lost.bit_count() == 1:
            self.say(
                f"{self._seconds()}  open mode was lost again, {lost} times in a row by now: "
                f"{controller.reason}"
            )

    def _seconds(self) -> str:
        return f"{time.monotonic() - self._began:8.3f} s"

    def _change(self, controller: SimulatedController) -> str:
        text = f"{self._seconds()}  {WORDS[controller.phase]}"
        if controller.phase is Phase.OPENING:
            text += f" in mode {self._settings.open_mode}"
        if controller.reason and controller.reason != self._reason:
            text += f": {controller.reason}"
        self._reason = controller.reason
        return text

    def _line(self, tally: Tally) -> str:
        if not tally.cycles:
            return f"waiting for a PC program at {self._place} (asked {tally.knocks} times)"
        return (
            f"{tally.cycles} cycles, {tally.replies} replies, {tally.missed} missed, "
            f"{tally.late} late, {tally.rejected} rejected, {tally.own_late} begun late by us"
            + (f", {tally.stretched} stretched" if self._stretch else "")
        )

    def _write(self, text: str) -> None:
        if not select([], [self._out], [], 0.0)[1]:
            return
        try:
            os.write(self._out, text.encode())
        except OSError:
            self._quiet = True  # nobody reads any more
