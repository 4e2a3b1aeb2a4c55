"""The person at a running campaign: shown where it stands, and heard.

What is shown is drawn by a thread of its own: a terminal that takes nothing more (a connection that
broke, a pipe that is full) delays neither the motion nor a stop.
"""

from __future__ import annotations

import contextlib
import math
import select
import sys
import termios
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Final

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from hil.campaign.dry_run import DryRun
from hil.campaign.operator import OperatorRequest, RunStatus, Stop
from hil.cell import Cell
from hil.progress import Silent, Task, put
from hil.terminal_text import plural, printable

from . import layout
from .keys import Keyboard, after, can_read, stops
from .layout import SIMULATED, Shown, lines

_KNOWN_AFTER = 2.0
"""s of motion and of waiting after which the pace of virtual time is reported."""

_BETWEEN = 0.6
"""s from motion to motion, as if seen once before: drives go off and on."""


class Pace:
    """Waiting time per second of motion, and between two motions.

    Between two motions the drives go off and on, an archive is closed and a repetition judged.

    Args:
        virtual: whether the controller's time is virtual; else a second of motion takes one.
    """

    def __init__(self, *, virtual: bool) -> None:
        self._virtual = virtual
        self._waited = self._moved = 0.0
        self._between = self._gaps = 0.0
        self._last: tuple[float, RunStatus] | None = None

    def take(self, status: RunStatus, now: float, *, held: bool) -> None:
        """Learn from a status that came `now` [s, any monotonic clock]; not while it is held."""
        if self._last is not None and not held:
            came, last = self._last
            waited, moved = now - came, last.time_left - status.time_left
            between = status.motion is None or last.motion is None
            self._gaps += 0.5 * ((status.motion is None) != (last.motion is None))  # begin, end
            if between or moved == 0.0:
                self._between += waited
            elif moved > 0.0:  # another override makes what is left longer
                self._waited += waited
                self._moved += moved
                self._between += 0.0 if self._virtual else waited - moved
        self._last = (now, status)

    def pause(self) -> None:
        """What passes until the next status is a person's time."""
        self._last = None

    def left(self, status: RunStatus) -> float | None:
        """Waiting time to the end of the run [s]; None where it cannot be determined yet."""
        changes = status.motions_left + (status.motion is None)
        between = changes * (_BETWEEN + self._between) / (1.0 + self._gaps)
        if not self._virtual:
            return status.time_left + between
        if min(self._waited, self._moved) < _KNOWN_AFTER:
            return None
        return status.time_left * self._waited / self._moved + between


_LOOK: Final = 0.2


def ask(console: Console, title: str, found: DryRun, stop: Stop) -> bool:
    """Show what was measured and wait for an answer; only "yes" accepts.

    Where torques contradict the model, only the names of the joints concerned do.

    A stop asked for meanwhile is a refusal. It is looked for while nothing is typed, so that the
    heartbeat of a real link goes on and Ctrl-C needs no answer.
    """
    console.print(_table(title, found))
    what = "the simulated arm" if found.simulated else "the arm"
    word = " ".join(found.against_gravity) or "yes"
    for warning in found.warnings:
        console.print(warning, style="bold red", markup=False, highlight=False)
    known = f"If you know why, type {word}" if found.against_gravity else "Type yes"
    return confirmed(
        console,
        f"Did {what} move as it should, with nothing in its way at {found.override:.0%} of full "
        f"speed? {known} to accept; anything else ends the run: ",
        word,
        stop,
    )


def confirmed(console: Console, question: str, word: str, stop: Stop) -> bool:
    """Ask, and wait for an answer: whether it is the word. A stop asked for is a refusal."""
    console.print(question, end="", markup=False, highlight=False)
    sys.stdout.flush()
    with contextlib.suppress(termios.error):  # what was typed before the question is no answer
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
    while not stop.requested:
        with contextlib.suppress(InterruptedError):
            if select.select([sys.stdin], [], [], _LOOK)[0]:
                answer = sys.stdin.readline().split()
                return " ".join(answer).lower() == word.lower()
    return False


def _table(title: str, found: DryRun) -> Table:
    heading = f"Dry run of {title}, {layout.clock(found.duration)} long"
    table = Table(title=Text(printable(heading)))
    table.add_column("joint")
    table.add_column("largest following error", justify="right")
    table.add_column("largest current", justify="right")
    table.add_column("torque and weight")
    for name, error, share in zip(
        found.joint_names, found.following_error, found.current_share, strict=True
    ):
        degrees = f"{math.degrees(error):.3f}°"
        agree = Text("agree")
        if name in found.against_gravity:
            agree = Text("contradict", style="bold red")
        elif name in found.gravity_not_seen:
            agree = Text("not seen")
        table.add_row(Text(printable(name)), degrees, f"{100.0 * share:.0f} % of its limit", agree)
    archives = ", ".join(found.archives)
    link = f"{plural(found.missed, 'packet')} missed, {plural(found.late, 'answer')} late"
    table.caption = Text(printable(f"{link}; {archives}"))
    return table


REFRESH_PERIOD: Final = 0.1
"""s between two pictures."""
LINE_EVERY: Final = 5.0
"""s between two lines where there is no terminal."""
FAREWELL: Final = 0.5
"""s that a terminal may take for the last picture."""
NEWEST: Final = 8
"""Of the lines said meanwhile that are shown."""
REMEMBERED: Final = 200
"""Lines said meanwhile that are left on the terminal at the end."""


def far_end_of(cell: Cell) -> str:
    """What the first line says of the cell's own link."""
    table = cell.controller
    if cell.only_simulated:
        return SIMULATED
    return (
        table.host
        if table.transport != "can" or table.can is None
        else f"{table.can.interface}:{table.can.channel}"
    )


class FullScreen:
    """A terminal's other page, so that the shell's own lines come back at the end."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, screen=True, auto_refresh=False)
        self._live.start()

    def draw(self, shown: Shown) -> None:
        """Show it at the size the terminal has now."""
        width, height = self._console.size
        self._live.update(Group(*lines(shown, width, height)), refresh=True)

    def close(self) -> None:
        """Back to the shell's page."""
        self._live.stop()


class PlainLines:
    """A line now and then, and one for whatever begins.

    Args:
        console: written to.
        unsaid: lines to be printed, removed from there.
    """

    def __init__(self, console: Console, unsaid: deque[str]) -> None:
        self._console, self._unsaid = console, unsaid
        self._due = 0.0
        self._at: tuple[str, int] | None = None

    def draw(self, shown: Shown) -> None:
        """Print what is new."""
        self._catch_up()
        status = shown.status
        if status is None or shown.age > LINE_EVERY:
            return
        at = (status.phase, status.number)
        if at == self._at and time.monotonic() < self._due:
            return
        self._at, self._due = at, time.monotonic() + LINE_EVERY
        put(self._console, layout.status_line(status, shown.left))

    def close(self) -> None:
        """Print what was said last."""
        self._catch_up()

    def _catch_up(self) -> None:
        while self._unsaid:
            put(self._console, self._unsaid.popleft())


class ScreenError(RuntimeError):
    """The screen does not show anything any more, or does not hear its keys."""


class Screen:
    """An `Operator` at a terminal, or a log; a `Reporter` too. A context manager.

    Args:
        joint_names: of the n joints.
        stop: set by the keys s and q.
        title: of the run.
        far_end: what is moved, for the first line: `SIMULATED`, or the controller's address.
        virtual: whether the controller's time is; the time left is that of waiting all the same.
        quiet: show nothing; keys are not read either.
        console: written to; standard output if left out.
    """

    def __init__(
        self,
        joint_names: Sequence[str],
        stop: Stop,
        *,
        title: str = "hil",
        far_end: str = "",
        virtual: bool = False,
        quiet: bool = False,
        console: Console | None = None,
    ) -> None:
        self._console = console or Console()
        self._full = not quiet and self._console.is_terminal and not self._console.is_dumb_terminal
        self._quiet = quiet
        self._stop = stop
        self._request = OperatorRequest()
        self._shown = Shown(title, tuple(joint_names), keys=False, far_end=far_end)
        self._pace = Pace(virtual=virtual)
        self._came = time.monotonic()
        self._said: deque[str] = deque(maxlen=REMEMBERED)
        self._undo = contextlib.ExitStack()
        self._stuck = False
        self._changing = threading.Lock()  # keys come in a thread of their own
        self._slow_phase = False
        self._keyboard: Keyboard | None = None
        self._undrawn: Exception | None = None

    @classmethod
    def of(cls, cell: Cell, stop: Stop, *, title: str = "", quiet: bool = False) -> Screen:
        """The screen of a run on a cell's own link; `title` is the cell's name if left out."""
        return cls(
            cell.joint_names,
            stop,
            title=title or cell.name,
            far_end=far_end_of(cell),
            virtual=cell.controller.transport == "simulated",
            quiet=quiet,
        )

    def __enter__(self) -> Screen:
        self._open()
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()
        self._leave_what_was_said()

    def show(self, status: RunStatus) -> None:
        """Show where the run stands; returns at once.

        Raises:
            ScreenError: nothing is drawn any more.
        """
        self._came = time.monotonic()
        self._pace.take(status, self._came, held=self._request.held)
        self._shown = replace(self._shown, status=status, left=self._left(status))
        self._leave_dry_run(status)
        if self._undrawn is not None:
            raise ScreenError(f"{type(self._undrawn).__name__}: {self._undrawn}")

    def request(self) -> OperatorRequest:
        """What the person requests.

        Raises:
            ScreenError: keys were read, and are not any more.
        """
        keyboard = self._keyboard
        if keyboard is not None and keyboard.failure is not None:
            raise ScreenError(f"{type(keyboard.failure).__name__}: {keyboard.failure}")
        return self._request

    def _leave_dry_run(self, status: RunStatus) -> None:
        """What the dry run was slowed to is not meant for what comes after; a hold is."""
        if status.phase == "dry run":
            self._slow_phase = True
        elif self._slow_phase and status.phase != "move":
            self._slow_phase = False
            with self._changing:
                slowed = self._request.override < 1.0
                self._request = replace(self._request, override=1.0)
            if slowed:
                self.say("the dry run is over: the override is 100 % again")

    @property
    def can_answer(self) -> bool:
        """Whether somebody sits at the terminal."""
        return self._full and can_read(sys.stdin)

    def accept_dry_run(self, found: DryRun) -> bool:
        """Ask on the terminal, on the shell's own page; False where nobody can answer."""
        if not self.can_answer:
            return False
        self._undo.close()
        self._pace.pause()
        try:
            self._leave_what_was_said()
            return not self._stuck and ask(self._console, self._shown.title, found, self._stop)
        finally:
            try:
                self._open()
            except Exception as error:  # the run goes on, as without a terminal
                self._undrawn = error

    def say(self, text: str) -> None:
        """One line that stays: after the end where there is a screen meanwhile."""
        if not self._quiet:
            self._said.append(text)

    @contextmanager
    def task(self, title: str, total: float) -> Iterator[Task]:
        """A piece of work; the screen shows it already."""
        with Silent().task(title, total) as task:
            yield task

    def press(self, key: str) -> None:
        """Take a key."""
        if stops(key):
            self._stop.requested = True
            return
        motion = None if self._shown.status is None else self._shown.status.motion
        with self._changing:
            override = self._request.override
            if motion is not None:
                override = min(override, motion.override)
            self._request = after(self._request, key, override)

    def _left(self, status: RunStatus) -> str:
        waiting = self._pace.left(status)
        if waiting is None:
            return f"{layout.clock(status.time_left)} of motion left"
        return f"{layout.clock(waiting)} left"

    def _open(self) -> None:
        self._undo = contextlib.ExitStack()
        over = threading.Event()
        self._undrawn = self._keyboard = None
        if self._quiet:
            return
        if self._full:
            self._keyboard = self._undo.enter_context(Keyboard(self.press))
            display: FullScreen | PlainLines = FullScreen(self._console)
        else:
            display = PlainLines(self._console, self._said)
        thread = threading.Thread(
            target=self._draw, args=(display, over), name="screen", daemon=True
        )
        thread.start()

        def close() -> None:
            over.set()
            thread.join(FAREWELL)
            self._stuck = thread.is_alive()

        self._undo.callback(close)

    def _draw(self, display: FullScreen | PlainLines, over: threading.Event) -> None:
        try:
            while not over.wait(REFRESH_PERIOD):
                display.draw(self.shown())
        except Exception as error:  # it shows nothing more, and `show` says why; the run goes on
            self._undrawn = error
        with contextlib.suppress(Exception):
            display.close()

    def shown(self) -> Shown:
        """What is shown now."""
        keyboard = self._keyboard
        return replace(
            self._shown,
            request=self._request,
            stopping=self._stop.requested,
            age=time.monotonic() - self._came,
            said=tuple(list(self._said)[-NEWEST:]),
            keys=keyboard is not None and keyboard.attached,
        )

    def _leave_what_was_said(self) -> None:
        """Print it on the shell's page, unless the terminal takes nothing any more."""
        while self._full and self._said and not self._stuck:
            with contextlib.suppress(OSError, ValueError):
                put(self._console, self._said.popleft())
