"""Recordings of other programs as archives in a temporary folder, until they are of use.

What is refused leaves nothing behind: archives and maps move to the folder of results at the end.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from hil.base.errors import InputError
from hil.base.files import convert_write_errors, replace_file, write_output
from hil.base.progress import Reporter
from hil.importers.messages import sentence
from hil.importers.recording import (
    ImportedRecording,
    ImportOptions,
    RobotOf,
    import_recording,
    is_archive,
)
from hil.importers.required_signals import require_motion, require_torque
from hil.importers.robot import Use
from hil.look.conclusions import concluded

MAP: Final = "map.toml"
"""File of the column map in a folder of results."""


@dataclass
class Staging:
    """Archives of recordings, imported where they are not archives yet.

    Attributes:
        fitted: archives to fit.
        predicted: archives to predict.
        recordings: those that were imported, by archive.
        sources: the files that those are from, by archive.
    """

    fitted: list[Path] = field(default_factory=list)
    predicted: list[Path] = field(default_factory=list)
    recordings: dict[Path, ImportedRecording] = field(default_factory=dict)
    sources: dict[Path, Path] = field(default_factory=dict)

    def check_places(self, folder: Path) -> None:
        """Raise InputError if an archive in this folder would replace a recording."""
        recordings = {path.resolve() for path in self.sources.values()}
        for archive in self.recordings:
            place = folder / archive.name
            if place.resolve() in recordings:
                problem = "is the recording itself, which its archive would replace"
                raise InputError(place, problem, remedy="name another folder: --output FOLDER")

    def move_to(self, folder: Path) -> Mapping[Path, Path]:
        """Move archives and maps to an existing folder; return the new paths by the old ones.

        Raises:
            InputError: the folder cannot be written to.
        """
        places = {archive: folder / archive.name for archive in self.recordings}
        with convert_write_errors(folder):
            for archive, place in places.items():
                with replace_file(place) as temporary:
                    shutil.copyfile(archive, temporary)
        texts = {place: self.recordings[archive].text for archive, place in places.items()}
        different = set(filter(None, texts.values()))
        for place, text in texts.items():
            if text is not None:
                name = MAP if len(different) == 1 else f"{place.stem}.{MAP}"
                write_output(folder / name, text)
        return places


@contextmanager
def staged(
    fitted: Sequence[Path],
    predicted: Sequence[Path],
    robot_of: RobotOf,
    options: ImportOptions,
    reporter: Reporter,
) -> Iterator[Staging]:
    """Import those recordings that are no archives, and report what was concluded.

    Raises:
        SourceError: one cannot be imported, or nothing can be identified from it.
    """
    with TemporaryDirectory(prefix="hil-") as folder:
        staging = Staging()
        uses: tuple[tuple[Sequence[Path], list[Path], Use], ...] = (
            (fitted, staging.fitted, "excitation"),
            (predicted, staging.predicted, "validation"),
        )
        for paths, archives, use in uses:
            for path in paths:
                if is_archive(path):
                    archives.append(path)
                    continue
                archive = _free(Path(folder), path)
                recording = import_recording(path, archive, robot_of, options, use=use)
                require_motion(archive, path)
                require_torque(archive, path)
                recording = concluded(recording, path, robot_of, options, use)
                _report(recording, path, reporter)
                archives.append(archive)
                staging.recordings[archive] = recording
                staging.sources[archive] = path
        try:
            yield staging
        except InputError as error:
            if error.path not in staging.sources:
                raise
            source = staging.sources[error.path]
            raise InputError(
                source, error.problem, field=error.field, remedy=error.remedy
            ) from error


def _free(folder: Path, recording: Path) -> Path:
    """Return a path for the archive of a recording; equal names get a number."""
    stem = recording.name if recording.is_dir() else recording.stem
    path = folder / f"{stem}.mcap"
    number = 2
    while path.exists():
        path = folder / f"{stem}-{number}.mcap"
        number = number + 1
    return path


def _report(recording: ImportedRecording, source: Path, reporter: Reporter) -> None:
    """Report what was concluded, then what the import found."""
    for conclusion in (*recording.concluded, *recording.examined.found):
        reporter.say(f"{source.name}: {sentence(conclusion)}")
    for warning in recording.examined.warnings:
        reporter.say(f"{source.name}: warning: {sentence(warning)}")
