"""`hil doctor`: what this PC can do, and what to change."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from hil.cli.arguments import JsonOption, print_json
from hil.cli.verdict import NOT_GOOD
from hil.doctor.diagnosis import as_json, examine, show
from hil.doctor.link import controller_in
from hil.progress import reporter

QUICK_SECONDS = 5.0


def doctor(
    cell: Annotated[Path | None, typer.Argument()] = None,
    duration: Annotated[float, typer.Option(min=1.0, max=36000.0)] = 60.0,
    output: Path = Path("runs"),
    quick: bool = False,
    json: JsonOption = False,
) -> None:
    """Measure whether this PC can answer a controller every 1 or 2 ms, and say what to change.

    Looks at permissions, processor, kernel, network card, route, port or CAN bus, and disk; then
    measures wake-up and turnaround latency in processes with the real-time settings of the
    exchange. Sends nothing to the controller, changes nothing, needs no root; run it as the user
    who will run hil. Every remedy is a command to type. Without CELL the cycle is 1 ms; of
    a CELL only [controller] has to be filled in.

    Exit status: 0 fit for the cell's cycle; 5 not fit, or the link cannot work, or measured for
    less than 60 s, so that the verdict is provisional; 2 bad input.

    Options:
        cell: Cell file: its link is looked at, and its cycle has to be fit.
        duration: Seconds of each of the two measurements.
        output: Where archives will be written; its disk is tried.
        quick: 5 s of each; the verdict is provisional (exit 5).
    """
    controller = None if cell is None else controller_in(cell)
    diagnosis = examine(
        controller,
        cycle_ms=1 if controller is None else controller.cycle_ms,
        seconds=QUICK_SECONDS if quick else duration,
        place=output,
        reporter=reporter(quiet=json),
    )
    if json:
        print_json(as_json(diagnosis))
    else:
        show(diagnosis, Console())
    if not diagnosis.fit or diagnosis.provisional:
        raise typer.Exit(NOT_GOOD)
