"""Progress without a terminal: plain lines, so that no command is silent for long."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Final

from rich.console import Console

from hil.base.terminal_text import printable


def progress_console() -> Console | None:
    """Return the terminal that shows progress: standard output, else standard error, else None."""
    consoles = (Console(), Console(stderr=True))
    return next((console for console in consoles if console.is_terminal), None)


@dataclass(eq=False)
class _Stage:
    """A task, a step or (`is_command`) a command under way; `total` is 0 where it is unknown."""

    title: str
    total: float = 0.0
    done: float = 0.0
    note: str = ""
    began: float = field(default_factory=time.monotonic)
    is_command: bool = False
    shown: bool = False

    def line(self, now: float) -> str:
        """Return title, share, time left and what is being done."""
        share = self.done / self.total if self.total else 0.0
        took = now - self.began
        parts = [self.title]
        if share:
            parts[0] += f": {100.0 * min(share, 1.0):.0f} %"
        if share >= _MIN_SHARE_FOR_ESTIMATE and share < 1.0:
            parts.append(f"about {_clock(took / share - took)} left")
        elif self.shown:
            parts.append(f"{_clock(took)} so far")
        return ", ".join([*parts, *([self.note] if self.note else [])])


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes}:{seconds:02d} min" if minutes else f"{seconds} s"


FIRST_LINE_DELAY: Final = 1.0  # s after which a stage that is not over is named
LINE_PERIOD: Final = 30.0  # s, the longest silence during a stage
STATUS_LINE_PERIOD: Final = 5.0  # s between two lines on a moving arm, where there is no terminal
_POLL_PERIOD: Final = 0.25  # Period of looking whether a line is due, s
_MIN_SHARE_FOR_ESTIMATE: Final = 0.05  # Share of a task from which the time left is estimated


class ProgressLines:
    """Progress of this program in plain lines on standard error, where there is no terminal.

    A line when a stage begins that is not over at once, and then one every `LINE_PERIOD`.
    """

    def __init__(self) -> None:
        self._printed = time.monotonic()
        self._stages: list[_Stage] = []
        self._step: _Stage | None = None
        self._looking = False

    def heard(self) -> None:
        """Record that the program printed something else: that is no silence."""
        self._printed = time.monotonic()

    @contextmanager
    def stage(
        self, title: str, total: float = 0.0, *, is_command: bool = False
    ) -> Iterator[_Stage]:
        """Begin a stage; a command is not named when it begins."""
        stage = _Stage(title, total, is_command=is_command, shown=is_command)
        self._stages.append(stage)
        self._watch()
        try:
            yield stage
        finally:
            self._stages.remove(stage)
            if not self._stages:
                self._step = None

    def step(self, title: str) -> None:
        """Begin a stage that lasts until the next step, or the end of all other stages."""
        self._step = _Stage(title)
        self._watch()

    def look(self, now: float) -> None:
        """Print a line if one is due at `now` [s of the monotonic clock]."""
        present = [*self._stages, *([self._step] if self._step else [])]
        stages = sorted(present, key=lambda stage: stage.began)
        if not stages:
            return
        begins = not stages[-1].shown and now - stages[-1].began >= FIRST_LINE_DELAY
        silence = now - max(self._printed, stages[0].began)
        if not begins and silence < LINE_PERIOD:
            return
        self._printed = now
        # The command itself is named only where nothing else is known.
        named = [stage for stage in stages if not stage.is_command] or stages
        line = "; ".join(stage.line(now) for stage in named)
        for stage in stages:
            stage.shown = True
        sys.stderr.write(printable(line, keep="") + "\n")
        sys.stderr.flush()

    def _watch(self) -> None:
        """Begin to look, in a thread that ends with the last stage."""
        if not self._looking:
            self._looking = True
            threading.Thread(target=self._look_often, daemon=True).start()

    def _look_often(self) -> None:
        with suppress(OSError, ValueError):  # standard error is closed
            while self._stages or self._step:
                self.look(time.monotonic())
                time.sleep(_POLL_PERIOD)
        self._looking = False


PROGRESS_LINES: Final = ProgressLines()
"""Progress lines of this program: one object, as there is one standard error."""


@contextmanager
def command_lines(command: str, *, quiet: bool) -> Iterator[None]:
    """Print plain lines during a command where there is no terminal, unless `quiet`."""
    if quiet or progress_console() is not None:
        yield
        return
    PROGRESS_LINES.heard()
    with PROGRESS_LINES.stage(f"hil {command}", is_command=True):
        yield
