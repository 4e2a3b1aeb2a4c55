"""Known conditions of recordings that the logs lack, such as the room temperature."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path
from typing import Final

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.safe_input import read_input
from hil.fleet.naming import date_in

_FIELD: Final = "--conditions"
_DATES: Final = ("when", "date", "time", "timestamp", "datetime")
_ROBOT: Final = "robot"
_REMEDY: Final = (
    "give a CSV file with dates in a column `when`, and a column of numbers for each condition"
)
_DAY: Final = 86400.0  # s


@dataclass(frozen=True, eq=False)
class Conditions:
    """Numbers over time, of each robot or of all of them.

    Attributes:
        names: of the numbers.
        rows: by robot, "" for all: times since 1970 (m,) [s] in their order, and numbers (m, c),
            NaN where none is stated.
    """

    names: tuple[str, ...] = ()
    rows: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)

    @classmethod
    def load(cls, path: Path) -> Conditions:
        """Read a CSV file: a column with dates, the others numbers; with `robot` by robot.

        Raises:
            InputError: it cannot be read, or has no dates or no numbers.
        """
        reader = csv.DictReader(StringIO(read_input(path, _REMEDY)))
        columns = [name.strip() for name in reader.fieldnames or ()]
        reader.fieldnames = columns
        date = next((name for name in columns if name.lower() in _DATES), None)
        robot = next((name for name in columns if name.lower() == _ROBOT), None)
        names = tuple(name for name in columns if name and name not in (date, robot))
        if date is None or not names:
            problem = f"has the columns {', '.join(columns) or 'none'}"
            raise InputError(path, problem, field=_FIELD, remedy=_REMEDY)
        by_robot: dict[str, list[tuple[float, list[float]]]] = {}
        for number, row in enumerate(reader, 2):
            values = [_number(path, number, name, row[name]) for name in names]
            whose = (row[robot] or "").strip() if robot is not None else ""
            by_robot.setdefault(whose, []).append((_seconds(path, number, row[date]), values))
        rows = {}
        for whose, entries in by_robot.items():
            entries.sort(key=lambda entry: entry[0])
            times, numbers = zip(*entries, strict=True)
            rows[whose] = (np.array(times), np.array(numbers).reshape(len(times), len(names)))
        return cls(names, rows)

    def of(self, robot: str, when: datetime) -> dict[str, float]:
        """Return the numbers of a robot at a time, interpolated; none where none is stated.

        A row for the robot takes precedence over a row for all robots. Up to a day before the
        first row and after the last one counts as well.
        """
        found: dict[str, float] = {}
        for whose in ("", robot):
            if whose not in self.rows:
                continue
            times, numbers = self.rows[whose]
            at = when.timestamp()
            for name, column in zip(self.names, numbers.T, strict=True):
                known = np.isfinite(column)
                stated = times[known]
                if len(stated) and stated[0] - _DAY <= at <= stated[-1] + _DAY:
                    found[name] = float(np.interp(at, stated, column[known]))
        return found


def _seconds(path: Path, row: int, text: str | None) -> float:
    """Return a date as seconds since 1970."""
    stated = (text or "").strip()
    try:
        return float(stated)
    except ValueError:
        pass
    try:
        date = datetime.fromisoformat(stated)
    except ValueError:
        found = date_in(stated)
        if found is None:
            problem = f"row {row}: {stated!r} is not a date"
            raise InputError(path, problem, field=_FIELD, remedy="write it as 2026-03-15") from None
        date = datetime.fromisoformat(found)
    return (date if date.tzinfo is not None else date.replace(tzinfo=UTC)).timestamp()


def _number(path: Path, row: int, name: str, text: str | None) -> float:
    stated = (text or "").strip()
    if not stated:
        return float("nan")
    try:
        return float(stated)
    except ValueError:
        problem = f"row {row}: {stated!r} of {name} is not a number"
        raise InputError(path, problem, field=_FIELD, remedy="leave it empty if unknown") from None
