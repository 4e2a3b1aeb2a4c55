"""Recordings of other programs in memory, until a result is written with their archives.

What is refused leaves nothing behind: archives and maps are written to the folder of results.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from hil.archive import Archive, write_archive
from hil.base.errors import InputError, SourceError
from hil.base.files import convert_write_errors, replace_file, write_output
from hil.base.progress import Reporter
from hil.importers.excerpt import MAX_EXCERPT_ROWS
from hil.importers.lerobot import is_data_set
from hil.importers.log_files import LogFiles
from hil.importers.messages import sentence
from hil.importers.recording_content import Use
from hil.importers.recording_import import (
    ImportedRecording,
    ImportOptions,
    RobotOf,
    is_archive,
    read_episodes,
    read_recording,
)
from hil.importers.required_signals import has_servo, require_motion, require_torque
from hil.look.before_identification import Concluded, LayoutReading, concluded
from identification.hypotheses.diagnosis import TorqueDiagnosis

MAP: Final = "map.toml"
"""File of the column map in a folder of results."""
_UNWRITTEN: Final = Path("<not written>")  # folder of the archives, as no file has it


@dataclass
class Staging:
    """Recordings to identify from: archive files, and other recordings in memory.

    Attributes:
        fitted: archives to fit.
        predicted: archives to predict.
        recordings: those that were imported, by the path of their archive.
        sources: the files that those are from, likewise.
        diagnoses: what their torques are, likewise, where that was asked.
        layouts: how others with the columns of one that was examined are read, by that map.
    """

    fitted: list[Path | Archive] = field(default_factory=list)
    predicted: list[Path | Archive] = field(default_factory=list)
    recordings: dict[Path, ImportedRecording] = field(default_factory=dict)
    sources: dict[Path, Path] = field(default_factory=dict)
    diagnoses: dict[Path, TorqueDiagnosis] = field(default_factory=dict)
    layouts: dict[str, LayoutReading] = field(default_factory=dict)

    def check_places(self, folder: Path) -> None:
        """Raise InputError if an archive in this folder would replace a recording."""
        recordings = {path.resolve() for path in self.sources.values()}
        for archive in self.recordings:
            place = folder / archive.name
            if place.resolve() in recordings:
                problem = "is the recording itself, which its archive would replace"
                raise InputError(place, problem, remedy="choose another folder: --output FOLDER")

    def write_to(self, folder: Path) -> Mapping[Path, Path]:
        """Write archives and maps to an existing folder; return their paths by the paths in memory.

        Raises:
            InputError: the folder cannot be written to.
        """
        places = {path: folder / path.name for path in self.recordings}
        with convert_write_errors(folder):
            for path, place in places.items():
                with replace_file(place) as temporary:
                    write_archive(self.recordings[path].archive, temporary)
        texts = {place: self.recordings[path].text for path, place in places.items()}
        different = set(filter(None, texts.values()))
        for place, text in texts.items():
            if text is not None:
                name = MAP if len(different) == 1 else f"{place.stem}.{MAP}"
                write_output(folder / name, text)
        return places

    def unused(self, recording: Path) -> Path:
        """Return a path for the archive of a recording; equal names get a number."""
        stem = recording.name if recording.is_dir() else recording.stem
        path = _UNWRITTEN / f"{stem}.mcap"
        number = 2
        while path in self.recordings:
            path = _UNWRITTEN / f"{stem}-{number}.mcap"
            number = number + 1
        return path


@contextmanager
def staged(
    fitted: Sequence[Path],
    predicted: Sequence[Path],
    robot_of: RobotOf,
    options: ImportOptions,
    reporter: Reporter,
) -> Iterator[Staging]:
    """Read the recordings that are not archives, and report the conclusions.

    Errors about an archive in memory name the recording it was read from.

    Args:
        fitted: recordings.
        predicted: recordings that are held out.
        robot_of: the arm of a recording.
        options: of the import.
        reporter: of progress.

    Raises:
        SourceError: one cannot be imported, or nothing can be identified from it.
    """
    staging = Staging()
    uses: tuple[tuple[Sequence[Path], list[Path | Archive], Use], ...] = (
        (fitted, staging.fitted, "excitation"),
        (predicted, staging.predicted, "validation"),
    )
    try:
        for paths, archives, use in uses:
            for path in paths:
                if is_archive(path):
                    archives.append(path)
                    continue
                for source, place, recording in _read(path, robot_of, options, use, staging):
                    found = _concluded(
                        recording, source, robot_of, options, reporter, staging.layouts
                    )
                    archives.append(found.recording.archive)
                    staging.recordings[place] = found.recording
                    if found.diagnosis is not None:
                        staging.diagnoses[place] = found.diagnosis
        yield staging
    except InputError as error:
        if error.path not in staging.sources:
            raise
        source = staging.sources[error.path]
        raise InputError(source, error.problem, field=error.field, remedy=error.remedy) from error


def _read(
    path: Path, robot_of: RobotOf, options: ImportOptions, use: Use, staging: Staging
) -> Iterator[tuple[Path, Path, ImportedRecording]]:
    """Yield the recordings of a file or folder, each with its name and the path of its archive."""

    def place_of(source: Path) -> Path:
        place = staging.unused(source)
        staging.sources[place] = source
        return place

    if is_data_set(path):
        for source, recording in read_episodes(path, robot_of, options, use=use, place_of=place_of):
            yield source, recording.archive.path, recording
    else:
        place = place_of(path)
        # Nothing here may refer to the recording: its text is forgotten when it was concluded.
        yield path, place, _read_one(path, robot_of, options, place, use)


def _read_one(
    path: Path, robot_of: RobotOf, options: ImportOptions, place: Path, use: Use
) -> ImportedRecording:
    files = LogFiles(longest=MAX_EXCERPT_ROWS)
    return read_recording(path, robot_of, options, place=place, use=use, files=files)


def _concluded(
    recording: ImportedRecording,
    source: Path,
    robot_of: RobotOf,
    options: ImportOptions,
    reporter: Reporter,
    layouts: dict[str, LayoutReading],
) -> Concluded:
    """Report what is concluded of a recording, and return it without the text of its log.

    That takes more memory than its numbers.
    """
    require_motion(recording.archive, source)
    require_torque(recording.archive, source)
    layout = layouts.get(recording.map_text or "")
    if layout is not None:
        found = Concluded(layout.read(recording, source, robot_of))
    else:
        found = concluded(recording, source, robot_of, options)
        if (layout := LayoutReading.of(recording, source, found)) is not None:
            layouts[layout.proposed] = layout
    _report(found.recording, source, reporter)
    request = replace(found.recording.request, files=LogFiles())
    return found._replace(recording=replace(found.recording, request=request))


def require_torques(staging: Staging) -> None:
    """Raise SourceError if some recordings have no torque, and others have."""
    for place, recording in staging.recordings.items():
        if has_servo(recording.archive):
            problem = "has no torque, and other recordings have"
            remedy = "identify recordings with and without torque separately"
            raise SourceError(staging.sources[place], problem, field="torque", remedy=remedy)


def _report(recording: ImportedRecording, source: Path, reporter: Reporter) -> None:
    """Report what was concluded, then what the import found."""
    for conclusion in (*recording.concluded, *recording.examined.found):
        reporter.say(f"{source.name}: {sentence(conclusion)}")
    for warning in recording.examined.warnings:
        reporter.say(f"{source.name}: warning: {sentence(warning)}")
