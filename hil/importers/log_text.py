"""Text of a log in any usual encoding; or what else a file is."""

from __future__ import annotations

import errno
import re
import zipfile
import zlib
from pathlib import Path
from typing import Final

from hil.base.errors import SourceError
from hil.base.safe_input import (
    GZIP,
    CompressionError,
    open_file,
    read_text,
    remedy_for_missing,
)
from hil.base.terminal_text import typed
from hil.importers.array_files import READERS
from hil.importers.column_map import Format
from hil.importers.spreadsheet import is_spreadsheet, text_of_sheet

COMMENTS: Final = ("#", "%", "//")
"""Starts of lines that are no rows."""
_ROSTOPIC = "%time,"  # of `rostopic echo -p`
_MAX_BYTES: Final = 1 << 31  # bytes; several times as many in memory
# Cells in apostrophes, or as spreadsheets protect text: ="0.5".
_OTHER_QUOTES: Final = re.compile(r"""(?<![^\s,;|])(?:'([^'"\n]*)'|="([^"\n]*)")(?![^\s,;|])""")
_MARK_BYTES: Final = 100  # bytes that are read for a mark
_OF_PANDAS: Final = "save its table with pandas: {}(FILE).to_parquet('log.parquet')"
_BINARY_MAGICS: Final = {
    b"PK\x03\x04": (
        "a zip file",
        "unpack it: unzip FILE; if it is a spreadsheet, it is cut off: copy it again",
    ),
    b"\x28\xb5\x2f\xfd": ("compressed by zstd", "unpack it: unzstd FILE"),
    b"\x89HDF\r\n": (
        "HDF5",
        "save its arrays, of h5py.File(FILE) as f, by names of your choice: "
        "numpy.savez('log.npz', t=f['t'], q=f['q'], tau=f['tau'])",
    ),
    b"ARROW1": ("Feather", _OF_PANDAS.format("pandas.read_feather")),
    b"\x80\x03": ("a pickle of Python", _OF_PANDAS.format("pandas.read_pickle")),
    b"\x80\x04": ("a pickle of Python", _OF_PANDAS.format("pandas.read_pickle")),
    b"\x80\x05": ("a pickle of Python", _OF_PANDAS.format("pandas.read_pickle")),
    b"PAR1": ("Parquet", "let its name end in .parquet"),
    b"\x93NUMPY": ("an array of numpy", "let its name end in .npy"),
    b"MATLAB": ("MATLAB's format", "let its name end in .mat"),
    b"\x89MCAP0": ("MCAP", "let its name end in .mcap"),
    b"#ROSBAG": ("a bag of ROS 1", "let its name end in .bag"),
    b"SQLite format 3": ("a database, as bags of ROS 2 are", "let its name end in .db3"),
}
"""Formats by the bytes at their start, each with a remedy."""
_MARKUP: Final = re.compile(r"\ufeff?\s*(<[?!A-Za-z]|[{\[]\s*[\"{\[]|(?:---\s+)?header:\s)")


def _not_a_table(path: Path, text: str) -> SourceError:
    """Return the error for XML, JSON or YAML in place of rows."""
    start = text.lstrip("\ufeff \t\r\n")
    if not start.startswith("<"):
        if start[0] in "{[":
            remedy = f"let its name end in .json: mv {typed(path.name)} {typed(path.stem)}.json"
            return SourceError(path, "is JSON, not a table of numbers", remedy=remedy)
        remedy = "give the bag, or a table of its joint states (CSV)"
        return SourceError(path, "is YAML of messages, not a table of numbers", remedy=remedy)
    if "<robot" in text:
        remedy = f"give the recording first: LOG --urdf {path.name}"
        return SourceError(path, "is a robot description (URDF), not a recording", remedy=remedy)
    remedy = "give a table of numbers (CSV), .npz, .mat, .parquet or a bag"
    return SourceError(path, "is XML, not a table of numbers", remedy=remedy)


def _head_of(path: Path) -> bytes:
    """Return the first bytes of a file, without its compression by gzip."""
    with open_file(path) as stream:
        start = stream.read(_MARK_BYTES)
        if not start.startswith(GZIP):
            return start
    try:
        return zlib.decompressobj(wbits=31).decompress(start, _MARK_BYTES)
    except zlib.error as error:
        problem = f"its compressed bytes are cut off or damaged: {error}"
        raise CompressionError(errno.EIO, problem, str(path)) from error


def _refuse_binary(path: Path, start: bytes) -> None:
    """Raise SourceError for a file of a format that is no text, whatever its suffix."""
    for mark, (kind, remedy) in _BINARY_MAGICS.items():
        if start.startswith(mark):
            remedy = remedy.replace("FILE", typed(path.name))
            raise SourceError(path, f"is {kind}, not text", remedy=remedy)


def is_readable_text(path: Path) -> bool:
    """Return whether a file is text, which may be compressed, by its first bytes.

    Raises:
        OSError: it cannot be read.
    """
    start = _head_of(path)
    return not (is_spreadsheet(path, start) or any(map(start.startswith, _BINARY_MAGICS)))


def text_of(path: Path, form: Format) -> str:
    """Return the text of a file in any usual encoding, or of a sheet of a spreadsheet.

    Raises:
        SourceError: it cannot be read, or has another format than a table.
    """
    try:
        start = _head_of(path)
        if is_spreadsheet(path, start):
            return text_of_sheet(path, form)
        _refuse_binary(path, start)
        text = read_text(path, _MAX_BYTES, encoding=form.encoding, or_latin=True)
    except SourceError:
        raise
    except (OSError, ValueError, LookupError, zipfile.BadZipFile) as error:
        raise _unreadable(path, error) from error
    return table_text(path, text)


def table_text(path: Path, text: str) -> str:
    """Return the text of a table with quotation marks as CSV has them, and a header as the others.

    Raises:
        SourceError: it is XML, JSON or YAML.
    """
    text = text.removeprefix("%") if text.startswith(_ROSTOPIC) else text  # a header there
    text = _OTHER_QUOTES.sub(r'"\1\2"', text) if "'" in text or '="' in text else text
    if _MARKUP.match(text):
        raise _not_a_table(path, text)
    return text.rstrip("\0")  # of blocks that a disk had not yet written


def _unreadable(path: Path, error: Exception) -> SourceError:
    """Return the error for a file whose bytes are no text."""
    problem = f"cannot be read ({error.strerror if isinstance(error, OSError) else error})"
    remedy = f"give a text file, or one that ends in {', '.join(READERS)}"
    if isinstance(error, FileNotFoundError):
        remedy = remedy_for_missing(path, remedy)
    elif isinstance(error, CompressionError):
        name = typed(path.name)
        remedy = f"copy it again, or take what is there: zcat {name} > part.csv"
    return SourceError(path, problem, remedy=remedy)
