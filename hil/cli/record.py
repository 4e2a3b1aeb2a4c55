"""`hil record`: the controller's own program moves the arm, and every cycle is archived."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from rich.console import Console
from rich.status import Status

from hil.archive.live import LiveView
from hil.campaign import Progress, Stop, stop_on_interrupt
from hil.campaign.live_link import LiveLink
from hil.campaign.motion_link import Recorded
from hil.cell import Cell
from hil.cli.arguments import AcceptInitOption, JsonOption, QuietOption, print_json
from hil.errors import ControllerFault, HilError, OperatorStopError
from hil.progress import say
from hil.recording import archive_path
from hil.recording import record as record_motion
from hil.terminal_text import printable

LINE_PERIOD = 5.0
"""s between two lines where there is no terminal."""


def record(
    cell: Path,
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("runs/record"),
    duration: Annotated[float | None, typer.Option(min=0.001)] = None,
    wait: Annotated[float | None, typer.Option(min=0.0)] = None,
    kind: Literal["excitation", "validation", "standstill"] = "excitation",
    accept_init: AcceptInitOption = False,
    live: Annotated[str | None, typer.Option(metavar="HOST:PORT")] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Record while the controller's own program moves the arm. Nothing is commanded from here.

    The safest first day with a robot: every packet is answered with what the controller sent, so
    the arm does what its own program says, and each cycle is archived. `hil identify` reads the
    archives like those of a campaign: record motions that reach far and fast in every joint, some
    of them with --kind validation, and a few seconds at rest with --kind standstill.

    **Example:** `hil record cell.toml -o archives --duration 60`, then `hil identify archives/*`.

    Start it before the controller's program, so that the session's beginning is in the file.
    When the recording ends, answers go on until the arm has stood still for a second, the drive is
    off or the session has ended; Ctrl-C (a second one, where the first ended the recording) leaves
    at once.

    Exit status 0 when the recording is complete, 4 when the link or the controller failed, a packet
    was refused (the line that begins with REFUSED says why), the controller did not come within
    --wait or ended before --duration was over, 130 when Ctrl-C cut short what --duration asked for,
    or the wait for the controller.

    Options:
        cell: The cell file.
        output: The archive (*.mcap), or a folder to number it in.
        duration: Seconds to record; until Ctrl-C if left out.
        wait: Seconds to wait for the controller; for ever if left out.
        kind: What it is for: to be fitted, to be predicted, or for the noise.
        live: Let Foxglove look meanwhile, e.g. 127.0.0.1:8765.
    """
    loaded = Cell.load(cell)
    path = archive_path(output, kind)
    with (
        stop_on_interrupt(twice=True) as stop,
        LiveLink.open(
            loaded, accept_init=accept_init, live=None if live is None else LiveView.parse(live)
        ) as link,
        View(loaded, stop, quiet=quiet or json) as view,
    ):
        link.connection.say = view.warn
        view.say(f"waiting for the controller; recording to {path}. Ctrl-C ends it")
        if link.live is not None:
            view.say(link.live.invitation)
        for note in link.notes():
            view.say(f"note: {note}")
        done = record_motion(
            link, loaded, path,
            kind=kind, stop=stop, duration=duration, wait=wait, watch=view.show,
        )  # fmt: skip
    early = _early_end(path, done, duration)
    figures = _figures(path, done, loaded)
    if not json:
        _report(path, done, loaded)
    elif early is None:
        print_json(figures)
    if early is not None:
        raise early.beside(figures)


def _early_end(path: Path, done: Recorded, duration: float | None) -> HilError | None:
    """What to say of a recording that is not what was asked for."""
    if done.outcome == "completed" and (duration is None or done.seconds >= duration):
        return None
    if done.outcome == "completed":
        reached = f"after {done.seconds:.1f} s of {duration:g} s"
        return ControllerFault(f"{done.reason} {reached}; {path} is whole.")
    if done.outcome == "stopped" and done.reason == "ended by the operator":
        return OperatorStopError(f"the recording was ended early; {path} is whole.")
    return ControllerFault(f"{done.reason}; {path} is whole up to there.")


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


def _report(path: Path, done: Recorded, cell: Cell) -> None:
    losses = {"records": done.records_lost, "events": done.events_lost}
    lost = "".join(f", {count} {what} LOST" for what, count in losses.items() if count)
    say(
        f"{path}: {done.records * cell.period:.1f} s in {done.records} cycles, {done.missed} "
        f"packets missed, {done.late} answers late, {done.not_accepted} not accepted{lost}; "
        f"{done.outcome}: {done.reason}"
    )


class View:
    """A live line on a terminal, a line now and then elsewhere; a context manager."""

    def __init__(self, cell: Cell, stop: Stop, *, quiet: bool) -> None:
        self._cell, self._stop, self._quiet = cell, stop, quiet
        console = Console()
        live = not quiet and console.is_terminal
        self._status: Status | None = console.status("") if live else None
        self._over, self._next = "", 0.0

    def __enter__(self) -> View:
        if self._status is not None:
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._status is not None:
            self._status.stop()

    def say(self, text: str) -> None:
        """A line that stays."""
        if not self._quiet:
            typer.echo(printable(text))
            sys.stdout.flush()

    def warn(self, text: str) -> None:
        """A line that is said in any case."""
        say(text, err=True)

    def show(self, progress: Progress) -> None:
        """The state of the recording."""
        if progress.over != self._over:
            self._over = progress.over
            # Said in any case: who ends the program now may take the answers from a moving arm.
            say(
                f"{progress.over}; still answering until the arm rests (Ctrl-C to leave at once)",
                err=self._quiet,
            )
        line = self._line(progress)
        if self._status is not None:
            self._status.update(line)
        elif time.monotonic() >= self._next:
            self._next = time.monotonic() + LINE_PERIOD
            self.say(line)

    def _line(self, progress: Progress) -> str:
        if not progress.heard:
            table = self._cell.controller
            who = table.host if table.transport == "udp" else "the controller"
            what = f"nothing heard from {who}"
            if progress.not_understood:
                what = f"{who}: {progress.not_understood}"
            return f"{what} ({progress.foreign} packets from elsewhere)"
        parts = [
            progress.state.name.lower().replace("_", " "),
            f"{progress.cycles * self._cell.period:.1f} s",
            f"{progress.missed} missed",
            f"{progress.late} late",
        ]
        if progress.not_accepted:
            parts.append(f"{progress.not_accepted} replies not accepted")
        if progress.position is not None and np.isfinite(progress.position).all():
            angles = np.degrees(self._cell.controller_angles(progress.position))
            parts.append(" ".join(f"{angle:.2f}°" for angle in angles))
        if self._stop.requested:
            parts.append("ending")
        return "  ".join(parts)
