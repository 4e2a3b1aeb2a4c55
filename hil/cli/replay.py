"""`hil replay`: simulate held-out motions under their recorded torques."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.arguments import (
    ArchivesArgument,
    JsonOption,
    QuietOption,
    print_json,
    with_options,
)
from hil.cli.identify_options import FEW, EstimatorOption, Identifying
from hil.cli.verdict import NOT_GOOD
from hil.files import make_folder
from hil.identify import identify_sources
from hil.outcome import RESULTS, report_replay
from hil.plots import check_format, save
from hil.progress import reporter as make_reporter
from hil.progress import say
from hil.replaying import ENSEMBLE, replay_motions


@with_options(Identifying, "how", but=FEW)
def replay(
    archives: ArchivesArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    ensemble: Annotated[int, typer.Option(min=0, max=1000)] = ENSEMBLE,
    estimator: EstimatorOption = "auto",
    *,
    how: Identifying,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Simulate held-out motions forward under their recorded torques.

    Reports the position errors of the models. The same weak feedback of 1 Hz keeps the errors of
    all models bounded. Position errors over time of the identified and the nominal arm are plotted
    with the spread of an ensemble, and their RMS is printed. Joints that drift by more than the
    parameter uncertainty are named, with the torque that the model lacks. The figure is added to
    the report of a campaign identified with the same options. Exit status 5 if the model is not
    good.

    **Example:** `hil replay runs/demo`

    Options:
        output: The figure (*.png, *.svg, *.pdf). Default: replay.png in the campaign folder or the
            working directory.
        ensemble: Number of variants to simulate, sampled from the uncertainty of the parameters; 0
            for none.
    """
    reporter = make_reporter(quiet=quiet or json)
    folder = archives[0] if archives[0].is_dir() else Path()
    target = output or folder / "replay.png"
    check_format(target)
    found = identify_sources(archives, reporter, how.options(estimator=estimator))
    replayed = replay_motions(found, reporter, ensemble)
    make_folder(target.parent)
    save(replayed.figure(), target)
    if (folder / RESULTS).exists() and archives[0].is_dir():
        report_replay(folder, found.results, replayed.beside, reporter)
    if json:
        print_json({"picture": str(target), **replayed.to_dict()})
    else:
        for line in replayed.lines()[-1 if quiet else 0 :]:
            say(line)
    if not found.verdict.good:
        raise typer.Exit(NOT_GOOD)
