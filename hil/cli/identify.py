"""`hil identify`: estimate parameters from recordings, with verdict and report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hil.base.one_screen import Paragraph
from hil.base.output_folder import require_possible
from hil.base.progress import reporter as make_reporter
from hil.base.safe_input import path_exists
from hil.cli.arguments import JsonOption, QuietOption, VerboseOption, with_options
from hil.cli.identify_options import EstimatorOption, Identifying
from hil.cli.imports import Described, Reading
from hil.cli.purpose_options import Required
from hil.cli.verdict import LABEL, finish
from hil.identified.identified_arm import identify_recordings, write_arm
from hil.identified.messages import read_lines
from hil.importers.recording import is_archive
from hil.report.output_files import REPORT

RecordingsArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORDING",
        help="Logs or bags, with --urdf; or archives (*.mcap), or one campaign folder.",
    ),
]


@with_options(Identifying, "how")
@with_options(Required, "required")
@with_options(Described, "arm", but=("friction", "standstill"))
@with_options(Reading, "reading")
def identify(
    recordings: RecordingsArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    predict: Annotated[list[Path] | None, typer.Option(metavar="RECORDING")] = None,
    paper: bool = False,
    split: Annotated[float, typer.Option(min=0.1, max=0.9)] = 0.7,
    fit_all: bool = False,
    annotate: bool = False,
    *,
    arm: Described,
    reading: Reading,
    estimator: EstimatorOption = "auto",
    how: Identifying,
    required: Required,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Estimate the dynamic parameters from recordings and judge the result.

    A log (CSV and other text, .npz, .mat, .mcap) or a bag needs the URDF of its arm; what its
    channels are is concluded from their names and units, and printed. Archives contain all inputs:
    URDF, friction law, drive train. Validation runs are predicted and never fitted. Exit status 0
    if the model is good for the purposes of --for, 5 if it is not; without --for, if it predicts
    unseen motion to a tenth of the torque or to twice its noise, better than the nominal model.

    **Examples:** `hil identify log.csv --urdf arm.urdf`, `hil identify runs/demo`

    Options:
        output: Folder for all files. Default: the campaign folder (with --paper its subfolder
            paper), else one beside the first recording, named after it.
        predict: Recording to predict and not to fit, of any kind (repeatable).
        paper: Preprocess as in the paper: filter positions, torques and regressor alike.
        split: Fraction that is fitted if there is no validation run; the rest is predicted.
        fit_all: Fit all recordings and hold nothing out: no model can then be judged good.
        annotate: Also write copies of the archives for viewers, with predicted torque and
            residual, into the subfolder annotated.
    """
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    stated = {"in_sample": fit_all, "estimator": estimator, **required.options()}
    options = how.options(method="paper" if paper else "default", split=split, **stated)
    output = _folder(recordings, output, paper=paper)
    if not arm.is_given:
        reading.refuse_without_robot()
    identified = identify_recordings(
        recordings,
        predict or [],
        arm.robot if arm.is_given else None,
        reading.options,
        options,
        reporter,
        output=output,
    )
    folder, results = write_arm(identified, output, annotate=annotate, reporter=reporter)
    written = (folder, folder / REPORT)
    read = [Paragraph(text, use.ljust(LABEL), 2) for use, text in read_lines(identified)]
    finish(results, json=json, quiet=quiet, verbose=verbose, written=written, read=read)


def _folder(recordings: list[Path], output: Path | None, *, paper: bool) -> Path | None:
    """Return the folder that was named, which can be written to; None: next to the recording."""
    if paper and len(recordings) == 1 and recordings[0].is_dir() and is_archive(recordings[0]):
        output = output or recordings[0] / "paper"
    if output is not None or path_exists(recordings[0]):
        require_possible(output or recordings[0].resolve().parent)
    return output
