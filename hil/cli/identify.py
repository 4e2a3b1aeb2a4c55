"""`hil identify`: estimate parameters from archives, with verdict and report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hil.annotate import annotate as write_annotated
from hil.cli.arguments import ArchivesArgument, JsonOption, QuietOption, with_options
from hil.cli.identify_options import EstimatorOption, Identifying
from hil.cli.verdict import finish
from hil.errors import InputError
from hil.files import make_folder
from hil.identify import identify_paths
from hil.outcome import write_outcome
from hil.progress import reporter as make_reporter


@with_options(Identifying, "how")
def identify(
    archives: ArchivesArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    predict: Annotated[list[Path] | None, typer.Option(metavar="ARCHIVE")] = None,
    paper: bool = False,
    split: Annotated[float, typer.Option(min=0.1, max=0.9)] = 0.7,
    in_sample: bool = False,
    estimator: EstimatorOption = "auto",
    annotate: bool = False,
    *,
    how: Identifying,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Estimate the dynamic parameters from archives and judge the result.

    Excitations and imported recordings are fitted; validation runs are predicted and never fitted.
    The archives contain all inputs: URDF, friction law, drive train. Exit status 0 if the model is
    good, 5 if it is not.

    Options:
        output: Folder for results.json, report.html and the files for other tools. Default: the
            campaign folder (with --paper its subfolder paper); none for single archives.
        predict: Archive to predict and not to fit, of any kind (repeatable).
        paper: Preprocess as in the paper: filter positions, torques and regressor alike.
        split: Fraction of the recording that is fitted if there is no validation run; the rest is
            predicted.
        in_sample: Fit all recordings and hold nothing out. All errors are then in-sample, and the
            model cannot be judged good.
        annotate: Also write copies of the archives for viewers, with the predicted torque and the
            residual as channels, in the subfolder annotated of the output.
    """
    reporter = make_reporter(quiet=quiet or json)
    method = "paper" if paper else "default"
    options = how.options(method=method, split=split, in_sample=in_sample, estimator=estimator)
    if len(archives) == 1 and archives[0].is_dir():
        output = output or (archives[0] / "paper" if paper else archives[0])
    if output is not None:
        make_folder(output)
    elif annotate:
        remedy = "name a folder for the copies with --output"
        raise InputError(None, "needs an output folder", field="--annotate", remedy=remedy)
    found = identify_paths(archives, reporter, options, predict=predict or ())
    results = found.results
    if output is not None:
        results = write_outcome(output, found, reporter)
        if annotate:
            copies = write_annotated(found, output)
            reporter.say(f"annotated for viewers: {', '.join(map(str, copies))}")
    finish(results, json=json, quiet=quiet)
