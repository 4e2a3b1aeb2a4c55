"""Search for recordings at and below places: archives, and on request logs and bags."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from glob import glob, has_magic
from pathlib import Path
from typing import NamedTuple, Protocol

from hil.archive.header import SUFFIX
from hil.base.errors import InputError
from hil.base.safe_input import remedy_for_missing

from .cache import CACHE_FOLDER
from .cluster import SkippedArchive
from .places import archives_at, is_url


class KindsOfLogs(Protocol):
    """Distinguishes logs and bags from other files."""

    def is_log(self, file: Path, siblings: Collection[str]) -> bool:
        """Return whether a file, found in a folder with these names, may be a log or a bag."""

    def is_other(self, file: Path) -> bool:
        """Return whether a file is known to be no recording, such as a table of results."""

    def is_folder_of_one(self, folder: Path) -> bool:
        """Return whether a folder is one recording: a bag, or a file for each quantity."""

    def is_archive(self, file: Path) -> bool:
        """Return whether a file is an archive of this software."""


class FoundRecordings(NamedTuple):
    """Paths or URLs of recordings, sorted."""

    archives: tuple[str, ...]
    logs: tuple[str, ...] = ()  #: logs, bags, and folders with a file for each quantity
    refused: tuple[SkippedArchive, ...] = ()  #: folders and files that cannot be read


def find_recordings(roots: Sequence[str], logs: KindsOfLogs | None = None) -> FoundRecordings:
    """Return the archives, and by `logs` also logs and bags, at or below some places.

    Places are folders, files, patterns such as ``robot*/**/*.csv`` and URLs. Links are followed; a
    folder reached by several links is searched once, under its own name.

    Raises:
        InputError: a place does not exist, or a URL cannot be reached.
    """
    search = _Search(logs)
    for root in _expanded(roots):
        path = Path(root)
        if is_url(root):
            search.archives.update(archives_at(root))
        elif path.is_file() or (logs is not None and path.is_dir() and logs.is_folder_of_one(path)):
            search.add(path.resolve(), named=True)
        elif path.is_dir():
            search.walk(path.resolve())
        else:
            remedy = remedy_for_missing(path, "give a folder with recordings below it")
            raise InputError(root, "does not exist", remedy=remedy)
    return FoundRecordings(
        tuple(sorted(search.archives)), tuple(sorted(search.logs)), tuple(search.refused)
    )


def _expanded(roots: Sequence[str]) -> Iterator[str]:
    """Yield places, and what a pattern matches in its place."""
    for root in roots:
        if is_url(root) or not has_magic(root) or os.path.lexists(root):
            yield root
            continue
        matching = sorted(glob(root, recursive=True))  # noqa: PTH207 - of absolute patterns, too
        if not matching:
            remedy = "check the pattern; ** stands for folders at any depth"
            raise InputError(root, "matches no file or folder", remedy=remedy)
        yield from matching


class _Search:
    """What was found so far."""

    def __init__(self, kinds: KindsOfLogs | None) -> None:
        self._kinds = kinds
        self._visited: set[Path] = set()
        self.archives: set[str] = set()
        self.logs: set[str] = set()
        self.refused: list[SkippedArchive] = []

    def walk(self, root: Path) -> None:
        """Search a folder and its subfolders."""
        for name, folders, files in os.walk(root, followlinks=True, onerror=self._refuse):
            folder = Path(name).resolve()
            if folder in self._visited:
                folders.clear()
                continue
            self._visited.add(folder)
            folders[:] = [subfolder for subfolder in folders if subfolder != CACHE_FOLDER]
            if (kinds := self._kinds) is not None:
                recordings = [each for each in folders if kinds.is_folder_of_one(folder / each)]
                self.logs.update((folder / each).as_posix() for each in recordings)
                folders[:] = [each for each in folders if each not in recordings]
            for path in (folder / file for file in files):
                if path.suffix == SUFFIX or (kinds is not None and kinds.is_log(path, files)):
                    self.add(path)

    def add(self, path: Path, *, named: bool = False) -> None:
        """Add a file, or the folder of one recording; `named` is one that was named itself."""
        if path.is_dir():
            self.logs.add(path.as_posix())
        elif not os.path.isfile(path):  # noqa: PTH113 - False where it cannot be reached
            self.refused.append(
                SkippedArchive(path.as_posix(), "is not a regular file that can be read")
            )
        elif self._kinds is None:
            if named and path.suffix.lower() != SUFFIX:
                problem = "is not an archive, and a log needs the description of its arm"
                raise InputError(path, problem, remedy="add --urdf ARM.urdf")
            self.archives.add(path.as_posix())
        elif path.suffix.lower() == SUFFIX and self._kinds.is_archive(path):
            self.archives.add(path.as_posix())
        elif not self._kinds.is_other(path):
            self.logs.add(path.as_posix())

    def _refuse(self, error: OSError) -> None:
        folder = Path(os.fsdecode(error.filename)).as_posix()
        self.refused.append(SkippedArchive(folder, f"cannot be read: {error.strerror}"))
