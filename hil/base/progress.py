"""Output on the terminal: single lines, and progress of long work as a bar or as lines."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from select import select
from typing import Protocol

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

from hil.base.progress_lines import PROGRESS_LINES, progress_console
from hil.base.terminal_text import printable

_MIN_BAR_COLUMNS = 8  # columns of a bar


def put(console: Console, text: str) -> None:
    """Print one line without markup, with control characters escaped; wrapped on a terminal."""
    whole = not console.is_terminal
    console.print(printable(text), markup=False, emoji=False, highlight=False, soft_wrap=whole)


def say(text: str, *, err: bool = False) -> None:
    """Print one line to standard output, or to standard error."""
    put(Console(stderr=err), text)


class Task:
    """Progress of a task: shows how much is done, and what is being done."""

    def __init__(self, show: Callable[[float, str], None]) -> None:
        self._show = show
        self._done = 0.0

    def advance(self, units: float, note: str = "") -> None:
        """Add `units` that are done; `note` is what is being done."""
        self._done += units
        self._show(self._done, note)


class Reporter(Protocol):
    """Receiver of messages and progress of long work."""

    def say(self, text: str) -> None:
        """Report a line of the result."""

    def step(self, text: str) -> None:
        """Report what is being done now: progress in words."""

    @contextmanager
    def task(self, title: str, total: float) -> Iterator[Task]:
        """Begin a task of `total` units; advance it by the yielded object."""


class Silent:
    """Reports nothing (tests, scripts)."""

    def say(self, text: str) -> None:
        """Drop the line."""

    def step(self, text: str) -> None:
        """Report the step as a line."""
        self.say(text)

    @contextmanager
    def task(self, title: str, total: float) -> Iterator[Task]:
        """Report `title`, and every tenth of the task."""
        self.say(title)
        printed = 0

        def show(done: float, note: str) -> None:
            nonlocal printed
            tenth = int(10 * done / max(total, 1e-12) + 1e-9)
            if tenth > printed:
                printed = tenth
                self.say(f"{title}: {10 * tenth} %  {note}".rstrip())

        yield Task(show)


class LineReporter(Silent):
    """One line per tenth of a task: for logs."""

    def __init__(self) -> None:
        self._out = sys.stdout

    def say(self, text: str) -> None:
        """Print the line at once."""
        self._out.write(printable(text) + "\n")
        self._out.flush()


class Messages(LineReporter):
    """Messages on standard output, progress as `PROGRESS_LINES`: without a terminal."""

    def say(self, text: str) -> None:
        """Print the line at once."""
        super().say(text)
        PROGRESS_LINES.heard()

    def step(self, text: str) -> None:
        """Begin a stage, which lasts until the next one."""
        PROGRESS_LINES.step(text)

    @contextmanager
    def task(self, title: str, total: float) -> Iterator[Task]:
        """Begin a stage of `total` units."""
        with PROGRESS_LINES.stage(title, total) as stage:

            def show(done: float, note: str) -> None:
                stage.done = done
                stage.note = note

            yield Task(show)


class Collecting:
    """Keeps the messages, for a command that shows one screen; progress is shown by another."""

    def __init__(self, progress: Reporter) -> None:
        self._progress = progress
        self.lines: list[str] = []

    def say(self, text: str) -> None:
        """Keep the line."""
        self.lines.append(text)

    def step(self, text: str) -> None:
        """Show what is being done."""
        self._progress.step(text)

    @contextmanager
    def task(self, title: str, total: float) -> Iterator[Task]:
        """Show the progress of a task."""
        with self._progress.task(title, total) as task:
            yield task


class Bar:
    """rich progress bars on a terminal; `output` receives the messages, by default it too."""

    def __init__(self, console: Console, output: Console | None = None) -> None:
        self._console = console
        self._output = output or console

    def say(self, text: str) -> None:
        """Print the line, on a terminal above the bar."""
        put(self._output, text)

    def step(self, text: str) -> None:
        """Print the line above the bar."""
        put(self._console, text)

    @contextmanager
    def task(self, title: str, total: float) -> Iterator[Task]:
        """Show a bar with the units done, the time spent and the time left."""
        whole = Column(no_wrap=True)
        progress = _WithNote(
            TextColumn("{task.description}", table_column=whole),
            BarColumn(bar_width=None, table_column=Column(ratio=1, min_width=_MIN_BAR_COLUMNS)),
            MofNCompleteColumn(table_column=whole),
            TimeElapsedColumn(table_column=whole),
            TextColumn("left", table_column=whole),
            TimeRemainingColumn(table_column=whole),
            console=self._console,
            transient=True,
            expand=True,
        )
        with progress:
            task = progress.add_task(title, total=round(total), note="")

            def show(done: float, note: str) -> None:
                progress.update(task, completed=round(done), note=printable(note, keep=""))

            yield Task(show)


class _WithNote(Progress):
    """Bars with their notes in a line of their own, for terminals of 80 columns."""

    def get_renderables(self) -> Iterable[RenderableType]:
        """Return bar and note of each task."""
        for task in self.tasks:
            yield self.make_tasks_table([task])
            yield Text(task.fields["note"], no_wrap=True, overflow="ellipsis")


def reporter(*, quiet: bool = False, messages: bool = True) -> Reporter:
    """Return a reporter, silent if `quiet`: messages on standard output, progress on a terminal.

    Without a terminal progress is plain lines on standard error. Without `messages` there is
    progress alone.
    """
    if not messages:
        return Collecting(reporter(quiet=quiet))
    if quiet:
        return Silent()
    console = progress_console()
    if console is None:
        return Messages()
    return Bar(console, Console() if console.stderr else console)


def say_at_once(text: str, descriptor: int = 1) -> None:
    """Print a line; drop it if terminal or pipe cannot accept it at once, so nothing is delayed."""
    with suppress(OSError):  # the reader has closed the pipe
        if select([], [descriptor], [], 0.0)[1]:
            os.write(descriptor, (printable(text) + "\n").encode())
