"""`hil study`: run and compare the two methods of the paper."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from hil.base.interrupt import STOP_SIGNALS, leave_on
from hil.base.progress import reporter as make_reporter
from hil.cell import Cell
from hil.cli.arguments import JsonOption, QuietOption, print_json
from hil.study import run_study, study_settings


def study(
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("runs/study"),
    quick: bool = False,
    cell: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    searches: Annotated[int | None, typer.Option(min=2)] = None,
    repetitions: Annotated[int | None, typer.Option(min=2)] = None,
    motions: Annotated[int | None, typer.Option(min=5)] = None,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    effects: Annotated[bool, typer.Option("--effects/--no-effects")] = True,
    workers: Annotated[int | None, typer.Option(min=1, max=256)] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Compare the paper's methods A and B and the default of `hil design` on the simulated NS 16.

    Searches several excitations of equal duration by each method, runs them and predicts held-out
    motions in the presence of model errors. Prints the conclusion first. Writes `report.html`,
    `results.json` and all archives to OUTPUT. After Ctrl-C or SIGTERM the same command resumes.

    **Examples:**

    - `hil study --quick --output runs/quick`: some minutes
    - `hil study --output runs/study`: ten searches of each method, about 20 minutes on two cores

    Options:
        output: Folder for the study.
        quick: Short searches, few repetitions and motions.
        cell: Cell file of a simulated arm other than the NS 16.
        searches: Searches of each method. Default: 10, with --quick 3.
        repetitions: Repetitions of each excitation. Default: 2.
        motions: Held-out motions, half of each class. Default: 30, with --quick 8.
        seed: Seed of the study; the result depends on nothing else. Default: 1.
        effects: Add model errors, one by one and all together.
        workers: Number of processes. Default: one per processor.
    """
    reporter = make_reporter(quiet=quiet or json)
    count = workers or len(os.sched_getaffinity(0))
    settings = study_settings(
        quick=quick,
        searches=searches,
        repetitions=repetitions,
        motions=motions,
        seed=seed,
        effects=effects,
    )
    arm = None if cell is None else Cell.load(cell)
    with leave_on(STOP_SIGNALS, f"stopped: the same command resumes the study in {output}"):
        result = run_study(output, settings, reporter, workers=count, cell=arm)
    if json:
        print_json(result.summary)
    else:
        typer.echo("\n".join(result.conclusion))
        reporter.say(f"report: {output / 'report.html'}")
