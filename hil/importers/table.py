"""A text file of numbers in columns, read by column name or index."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.errors import SourceError
from hil.importers.column_map import Column, Format

Array = NDArray[np.float64]

_DELIMITERS = (",", ";", "\t", "|")
_COMMENTS = ("#", "%", "//")


@dataclass(frozen=True, eq=False)
class Table:
    """A log of numbers, not yet converted.

    Attributes:
        path: the file.
        names: column names, empty when the file has none.
        width: number of columns.
        lines: the rows of numbers as text.
        first_line: number of the first of them in the file, from 1.
        delimiter: between columns, None for white space.
    """

    path: Path
    names: tuple[str, ...]
    width: int
    lines: list[str]
    first_line: int
    delimiter: str | None

    @classmethod
    def read(cls, path: Path, form: Format) -> Table:
        """Read a file and find out its delimiter and header.

        Raises:
            SourceError: it cannot be read, or has no row of numbers.
        """
        try:
            text = path.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise SourceError(
                path, f"cannot be read ({error})", remedy="name a text file"
            ) from error
        lines = text.splitlines()
        start = form.skip_rows
        while start < len(lines) and _is_empty(lines[start]):
            start += 1
        delimiter = form.delimiter or _delimiter(lines[start : start + 2], form.decimal)
        names: tuple[str, ...] = ()
        if start < len(lines):
            cells = _cells(lines[start], delimiter)
            if form.header or (form.header is None and not _are_numbers(cells, form.decimal)):
                names = tuple(cell.strip().strip("\"'").strip() for cell in cells)
                start += 1
        while lines and _is_empty(lines[-1]):
            lines.pop()
        rows = lines[start:]
        if not rows:
            raise SourceError(path, "has no row of numbers")
        if form.decimal == ",":
            rows = [row.replace(",", ".") for row in rows]
        width = len(_cells(rows[0], delimiter))
        return cls(path, names, width, rows, start + 1, delimiter)

    def numbers(self, columns: Sequence[Column], field: str) -> Array:
        """Columns as numbers, shape (rows, columns).

        Raises:
            SourceError: no such column, or a cell that is no number.
        """
        indices = [self._index(column, field) for column in columns]
        try:
            return np.loadtxt(
                io.StringIO("\n".join(self.lines)),
                delimiter=self.delimiter,
                usecols=indices,
                comments=None,
                ndmin=2,
                dtype=np.float64,
            )
        except ValueError:
            self._blame(indices, field)
            raise

    def stamps(self, column: Column, decimals: int) -> NDArray[np.int64]:
        """A column of times as whole nanoseconds, exactly as written; shape (rows,).

        Args:
            column: name or index.
            decimals: decimal places between the column's unit and the second.
        """
        index = self._index(column, "time")
        stamps = []
        for row, line in enumerate(self.lines):
            cells = _cells(line, self.delimiter)
            try:
                stamps.append(int(Decimal(cells[index].strip()).scaleb(9 - decimals).to_integral()))
            except (IndexError, InvalidOperation, ValueError, OverflowError) as error:
                found = repr(cells[index].strip()) if index < len(cells) else "nothing"
                raise SourceError(
                    self.path,
                    f"line {self.first_line + row} has {found} for the time",
                    field="time",
                ) from error
        return np.array(stamps, np.int64)

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

    def _blame(self, indices: Sequence[int], field: str) -> None:
        """Raise the error that names the first cell that is no number."""
        for row, line in enumerate(self.lines):
            cells = _cells(line, self.delimiter)
            for index in indices:
                cell = cells[index].strip() if index < len(cells) else None
                if cell is None or not _is_number(cell):
                    name = self.names[index] if index < len(self.names) else str(index)
                    raise SourceError(
                        self.path,
                        f"line {self.first_line + row} has "
                        f"{'nothing' if not cell else repr(cell)} in column {name}, not a number",
                        field=field,
                        remedy="correct the line, or cut the log before it",
                    )


def _is_empty(line: str) -> bool:
    text = line.strip()
    return not text or text.startswith(_COMMENTS)


def _cells(line: str, delimiter: str | None) -> list[str]:
    return line.split(delimiter)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _are_numbers(cells: Sequence[str], decimal: str) -> bool:
    return all(_is_number(cell.strip().replace(decimal, ".")) for cell in cells if cell.strip())


def _delimiter(lines: Sequence[str], decimal: str) -> str | None:
    """The delimiter that the first lines have alike; None for white space."""
    for candidate in _DELIMITERS:
        counts = {line.count(candidate) for line in lines}
        if candidate != decimal and counts and 0 not in counts:
            return candidate
    return None
