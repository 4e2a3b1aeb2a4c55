"""Table of quantities over time: written by a batch and a trend, and read by a trend."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import date, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args

import numpy as np

from hil.base.errors import InputError
from hil.base.files import replace_file
from hil.base.safe_input import open_file
from hil.batch.estimates import BatchEstimate
from hil.batch.graph import BatchResult
from hil.fleet.conditions import Conditions
from hil.fleet.naming import date_in
from hil.fleet.quantities import (
    FollowedQuantity,
    QuantityName,
    mean_parameters,
    tracked_quantities,
)
from hil.fleet.series import DatedRecording, QuantityFamily, TypeSeries, moment_of
from hil.fleet.trend import FleetTrend

NAME: Final = "quantities"
"""Name of the table of `hil batch` that `hil trend` reads."""
_SERIES: Final = ("robot", "type", "joint", "quantity", "unit", "speed", "when", "value", "std")
_TREND: Final = (
    *("adjusted", "fitted", "change", "half", "rate", "rate_half"),
    *("p_value", "changed", "explained"),
)
_NEEDED: Final = ("robot", "joint", "quantity", "when", "value")
_NO_NUMBERS: Final = ("archive",)
_FIELD: Final = "table"

Row = dict[str, Any]
_Key = tuple[str, int]  # date of a recording, and its number among others of that date


def write_trend(path: Path, fleet: FleetTrend) -> None:
    """Write every value of every series as CSV, a row each; the file is replaced atomically.

    Raises:
        OSError: it cannot be written.
    """
    names = sorted(
        {name for robot in fleet.robots for each in robot.recordings for name in each.facts}
    )
    _write(path, (*_SERIES, *_TREND, *names), _rows_of_trend(fleet))


def _rows_of_trend(fleet: FleetTrend) -> Iterator[Row]:
    for robot in fleet.robots:
        facts = {each.when: each.facts for each in robot.recordings}
        for trend in robot.trends:
            shared = {
                "robot": robot.robot,
                "type": robot.kind,
                "joint": trend.joint,
                "quantity": trend.quantity,
                "unit": trend.unit,
                "speed": trend.speed,
                **{name: getattr(trend, name) for name in _TREND[2:]},
            }
            columns = (trend.values, trend.stds, trend.adjusted, trend.fitted)
            rows = zip(trend.dates, *(column.tolist() for column in columns), strict=True)
            for when, value, std, adjusted, fitted in rows:
                yield {
                    **shared,
                    "when": when,
                    "value": value,
                    "std": std,
                    "adjusted": adjusted,
                    "fitted": fitted,
                    **facts[when],
                }


def write_batch(folder: Path, result: BatchResult) -> list[Path]:
    """Write the quantities of every repetition with a date into an existing folder.

    Return the path, none if no repetition has a date.

    Raises:
        OSError: it cannot be written.
    """
    dated = [each for each in result.repetitions if each.when]
    if not dated:
        return []
    names = sorted({name for each in dated for name in each.facts})
    path = folder / f"{NAME}.csv"
    _write(path, (*_SERIES, "archive", *names), _rows_of_batch(result, dated))
    return [path]


def _rows_of_batch(result: BatchResult, dated: Sequence[BatchEstimate]) -> Iterator[Row]:
    by_type: dict[str, list[BatchEstimate]] = {}
    for each in dated:
        arm = result.arms[each.arm]
        by_type.setdefault(arm.arm_type or arm.digest, []).append(each)
    for kind, members in by_type.items():
        model = result.arms[members[0].arm].cell.model
        estimates = [each.estimate for each in members]
        for tracked in tracked_quantities(model, estimates, mean_parameters(estimates)):
            if not len(tracked.weights):
                continue  # the error of a reference model: needs the sums of the recordings
            values, variances = tracked.in_estimates(estimates)
            numbers = zip(members, values.tolist(), np.sqrt(variances).tolist(), strict=True)
            for each, value, std in numbers:
                arm = result.arms[each.arm]
                yield {
                    "robot": arm.robot or arm.name,
                    "type": kind,
                    **tracked.followed._asdict(),
                    "when": each.when,
                    "value": value,
                    "std": std,
                    "archive": each.archive,
                    **each.facts,
                }


def _write(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    with (
        replace_file(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _text(value) for name, value in row.items()} for row in rows)


def _text(value: Any) -> Any:
    if isinstance(value, bool):
        return str(value).lower()
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    return value


# Reading


def is_table(path: Path) -> bool:
    """Return whether a file has the columns of a table of quantities."""
    try:
        return set(_NEEDED) <= set(_header(path))
    except (OSError, UnicodeDecodeError, ValueError, csv.Error):
        return False


def _header(path: Path) -> list[str]:
    if path.suffix.lower() == ".parquet":
        from pyarrow import parquet  # a tenth of a second, only where tables are read

        return list(parquet.read_schema(path).names)
    if path.suffix.lower() != ".csv":
        return []
    with open_file(path) as stream:
        first = stream.readline(1 << 16).decode("utf-8")
    return next(csv.reader([first]), [])


def read_table(path: Path, conditions: Conditions = Conditions()) -> list[TypeSeries]:  # noqa: B008
    """Read the series of a table: CSV or Parquet, a row for each value.

    Columns are robot, joint, quantity, when and value, and where known type, unit, speed, std. All
    other columns of numbers, such as temperatures, may explain a change; those that a trend adds
    are passed over.

    Args:
        path: of the table.
        conditions: of recordings, in addition to its columns.

    Raises:
        InputError: it cannot be read, or a row is invalid.
    """
    entries = [_Entry.of(path, number, row) for number, row in enumerate(_rows(path), 2)]
    by_type: dict[str, list[_Entry]] = {}
    for entry in entries:
        by_type.setdefault(entry.kind, []).append(entry)
    if not by_type:
        raise InputError(path, "has no row", field=_FIELD, remedy="choose another table")
    return [_series(kind, members, conditions) for kind, members in by_type.items()]


class _Entry(NamedTuple):
    """One row of a table."""

    kind: str
    robot: str
    followed: FollowedQuantity
    when: str
    value: float
    std: float
    facts: Mapping[str, float]

    @classmethod
    def of(cls, path: Path, number: int, row: Mapping[str, Any]) -> _Entry:
        """Return a row; InputError if it is invalid."""
        quantity: QuantityName | None = next(
            (name for name in get_args(QuantityName) if name == row["quantity"]), None
        )
        if quantity is None:
            problem = (
                f"row {number}: {row['quantity']!r} is none of {', '.join(get_args(QuantityName))}"
            )
            raise InputError(path, problem, field="quantity", remedy="leave such rows out")
        when = _date(row["when"])
        if when is None:
            problem = f"row {number}: {row['when']!r} is not a date"
            raise InputError(path, problem, field="when", remedy="write it as 2026-03-15")
        followed = FollowedQuantity(
            str(row["joint"]), quantity, str(row.get("unit") or ""), _number(row.get("speed"))
        )
        known = (*_SERIES, *_TREND, *_NO_NUMBERS)
        facts = {name: _number(value) for name, value in row.items() if name not in known}
        return cls(
            kind=str(row.get("type") or ""),
            robot=str(row["robot"]),
            followed=followed,
            when=when,
            value=_or_nan(_number(row["value"])),
            std=_number(row.get("std")) or 0.0,
            facts={name: value for name, value in facts.items() if value is not None},
        )


def _series(kind: str, entries: Sequence[_Entry], conditions: Conditions) -> TypeSeries:
    """Return the series of one type; several values of one date are from several recordings."""
    facts: dict[str, dict[_Key, dict[str, float]]] = {}
    values: dict[FollowedQuantity, dict[str, dict[_Key, tuple[float, float]]]] = {}
    for entry in entries:
        known = values.setdefault(entry.followed, {}).setdefault(entry.robot, {})
        number = 0
        while (entry.when, number) in known:
            number += 1
        known[entry.when, number] = (entry.value, entry.std**2)
        facts.setdefault(entry.robot, {}).setdefault((entry.when, number), {}).update(entry.facts)
    keys = {
        robot: sorted(dates, key=lambda key: (moment_of(key[0]), key[1]))
        for robot, dates in sorted(facts.items())
    }
    recordings = {
        robot: tuple(
            DatedRecording(key[0], {**facts[robot][key], **conditions.of(robot, moment_of(key[0]))})
            for key in ordered
        )
        for robot, ordered in keys.items()
    }
    families = []
    for followed, of_robots in values.items():
        arrays = {}
        for robot, known in of_robots.items():
            numbers, variances = np.array(
                [known.get(key, (np.nan, np.nan)) for key in keys[robot]]
            ).T
            arrays[robot] = (numbers, variances)
        families.append(QuantityFamily(followed, arrays))
    joints = tuple(dict.fromkeys(each.joint for each in values))
    return TypeSeries(kind, joints, recordings, families)


def _rows(path: Path) -> Iterator[Mapping[str, Any]]:
    """Yield the rows of a table by column; InputError if it cannot be read."""
    try:
        if path.suffix.lower() == ".parquet":
            from pyarrow import parquet

            yield from parquet.read_table(path).to_pylist()
            return
        with path.open(encoding="utf-8", newline="") as file:
            yield from csv.DictReader(file)
    except (OSError, ValueError, csv.Error) as error:
        problem = f"cannot be read ({error or type(error).__name__})"
        raise InputError(path, problem, field=_FIELD, remedy="write it again") from error


def _date(value: object) -> str | None:
    """Return a date of a table, ISO 8601."""
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, date):
        return datetime(value.year, value.month, value.day).isoformat()
    text = str(value or "").strip()
    try:
        datetime.fromisoformat(text)
    except ValueError:
        return date_in(text)
    return text


def _number(value: object) -> float | None:
    """Return a number of a table, None where it is empty or a text."""
    if isinstance(value, bool) or value is None:
        return None
    try:
        number = float(str(value))
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
