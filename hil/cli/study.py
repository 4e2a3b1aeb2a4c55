"""`hil study`: run and compare the two methods of the paper."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from hil.base.errors import OperatorStopError
from hil.base.progress import reporter as make_reporter
from hil.cell import Cell
from hil.cli.arguments import JsonOption, QuietOption, print_json
from hil.study import run_study, study_settings


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
    """Reproduce the paper: method A (sines) against B (via points) on the simulated COMAU NS 16.

    Searches and runs both excitations, and predicts held-out fly-by motions. Writes `report.html`,
    `results.json` and all archives to OUTPUT. After Ctrl-C the same command resumes.

    **Examples:**

    - `hil study --quick --output runs/quick`: some minutes
    - `hil study --output runs/study`: as in the paper, about 30 minutes on two processors

    Options:
        output: Folder for the study.
        quick: Short searches, few repetitions and motions.
        cell: Cell file of a simulated arm other than the NS 16.
        repetitions: Repetitions of each excitation. Default: 30, with --quick 4.
        motions: Held-out motions. Default: 30, with --quick 10.
        seed: Seed of the study; the result depends on nothing else. Default: 1.
        effects: Repeat everything with effects that the model does not contain.
        workers: Number of processes. Default: one per processor.
    """
    reporter = make_reporter(quiet=quiet or json)
    count = workers or len(os.sched_getaffinity(0))
    try:
        settings = study_settings(
            quick=quick, repetitions=repetitions, motions=motions, seed=seed, effects=effects
        )
        arm = None if cell is None else Cell.load(cell)
        result = run_study(output, settings, reporter, workers=count, cell=arm)
    except KeyboardInterrupt:
        raise OperatorStopError(
            f"stopped; the same command resumes the study in {output}"
        ) from None
    if json:
        print_json(result.summary)
    else:
        typer.echo("\n".join(result.conclusion))
