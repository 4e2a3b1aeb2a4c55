"""`hil identify`: estimate parameters from recordings, with verdict and report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hil.base.one_screen import Paragraph
from hil.base.output_folder import require_possible
from hil.base.progress import Reporter
from hil.base.progress import reporter as make_reporter
from hil.base.safe_input import path_exists
from hil.cli.arguments import JsonOption, QuietOption, VerboseOption, with_options
from hil.cli.identify_options import EstimatorOption, Identifying
from hil.cli.imports import RARE, Described, Reading
from hil.cli.purpose_options import Required
from hil.cli.servo_verdict import finish_servo
from hil.cli.verdict import LABEL_COLUMNS, finish
from hil.identified.identified_arm import identify_recordings, write_arm
from hil.identified.identified_servo import IdentifiedServo, write_servo
from hil.identified.messages import read_lines, servo_read_lines
from hil.importers.recording_import import is_archive
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
@with_options(Described, "arm", but=("friction", "standstill_speed"))
@with_options(Reading, "reading", rare=RARE)
def identify(
    recordings: RecordingsArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    predict: Annotated[list[Path] | None, typer.Option(metavar="RECORDING")] = None,
    paper: bool = False,
    split: Annotated[float, typer.Option(min=0.1, max=0.9)] = 0.7,
    fit_all: bool = False,
    annotate: bool = False,
    compare: Annotated[Path | None, typer.Option(metavar="FILE.xml")] = None,
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

    A log (CSV and other text, .npz, .mat, .mcap) or a bag needs the URDF of its arm; the meaning of
    its channels is inferred from names and units, and printed. Archives contain all inputs.
    Validation runs are predicted, never fitted. From commanded positions without torque it
    identifies servo and friction of each joint. Exit status 5 if the model fails a purpose of
    --for; without --for, if its error on unseen motion exceeds both a tenth of the torque and twice
    the noise.

    **Examples:** `hil identify log.csv --urdf arm.urdf`, `hil identify runs/demo`

    Options:
        output: Folder for all files. Default: the campaign folder (--paper: its subfolder), or one
            next to the first recording, named after it.
        predict: Recording to predict instead of fit (repeatable).
        paper: Filter torques and regressor in the same way, as in the paper.
        split: Fraction of a recording to fit if there is no validation run.
        fit_all: Hold nothing out; no model is then judged good.
        annotate: Also write archives with predicted torque, for viewers.
        compare: MJCF whose servo parameters to compare with, for recordings without torque.
    """
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    stated = {"in_sample": fit_all, "estimator": estimator, **required.options()}
    options = how.options(method="paper" if paper else "default", split=split, **stated)
    output = _folder(recordings, output, paper=paper)
    if not arm.is_given:
        reading.refuse_without_robot()
    robot = arm.robot if arm.is_given else None
    identified = identify_recordings(
        recordings, predict or [], robot, reading.options, options, reporter,
        output=output, compare=compare,
    )  # fmt: skip
    show = {"json": json, "quiet": quiet, "verbose": verbose}
    if isinstance(identified, IdentifiedServo):
        _finish_servo(identified, output, reporter, **show)
        return
    folder, results = write_arm(identified, output, annotate=annotate, reporter=reporter)
    read = [Paragraph(text, use.ljust(LABEL_COLUMNS), 2) for use, text in read_lines(identified)]
    finish(results, **show, written=(folder, folder / REPORT), read=read)


def _folder(recordings: list[Path], output: Path | None, *, paper: bool) -> Path | None:
    """Return the folder that was named, which can be written to; None: next to the recording."""
    if paper and len(recordings) == 1 and recordings[0].is_dir() and is_archive(recordings[0]):
        output = output or recordings[0] / "paper"
    if output is not None or path_exists(recordings[0]):
        require_possible(output or recordings[0].resolve().parent)
    return output


def _finish_servo(
    servo: IdentifiedServo, output: Path | None, reporter: Reporter, **show: bool
) -> None:
    """Write the files of an arm without torque, and print its verdict."""
    folder = write_servo(servo, output, reporter)
    read = [Paragraph(text, use.ljust(LABEL_COLUMNS), 2) for use, text in servo_read_lines(servo)]
    finish_servo(servo.results, **show, written=(folder, folder / REPORT), read=read)
