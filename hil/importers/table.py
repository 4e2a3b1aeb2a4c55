"""Text files of numbers in columns, read by column name or index."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.errors import SourceError
from hil.importers.arrays import READERS
from hil.importers.column_map import HOLE, Column, Format
from hil.reading import read_text, remedy_for_missing

Array = NDArray[np.float64]

_COMMENTS = ("#", "%", "//")
# Tried in this order; a decimal comma only where the comma is not the delimiter.
_WRITTEN = (
    (",", "."), (";", "."), ("\t", "."), ("|", "."), (None, "."),
    (";", ","), ("\t", ","), ("|", ","), (None, ","),
)  # fmt: skip
_ROSTOPIC = "%time,"  # of `rostopic echo -p`
_PROBED = 20  # lines
_LONGEST = 1 << 31  # bytes; several times as many in memory
_LONGEST_TIME = 30  # digits before the point, more than of nanoseconds since 1970
# 1.0D+03: double precision as Fortran writes it.
_FORTRAN = re.compile(r"(?<=[\d.])[dD](?=[+-]?\d)")
_MISSING = frozenset({"", "-", "--", "na", "n/a", "null", "none"})


@dataclass(frozen=True, eq=False)
class Table:
    """A text file of numbers, not yet converted."""

    path: Path
    names: tuple[str, ...]  #: of the columns; empty if the file has none
    width: int  #: number of columns
    lines: list[str]  #: rows of numbers as text, points and exponents as Python reads them
    numbered: Sequence[int]  #: line numbers in the file, from 1
    delimiter: str | None  #: between columns; None for white space
    gaps: bool  #: whether rows may lack numbers

    @classmethod
    def read(cls, path: Path, form: Format) -> Table:
        """Read a file and detect its delimiter, decimal mark and header.

        Raises:
            SourceError: it cannot be read, or has no row of numbers.
        """
        try:
            text = read_text(path, _LONGEST).removeprefix("\ufeff")
            if text.startswith(_ROSTOPIC):  # a header, not a comment
                text = text.removeprefix("%")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            problem = f"cannot be read ({reason})"
            remedy = f"name a text file, or one that ends in {', '.join(READERS)}"
            if isinstance(error, FileNotFoundError):
                remedy = remedy_for_missing(path, remedy)
            raise SourceError(path, problem, remedy=remedy) from error
        numbered = [
            (number, line)
            for number, line in enumerate(text.splitlines(), 1)
            if number > form.skip_rows and not line.lstrip().startswith(_COMMENTS)
        ]
        numbered = _between(numbered, path, form)
        delimiter, decimal = _written([line for _, line in numbered[:_PROBED]], form)
        if form.transposed:
            numbered = _transposed(numbered, delimiter, path)
        numbers, lines = [number for number, _ in numbered], [line for _, line in numbered]
        names: tuple[str, ...] = ()
        if lines:
            cells = lines[0].split(delimiter)
            if form.header or (form.header is None and not _are_numbers(cells, decimal)):
                names = tuple(cell.strip().strip("\"'").strip() for cell in cells)
                numbers, lines = numbers[1:], lines[1:]
        if not lines:
            raise SourceError(path, "has no row of numbers")
        if decimal == ",":
            lines = [line.replace(",", ".") for line in lines]
        if _FORTRAN.search(lines[0]):
            lines = [_FORTRAN.sub("e", line) for line in lines]
        width = len(lines[0].split(delimiter))
        if len(names) < width > 1 and not lines[0].split(delimiter)[-1].strip():
            width -= 1  # each line ends with a delimiter
        if names and len(names) < width:
            raise SourceError(
                path,
                f"has {len(names)} names ({', '.join(names)}) above rows of {width} numbers",
                remedy="name the other columns, or count columns from 0: [format] header = "
                "false and skip_rows",
            )
        return cls(path, names, width, lines, numbers, delimiter, form.missing == "drop")

    def numbers(self, columns: Sequence[Column], field: str, _array: str | None = None) -> Array:
        """Return columns as numbers, shape (rows, columns), NaN where missing ones are allowed.

        Raises:
            SourceError: no such column, or a cell that is not a finite number.
        """
        indices = [self._index(column, field) for column in columns]
        try:
            values = np.loadtxt(
                io.StringIO("\n".join(self.lines)),
                delimiter=self.delimiter,
                usecols=indices,
                comments=None,
                ndmin=2,
                dtype=np.float64,
            )
        except ValueError:
            values = self._cell_by_cell(indices, field)
        if not self.gaps and not np.isfinite(values).all():
            return self._cell_by_cell(indices, field)
        return np.asarray(values)

    def matrix(self, _name: str | None, field: str) -> Array:
        """Return all columns; see `numbers`."""
        return self.numbers(range(self.width), field)

    def times(self, column: Column, decimals: int, _array: str | None = None) -> list[int | None]:
        """Return a column of times as whole nanoseconds, exactly; of a single line, that line.

        There are `decimals` decimal places between the column's unit and the second. Missing times
        are None where they are allowed.

        Raises:
            SourceError: no such column, or a time that is not a number.
        """
        index = self._index(column, "time")
        if len(self.lines) == 1 and not self.names:
            texts = [(self.numbered[0], cell) for cell in self.lines[0].split(self.delimiter)]
        else:
            texts = [
                (number, (line.split(self.delimiter)[index : index + 1] or [""])[0])
                for number, line in zip(self.numbered, self.lines, strict=True)
            ]
        found = list[int | None]()
        for number, text in texts:
            if self.gaps and text.strip().lower() in (*_MISSING, "nan"):
                found.append(None)
                continue
            try:
                found.append(_nanoseconds(text, decimals))
            except (ArithmeticError, ValueError) as error:
                shown = repr(text.strip()) if text.strip() else "nothing"
                problem = f"line {number} has {shown} for the time"
                raise SourceError(self.path, problem, field="time", remedy=HOLE) from error
        return found

    def _index(self, column: Column, field: str) -> int:
        if isinstance(column, str):
            if column in self.names:
                return self.names.index(column)
        elif column < self.width:
            return column
        if self.names:
            remedy = f"its columns are {', '.join(self.names)}"
        else:
            remedy = f"it has {self.width} columns and no header; count them from 0"
        raise SourceError(self.path, f"there is no column {column!r}", field=field, remedy=remedy)

    def _cell_by_cell(self, indices: Sequence[int], field: str) -> Array:
        """Return what `numbers` does, or raise the error that names the first invalid cell."""
        values = np.full((len(self.lines), len(indices)), np.nan)
        for row, line in enumerate(self.lines):
            cells = line.split(self.delimiter)
            for place, index in enumerate(indices):
                cell = cells[index].strip() if index < len(cells) else ""
                number = float(cell) if _is_number(cell) else np.nan
                if np.isfinite(number):
                    values[row, place] = number
                elif not (self.gaps and (cell.lower() in _MISSING or _is_number(cell))):
                    name = self.names[index] if index < len(self.names) else str(index)
                    shown = repr(cell) if cell else "nothing"
                    raise SourceError(
                        self.path,
                        f"line {self.numbered[row]} has {shown} in column {name}, not a number",
                        field=field,
                        remedy=HOLE,
                    )
        return values


def _between(numbered: list[tuple[int, str]], path: Path, form: Format) -> list[tuple[int, str]]:
    """Remove empty lines before and after the numbers; one between them may be a lost row."""
    filled = [place for place, (_, line) in enumerate(numbered) if line.strip()]
    if not filled:
        raise SourceError(path, "has no row of numbers")
    if form.skip_empty:
        return [numbered[place] for place in filled]
    numbered = numbered[filled[0] : filled[-1] + 1]
    header = next((place for place, (_, line) in enumerate(numbered[1:], 1) if line.strip()), 1)
    numbered = numbered[:1] + numbered[header:]
    empty = next((number for number, line in numbered if not line.strip()), None)
    if empty is not None:
        raise SourceError(
            path,
            f"line {empty} is empty",
            remedy="remove it, or cut the log there; where empty lines mean nothing: [format] "
            "skip_empty = true; to skip lines of a header: [format] skip_rows",
        )
    return numbered


def _transposed(
    numbered: list[tuple[int, str]], delimiter: str | None, path: Path
) -> list[tuple[int, str]]:
    """Return columns as lines, numbered by sample."""
    cells = [line.split(delimiter) for _, line in numbered]
    widths = {len(row) for row in cells}
    if len(widths) > 1:
        problem = f"its lines have from {min(widths)} to {max(widths)} numbers"
        remedy = "all channels must be equally long"
        raise SourceError(path, problem, field="format.transposed", remedy=remedy)
    joiner = " " if delimiter is None else delimiter
    return [(sample, joiner.join(row)) for sample, row in enumerate(zip(*cells, strict=True))]


def _written(lines: Sequence[str], form: Format) -> tuple[str | None, str]:
    """Return delimiter (None for white space) and decimal mark: the first pair that gives numbers.

    The first line may be a header; if no pair fits, the delimiter that all lines have.
    """
    marks = [form.decimal] if form.decimal else [".", ","]
    tried = [(d, m) for d, m in _WRITTEN if m in marks and form.delimiter in (None, d)]
    if form.delimiter is not None and not tried:
        tried = [(form.delimiter, marks[0])]
    body = lines[1:] or lines
    for delimiter, mark in tried:
        split = [line.split(delimiter) for line in body]
        width = {len(row) for row in split}
        if len(width) > 1 or (width == {1} and delimiter is not None):
            continue
        if all(_are_numbers(row, mark) for row in split):
            return delimiter, mark
    for delimiter, mark in tried:
        if delimiter is not None and all(delimiter in line for line in lines[:2]):
            return delimiter, mark
    return form.delimiter, marks[0]


def _nanoseconds(text: str, decimals: int) -> int:
    """Return a time exactly; raise ValueError or ArithmeticError where it is invalid."""
    time = Decimal(text.strip())
    if time and time.adjusted() > _LONGEST_TIME:
        raise ValueError(f"{text!r} is not a time")
    return int(time.scaleb(9 - decimals).to_integral())


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _are_numbers(cells: Sequence[str], decimal: str) -> bool:
    """Return whether there are cells with content, all of them numbers."""
    filled = [cell.strip() for cell in cells if cell.strip().lower() not in _MISSING]
    if decimal == "," and any("." in cell for cell in filled):
        return False
    return bool(filled) and all(
        _is_number(_FORTRAN.sub("e", cell.replace(decimal, "."))) for cell in filled
    )
