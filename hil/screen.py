"""Screen of a run: its progress, the keys of its operator, and lines without a terminal.

A thread draws it: a terminal that blocks delays neither motion nor stop.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import select
import sys
import termios
import textwrap
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final, Literal, TextIO

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from hil.campaign.dry_run import DryRun
from hil.campaign.operator import DriftCurve, MotionProgress, OperatorRequest, RunStatus, Stop
from hil.cell import Cell
from hil.progress import Silent, Task, put
from hil.terminal_text import plural, printable

Array = NDArray[np.float64]

# --- keys

STEP: Final = 0.1
"""Step of the override per key, and its least value."""
_LONGEST_TYPED: Final = 3
"""Most keys at once from an operator; of more, which are pasted, only stop and hold count."""
HELP: Final = "h hold   space resume   s stop   + - override   1…9: 10…90 %   0: 100 %"
_ACTIONS: Final[dict[str, Literal["hold", "resume", "stop"]]] = {
    **dict.fromkeys("hH\x1b", "hold"),
    **dict.fromkeys(" rR", "resume"),
    **dict.fromkeys("sSqQ", "stop"),
}
_SEQUENCES: Final = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]?|\x1bO.?", re.DOTALL)
"""Sequences of arrow and function keys; the last one may be incomplete."""
_AFTER_ESCAPE: Final = re.compile(r"\x1b([^\x1b])", re.DOTALL)
_UNFINISHED: Final = re.compile(rb"\x1b(?:\[[0-?]*[ -/]*|O)?\Z")
_SEQUENCE_WAIT: Final = 0.05
"""s to wait for the rest of a sequence; without it, it is the key Esc."""
_CHUNK: Final = 256
_LOCAL, _CONTROL, _INPUT = 3, 6, 0


def typed(chunk: str) -> str:
    """Return the keys in what a terminal sent, without sequences of arrow and function keys.

    Esc holds. With another key (as a terminal sends Alt) it is that key for stop and hold, and a
    hold for any other.
    """

    def urgent(key: str) -> bool:
        return _ACTIONS.get(key) in ("stop", "hold")

    keys = _AFTER_ESCAPE.sub(
        lambda found: found[1] if urgent(found[1]) else "\x1b", _SEQUENCES.sub("", chunk)
    )
    return keys if len(keys) <= _LONGEST_TYPED else "".join(filter(urgent, keys))


def after(request: OperatorRequest, key: str, override: float) -> OperatorRequest:
    """Return the request after a key; the `override` of the motion may be below the requested."""
    action = _ACTIONS.get(key)
    if action in ("hold", "resume"):
        return replace(request, held=action == "hold")
    if key in "+=-_":
        tenths = round((override + (STEP if key in "+=" else -STEP)) / STEP)
        return replace(request, override=min(1.0, max(STEP, tenths * STEP)))
    if key.isascii() and key.isdigit():
        return replace(request, override=(int(key) or 10) * STEP)
    return request


def can_read(stream: TextIO) -> bool:
    """Return whether single keys can be read: a terminal with this program in its foreground."""
    try:
        fd = stream.fileno()
        return os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp()
    except (OSError, ValueError):
        return False


@contextmanager
def single_keys(fd: int) -> Iterator[None]:
    r"""Read keys as they are pressed, without echo; restore the terminal at the end.

    Ctrl-C and Ctrl-\ stay signals. Ctrl-Z is disabled: a suspended program sends no heartbeat, and
    the arm would be stopped. So is Ctrl-S, which would freeze the screen.
    """
    before = termios.tcgetattr(fd)
    settings: list[Any] = [part[:] if isinstance(part, list) else part for part in before]
    settings[_LOCAL] &= ~(termios.ICANON | termios.ECHO)
    settings[_INPUT] &= ~termios.IXON
    settings[_CONTROL][termios.VMIN], settings[_CONTROL][termios.VTIME] = 1, 0
    settings[_CONTROL][termios.VSUSP] = os.fpathconf(fd, "PC_VDISABLE").to_bytes(1, "little")
    termios.tcsetattr(fd, termios.TCSADRAIN, settings)
    try:
        yield
    finally:
        with contextlib.suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(fd, termios.TCSADRAIN, before)


class Keyboard:
    """Reads keys of the terminal in a thread; `failure` is why they are no longer read, or None."""

    def __init__(self, take: Callable[[str], None]) -> None:
        self._take = take
        self.over = threading.Event()
        self.attached = False
        self.failure: Exception | None = None

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Read keys meanwhile, if standard input is a terminal."""
        if not can_read(sys.stdin):
            yield
            return
        fd = sys.stdin.fileno()
        thread = threading.Thread(target=self.read, args=(fd,), daemon=True)
        with single_keys(fd):
            self.attached = True
            thread.start()
            try:
                yield
            finally:
                self.over.set()
                thread.join()
                self.attached = False

    def read(self, fd: int) -> None:
        """Pass keys on until `over` is set, or the terminal is gone."""
        try:
            while not self.over.is_set():
                if select.select([fd], [], [], _POLL)[0]:
                    for key in typed(_chunk(fd).decode(errors="replace")):
                        self._take(key)
        except Exception as error:  # the operator is informed that keys have no effect
            self.failure, self.attached = error, False


def _chunk(fd: int) -> bytes:
    """Return what a terminal sent at once; raise EOFError if it is gone."""
    chunk = os.read(fd, _CHUNK)
    if not chunk:
        raise EOFError("the terminal is gone")
    while _UNFINISHED.search(chunk) and select.select([fd], [], [], _SEQUENCE_WAIT)[0]:
        more = os.read(fd, _CHUNK)
        if not more:
            break
        chunk += more
    return chunk


# --- the picture

STALE: Final = 1.0
"""Age of a status that is reported, s."""
SIMULATED: Final = "SIMULATED"
_TITLE: Final = 20  # Most columns of the title
_NAME: Final = 14  # Columns of a joint's name
_NUMBERS: Final = 28  # Columns of a joint's numbers, beside its name and bars
_HEIGHTS: Final = "▁▂▃▄▅▆▇█"
WARNING: Final = 0.8
"""Share of a limit from which it is coloured."""


@dataclass(frozen=True, eq=False)
class Shown:
    """State of the screen; `age` of the status and waiting time `left` in s."""

    title: str
    joint_names: tuple[str, ...]
    status: RunStatus | None = None
    request: OperatorRequest = field(default_factory=OperatorRequest)
    stopping: bool = False
    age: float = 0.0
    messages: tuple[str, ...] = ()
    keys: bool = True
    controller: str = ""
    left: str = ""


def lines(shown: Shown, width: int, height: int) -> list[Text]:
    """Return the picture, made for 80 columns and 24 lines; a smaller terminal shows a part."""
    status = shown.status
    motion = None if status is None else status.motion
    screen = [_heading(shown, width), Text("nothing moves", style="dim"), _state(shown), Text()]
    if motion is not None:
        screen[1] = _bar_of_motion(motion, width)
        troubled = motion.missed or motion.late or motion.not_accepted
        screen[3] = Text(f"cycles {motion.cycles}, {_packets(motion)}")
        screen[3].stylize("bold yellow" if troubled else "green")
        screen += [Text(), *_joints(shown.joint_names, motion, width)]
    if status is not None and status.drift is not None:
        screen += [Text(), _drift(status.drift, width)]
    notes, events = status.notes if status else (), motion.events if motion else ()
    rows = [
        row
        for line in (*shown.messages, *notes, *events)
        for row in textwrap.wrap(printable(line, keep=""), max(8, width), subsequent_indent="  ")
    ]
    room = height - len(screen) - 2
    if room > 0:
        screen += [Text(), *(Text(row, style="dim") for row in rows[-room:])]
    screen += [Text()] * (height - 1 - len(screen))
    keys = HELP if shown.keys else "Ctrl-C stops on the path"
    screen = [*screen[: height - 1], Text(keys.ljust(width), style="reverse")]
    for line in screen:
        line.truncate(width, overflow="ellipsis")
    return screen


def status_line(status: RunStatus, left: str = "") -> str:
    """Return the progress of a run in one line; `left` is the waiting time to its end."""
    parts = [_phase(status)]
    motion = status.motion
    if motion is not None:
        held = "held" if motion.held else f"override {100.0 * motion.override:.0f} %"
        parts += [_times(motion), held, _packets(motion)]
        shares = {"following error": motion.following_share, "current": motion.current_share}
        parts += [
            f"{what} {100.0 * share.max():.0f} % of its limit"
            for what, share in shares.items()
            if share is not None
        ]
    if status.drift is not None:
        parts.append(_drift_text(status.drift))
    return ", ".join([*parts, left or f"{clock(status.time_left)} left"])


def _phase(status: RunStatus) -> str:
    return f"{status.phase} {status.number} of {status.total}"


def _times(motion: MotionProgress) -> str:
    if motion.motion_time is None or not motion.duration:
        return motion.state.name.lower()
    return f"{motion.motion_time:.1f} of {motion.duration:.1f} s"


def _packets(motion: MotionProgress) -> str:
    """Return the packet counts of a motion and its reply times."""
    text = f"{motion.missed} missed, {motion.late} late, {motion.not_accepted} not accepted"
    if (latency := motion.latency) is None:
        return text
    median, p99, worst = map(duration, (latency.median, latency.p99, latency.worst))
    return f"{text}, {median}, 99 % {p99}, worst {worst}"


def _heading(shown: Shown, width: int) -> Text:
    status, title = shown.status, Text(printable(shown.title), style="bold")
    title.truncate(_TITLE, overflow="ellipsis")
    simulated = shown.controller == SIMULATED
    text = title.append(f"  {shown.controller}", "bold green" if simulated else "bold yellow")
    if status is None:
        return text.append("  beginning", "dim")
    left = shown.left or f"{clock(status.time_left)} left"
    text.append(f"  {_phase(status)}", "bold cyan")
    text.truncate(max(0, width - len(left) - 2), overflow="ellipsis")
    return text.append(left.rjust(width - text.cell_len), "bold")


def _bar_of_motion(motion: MotionProgress, width: int) -> Text:
    times = _times(motion)
    done = 0.0 if motion.motion_time is None else motion.motion_time / (motion.duration or math.inf)
    return _bar(done, width - len(times) - 1, "cyan").append(f" {times}")


def _state(shown: Shown) -> Text:
    text, motion = Text(), None if shown.status is None else shown.status.motion
    if shown.stopping or shown.request.held:
        word, hue = ("STOPPING", "red") if shown.stopping else ("HELD", "yellow")
        text.append(f" {word} ", style=f"bold {hue} reverse").append("  ")
    if shown.age > STALE and shown.status is not None:
        text.append(f"no news for {shown.age:.0f} s  ", style="bold red")
    override = shown.request.override if motion is None else motion.override
    text.append(f"override {100.0 * override:.0f} %")
    if motion is not None and motion.rate is not None:
        text.append(f", now {100.0 * motion.rate:.0f} %", style="dim")
    if motion is not None:
        text.append(f"   {motion.state.name.lower().replace('_', ' ')}", style="dim")
    return text


def _joints(names: Sequence[str], motion: MotionProgress, width: int) -> list[Text]:
    """Return a line per joint: following error and current with their shares of the limits."""
    if motion.following_error is None or motion.current is None:
        return []
    assert motion.following_share is not None
    assert motion.current_share is not None
    bars = max(1, (width - _NAME - _NUMBERS) // 2)
    titles = "".join(
        f"  {title}".ljust(14 + bars)
        for title in ("following error / threshold", "current / limit")
    )
    rows = [Text("joint".ljust(_NAME) + titles, style="bold")]
    for index, name in enumerate(names):
        line = Text(name[:_NAME].ljust(_NAME))
        for value, share in (
            (f"{np.degrees(motion.following_error[index]):8.3f}°", motion.following_share[index]),
            (f"{motion.current[index]:7.2f} A", motion.current_share[index]),
        ):
            line.append(f"{value} ").append_text(_bar(share, bars - 1, colour(share)))
            line.append(f" {100.0 * share:3.0f}%", style=colour(share))
        rows.append(line)
    return rows


def _drift(drift: DriftCurve, width: int) -> Text:
    text = Text(f"warm-up: {_drift_text(drift)}  ")
    return text.append(curve(drift.change, max(0, width - text.cell_len)), style="cyan")


def _drift_text(drift: DriftCurve) -> str:
    known = drift.change[np.isfinite(drift.change)]
    change = f"{100.0 * known[-1]:.1f} %" if len(known) else "?"
    return f"friction changed by {change} (warm below {100.0 * drift.threshold:g} %)"


def _bar(share: float, width: int, style: str) -> Text:
    """Return a bar of a share of a limit, full from 1 on."""
    filled = round(max(0, width) * float(np.clip(np.nan_to_num(share), 0.0, 1.0)))
    return Text.assemble(("█" * filled, style), ("·" * (width - filled), "dim"))


def colour(share: float) -> str:
    """Return the style of a share of a limit."""
    if share <= WARNING:
        return "green"
    return "yellow" if share <= 1.0 else "bold red"


def curve(values: Array, width: int) -> str:
    """Return the last `width` finite values as a row of blocks, from 0 to the largest of them."""
    shown = np.maximum(values[np.isfinite(values)], 0.0)[-max(1, width) :]
    step = (shown.max(initial=0.0) or 1.0) / len(_HEIGHTS)
    return "".join(_HEIGHTS[min(len(_HEIGHTS) - 1, int(value / step))] for value in shown)


def clock(seconds: float) -> str:
    """Return a time as h:mm:ss or m:ss."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def duration(seconds: float) -> str:
    """Return a latency as text."""
    if not math.isfinite(seconds):
        return "> 5 ms"
    return f"{1e3 * seconds:.1f} ms" if seconds >= 1e-3 else f"{1e6 * seconds:.0f} µs"


# --- time left

_KNOWN_AFTER: Final = 2.0
"""s of motion and of waiting after which the time left in virtual time is shown."""
_BETWEEN: Final = 0.6
"""Initial estimate of the time between two motions, s."""


class Pace:
    """Estimates the waiting time per second of motion, 1 in real time, and between motions."""

    def __init__(self, *, virtual: bool) -> None:
        self._virtual = virtual
        self._waited = self._moved = 0.0
        self._between = self._gaps = 0.0
        self._last: tuple[float, RunStatus] | None = None

    def update(self, status: RunStatus, now: float, *, held: bool) -> None:
        """Update the estimate with a status at `now` [s, monotonic clock], not during a hold."""
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
        """Leave out the time until the next status, in which the operator is asked."""
        self._last = None

    def left(self, status: RunStatus) -> float | None:
        """Return the waiting time to the end of the run [s]; None if it is not known yet."""
        changes = status.motions_left + (status.motion is None)
        between = changes * (_BETWEEN + self._between) / (1.0 + self._gaps)
        if not self._virtual:
            return status.time_left + between
        if min(self._waited, self._moved) < _KNOWN_AFTER:
            return None
        return status.time_left * self._waited / self._moved + between


# --- questions

_POLL: Final = 0.1
"""Period of polling keys and stop requests, s."""


def ask(console: Console, title: str, found: DryRun, stop: Stop) -> bool:
    """Show a dry run and ask for its acceptance: "yes", or the joints that contradict the model."""
    table = Table(title=Text(printable(f"Dry run of {title}, {clock(found.duration)} long")))
    for column in ("joint", "largest following error", "largest current", "torque and gravity"):
        table.add_column(column, justify="right" if column.startswith("largest") else "left")
    agree = {name: Text("not determined") for name in found.gravity_not_seen}
    agree |= {name: Text("contradict", style="bold red") for name in found.against_gravity}
    for name, error, share in zip(
        found.joint_names, found.following_error, found.current_share, strict=True
    ):
        current = f"{100.0 * share:.0f} % of its limit"
        weight = agree.get(name, Text("agree"))
        table.add_row(Text(printable(name)), f"{math.degrees(error):.3f}°", current, weight)
    link = f"{plural(found.missed, 'packet')} missed, {plural(found.late, 'reply')} late"
    table.caption = Text(printable(f"{link}; {', '.join(found.archives)}"))
    console.print(table)
    for warning in found.warnings:
        console.print(warning, style="bold red", markup=False, highlight=False)
    what = "the simulated arm" if found.simulated else "the arm"
    word = " ".join(found.against_gravity) or "yes"
    known = f"If you know the cause, type {word}" if found.against_gravity else "Type yes"
    question = (
        f"Did {what} move as it should, with nothing in its way at {found.override:.0%} of full "
        f"speed? {known} to accept; anything else ends the run: "
    )
    return confirmed(console, question, word, stop)


def confirmed(console: Console, question: str, word: str, stop: Stop) -> bool:
    """Ask for a word and return whether it was typed; False also after a stop request."""
    console.print(question, end="", markup=False, highlight=False)
    sys.stdout.flush()
    with contextlib.suppress(termios.error):  # discard what was typed before the question
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
    while not stop.requested:
        with contextlib.suppress(InterruptedError):
            if select.select([sys.stdin], [], [], _POLL)[0]:
                return " ".join(sys.stdin.readline().split()).lower() == word.lower()
    return False


# --- the screen

REFRESH_PERIOD: Final = 0.1  # s between two pictures
LINE_EVERY: Final = 5.0  # s between two lines where there is no terminal
FAREWELL: Final = 0.5  # s that a terminal may take for the last picture
NEWEST, REMEMBERED = 8, 200
"""Messages that are shown, and that are printed at the end."""


def controller_of(cell: Cell) -> str:
    """Return what the first line shows of the cell's own link."""
    table = cell.controller
    if cell.only_simulated:
        return SIMULATED
    if table.transport == "can" and table.can is not None:
        return f"{table.can.interface}:{table.can.channel}"
    return table.host


class ScreenError(RuntimeError):
    """The screen is no longer drawn, or its keys are no longer read."""


class Screen:
    """An `Operator` at a terminal, or a log; a `Reporter` too. A context manager.

    Args:
        joint_names: of the n joints.
        stop: set by the keys s and q.
        title: of the run.
        controller: `SIMULATED`, or the controller's address.
        virtual: whether time is virtual; the time left is that of waiting in any case.
        quiet: show nothing and read no keys.
        console: written to; standard output if left out.
    """

    def __init__(
        self,
        joint_names: Sequence[str],
        stop: Stop,
        *,
        title: str = "hil",
        controller: str = "",
        virtual: bool = False,
        quiet: bool = False,
        console: Console | None = None,
    ) -> None:
        self._console = console or Console()
        self._full = not quiet and self._console.is_terminal and not self._console.is_dumb_terminal
        self._quiet = quiet
        self._stop = stop
        self._request = OperatorRequest()
        self._shown = Shown(title, tuple(joint_names), keys=False, controller=controller)
        self._pace = Pace(virtual=virtual)
        self._came = time.monotonic()
        self._messages: deque[str] = deque(maxlen=REMEMBERED)
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
        """Return the screen of a run on a cell's own link; `title` is by default its name."""
        return cls(
            cell.joint_names,
            stop,
            title=title or cell.name,
            controller=controller_of(cell),
            virtual=cell.controller.transport == "simulated",
            quiet=quiet,
        )

    def __enter__(self) -> Screen:
        self._open()
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()
        self._print_messages_at_end()

    def show(self, status: RunStatus) -> None:
        """Show the progress of the run at once. ScreenError: the drawing thread has ended."""
        self._came = time.monotonic()
        self._pace.update(status, self._came, held=self._request.held)
        waiting = self._pace.left(status)
        left = f"{clock(status.time_left)} of motion left"
        left = left if waiting is None else f"{clock(waiting)} left"
        self._shown = replace(self._shown, status=status, left=left)
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

    def accept_dry_run(self, found: DryRun) -> bool:
        """Ask on the terminal's main page; False without a terminal."""
        if not self.can_answer:
            return False
        self._undo.close()
        self._pace.pause()
        try:
            self._print_messages_at_end()
            return not self._stuck and ask(self._console, self._shown.title, found, self._stop)
        finally:
            try:
                self._open()
            except Exception as error:  # the run continues as without a terminal
                self._undrawn = error

    def say(self, text: str) -> None:
        """Print a line at once, or after the screen has closed."""
        if not self._quiet:
            self._messages.append(text)

    @contextmanager
    def task(self, title: str, total: float) -> Iterator[Task]:
        """Begin a task; the screen shows its progress already."""
        with Silent().task(title, total) as task:
            yield task

    def press(self, key: str) -> None:
        """Apply a key."""
        if _ACTIONS.get(key) == "stop":
            self._stop.requested = True
            return
        motion = None if self._shown.status is None else self._shown.status.motion
        with self._changing:
            override = self._request.override
            if motion is not None:
                override = min(override, motion.override)
            self._request = after(self._request, key, override)

    def shown(self) -> Shown:
        """Return the present state of the screen."""
        return replace(
            self._shown,
            request=self._request,
            stopping=self._stop.requested,
            age=time.monotonic() - self._came,
            messages=tuple(self._messages)[-NEWEST:],
            keys=self._keyboard is not None and self._keyboard.attached,
        )

    def _leave_dry_run(self, status: RunStatus) -> None:
        """Reset the override after the dry run; a hold remains."""
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
        display, end = self._print_line, self._print_messages
        if self._full:
            self._keyboard = Keyboard(self.press)
            self._undo.enter_context(self._keyboard.reading())
            # The alternate page of the terminal: the shell's lines reappear at the end.
            live = Live(console=self._console, screen=True, auto_refresh=False)
            live.start()
            display, end = partial(self._draw_page, live), live.stop

        def draw() -> None:
            try:
                while not over.wait(REFRESH_PERIOD):
                    display(self.shown())
            except Exception as error:  # reported by `show`
                self._undrawn = error
            with contextlib.suppress(Exception):
                end()

        thread = threading.Thread(target=draw, name="screen", daemon=True)
        thread.start()

        def close() -> None:
            over.set()
            thread.join(FAREWELL)
            self._stuck = thread.is_alive()

        self._undo.callback(close)

    def _draw_page(self, live: Live, shown: Shown) -> None:
        live.update(Group(*lines(shown, *self._console.size)), refresh=True)

    def _print_line(self, shown: Shown) -> None:
        """Print new messages, and a status line every `LINE_EVERY` s and for each motion."""
        self._print_messages()
        status = shown.status
        if status is None or shown.age > LINE_EVERY:
            return
        at = (status.phase, status.number)
        if at != self._line_of or time.monotonic() >= self._line_due:
            self._line_of, self._line_due = at, time.monotonic() + LINE_EVERY
            put(self._console, status_line(status, shown.left))

    def _print_messages(self) -> None:
        while self._messages:
            put(self._console, self._messages.popleft())

    def _print_messages_at_end(self) -> None:
        """Print the messages on the main page, unless the terminal blocks."""
        while self._full and self._messages and not self._stuck:
            with contextlib.suppress(OSError, ValueError):
                put(self._console, self._messages.popleft())
