"""`hil study`: the paper's two methods, run and compared."""

from __future__ import annotations

import json as json_format
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

import typer

from hil.cell import Cell
from hil.cli.arguments import JsonOption, QuietOption
from hil.errors import OperatorStopError
from hil.progress import reporter as make_reporter
from hil.study import run_study, study_settings
from hil.study.results import summary_of


def study(
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("runs/study"),
    quick: bool = False,
    cell: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    repetitions: Annotated[int | None, typer.Option(min=2)] = None,
    motions: Annotated[int | None, typer.Option(min=5)] = None,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    effects: Annotated[bool, typer.Option("--effects/--no-effects")] = True,
    workers: Annotated[int | None, typer.Option(min=1, max=256)] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Reproduce the paper: A (sines) against B (via points), on the simulated COMAU NS 16.

    Both are designed, executed, and asked to predict motions they have never seen, of three
    classes; then one thing after another is varied. Leaves `report.html` and `results.json` in
    OUTPUT, with every archive they rest on. After Ctrl-C the same command resumes there.

    **Examples:**

    - `hil study --quick --output runs/quick`: the whole way in minutes
    - `hil study --output runs/study`: as the paper's, some 40 minutes on two free processors

    Options:
        output: Folder for the whole study.
        quick: Short searches, few repetitions and motions: minutes.
        cell: Cell file of another simulated arm than the paper's NS 16.
        repetitions: Executions of each excitation; 30 if left out, 4 with --quick.
        motions: Held-out motions of each class; 30 if left out, 10 with --quick.
        seed: One seed, one study; 1 if left out.
        effects: Run everything again with what the model leaves out: torque ripple, friction drift,
            elasticity, delay.
        workers: Processes; one for each processor if left out.
    """
    reporter = make_reporter(quiet=quiet or json)
    count = workers or len(os.sched_getaffinity(0))
    try:
        with _ended_like_ctrl_c():
            settings = study_settings(
                quick=quick, repetitions=repetitions, motions=motions, seed=seed, effects=effects
            )
            arm = None if cell is None else Cell.load(cell)
            found = run_study(output, settings, reporter, workers=count, cell=arm)
    except KeyboardInterrupt:
        raise OperatorStopError(
            f"stopped; what is complete stays in {output}: the same command resumes there"
        ) from None
    summary = summary_of(found)
    typer.echo(json_format.dumps(summary, indent=1) if json else summary["line"])


@contextmanager
def _ended_like_ctrl_c() -> Iterator[None]:
    """A terminal that is closed, or `kill`, ends the study's own processes with it."""
    in_main = threading.current_thread() is threading.main_thread()
    with ExitStack() as undo:
        for one in (signal.SIGTERM, signal.SIGHUP) if in_main else ():
            if signal.getsignal(one) is signal.SIG_DFL:  # nohup ignores the second on purpose
                undo.callback(signal.signal, one, signal.SIG_DFL)
                signal.signal(one, signal.default_int_handler)
        yield
