"""`hil identify`: estimate parameters from recordings, with verdict and report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from hil.annotate import annotate as write_annotated
from hil.cli.arguments import JsonOption, QuietOption, with_options
from hil.cli.identify_options import EstimatorOption, Identifying
from hil.cli.imports import Described, Reading
from hil.cli.verdict import finish
from hil.errors import InputError
from hil.files import make_folder, write_output
from hil.identify import Identification, Options, identify_paths
from hil.importers.recording import is_archive
from hil.importers.staging import staged
from hil.outcome import REPORT, write_outcome
from hil.output_folder import SOURCES, folder_beside, require_possible, sources_text
from hil.progress import Reporter
from hil.progress import reporter as make_reporter
from hil.reading import path_exists
from hil.results import Results

RecordingsArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORDING...",
        help="Logs or bags, with --urdf; or archives (*.mcap), or one campaign folder.",
    ),
]


@with_options(Identifying, "how")
@with_options(Described, "arm", but=("friction", "standstill"))
@with_options(Reading, "reading")
def identify(
    recordings: RecordingsArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    predict: Annotated[list[Path] | None, typer.Option(metavar="RECORDING")] = None,
    paper: bool = False,
    split: Annotated[float, typer.Option(min=0.1, max=0.9)] = 0.7,
    in_sample: bool = False,
    estimator: EstimatorOption = "auto",
    annotate: bool = False,
    *,
    arm: Described,
    reading: Reading,
    how: Identifying,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Estimate the dynamic parameters from recordings and judge the result.

    A log (CSV and other text, .npz, .mat, .mcap) or a bag needs the URDF of its arm; what its
    channels are is concluded from their names and units, and printed. Archives contain all inputs:
    URDF, friction law, drive train. Validation runs are predicted and never fitted. Exit status 0
    if the model is good, 5 if it is not.

    **Example:** `hil identify log.csv --urdf arm.urdf`

    Options:
        output: Folder for results.json, report.html, the files for other tools, and the archives
            and the column map of imported logs. Default: the campaign folder (with --paper its
            subfolder paper), else a folder named after the first recording, beside it.
        predict: Recording to predict and not to fit, of any kind (repeatable).
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
    if len(recordings) == 1 and recordings[0].is_dir() and is_archive(recordings[0]):
        output = output or (recordings[0] / "paper" if paper else recordings[0])
    if output is not None or path_exists(recordings[0]):
        require_possible(output or recordings[0].resolve().parent)
    work = _Work(recordings, predict or [], output, options, annotate, reporter)
    if arm.is_given:
        results, folder = work.from_recordings(arm, reading)
    else:
        reading.refuse_without_robot()
        results, folder = work.from_archives()
    finish(results, json=json, quiet=quiet, written=(folder, folder / REPORT))


@dataclass(frozen=True)
class _Work:
    """An identification and where its results are written."""

    recordings: Sequence[Path]
    predict: Sequence[Path]
    output: Path | None
    options: Options
    annotate: bool
    reporter: Reporter

    def from_archives(self) -> tuple[Results, Path]:
        """Identify from archives or a campaign; return the results and their folder."""
        for path in (*self.recordings, *self.predict):
            if path.is_file() and path.suffix.lower() != ".mcap":
                problem = "is not an archive, and a log needs the description of its arm"
                raise InputError(path, problem, remedy="add --urdf ARM.urdf")
        found = identify_paths(self.recordings, self.reporter, self.options, predict=self.predict)
        folder, sources = self._folder()
        results = self._write(folder, found)
        if sources is not None:
            write_output(folder / SOURCES, sources)
        return results, folder

    def from_recordings(self, arm: Described, reading: Reading) -> tuple[Results, Path]:
        """Import what is no archive and identify; return the results and their folder."""
        with staged(
            self.recordings, self.predict, arm.robot, reading.options, self.reporter
        ) as staging:
            if self.output is not None:
                staging.check_places(self.output)
            found = identify_paths(
                staging.fitted, self.reporter, self.options, predict=staging.predicted
            )
            folder, sources = self._folder()
            places = staging.move_to(folder)
            found = replace(found, paths=tuple(places.get(path, path) for path in found.paths))
            results = self._write(folder, found)
        if sources is not None:
            write_output(folder / SOURCES, sources)
        return results, folder

    def _write(self, folder: Path, found: Identification) -> Results:
        results = write_outcome(folder, found, self.reporter)
        if self.annotate:
            copies = write_annotated(found, folder)
            self.reporter.say(f"annotated for viewers: {', '.join(map(str, copies))}")
        return results

    def _folder(self) -> tuple[Path, str | None]:
        """Create the folder of the results; return it and what it states as their sources."""
        if (
            self.recordings[0].is_dir()
            and self.output is not None
            and is_archive(self.recordings[0])
        ):
            make_folder(self.output)
            return self.output, None
        sources = sources_text(self.recordings, self.predict)
        folder = self.output or folder_beside(self.recordings[0], sources)
        make_folder(folder)
        return folder, sources
