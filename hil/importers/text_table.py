"""Text tables as robots, controllers and spreadsheets write them, read by column with pandas."""

from __future__ import annotations

import csv
import io
import re
from bisect import bisect_right
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cached_property
from itertools import count
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.errors import SourceError
from hil.importers.column_map import HOLE, Column, Format
from hil.importers.conclusions import Excerpt, LeftOut, Omitted
from hil.importers.date_stamps import nanoseconds_of_dates
from hil.importers.dialect import (
    FORTRAN,
    MISSING,
    Dialect,
    dialect_of,
    is_written,
    number_of,
    thousands_mark,
    with_points,
)
from hil.importers.list_cells import spread_lists
from hil.importers.log_text import COMMENTS, table_text, text_of
from hil.importers.long_text import LongText, long_text
from hil.importers.stated_units import stated_unit, without_unit
from hil.importers.units import unit_of

if TYPE_CHECKING:
    import pandas as pd


_EMPTY: Final = "record again, or give the file that has the samples"
_PROBE_LINES: Final = 100  # lines
_MAX_NAMES_SHOWN: Final = 300  # characters
_MAX_CELL_SHOWN: Final = 30  # characters
_MAX_TIME_DIGITS: Final = 30  # digits before the point, more than of nanoseconds since 1970
_QUOTES: Final = "\"'"
_BRACKETS: Final = "[]() "
# Of columns, as PLCs and programs write them below the names.
_TYPE: Final = re.compile(
    r"l?real|float(32|64)?|double|single|numeric|number|[usld]{0,2}int(8|16|32|64)?|integer|bool"
    r"(ean)?|l?time|date|datetime|string|text|d?word|byte|[<>]?[fiu][248]"
)


class _Layout(NamedTuple):
    """The lines of a table by what they are: numbers of lines from 1, with their text."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    rows: list[tuple[int, str]]
    repeated: int  #: lines that repeat the header between the rows
    empty: list[int]  #: lines between the rows that are empty


@dataclass(frozen=True, eq=False)
class TextTable:
    """A text table of numbers, not yet converted."""

    path: Path
    names: tuple[str, ...]  #: of the columns; empty if the file has none
    units: tuple[str, ...]  #: stated in a line below the names; empty if there is none
    width: int  #: number of columns
    lines: list[str]  #: rows of numbers as text
    numbered: Sequence[int]  #: line numbers in the file, from 1
    dialect: Dialect
    gaps: bool  #: whether rows may lack numbers
    left_out: tuple[LeftOut | Excerpt, ...] = ()
    interrupted: int | None = None  #: first empty line at which rows may be missing
    unbroken: int | None = None  #: first rows, that follow each other in the file; None for all
    _converted: dict[tuple[int, ...], Array] = field(default_factory=dict, compare=False)
    _times: dict[tuple[int, int], Sequence[int | None]] = field(default_factory=dict, compare=False)

    @classmethod
    def read(cls, path: Path, form: Format, longest: int | None = None) -> TextTable:
        """Read a file and detect its encoding, dialect, header and units.

        Of one with more lines than `longest` stretches are read.

        Raises:
            SourceError: it cannot be read, or has no row of numbers.
        """
        long = None if longest is None else long_text(path, form, longest)
        numbered, text = _numbered_lines(path, form, long)
        comments = [line for _, line in numbered if line.lstrip().startswith(COMMENTS)]
        numbered = [entry for entry in numbered if not entry[1].lstrip().startswith(COMMENTS)]
        filled = [line for _, line in numbered if line.strip()]
        if not filled:
            raise SourceError(path, "has no row of numbers", remedy=_EMPTY)
        dialect = dialect_of(filled[-_PROBE_LINES:], form)  # notes are above the rows
        if form.transposed:
            numbered = _transposed([entry for entry in numbered if entry[1].strip()], dialect, path)
        names, units, rows, repeated, empty = _layout(numbered, dialect, path, form)
        if FORTRAN.search(rows[0][1]):
            rows = [(number, FORTRAN.sub("e", line)) for number, line in rows]
        width = _width(names, dialect.cells(rows[0][1]), path)
        beginning = rows[:_PROBE_LINES]
        if any(names[width:]) and all(len(dialect.cells(line)) <= width for _, line in beginning):
            raise _unlike(names, width, path)
        if not names and form.header is None and comments:
            commented = dialect.cells(comments[-1].lstrip().lstrip("#%/"))
            names = tuple(commented) if len(commented) == width > 1 else ()
        is_cut = not form.transposed and _is_cut(rows, dialect, width, text)
        rows = rows[:-1] if is_cut else rows
        omitted = {
            Omitted.HEADERS: repeated,
            Omitted.EMPTY_LINES: len(empty),
            Omitted.CUT_ROW: int(is_cut),
        }
        left_out: tuple[LeftOut | Excerpt, ...] = tuple(
            LeftOut(what, lines) for what, lines in omitted.items() if lines
        )
        numbers = [number for number, _ in rows]
        lines = [line for _, line in rows]
        gaps = form.missing != "refuse"
        interrupted = None if gaps or form.skip_empty else _interruption(numbers, empty)
        unbroken = None
        if long is not None:
            left_out = (*left_out, long.excerpt)
            unbroken = bisect_right(numbers, long.unbroken)
        return cls(
            path,
            names,
            units,
            width,
            lines,
            numbers,
            dialect,
            gaps,
            left_out,
            interrupted,
            unbroken,
        )

    @property
    def row_numbers(self) -> NDArray[np.intp]:
        """Place of each row in the file (m,), from 0."""
        if self.unbroken is None:
            return np.arange(len(self.lines))
        return np.asarray(self.numbered) - self.numbered[0]

    def unit(self, column: Column) -> str | None:
        """Return the unit that the file states for a column: below its name, or in brackets.

        One that is not known is returned as it is written.
        """
        place = self._place(column)
        if place is None:
            return None
        below = self.units[place] if place < len(self.units) else ""
        name = self.names[place] if place < len(self.names) else ""
        return stated_unit(below) or without_unit(name)[1]

    @property
    def lacks_numbers(self) -> bool:
        """Whether cells at the start are empty."""
        return any("" in self.dialect.cells(line) for line in self.lines[:_PROBE_LINES])

    @property
    def texts(self) -> list[str | None]:
        """The text of each column, None if it is a number or not the same in first and last row."""
        first, last = (self.dialect.cells(self.lines[row]) for row in (0, -1))
        texts: list[str | None] = []
        for column in range(self.width):
            ends = {row[column] if column < len(row) else "" for row in (first, last)}
            text = ends.pop() if len(ends) == 1 else ""
            texts.append(None if not text or self.is_number(text) else text)
        return texts

    def is_number(self, cell: str) -> bool:
        """Return whether a cell is a number, a missing one, or a date stamp."""
        return is_written(cell, self.dialect)

    def has(self, name: str) -> bool:
        """Return whether a column has this name, with or without its unit."""
        return self._place(name) is not None

    def numbers(self, columns: Sequence[Column], field: str, _array: str | None = None) -> Array:
        """Return columns as numbers, shape (rows, columns), NaN where missing ones are allowed.

        They are converted once, and read-only.

        Raises:
            SourceError: no such column, or a cell that is not a finite number.
        """
        indices = [self._index(column, field) for column in columns]
        key = tuple(indices)
        if key not in self._converted:
            values = self._numbers(indices, field)
            values.flags.writeable = False
            self._converted[key] = values
        return self._converted[key]

    def _numbers(self, indices: Sequence[int], field: str) -> Array:
        try:
            values = self._simple_numbers(indices)
        except ValueError:  # a cell is not a number as Python writes it
            values = self._written_numbers(indices)
        if np.isfinite(values).all():
            return np.asarray(values)
        return np.column_stack([self._cell_by_cell(index, field) for index in indices])

    def _simple_numbers(self, indices: Sequence[int]) -> Array:
        """Return columns (m, k) without pandas, whose import takes longer than reading most logs.

        Raises:
            ValueError: a cell is not a number of Python, or the dialect has other ones.
        """
        if not self._is_simple:
            raise ValueError("numbers are written in another way")
        used, places = np.unique(indices, return_inverse=True)
        values = np.loadtxt(
            self.lines,
            delimiter=self.dialect.delimiter,
            usecols=used.tolist(),
            ndmin=2,
            comments=None,
        )
        if len(values) != len(self.lines):
            raise ValueError("an empty line has no numbers")
        return np.asarray(values[:, places])

    def _written_numbers(self, indices: Sequence[int]) -> Array:
        """Return columns (m, k) as the dialect writes them, NaN without a number."""
        try:
            frame = self._frame(
                indices,
                dtype=np.float64,
                decimal=self.dialect.decimal,
                keep_default_na=False,
                na_values=MISSING,
            )
        except ValueError:  # a cell is not a number as written in this dialect
            return np.full((len(self.lines), 1), np.nan)
        return np.asarray(frame[list(indices)].to_numpy(copy=True))

    @cached_property
    def _is_simple(self) -> bool:
        """Whether the delimiter alone separates cells, with a decimal point in numbers."""
        return self.dialect.decimal == "." and not any('"' in line for line in self.lines)

    def matrix(self, _name: str | None, field: str) -> Array:
        """Return all columns; see `numbers`."""
        return self.numbers(range(self.width), field)

    def times(
        self, column: Column, decimals: int, _array: str | None = None
    ) -> Sequence[int | None]:
        """Return a column of times as whole nanoseconds, exactly; of a single line, that line.

        There are `decimals` decimal places between the column's unit and the second; a date stamp
        needs none. Missing times are None where they are allowed. They are converted once.

        Raises:
            SourceError: no such column, or a time that is neither a number nor a date.
        """
        key = self._index(column, "time"), decimals
        if key not in self._times:
            self._times[key] = tuple(self._converted_times(*key))
        return self._times[key]

    def _converted_times(self, index: int, decimals: int) -> list[int | None]:
        if len(self.lines) == 1 and not self.names:
            texts = self.dialect.cells(self.lines[0])
            numbers = [self.numbered[0]] * len(texts)
        else:
            texts = self._texts(index)
            numbers = list(self.numbered)
        numerals = with_points(texts, self.dialect)
        times: list[int | None] = [_nanoseconds(text, decimals) for text in numerals]
        unread = [row for row, time in enumerate(times) if time is None]
        if len(unread) > len(times) / 2:
            times = nanoseconds_of_dates(texts)
            unread = [row for row, time in enumerate(times) if time is None]
        if unread and not self.gaps:
            text = texts[unread[0]]
            problem = f"line {numbers[unread[0]]} has {_shown(text)} for the time"
            raise SourceError(self.path, problem, field="time", remedy=self._remedy(text))
        return times

    def _remedy(self, text: str) -> str:
        """Return the remedy for a cell that is not a number."""
        mark = thousands_mark(text, self.dialect)
        if mark is None:
            return HOLE
        return f'if {mark!r} separates thousands: [format] thousands = "{mark}"; else {HOLE}'

    def _place(self, column: Column) -> int | None:
        """Return the index of a column, None if there is none; a name may lack its unit."""
        if not isinstance(column, str):
            return column if column < self.width else None
        if column in self.names:
            return self.names.index(column)
        bare = [without_unit(name)[0] for name in self.names]
        return bare.index(column) if bare.count(column) == 1 else None

    def _index(self, column: Column, field: str) -> int:
        place = self._place(column)
        same = [index for index, name in enumerate(self.names) if name == column]
        if len(same) > 1 and not field.startswith("time"):  # exports repeat their one clock
            raise SourceError(
                self.path,
                f"{len(same)} columns have the name {column!r}",
                field=field,
                remedy="rename them, or give their indices from 0 in the map:"
                f" {' or '.join(map(str, same))}",
            )
        if place is not None:
            return place
        if self.names:
            remedy = f"its columns are {', '.join(self.names)}"
        else:
            remedy = f"it has {self.width} columns and no header; count them from 0"
        raise SourceError(self.path, f"there is no column {column!r}", field=field, remedy=remedy)

    @cached_property
    def _widest(self) -> int:
        """Largest number of cells in a line."""
        delimiter = self.dialect.delimiter
        return max(
            len(self.dialect.cells(line) if '"' in line else line.split(delimiter))
            for line in self.lines
        )

    def _frame(self, indices: Sequence[int], **options: Any) -> pd.DataFrame:
        """Return columns by index, one row for each line."""
        import pandas as pd  # 0.4 s; only a text table needs it

        text = "\n".join(self.lines)
        delimiter = self.dialect.delimiter
        return pd.read_csv(
            io.StringIO(text),
            sep=r"\s+" if delimiter is None else delimiter,
            header=None,
            names=range(max(self._widest, self.width)),
            usecols=sorted(set(indices)),
            index_col=False,
            skipinitialspace=True,
            skip_blank_lines=False,
            quoting=csv.QUOTE_MINIMAL if '"' in text else csv.QUOTE_NONE,
            **options,
        )

    def _texts(self, index: int) -> list[str]:
        """Return the cells of a column as text; empty where a line is too short."""
        if self._is_simple:
            rows = (line.split(self.dialect.delimiter, index + 1) for line in self.lines)
            return [cells[index].strip() if index < len(cells) else "" for cells in rows]
        try:
            cells = self._frame([index], dtype=str, na_filter=False)[index].tolist()
        except ValueError:  # of a quotation mark
            cells = []
        if len(cells) == len(self.lines):
            return [cell.strip() if isinstance(cell, str) else "" for cell in cells]
        odd = next((k for k, line in enumerate(self.lines) if line.count('"') % 2), 0)
        problem = f"line {self.numbered[odd]} has a quotation mark that is not closed"
        raise SourceError(self.path, problem, remedy="remove it")

    def _cell_by_cell(self, index: int, field: str) -> Array:
        """Return a column as numbers, or raise the error that names the first invalid cell."""
        texts = self._texts(index)
        numerals = with_points(texts, self.dialect)
        values = np.array([number_of(text) for text in numerals])
        if self.gaps or (not np.isfinite(values).any() and len(set(texts)) == 1):
            values[~np.isfinite(values)] = np.nan
            return values  # of a column without any number the reader knows the joint
        invalid = np.flatnonzero(~np.isfinite(values))
        if not invalid.size:
            return values
        row = int(invalid[0])
        name = self.names[index] if index < len(self.names) else str(index)
        problem = (
            f"line {self.numbered[row]} has {_shown(texts[row])} in column {name}, not a number"
        )
        remedy = self._remedy(texts[row])
        raise SourceError(self.path, problem, field=field, remedy=remedy)


def _numbered_lines(
    path: Path, form: Format, long: LongText | None
) -> tuple[list[tuple[int, str]], str]:
    """Return the lines of a file, or the sampled lines of a long one, and their text."""
    text = text_of(path, form) if long is None else table_text(path, long.text)
    text = spread_lists(path, text, drop=form.missing != "refuse")
    numbers = count(1) if long is None else long.numbers
    every = zip(numbers, text.splitlines(), strict=False)
    return [(number, line) for number, line in every if number > form.skip_rows], text


def _layout(numbered: list[tuple[int, str]], dialect: Dialect, path: Path, form: Format) -> _Layout:
    """Return names, units and rows of a table; lines above the names and repeated ones are gone."""
    filled = [(number, line) for number, line in numbered if line.strip()]
    begin = 1 if form.header else _first_row(filled, dialect)
    if form.header is False:
        begin = 0
    if begin >= len(filled):
        raise SourceError(path, "has no row of numbers", remedy=_EMPTY)
    head = [dialect.cells(line) for _, line in filled[:begin]]
    units: list[str] = []
    while len(head) > 1:
        if _are_units(head[-1]):
            units = head.pop()
        elif _are_types(head[-1]) and len(head[-1]) == len(head[-2]):
            head.pop()
        else:
            break
    names = [cell.strip(_QUOTES).strip() for cell in head[-1]] if head else []
    last = filled[-1][0]
    rows = [entry for entry in numbered if filled[begin][0] <= entry[0] <= last]
    above = {line.strip() for _, line in filled[:begin]}
    repeats = sum(line.strip() in above for _, line in rows)
    if repeats:
        rows = _without_heads(rows, above)
    empty = [number for number, line in rows if not line.strip()]
    rows = [entry for entry in rows if entry[1].strip()]
    return _Layout(tuple(names), tuple(units), rows, repeats, empty)


def _interruption(numbers: Sequence[int], empty: Sequence[int]) -> int | None:
    """Return the first empty line between rows; None if one follows each row, or there is none."""
    every_row = len(empty) > 1 and len(set(np.diff(numbers))) == 1
    return None if every_row or not empty else empty[0]


def _is_cut(rows: Sequence[tuple[int, str]], dialect: Dialect, width: int, text: str) -> bool:
    """Return whether the last row ends too early, as of a logger that was killed.

    It has fewer cells than the row before it; or the file does not end with its line, and the last
    number has fewer digits than in any other row.
    """
    if len(rows) < 2 or width < 2:
        return False
    last = dialect.cells(rows[-1][1])
    if len(last) < width:
        return len(dialect.cells(rows[-2][1])) >= width
    if text.endswith("\n"):
        return False
    others = min(len(dialect.cells(line)[-1]) for _, line in rows[-_PROBE_LINES:-1])
    return len(last[-1]) < others


def _without_heads(rows: Sequence[tuple[int, str]], head: Collection[str]) -> list[tuple[int, str]]:
    """Return rows without the lines of the head that a logger wrote again when it was restarted.

    Empty lines before and after them belong to the head.
    """
    data: list[tuple[int, str]] = []
    follows_head = False
    for number, line in rows:
        if line.strip() in head:
            while data and not data[-1][1].strip():
                data.pop()
            follows_head = True
        elif line.strip() or not follows_head:
            data.append((number, line))
            follows_head = False
    return data


def _first_row(lines: Sequence[tuple[int, str]], dialect: Dialect) -> int:
    """Return the place of the first row of numbers: of the usual length, with some number.

    A line above it without any number is a name, a unit or a note.
    """
    probed = [dialect.cells(line) for _, line in lines[: 5 * _PROBE_LINES]]
    numeric = [any(is_written(cell, dialect) and cell for cell in row) for row in probed]
    lengths = [len(row) for row, some in zip(probed, numeric, strict=True) if some]
    if not lengths:
        return len(lines)
    usual = max(sorted(set(lengths)), key=lengths.count)
    # A note such as "Rate, 250" has a number, too, and fewer cells.
    fitting = [some and len(row) >= usual for row, some in zip(probed, numeric, strict=True)]
    return fitting.index(True) if True in fitting else numeric.index(True)


def _are_units(cells: Sequence[str]) -> bool:
    """Return whether the cells of a line are units; some may be missing or unknown."""
    filled = [cell.strip(_BRACKETS) for cell in cells if cell.strip(f"{_BRACKETS}-")]
    known = sum(unit_of(cell) is not None for cell in filled)
    return known > 0.5 * len(filled) and all(map(stated_unit, filled))


def _are_types(cells: Sequence[str]) -> bool:
    """Return whether the cells of a line are types of columns."""
    return all(_TYPE.fullmatch(cell.strip(_QUOTES).lower()) for cell in cells)


def _width(names: Sequence[str], first: Sequence[str], path: Path) -> int:
    width = len(first)
    if len(names) < width > 1 and not first[-1]:
        width -= 1  # each line ends with a delimiter
    if names and len(names) < width:
        raise _unlike(names, width, path)
    return width


def _unlike(names: Sequence[str], width: int, path: Path) -> SourceError:
    shown = shorten(", ".join(names), _MAX_NAMES_SHOWN, placeholder=", ...")
    remedy = (
        "name every column in the header, or count columns from 0: [format] header = false and"
        " skip_rows"
    )
    if all(name.lstrip("-").isdecimal() for name in names):
        remedy = "write numbers with points, or with commas and semicolons between the columns"
    problem = f"has {len(names)} names ({shown}) above rows of {width} numbers"
    return SourceError(path, problem, remedy=remedy)


def _shown(cell: str) -> str:
    """Return a cell for a message, the beginning of a long one."""
    if not cell:
        return "nothing"
    is_long = len(cell) > _MAX_CELL_SHOWN
    return repr(cell[:_MAX_CELL_SHOWN]) + (" ..." if is_long else "")


def _transposed(
    numbered: list[tuple[int, str]], dialect: Dialect, path: Path
) -> list[tuple[int, str]]:
    """Return columns as lines, numbered by sample."""
    cells = [dialect.cells(line) for _, line in numbered]
    widths = {len(row) for row in cells}
    if len(widths) > 1:
        problem = f"its lines have from {min(widths)} to {max(widths)} numbers"
        remedy = "all channels must be equally long"
        raise SourceError(path, problem, field="format.transposed", remedy=remedy)
    joiner = " " if dialect.delimiter is None else dialect.delimiter
    return [(sample, joiner.join(row)) for sample, row in enumerate(zip(*cells, strict=True))]


# Cells


def _nanoseconds(text: str, decimals: int) -> int | None:
    """Return a time exactly; None where it is no number, or no time."""
    try:
        time = Decimal(text)
        if time and time.adjusted() > _MAX_TIME_DIGITS:
            return None
        return int(time.scaleb(9 - decimals).to_integral())
    except (ArithmeticError, ValueError):
        return None
