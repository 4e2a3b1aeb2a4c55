"""`hil doctor`: check whether this PC can serve a controller in real time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from hil.base.exit_status import ExitStatus
from hil.base.one_screen import brief
from hil.base.progress import reporter, say
from hil.cell import Cell
from hil.cli.arguments import JsonOption, VerboseOption, print_json
from hil.doctor.diagnosis import examine
from hil.doctor.messages import as_json, show, summary

QUICK_SECONDS = 5.0


def doctor(
    cell: Annotated[Path | None, typer.Argument()] = None,
    duration: Annotated[float, typer.Option(min=1.0, max=36000.0)] = 60.0,
    output: Path = Path("runs"),
    quick: bool = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Measure whether this PC can reply to a controller in time, and list what to change.

    Checks permissions, processor, load, route, port or CAN bus, and disk; then measures wake-up and
    turnaround latency in processes with the real-time settings of an exchange. Sends nothing to the
    controller, changes nothing and needs no root; run it as the user who will run hil. Each remedy
    is a command. Judges cycles of 1 and 2 ms, and the cycle of CELL; without CELL, 1 ms.

    Exit status: 0 fit for the cycle; 5 not fit, or the link cannot work, or measured for less than
    60 s (provisional); 2 bad input.

    Options:
        cell: Cell file, for its link and cycle.
        duration: Duration of each of the two measurements, s.
        output: Folder for archives, on the disk to test.
        quick: Measure for 5 s each; the result is provisional (exit status 5).
    """
    loaded = None if cell is None else Cell.load(cell)
    diagnosis = examine(
        None if loaded is None else loaded.link_spec,
        cycle_ms=1 if loaded is None else loaded.controller.cycle_ms,
        seconds=QUICK_SECONDS if quick else duration,
        place=output,
        reporter=reporter(quiet=json),
    )
    if json:
        print_json(as_json(diagnosis))
    elif verbose:
        show(diagnosis, Console())
    else:
        for line in brief([*summary(diagnosis), "all checks, every remedy and the criteria: -v"]):
            say(line)
    if not diagnosis.fit or diagnosis.provisional:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)
