"""`hil replay`: held-out motions simulated forwards under the recorded torques."""

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
    """Simulate held-out motions under their recorded torques: how far models go astray.

    A light feedback of 1 Hz, the same for every model, keeps errors from adding up. Position errors
    over time of the identified and of the nominal arm go into a figure, with the spread of an
    ensemble; their root mean squares are printed. A joint that drifts by more than the parameters
    are uncertain is named, with the torque that the model leaves out. The figure goes into the
    report of a campaign that was identified alike. Exit status 5 if the model is not good.

    **Example:** `hil replay runs/demo`

    Options:
        output: The figure (*.png, *.svg, *.pdf); if left out replay.png, in the campaign folder or
            here.
        ensemble: Number of variants, as far apart as the parameters are uncertain, that are
            simulated as well; 0 for none.
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
