"""Text tables that are too long to be read whole: stretches of their lines."""

from __future__ import annotations

import gzip
import io
import os
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.base.safe_input import GZIP, encoding_by_start, open_file
from hil.importers.column_map import Format
from hil.importers.conclusions import Excerpt
from hil.importers.dialect import Dialect, dialect_of, number_of
from hil.importers.excerpt import PROBE_STRIDE, STRETCH_ROWS, activity, chosen_stretches
from hil.importers.log_text import COMMENTS, is_readable_text

_PROBE_BYTES: Final = 1 << 16  # bytes that show encoding and length of lines
# of the usual length, a line in a count by the size of the file
_MIN_LINE_LENGTH_SHARE: Final = 0.5
_COMPRESSED_LINE_BYTES: Final = 4  # bytes, a line of a log that is compressed
_DIALECT_LINES: Final = 100
_MAX_CHARACTERS: Final = 1 << 26  # characters that are read; lines of many columns are fewer


class LongText(NamedTuple):
    """Lines of a long text that are read."""

    numbers: list[int]  #: of the lines in the file, from 1
    text: str  #: of these lines
    unbroken: int  #: first lines, that follow each other
    excerpt: Excerpt


def long_text(path: Path, form: Format, longest: int) -> LongText | None:
    """Return stretches of a text of more lines than `longest`; None of another file.

    The file is read twice, never whole: once for what moves in each stretch, once for the lines of
    those that are chosen. The first stretch, which has the header, is always one of them.
    """
    try:
        if form.transposed or not _may_be_longer(path, longest) or not is_readable_text(path):
            return None
        return _excerpt(path, form, longest)
    except (OSError, EOFError, LookupError, zlib.error):
        return None  # whoever reads it whole says what is wrong


def _excerpt(path: Path, form: Format, longest: int) -> LongText | None:
    probes: list[list[list[float]]] = []
    total = size = 0
    dialect: Dialect | None = None
    for lines in _stretches(path, form):
        total += len(lines)
        size += sum(map(len, lines))
        dialect = dialect or _dialect(lines, form)
        probes.append(
            _probe(lines[len(lines) % PROBE_STRIDE :: PROBE_STRIDE] or lines[-1:], dialect)
        )
    if total <= longest or dialect is None:
        return None
    moved = activity(_of_one_width(probes))
    most = int(min(longest, _MAX_CHARACTERS * total / size) / STRETCH_ROWS)
    chosen = {0, *chosen_stretches(moved[1:], max(1, most - 1)) + 1}
    numbers: list[int] = []
    read: list[str] = []
    for index, lines in enumerate(_stretches(path, form)):
        if index in chosen:
            numbers += range(index * STRETCH_ROWS + 1, index * STRETCH_ROWS + 1 + len(lines))
            read += lines
    follow = next(k for k in range(len(chosen) + 1) if k not in chosen)
    excerpt = Excerpt(len(read), total, len(chosen))
    return LongText(numbers, "\n".join(read) + "\n", follow * STRETCH_ROWS, excerpt)


def _may_be_longer(path: Path, longest: int) -> bool:
    """Return whether a file may have more lines, by its size and the length of its first ones."""
    with open_file(path) as stream:
        start = stream.read(_PROBE_BYTES)
        size = os.fstat(stream.fileno()).st_size
    if start.startswith(GZIP):
        return size > longest * _COMPRESSED_LINE_BYTES
    lines = start.count(b"\n") or start.count(b"\r")
    return lines > 0 and size > longest * _MIN_LINE_LENGTH_SHARE * len(start) / lines


@contextmanager
def _opened(path: Path, form: Format) -> Iterator[io.TextIOWrapper]:
    with open_file(path) as stream:
        is_packed = stream.peek(len(GZIP)).startswith(GZIP)
        content = gzip.GzipFile(fileobj=stream) if is_packed else stream
        encoding = form.encoding or encoding_by_start(content.read(_PROBE_BYTES))
        content.seek(0)
        with io.TextIOWrapper(content, encoding, errors="replace") as text:
            yield text


def _stretches(path: Path, form: Format) -> Iterator[list[str]]:
    """Yield the lines of a file, without their ends, in stretches of equal number."""
    with _opened(path, form) as stream:
        while lines := [line.rstrip("\n") for line in islice(stream, STRETCH_ROWS)]:
            yield lines


def _dialect(lines: Sequence[str], form: Format) -> Dialect:
    filled = [line for line in lines if line.strip() and not line.lstrip().startswith(COMMENTS)]
    return dialect_of(filled[:_DIALECT_LINES], form)


def _probe(lines: Sequence[str], dialect: Dialect) -> list[list[float]]:
    """Return the numbers of lines, NaN for other cells."""
    return [
        [number_of(cell.replace(dialect.decimal, ".")) for cell in dialect.cells(line)]
        for line in lines
    ]


def _of_one_width(probes: Sequence[Sequence[Sequence[float]]]) -> list[Array]:
    """Return rows (k, c) of each stretch, as many columns as most rows have."""
    lengths = [len(row) for rows in probes for row in rows]
    width = int(np.bincount(lengths).argmax())
    nothing = [np.nan] * width
    return [
        np.array([row if len(row) == width else nothing for row in rows], np.float64)
        for rows in probes
    ]
