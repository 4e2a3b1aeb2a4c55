"""Files of logs, each parsed once however often a recording is read from it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from hil.importers.array_files import READERS, ArrayFile, format_of
from hil.importers.column_map import Format
from hil.importers.text_table import TextTable

TEXTS: Final = (".csv", ".txt", ".dat", ".tsv", ".asc", ".log", ".gz")
_ARRAYS: Final = tuple(suffix for suffix in READERS if suffix not in (".mcap", ".m", ".json"))
MARKS: Final = ("manifest.json", "metadata.yaml", "cell.toml", "plan.json", "results.json")
"""Files of a campaign, a bag or a folder of results."""


def files_in(folder: Path) -> list[Path]:
    """Return the files of a folder that may be tables or arrays, in order of their names."""
    suffixes = (*TEXTS, *_ARRAYS)
    return sorted(
        path for path in folder.iterdir() if path.suffix.lower() in suffixes and path.is_file()
    )


def is_folder_of_logs(path: Path) -> bool:
    """Return whether a folder has tables or arrays, and is no campaign, no bag and no result."""
    try:
        names = {file.name for file in path.iterdir()}
        of_others = any(path.glob("*.mcap")) or any(path.glob("*.db3*")) or any(path.glob("*.bag"))
        return not (names & {*MARKS} or of_others) and bool(files_in(path))
    except OSError:
        return False


class LogFiles:
    """Parsed files by path and format; a file is not read again when it changes.

    Some `arrays` may be given, such as an episode's that shares a file with others.

    Attributes:
        longest: rows that are read of a recording, see :mod:`hil.importers.excerpt`; None for all.
    """

    def __init__(
        self, arrays: Mapping[Path, ArrayFile] | None = None, *, longest: int | None = None
    ) -> None:
        self.longest = longest
        self._arrays: dict[Path, ArrayFile] = dict(arrays or {})
        self._tables: dict[tuple[Path, str], TextTable] = {}

    def arrays(self, path: Path) -> ArrayFile:
        """Return a file of arrays.

        Raises:
            SourceError: it cannot be read, or has no array of numbers.
        """
        if path not in self._arrays:
            self._arrays[path] = ArrayFile(path)
        return self._arrays[path]

    def table(self, path: Path, form: Format) -> TextTable:
        """Return a text table.

        Raises:
            SourceError: it cannot be read, or has no row of numbers.
        """
        key = path, form.model_dump_json()
        if key not in self._tables:
            self._tables[key] = TextTable.read(path, form, self.longest)
        return self._tables[key]

    def file(self, path: Path, form: Format) -> TextTable | ArrayFile:
        """Return arrays or a table, by the suffix of the file; see both."""
        return self.arrays(path) if format_of(path) in READERS else self.table(path, form)
