"""An identified arm without torque, and the files written about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

from hil import plots  # its pictures load matplotlib, on first use
from hil.archive import Archive
from hil.base.errors import InputError
from hil.base.files import make_folder, write_files
from hil.base.output_folder import SOURCES, folder_beside, sources_text
from hil.base.progress import Reporter, Silent
from hil.identified.recordings_read import recording_results
from hil.identified.staging import Staging
from hil.importers.conclusions import OtherClock
from hil.importers.recording_import import ImportedRecording, is_archive
from hil.importers.required_signals import has_servo, require_commands
from hil.pipeline.options import Options
from hil.report.output_files import REPORT
from hil.report.servo_page import LEGENDS, motion_charts, servo_page_bytes
from hil.results.provenance import RESULTS
from hil.results.series import SERIES
from hil.results.servo_result import ServoResults
from hil.results.servo_series import servo_series_bytes
from hil.servo.identification import ServoIdentification, ServoOptions, identify_servos

PICTURE = "motion.png"


@dataclass(frozen=True, eq=False)
class IdentifiedServo:
    """Servo and friction of an arm without torque, in memory.

    Attributes:
        recordings: files that were fitted.
        predicted: recordings that were predicted and not fitted.
        identification: the fit, and everything that it was computed from.
        channels: a line for each group of channels of imported recordings: what it is, and why.
        staging: imported recordings, whose archives are written with the result.
    """

    recordings: tuple[Path, ...]
    predicted: tuple[Path, ...]
    identification: ServoIdentification
    channels: tuple[str, ...]
    staging: Staging | None = None

    @property
    def results(self) -> ServoResults:
        """Content of `results.json`."""
        return self.identification.results

    def __repr__(self) -> str:
        return f"<IdentifiedServo {self.results.cell}: {self.results.verdict.line}>"

    def save(
        self, folder: str | PathLike[str] | None = None, *, reporter: Reporter | None = None
    ) -> Path:
        """Write results, report, picture, archives and column maps, and return their folder.

        Args:
            folder: for the files; None for one named after the first recording, next to it.
            reporter: receives the names of the files.

        Raises:
            InputError: an archive in the folder would replace a recording.
            OutputError: it cannot be written to.
        """
        return write_servo(self, folder, reporter or Silent())


def are_servos(archives: Sequence[Path | Archive]) -> bool:
    """Return whether all archives in memory have commanded positions and no torque."""
    in_memory = [archive for archive in archives if isinstance(archive, Archive)]
    return len(in_memory) == len(archives) > 0 and all(map(has_servo, in_memory))


def identified_servo(
    staging: Staging,
    recordings: Sequence[Path],
    predicted: Sequence[Path],
    options: Options,
    compare: Path | None,
    channels: tuple[str, ...],
    reporter: Reporter,
) -> IdentifiedServo:
    """Identify from staged recordings without torque; `compare` is an MJCF.

    Args:
        staging: the recordings in memory.
        recordings: files that are fitted.
        predicted: files that are predicted.
        options: of any identification; options about torques are ignored.
        compare: file whose parameters are compared, or None.
        channels: a line for each group of channels.
        reporter: of progress.
    """
    for archives, fitted in ((staging.fitted, True), (staging.predicted, False)):
        for archive in archives:
            if isinstance(archive, Archive):
                require_commands(archive, staging.sources[archive.path], fitted=fitted)
    servo = ServoOptions(split=options.split, in_sample=options.in_sample, compare=compare)
    identification = identify_servos(
        staging.fitted, reporter, servo, predict=staging.predicted, name=recordings[0].stem
    )
    predicted_names = {each.archive for each in identification.results.validation}
    held_out = [
        source for place, source in staging.sources.items() if place.name in predicted_names
    ]
    read = recording_results(staging, held_out)
    known = not any(_has_other_clock(recording) for recording in staging.recordings.values())
    update = {"recordings": read, "delay_known": known}
    results = identification.results.model_copy(update=update)
    identification = replace(identification, results=results)
    return IdentifiedServo(tuple(recordings), tuple(predicted), identification, channels, staging)


def _has_other_clock(recording: ImportedRecording) -> bool:
    """Return whether the commands of a recording were moved from another clock."""
    found = (*recording.concluded, *recording.examined.found)
    return any(isinstance(each, OtherClock) for each in found)


def write_servo(
    servo: IdentifiedServo, folder: str | PathLike[str] | None, reporter: Reporter
) -> Path:
    """Write all files of an arm without torque; see :meth:`IdentifiedServo.save`."""
    first = servo.recordings[0]
    is_folder = first.is_dir() and is_archive(first)
    sources = None if is_folder else sources_text(servo.recordings, servo.predicted)
    if folder is not None:
        place = Path(folder)
    else:
        place = first if sources is None else folder_beside(first, sources)
    if servo.staging is not None:
        servo.staging.check_places(place)
    make_folder(place)
    if servo.staging is not None:
        servo.staging.write_to(place)
    results = servo.results
    series = servo.identification.series
    files: dict[str, str | bytes | None] = {
        RESULTS: results.to_json(),
        SERIES: servo_series_bytes(series),
        REPORT: servo_page_bytes(results, series),
    }
    if sources is not None:
        files[SOURCES] = sources
    write_files(place, files)
    if series:
        charts = motion_charts(results, series[0])
        plots.save(plots.draw_charts([charts], LEGENDS, enlarged=1.2), place / PICTURE)
    reporter.say(f"written to {place}: {RESULTS}, {REPORT}, {PICTURE}")
    return place


def refuse_comparison(compare: Path | None) -> None:
    """Raise InputError for a file to compare with where torques are identified."""
    if compare is not None:
        problem = "is for recordings without torque"
        remedy = "omit it: the nominal model of the URDF is compared"
        raise InputError(compare, problem, field="--compare", remedy=remedy)
