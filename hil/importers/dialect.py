"""How the cells of a text table are written: delimiters, decimal marks, missing numbers, dates."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from functools import cache
from typing import Final, NamedTuple

from hil.importers.column_map import Format

# Tried in this order; the last is that of numbers in quotation marks.
_DIALECTS = (
    (",", "."), (";", "."), ("\t", "."), ("|", "."), (None, "."),
    (";", ","), ("\t", ","), ("|", ","), (None, ","), (",", ","),
)  # fmt: skip
# 1.0D+03: double precision as Fortran writes it.
FORTRAN = re.compile(r"(?<=[\d.])[dD](?=[+-]?\d)")
_THOUSANDS: Final = ".,'\u2019 \u00a0\u202f"  # of which one may separate groups of three digits
_MISSING_TEXTS: Final = frozenset(
    {"", "-", "--", "na", "n/a", "#n/a", "#na", "null", "none", "nan", "-nan", "+nan", "nan(ind)"}
    | {"-nan(ind)", "1.#ind", "-1.#ind", "1.#qnan", "-1.#qnan", "1.#snan", "#num!", "#value!"}
    | {"#div/0!", "#ref!", "missing"}
)
"""What loggers, spreadsheets and run-time libraries write where there is no number; lower case."""
MISSING: Final = sorted({f(text) for text in _MISSING_TEXTS for f in (str, str.upper, str.title)})
_DAY: Final = r"\d{1,4}([-./])(?:\d{1,2}|[A-Za-z]{3})\1\d{1,4}"
_CLOCK: Final = r"\d{1,2}:\d{2}(?::\d{2}(?:[.,:]\d+)?)?(?:\s*[AaPp][Mm])?\s*(?:Z|[+-]\d{2}:?\d{2})?"
_DATE: Final = re.compile(rf"(?:{_DAY}(?:[ T]+{_CLOCK})?|{_CLOCK})")


class Dialect(NamedTuple):
    """How the cells of a line are written."""

    delimiter: str | None  #: between columns; None for white space
    decimal: str  #: decimal mark
    thousands: str | None = None  #: between groups of three digits, where the map states it

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line without quotation marks."""
        if self.delimiter is None:
            line = " ".join(line.split())
            delimiter = " "
        else:
            delimiter = self.delimiter
        if '"' not in line:
            return [cell.strip() for cell in line.split(delimiter)]
        parsed = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
        return [cell.strip() for cell in parsed]


def dialect_of(lines: Sequence[str], form: Format) -> Dialect:
    """Return the dialect in which most cells of lines are numbers, the first of equal ones."""
    marks = [form.decimal] if form.decimal else [".", ","]
    tried = [
        Dialect(delimiter, mark, form.thousands)
        for delimiter, mark in _DIALECTS
        if mark in marks and form.delimiter in (None, delimiter)
    ]
    if form.delimiter is not None and not tried:
        tried = [Dialect(form.delimiter, marks[0], form.thousands)]

    def share(dialect: Dialect) -> float:
        """Return the share of numbers in lines of the usual length that have any."""
        rows = [dialect.cells(line) for line in lines]
        lengths = [len(row) for row in rows]
        usual = max(sorted(set(lengths)), key=lengths.count)
        if usual == 1 and dialect.delimiter is not None and form.delimiter is None:
            return -1.0
        counts = [
            sum(is_written(cell, dialect) for cell in row)
            for row in rows
            if abs(len(row) - usual) <= 1
        ]
        numeric = [count for count in counts if count]
        return sum(numeric) / (usual * len(numeric)) if numeric else -1.0

    return max(tried, key=share)


def number_of(text: str) -> float:
    """Return the number that a text is, else NaN."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def thousands_mark(text: str, dialect: Dialect) -> str | None:
    """Return the mark between groups of three digits: one that is not the decimal mark, or None."""
    match = _groups(dialect.decimal).fullmatch(text)
    return None if match is None else match["mark"]


@cache
def _groups(decimal: str) -> re.Pattern[str]:
    marks = "".join(mark for mark in _THOUSANDS if mark != decimal)
    return re.compile(
        rf"[+-]?[1-9]\d{{0,2}}(?P<mark>[{re.escape(marks)}])\d{{3}}(?:(?P=mark)\d{{3}})*"
        rf"(?P<part>{re.escape(decimal)}\d*)?(?:[eE][+-]?\d+)?"
    )


def with_points(texts: Sequence[str], dialect: Dialect) -> list[str]:
    """Return cells of a column with a decimal point and without marks between thousands.

    Such marks are taken for what they are where the map states them, or where the column proves
    them: a number with both marks, or with two groups.
    """
    mark = dialect.thousands
    if mark is None:
        matches = [match for match in map(_groups(dialect.decimal).fullmatch, texts) if match]
        marks = {match["mark"] for match in matches}
        proved = any(match["part"] or match[0].count(match["mark"]) > 1 for match in matches)
        mark = marks.pop() if proved and len(marks) == 1 else None
    if mark is not None:
        pattern = _groups(dialect.decimal)
        texts = [text.replace(mark, "") if pattern.fullmatch(text) else text for text in texts]
    if dialect.decimal == ".":
        return list(texts)
    return [text.replace(dialect.decimal, ".") if "." not in text else text for text in texts]


def is_date(cell: str) -> bool:
    """Return whether a cell is a date stamp with the time of a day."""
    return bool(_DATE.fullmatch(cell)) and ":" in cell


def is_written(cell: str, dialect: Dialect) -> bool:
    """Return whether a cell is a number in this dialect, a missing one, or a date stamp."""
    pointed = dialect.decimal == "," and "." in cell
    numeral = cell.replace(dialect.decimal, ".")
    if not pointed and math.isfinite(number_of(numeral)):  # as most cells are
        return True
    if cell.lower() in _MISSING_TEXTS or _DATE.fullmatch(cell):
        return True
    if pointed:
        return thousands_mark(cell, dialect) is not None
    is_number = math.isfinite(number_of(FORTRAN.sub("e", numeral))) or numeral.lower() in (
        "inf",
        "-inf",
    )
    return bool(is_number) or thousands_mark(cell, dialect) is not None
