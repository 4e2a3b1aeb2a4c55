"""Screen of a run: its progress, questions to its operator, and lines without a terminal.

A thread draws it: a terminal that blocks delays neither motion nor stop.
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
from functools import partial
from typing import Final

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.layout import Layout
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from hil.base.progress import Silent, Task, put
from hil.base.progress_lines import LINE_PERIOD, STATUS_LINE_PERIOD, progress_console
from hil.base.terminal_text import plural, printable
from hil.campaign.dry_run_record import DryRunRecord
from hil.campaign.operator import RunStatus
from hil.campaign.operator_keys import ACTIONS, HELP, KEY_POLL_PERIOD, Keyboard, after, can_read
from hil.campaign.record_messages import gravity_lines
from hil.cell import Cell
from hil.control.motion_watch import REFUSED, MotionProgress, OperatorRequest, Stop
from identification.text import percentage

# --- the picture

STALE_AFTER_SECONDS: Final = 1.0
"""Age of a status that is reported, s."""
SIMULATED: Final = "SIMULATED"
WARNING_SHARE: Final = 0.8
"""Share of a limit from which it is coloured."""


def status_line(status: RunStatus) -> str:
    """Return the progress of a run in one line."""
    parts = [f"{status.phase} {status.number} of {status.total}"]
    motion = status.motion
    if motion is not None:
        held = "held" if motion.held else f"override {percentage(motion.override)}"
        parts += [_times(motion), held, _packets(motion)]
        shares = {"following error": motion.following_share, "current": motion.current_share}
        parts += [
            f"{what} {percentage(share.max())} of its limit"
            for what, share in shares.items()
            if share is not None
        ]
    return ", ".join([*parts, f"{clock(status.time_left)} left"])


def _times(motion: MotionProgress) -> str:
    if motion.motion_time is None or not motion.duration:
        return motion.state.name.lower()
    return f"{motion.motion_time:.1f} of {motion.duration:.1f} s"


def _packets(motion: MotionProgress) -> str:
    packets = f"packets {motion.missed} missed, {motion.late_packets} late"
    return f"{packets}; replies {motion.late} late, {motion.not_accepted} not accepted"


def _motion_rows(names: Sequence[str], motion: MotionProgress) -> list[RenderableType]:
    """Return progress and packets of a motion, and a table of its joints."""
    progress = Table.grid(padding=(0, 1), expand=True)
    progress.add_column(ratio=1)
    progress.add_column(no_wrap=True)
    done = motion.motion_time or 0.0
    total = motion.duration or math.inf
    progress.add_row(ProgressBar(total, done), _times(motion))
    lost = motion.missed or motion.late_packets or motion.late or motion.not_accepted
    packets = Text(f"cycles {motion.cycles}, {_packets(motion)}", "bold yellow" if lost else "")
    if motion.position is None and motion.following_error is None:
        return [progress, packets]
    joints = Table(box=None, pad_edge=False, expand=True)
    joints.add_column("joint", no_wrap=True)
    for title in ("following error", "of its threshold", "current", "of its limit"):
        joints.add_column(title, justify="right", no_wrap=True)
    for index, name in enumerate(names):
        joints.add_row(Text(name), *_joint_cells(motion, index))
    return [progress, packets, joints]


def _joint_cells(motion: MotionProgress, joint: int) -> tuple[str | Text, ...]:
    """Return following error and current of a joint, "-" while its drive is off."""
    error = motion.following_error
    error_share = motion.following_share
    current = motion.current
    current_share = motion.current_share
    if error is None or error_share is None or current is None or current_share is None:
        return ("-",) * 4
    return (
        f"{np.degrees(error[joint]):.3f}°",
        _share(error_share[joint]),
        f"{current[joint]:.2f} A",
        _share(current_share[joint]),
    )


def _share(share: float) -> Text:
    colour = "bold red" if share > 1.0 else "yellow" if share > WARNING_SHARE else "green"
    return Text(percentage(share), style=colour)


def clock(seconds: float) -> str:
    """Return a time as h:mm:ss or m:ss."""
    minutes, second = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{second:02d}" if hours else f"{minutes}:{second:02d}"


# --- questions


def ask(console: Console, title: str, dry_run: DryRunRecord, stop: Stop) -> bool:
    """Show a dry run and ask for its acceptance: "yes", or the joints that contradict the model.

    Args:
        console: of the terminal.
        title: of the campaign.
        dry_run: that was done.
        stop: request of the operator.
    """
    table = Table(title=Text(printable(f"Dry run of {title}, {clock(dry_run.duration)} long")))
    for column in ("joint", "largest following error", "largest current", "torque and gravity"):
        table.add_column(column, justify="right" if column.startswith("largest") else "left")
    agree = {name: Text("not determined") for name in dry_run.gravity_not_seen}
    agree |= {name: Text("contradict", style="bold red") for name in dry_run.against_gravity}
    for name, error, share in zip(
        dry_run.joint_names, dry_run.following_error, dry_run.current_share, strict=True
    ):
        current = f"{100.0 * share:.0f} % of its limit"
        weight = agree.get(name, Text("agree"))
        table.add_row(Text(printable(name)), f"{math.degrees(error):.3f}°", current, weight)
    link = f"{plural(dry_run.missed, 'packet')} missed, {plural(dry_run.late, 'reply')} late"
    table.caption = Text(printable(f"{link}; {', '.join(dry_run.archives)}"))
    console.print(table)
    for warning in gravity_lines(dry_run):
        console.print(warning, style="bold red", markup=False, highlight=False)
    what = "the simulated arm" if dry_run.simulated else "the arm"
    word = " ".join(dry_run.against_gravity) or "yes"
    instruction = f"If you know the cause, type {word}" if dry_run.against_gravity else "Type yes"
    question = (
        f"Did {what} move as it should, with nothing in its way at {percentage(dry_run.override)} "
        f"of full speed? {instruction} to accept; anything else ends the run: "
    )
    return confirmed(console, question, word, stop)


def confirmed(console: Console, question: str, word: str, stop: Stop) -> bool:
    """Ask for a word and return whether it was typed; False also after a stop request.

    Args:
        console: of the terminal.
        question: that is shown.
        word: to be typed.
        stop: request of the operator.
    """
    console.print(question, end="", markup=False, highlight=False)
    sys.stdout.flush()
    with contextlib.suppress(termios.error):  # discard what was typed before the question
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
    while not stop.requested:
        with contextlib.suppress(InterruptedError):
            if select.select([sys.stdin], [], [], KEY_POLL_PERIOD)[0]:
                return " ".join(sys.stdin.readline().split()).lower() == word.lower()
    return False


# --- the screen

REFRESH_PERIOD: Final = 0.1  # s between two pictures
LAST_PICTURE_TIMEOUT: Final = 0.5  # s that a terminal may take for the last picture
SHOWN_MESSAGES = 5
MAX_STORED_MESSAGES = 200
"""Messages that are shown, and that are printed at the end."""


class ScreenError(RuntimeError):
    """The screen is no longer drawn, or its keys are no longer read."""


class Screen:
    """An `Operator` at a terminal, or a log; a `Reporter` too. A context manager.

    Args:
        joint_names: of the n joints.
        stop: set by the keys s and q.
        title: of the run.
        controller: `SIMULATED`, or the controller's address.
        quiet: show nothing and read no keys.
        console: written to; standard output if left out. If that is no terminal, status lines
            go to standard error, less often if that is none either.
    """

    def __init__(
        self,
        joint_names: Sequence[str],
        stop: Stop,
        *,
        title: str = "hil",
        controller: str = "",
        quiet: bool = False,
        console: Console | None = None,
    ) -> None:
        self._console = console or Console()
        log = console or progress_console()
        self._sparse = log is None
        self._log = log or Console(stderr=True)
        self._full = not quiet and self._console.is_terminal and not self._console.is_dumb_terminal
        self._quiet = quiet
        self._stop = stop
        self._request = OperatorRequest()
        self._title = title
        self._controller = controller
        self._names = tuple(joint_names)
        self._status: RunStatus | None = None
        self._came = time.monotonic()
        self._messages: deque[str] = deque(maxlen=MAX_STORED_MESSAGES)
        self._news = ""  # said since the last status
        self._undo = contextlib.ExitStack()
        self._stuck = False
        self._changing = threading.Lock()  # keys come in a thread of their own
        self._slow_phase = False
        self._keyboard: Keyboard | None = None
        self._undrawn: Exception | None = None
        self._line_of: tuple[str, int] | None = None
        self._line_due = 0.0

    @classmethod
    def of(cls, cell: Cell, stop: Stop, *, title: str = "", quiet: bool = False) -> Screen:
        """Return the screen of a run on a cell's own link.

        Args:
            cell: of the run.
            stop: request of the operator.
            title: by default the name of the cell.
            quiet: show no picture.
        """
        spec = cell.link_spec
        link = SIMULATED if spec is None or cell.only_simulated else spec.description
        name = title or cell.name
        return cls(cell.joint_names, stop, title=name, controller=link, quiet=quiet)

    def __enter__(self) -> Screen:
        self._open()
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()
        self._print_messages_at_end()

    def show(self, status: RunStatus) -> None:
        """Show the progress of the run at once. ScreenError: the drawing thread has ended."""
        self._came = time.monotonic()
        self._news = ""
        self._status = status
        self._leave_dry_run(status)
        if self._undrawn is not None:
            raise ScreenError(f"{type(self._undrawn).__name__}: {self._undrawn}")

    def request(self) -> OperatorRequest:
        """Return the present request. ScreenError: keys are no longer read."""
        failure = None if self._keyboard is None else self._keyboard.failure
        if failure is not None:
            raise ScreenError(f"{type(failure).__name__}: {failure}")
        return self._request

    @property
    def can_answer(self) -> bool:
        """Whether the operator can be asked at the terminal."""
        return self._full and can_read(sys.stdin)

    def accept_dry_run(self, record: DryRunRecord) -> bool:
        """Ask on the terminal's main page; False without a terminal."""
        if not self.can_answer:
            return False
        self._undo.close()
        try:
            self._print_messages_at_end()
            return not self._stuck and ask(self._console, self._title, record, self._stop)
        finally:
            try:
                self._open()
            except Exception as error:  # the run continues as without a terminal
                self._undrawn = error

    def say(self, text: str) -> None:
        """Print a line at once, or after the screen has closed."""
        self._news = text
        if not self._quiet:
            self._messages.append(text)

    def step(self, text: str) -> None:
        """Print a line; a run has no steps other than its status."""
        self.say(text)

    @contextmanager
    def task(self, title: str, total: float) -> Iterator[Task]:
        """Begin a task; the screen shows its progress already."""
        with Silent().task(title, total) as task:
            yield task

    def press(self, key: str) -> None:
        """Apply a key."""
        if ACTIONS.get(key) == "stop":
            self._stop.requested = True
            return
        with self._changing:
            self._request = after(self._request, key, self._override)
        if ACTIONS.get(key) not in ("hold", "resume"):
            # An override chosen after the dry run is for what follows.
            self._slow_phase &= self._status is not None and self._status.phase == "dry run"

    @property
    def _override(self) -> float:
        """Override of the present motion, or of the next one of its kind."""
        status = self._status
        if status is None:
            return self._request.override
        if status.motion is not None:
            return min(self._request.override, status.motion.override)
        return min(self._request.override, status.most)

    @property
    def age(self) -> float:
        """Time since the last status [s]."""
        return time.monotonic() - self._came

    def picture(self) -> Layout:
        """Return the present picture, made for 80 columns and 24 lines."""
        status = self._status
        request = self._request
        motion = None if status is None else status.motion
        top = Table.grid(padding=(0, 2), expand=True)
        top.add_column(no_wrap=True, ratio=1)
        top.add_column(no_wrap=True, justify="right")
        simulated = self._controller == SIMULATED
        title = Text(printable(self._title), style="bold")
        title.append(f"  {self._controller}", "bold green" if simulated else "bold yellow")
        left = ""
        if status is not None:
            title.append(f"  {status.phase} {status.number} of {status.total}", "bold cyan")
            left = f"{clock(status.time_left)} left"
        top.add_row(title, left)
        state = Text()
        if self._stop.requested or request.held:
            stopping = self._stop.requested
            word, colour = ("STOPPING", "red") if stopping else ("HELD", "yellow")
            state.append(f" {word} ", style=f"bold {colour} reverse").append("  ")
        if status is not None and self.age > STALE_AFTER_SECONDS:
            # What was shown last is over; a message that came since is why the run waits.
            reason = f": {self._news}" if self._news else ""
            what, style = ("motion", "bold") if motion is None else ("news", "bold red")
            state.append(printable(f"no {what} for {self.age:.0f} s{reason}  "), style=style)
            motion = None
        state.append(f"override {percentage(self._override)}")
        if motion is not None and motion.rate is not None:
            state.append(f", now {percentage(motion.rate)}")
        if motion is not None:
            state.append(f"   {motion.state.name.lower().replace('_', ' ')}", style="dim")
        rows: list[RenderableType] = [top, state]
        rows += [] if motion is None else _motion_rows(self._names, motion)
        newest = tuple(self._messages)[-SHOWN_MESSAGES:]
        rows.append(Text())
        for line in newest:
            style = "bold red" if line.startswith(REFUSED) else "dim"
            rows.append(Text(printable(line, keep=""), style=style))
        keys = self._keyboard is not None and self._keyboard.attached
        help_line = Text(HELP if keys else "Ctrl-C stops on the path", style="reverse")
        page = Layout()
        page.split_column(Layout(Group(*rows)), Layout(help_line, size=1))
        return page

    def _leave_dry_run(self, status: RunStatus) -> None:
        """Reset an override that was set in the dry run; a hold remains."""
        if status.phase == "dry run":
            self._slow_phase = True
        elif self._slow_phase and status.phase != "move":
            self._slow_phase = False
            with self._changing:
                slowed = self._request.override < 1.0
                self._request = replace(self._request, override=1.0)
            if slowed:
                self.say("the dry run has ended: the override is 100 % again")

    def _open(self) -> None:
        self._undo = contextlib.ExitStack()
        over = threading.Event()
        self._undrawn = self._keyboard = None
        if self._quiet:
            return
        display = self._print_line
        end = self._print_messages
        if self._full:
            self._keyboard = Keyboard(self.press)
            self._undo.enter_context(self._keyboard.reading())
            # The alternate page of the terminal: the shell's lines reappear at the end.
            live = Live(console=self._console, screen=True, auto_refresh=False)
            live.start()
            display = partial(self._draw_page, live)
            end = live.stop

        def draw() -> None:
            try:
                while not over.wait(REFRESH_PERIOD):
                    display()
            except Exception as error:  # reported by `show`
                self._undrawn = error
            with contextlib.suppress(Exception):
                end()

        thread = threading.Thread(target=draw, name="screen", daemon=True)
        thread.start()

        def close() -> None:
            over.set()
            thread.join(LAST_PICTURE_TIMEOUT)
            self._stuck = thread.is_alive()

        self._undo.callback(close)

    def _draw_page(self, live: Live) -> None:
        live.update(self.picture(), refresh=True)

    def _print_line(self) -> None:
        """Print new messages, and a status line now and then and for each motion.

        Without any terminal a line for each kind of motion, and every `LINE_PERIOD` s.
        """
        self._print_messages()
        status = self._status
        period = LINE_PERIOD if self._sparse else STATUS_LINE_PERIOD
        if status is None or self.age > period:
            return
        at = (status.phase, status.number)
        if self._sparse:  # ways between the others are none of their own
            at = self._line_of or at if status.phase == "move" else (status.phase, 0)
        if at != self._line_of or time.monotonic() >= self._line_due:
            self._line_of = at
            self._line_due = time.monotonic() + period
            put(self._log, status_line(status))

    def _print_messages(self) -> None:
        while self._messages:
            put(self._console, self._messages.popleft())

    def _print_messages_at_end(self) -> None:
        """Print the messages on the main page, unless the terminal blocks."""
        while self._full and self._messages and not self._stuck:
            with contextlib.suppress(OSError, ValueError):
                put(self._console, self._messages.popleft())
