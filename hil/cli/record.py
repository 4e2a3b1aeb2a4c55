"""`hil record`: the controller's own program moves the arm, and every cycle is archived."""

from __future__ import annotations

import json as json_format
import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from rich.console import Console
from rich.status import Status

from hil.campaign import Progress, Stop, stop_on_interrupt
from hil.campaign.live_link import LiveLink
from hil.campaign.motion_link import Recorded
from hil.cell import Cell
from hil.errors import ControllerFault, OperatorStopError
from hil.recording import archive_path
from hil.recording import record as record_motion

LINE_PERIOD = 5.0
"""s between two lines where there is no terminal."""


def record(
    cell: Annotated[Path, typer.Argument(help="The cell file.", show_default=False)],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="The archive (*.mcap), or a folder to number it in."),
    ] = Path("runs/record"),
    duration: Annotated[
        float | None,
        typer.Option(
            min=0.001, help="Seconds to record; until Ctrl-C if left out.", show_default=False
        ),
    ] = None,
    kind: Annotated[
        Literal["excitation", "validation", "standstill"],
        typer.Option(help="What it is for: to be fitted, to be predicted, or for the noise."),
    ] = "excitation",
    accept_init: Annotated[
        bool,
        typer.Option(
            "--accept-init",
            help="Use the controller's gear ratios, calibration and coupling where they differ "
            "from the cell's; the archive says so.",
        ),
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only the last line.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Record while the controller's own program moves the arm. Nothing is commanded from here.

    The safest first day with a robot: every packet is answered with what the controller sent, so
    the arm does what its own program says, and each cycle is archived. `hil identify` reads the
    archives like those of a campaign: record motions that reach far and fast in every joint, some
    of them with --kind validation, and a few seconds at rest with --kind standstill.

    **Example:** `hil record cell.toml -o archives --duration 60`, then `hil identify archives/*`.

    Start it before the controller's program, so that the session's beginning is in the file.
    Exit status 0 when the recording is complete, 4 when the link or the controller failed, 130
    when Ctrl-C cut short what --duration asked for.
    """
    loaded = Cell.load(cell)
    path = archive_path(output, kind)
    with (
        stop_on_interrupt() as stop,
        LiveLink.open(loaded, accept_init=accept_init) as link,
        View(loaded, stop, quiet=quiet or json) as view,
    ):
        view.say(f"waiting for the controller; recording to {path}. Ctrl-C ends it")
        for note in link.notes():
            view.say(f"note: {note}")
        done = record_motion(
            link, loaded, path, kind=kind, stop=stop, duration=duration, watch=view.show
        )
    _report(path, done, loaded, view.missed, json=json)
    if done.outcome == "completed":
        return
    if stop.requested:
        raise OperatorStopError(f"the recording was ended early; {path} is whole.")
    raise ControllerFault(f"{done.reason}; {path} is whole up to there.")


def _report(path: Path, done: Recorded, cell: Cell, missed: int, *, json: bool) -> None:
    seconds = done.records * cell.period
    if json:
        summary = {
            "archive": str(path),
            "outcome": done.outcome,
            "reason": done.reason,
            "cycles": done.records,
            "duration": seconds,
            "missed": missed,
            "records_lost": done.records_lost,
        }
        typer.echo(json_format.dumps(summary))
        return
    lost = f", {done.records_lost} records LOST" if done.records_lost else ""
    typer.echo(
        f"{path}: {seconds:.1f} s in {done.records} cycles, {missed} packets missed{lost}; "
        f"{done.outcome}: {done.reason}"
    )


class View:
    """A live line on a terminal, a line now and then elsewhere."""

    def __init__(self, cell: Cell, stop: Stop, *, quiet: bool) -> None:
        self.missed = 0
        self._cell, self._stop, self._quiet = cell, stop, quiet
        console = Console()
        live = not quiet and console.is_terminal
        self._status: Status | None = console.status("") if live else None
        self._next = 0.0

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
            typer.echo(text)
            sys.stdout.flush()

    def show(self, progress: Progress) -> None:
        """The state of the recording."""
        self.missed = progress.missed
        line = self._line(progress)
        if self._status is not None:
            self._status.update(line)
        elif time.monotonic() >= self._next:
            self._next = time.monotonic() + LINE_PERIOD
            self.say(line)

    def _line(self, progress: Progress) -> str:
        parts = [
            progress.state.name.lower().replace("_", " "),
            f"{progress.cycles * self._cell.period:.1f} s",
            f"{progress.missed} missed",
        ]
        if progress.position is not None and np.isfinite(progress.position).all():
            angles = np.degrees(self._cell.controller_angles(progress.position))
            parts.append(" ".join(f"{angle:.2f}°" for angle in angles))
        if self._stop.requested:
            parts.append("ending")
        return "  ".join(parts)
