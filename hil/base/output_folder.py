"""Default results folder: named after the recording, next to it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Final

from hil.base.errors import InputError
from hil.base.files import file_digest, json_digest
from hil.base.safe_input import path_exists

SOURCES: Final = "sources.json"
"""File of an output folder with the digests of the recordings that its results are from."""

_MAX_SOURCES_BYTES: Final = 1 << 20  # bytes


def sources_text(fitted: Sequence[Path], predicted: Sequence[Path]) -> str:
    """Return the content of `sources.json`: name and SHA-256 of each recording, by use.

    Raises:
        InputError: one cannot be read.
    """
    groups = {"fitted": fitted, "predicted": predicted}
    table = {
        use: [{"name": path.name, "sha256": _digest(path)} for path in paths]
        for use, paths in groups.items()
    }
    return json.dumps(table, indent=1) + "\n"


def folder_beside(recording: Path, sources: str) -> Path:
    """Return the results folder of a recording: its name without suffix, next to it.

    A folder of that name that has results of other recordings, or anything else, is left alone;
    the next number that is free, or has the results of these `sources`, is appended.

    """
    for folder in _candidates(recording):
        if not path_exists(folder) or _has(folder, sources):
            return folder
    raise AssertionError("numbers do not end")


def require_possible(folder: Path) -> None:
    """Raise InputError if a folder cannot be created or written to; it is not created."""
    existing = next(path for path in (folder, *folder.resolve().parents) if path_exists(path))
    if not existing.is_dir():
        raise InputError(
            folder, f"cannot be created ({existing} is a file)", remedy="choose another folder"
        )
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(
            existing, "cannot be written to", remedy="choose another folder (--output)"
        )


def _candidates(recording: Path) -> Iterator[Path]:
    name = recording.name if recording.is_dir() else recording.stem
    yield recording.with_name(name)
    for number in count(2):
        yield recording.with_name(f"{name}-{number}")


def _has(folder: Path, sources: str) -> bool:
    """Return whether a folder has the results of these sources."""
    path = folder / SOURCES
    try:
        with path.open("rb") as file:
            return file.read(_MAX_SOURCES_BYTES) == sources.encode()
    except OSError:
        return False


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of all files directly in a folder."""
    try:
        if not path.is_dir():
            return file_digest(path)
        files = sorted(file for file in path.iterdir() if file.is_file())
        return json_digest({file.name: file_digest(file) for file in files})
    except OSError as error:
        problem = f"cannot be read ({error.strerror or error})"
        raise InputError(path, problem, remedy="check its name and permissions") from error
