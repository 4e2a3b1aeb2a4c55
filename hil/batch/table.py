"""The result of a batch as tables that any other program can read: CSV, and Parquet with pyarrow.

`parameters` has a row per estimate and parameter, `axes` a row per estimate and joint, `not_used`
one per archive that was left out. `docs/batch.md` describes every column.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterator
from datetime import datetime
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

from hil.files import replacing
from hil.reading import instant
from hil.version import software

from .estimates import relative_error
from .types import BatchResult, LevelEstimate

SCHEMA_VERSION: Final = 1
"""Raised when a column changes its meaning or goes; new columns do not raise it."""

Row = dict[str, Any]

# Rows in memory at a time, however large the batch.
_PORTION = 20_000


class Table(NamedTuple):
    """A table: its columns and where its rows come from.

    Attributes:
        name: of the files, without their endings.
        columns: names, each with its kind behind a colon unless that is text.
        rows: of a result.
    """

    name: str
    columns: str
    rows: Callable[[BatchResult], Iterator[Row]]

    @property
    def kinds(self) -> dict[str, str]:
        """Kind of each column by name."""
        pairs = (one.partition(":") for one in self.columns.split())
        return {name: kind or "text" for name, _, kind in pairs}

    @property
    def csv_columns(self) -> list[str]:
        """Those that CSV has: all but lists."""
        return [name for name, kind in self.kinds.items() if kind != "numbers"]


def write_tables(folder: Path, result: BatchResult) -> list[Path]:
    """Write all tables into a folder that exists, and return their paths.

    Parquet files are written if pyarrow is installed. Each file is replaced whole.

    Raises:
        OSError: a file cannot be written.
    """
    written = []
    for table in TABLES:
        for ending, write in ((".csv", _write_csv), (".parquet", _write_parquet)):
            if ending == ".csv" or has_parquet():
                written.append(folder / f"{table.name}{ending}")
                write(written[-1], table, result)
    return written


def has_parquet() -> bool:
    """Whether Parquet can be written: whether pyarrow is installed."""
    return find_spec("pyarrow") is not None


def _levels(result: BatchResult) -> Iterator[tuple[LevelEstimate, Row]]:
    """Estimates, each with what all its rows have."""
    for level in (*result.repetitions, *result.campaigns, *result.pooled):
        yield (
            level,
            {
                "level": level.level,
                "arm": result.arms[level.arm].name,
                "arm_digest": level.arm,
                "campaign": level.campaign,
                "setup": level.setup,
                "archive": level.archive,
                "archive_sha256": level.sha256,
                "when": instant(level.when),
            },
        )


def _parameter_rows(result: BatchResult) -> Iterator[Row]:
    made_with = ", ".join(f"{name} {version}" for name, version in software().items())
    for level, shared in _levels(result):
        model = result.arms[level.arm].cell.model
        shared |= {
            "archives": level.repetitions,
            "samples": int(level.samples.sum()),
            "condition": level.condition,
            "relative_error": relative_error(level.noise_std, level.torque_rms, level.samples),
            "unseen_relative_error": relative_error(level.unseen_rms, level.unseen_torque_rms),
            "method": level.method,
            "warnings": "; ".join(level.warnings),
            "estimator": result.estimator,
            "settings": level.settings,
            "code": result.code,
            "software": made_with,
        }
        friction = {term.name: term for term in model.friction.terms}
        for k, name in enumerate(level.names):
            value, std = float(level.values[k]), float(level.std[k])
            half = level.interval_factor * std
            term = friction.get(name)
            yield {
                **shared,
                "parameter": name,
                "kind": "inertial" if term is None else "friction",
                "axis": "" if term is None else model.joint_names[term.owner],
                "unit": level.units[k],
                "value": value,
                "std": std,
                "low": value - half,
                "high": value + half,
                "determined": math.isfinite(std),
                "covariance": None if level.covariance is None else level.covariance[k],
            }


def _axis_rows(result: BatchResult) -> Iterator[Row]:
    for level, shared in _levels(result):
        model = result.arms[level.arm].cell.model
        for j, joint in enumerate(model.joint_names):
            yield {
                **shared,
                "axis": joint,
                "unit": "N·m" if model.chain.revolute[j] else "N",
                "samples": int(level.samples[j]),
                "torque_rms": float(level.torque_rms[j]),
                "error_std": float(level.noise_std[j]),
                "unseen_torque_rms": float(level.unseen_torque_rms[j]),
                "unseen_error_rms": float(level.unseen_rms[j]),
            }


def _unused_rows(result: BatchResult) -> Iterator[Row]:
    for kind, ones in (("broken", result.broken), ("skipped", result.skipped)):
        for one in ones:
            yield {"path": one.path, "kind": kind, "reason": one.reason}


_ESTIMATE: Final = "level arm arm_digest campaign setup archive archive_sha256 when:time"
TABLES: Final = (
    Table(
        "parameters",
        f"{_ESTIMATE} parameter kind axis unit value:number std:number low:number high:number "
        "determined:truth archives:count samples:count condition:number relative_error:number "
        "unseen_relative_error:number method warnings estimator settings code software "
        "covariance:numbers",
        _parameter_rows,
    ),
    Table(
        "axes",
        f"{_ESTIMATE} axis unit samples:count torque_rms:number error_std:number "
        "unseen_torque_rms:number unseen_error_rms:number",
        _axis_rows,
    ),
    Table("not_used", "path kind reason", _unused_rows),
)


def _write_csv(path: Path, table: Table, result: BatchResult) -> None:
    columns = table.csv_columns
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_as_text(row[name]) for name in columns] for row in table.rows(result))


def _as_text(value: Any) -> Any:
    """Numbers in full precision; time in ISO 8601; nothing for what is not known."""
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value is None else _clean(value)


def _write_parquet(path: Path, table: Table, result: BatchResult) -> None:
    # Half a second to import, and not installed everywhere.
    import pyarrow
    import pyarrow.parquet

    types = {
        "text": pyarrow.string(),
        "number": pyarrow.float64(),
        "count": pyarrow.int64(),
        "truth": pyarrow.bool_(),
        "time": pyarrow.timestamp("us", tz="UTC"),
        "numbers": pyarrow.list_(pyarrow.float64()),
    }
    facts = {"schema_version": SCHEMA_VERSION, "code": result.code, "software": software()}
    schema = pyarrow.schema(
        [(name, types[kind]) for name, kind in table.kinds.items()],
        metadata={"hil": json.dumps(facts)},
    )
    rows = ({name: _clean(value) for name, value in row.items()} for row in table.rows(result))
    with (
        replacing(path) as temporary,
        pyarrow.parquet.ParquetWriter(temporary, schema, compression="zstd") as writer,
    ):
        while portion := list(islice(rows, _PORTION)):
            writer.write_table(pyarrow.Table.from_pylist(portion, schema=schema))


def _clean(value: Any) -> Any:
    """Without the bytes in a file name that are no text."""
    return value.encode("utf-8", "replace").decode("utf-8") if isinstance(value, str) else value
