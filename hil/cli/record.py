"""`hil record`: record a motion of the controller's own program."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from rich.console import Console

from hil.archive.live import LiveView
from hil.archive.recorder import Recorded
from hil.base.errors import ControllerError, HilError, OperatorStopError
from hil.base.progress import put, say
from hil.base.progress_lines import LINE_PERIOD, progress_console
from hil.campaign import Progress, stop_on_interrupt
from hil.cell import AngleFrame, Cell
from hil.cli.arguments import JsonOption, QuietOption, print_json
from hil.control.live_link import LiveLink
from hil.control.record import archive_path
from hil.control.record import record as record_motion

Kind = Annotated[Literal["excitation", "validation", "standstill"], typer.Option(metavar="USE")]
LINE_EVERY = 5.0
"""Time between two lines, s."""


def record(
    cell: Path,
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("runs/record"),
    duration: Annotated[float | None, typer.Option(min=0.001)] = None,
    wait: Annotated[float | None, typer.Option(min=0.0)] = None,
    kind: Kind = "excitation",
    live: Annotated[str | None, typer.Option(metavar="HOST:PORT")] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Record while the controller's own program moves the arm. This PC commands nothing.

    Each reply repeats the set-point that the controller sent, so the arm follows its own program
    and every cycle is archived. It is the safest first test with a robot. `hil identify` reads the
    archives like those of a campaign: record fast motions over the whole range of every joint, some
    with --kind validation, and a few seconds at rest with --kind standstill.

    **Example:** `hil record cell.toml -o archives --duration 60`, then `hil identify archives/*`.

    Start it before the controller's program, so that the archive contains the start of the session.
    After the recording, replies continue until the arm has been at rest for a second, the drive is
    off or the session has ended. Ctrl-C ends the recording; a second one exits at once.

    Exit status: 0 complete; 4 the link or the controller failed, a packet was refused (see the line
    REFUSED), no controller came within --wait, or the session ended before --duration; 130 Ctrl-C
    ended the recording before --duration, or the wait for the controller.

    Options:
        cell: The cell file.
        output: The archive (*.mcap), or a folder for numbered archives.
        duration: Time to record, s. Default: until Ctrl-C.
        wait: Time to wait for the controller, s. Default: unlimited.
        kind: excitation (fitted), validation (predicted) or standstill (noise).
        live: Stream to Foxglove at this address, such as 127.0.0.1:8765.
    """
    loaded = Cell.load(cell)
    path = archive_path(output, kind)
    report = partial(say, err=True)
    with (
        stop_on_interrupt(twice=True) as stop,
        LiveLink.open(
            loaded,
            live=None if live is None else LiveView.parse(live),
            report=report,
            stop=stop,
        ) as link,
    ):
        view = View(loaded, quiet=quiet or json)
        link.connection.report = report
        view.say(f"waiting for the controller; recording to {path}. Ctrl-C to stop")
        if link.live is not None:
            view.say(link.live.notice)
        for note in link.notes():
            view.say(f"note: {note}")
        done = record_motion(
            link, loaded, path,
            kind=kind, stop=stop, duration=duration, wait=wait, watch=view.show,
        )  # fmt: skip
    early = _early_end(path, done, duration, by_operator=stop.requested)
    figures = _figures(path, done, loaded)
    if not json:
        say(_line(figures))
    elif early is None:
        print_json(figures)
    if early is not None:
        raise early.beside(figures)


def _early_end(
    path: Path, done: Recorded, duration: float | None, *, by_operator: bool
) -> HilError | None:
    """Return the error of a recording that ended early."""
    if done.outcome == "completed" and (duration is None or done.seconds >= duration):
        return None
    if done.outcome == "completed":
        reached = f"after {done.seconds:.1f} s of {duration:g} s"
        return ControllerError(f"{done.reason} {reached}; {path} is complete.")
    if done.outcome == "stopped" and by_operator:
        return OperatorStopError(f"the recording was ended early; {path} is complete.")
    return ControllerError(f"{done.reason}; {path} is complete up to there.")


def _figures(path: Path, done: Recorded, cell: Cell) -> dict[str, object]:
    return {
        "archive": str(path),
        "outcome": done.outcome,
        "reason": done.reason,
        "cycles": done.records,
        "duration": done.records * cell.period,
        "missed": done.missed,
        "late": done.late,
        "not_accepted": done.not_accepted,
        "records_lost": done.records_lost,
        "events_lost": done.events_lost,
    }


def _line(figures: Mapping[str, object]) -> str:
    return (
        "{archive}: {duration:.1f} s in {cycles} cycles, {missed} packets missed, {late} replies "
        "late, {not_accepted} not accepted, {records_lost} records and {events_lost} events lost; "
        "{outcome}: {reason}"
    ).format_map(figures)


class View:
    """Progress of a recording: a line every 5 s, and one when it is over.

    Progress is shown on a terminal: standard output, else standard error. Without one it goes to
    standard error, less often.
    """

    def __init__(self, cell: Cell, *, quiet: bool) -> None:
        self._cell = cell
        self._quiet = quiet
        console = progress_console()
        self._progress = None if quiet else console or Console(stderr=True)
        self._period = LINE_EVERY if console is not None else LINE_PERIOD
        self._over = ""
        self._next = 0.0

    def say(self, text: str) -> None:
        """Print a line, unless quiet."""
        if not self._quiet:
            say(text)

    def show(self, progress: Progress) -> None:
        """Print what has changed."""
        if progress.over != self._over:
            self._over = progress.over
            # Also when quiet: the arm still moves, and needs replies.
            how = "replying until the arm is at rest (Ctrl-C to exit at once)"
            say(f"{progress.over}; {how}", err=self._quiet)
        if self._progress is not None and time.monotonic() >= self._next:
            self._next = time.monotonic() + self._period
            put(self._progress, self._line(progress))

    def _line(self, progress: Progress) -> str:
        if progress.waiting:
            return progress.waiting
        text = (
            f"{progress.state.name.lower().replace('_', ' ')}  "
            f"{progress.cycles * self._cell.period:.1f} s  {progress.missed} missed, "
            f"{progress.late} late, {progress.not_accepted} not accepted"
        )
        if progress.position is None or not np.isfinite(progress.position).all():
            return text
        return f"{text}  {AngleFrame.pendant(self._cell).text_of_angles(progress.position)}"
