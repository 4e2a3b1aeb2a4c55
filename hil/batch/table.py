"""Tables of the result of a batch: CSV, and Parquet with pyarrow.

`parameters` has a row per estimate and parameter, `axes` a row per estimate and joint, `not_used` a
row per archive that was left out. `docs/batch.md` describes every column.
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

from hil.files import replace_file
from hil.reading import parse_time
from hil.version import software

from .estimates import relative_error
from .types import BatchResult, LevelEstimate

SCHEMA_VERSION: Final = 1
"""Increased when a column changes its meaning or is removed, not when one is added."""

Row = dict[str, Any]

_PORTION: Final = 20_000  # rows in memory at a time


class Table(NamedTuple):
    """A table: file name without suffix, kind of each column, rows of a result."""

    name: str
    kinds: dict[str, str]
    rows: Callable[[BatchResult], Iterator[Row]]

    @property
    def csv_columns(self) -> list[str]:
        """Columns of CSV: all but lists."""
        return [name for name, kind in self.kinds.items() if kind != "numbers"]


def write_tables(folder: Path, result: BatchResult) -> list[Path]:
    """Write all tables into an existing folder, and return their paths.

    Parquet files are written if pyarrow is installed. Each file is replaced atomically.

    Raises:
        OSError: a file cannot be written.
    """
    writers = {".csv": _write_csv} | ({".parquet": _write_parquet} if has_parquet() else {})
    paths = []
    for table in TABLES:
        for ending, write in writers.items():
            paths.append(folder / f"{table.name}{ending}")
            with replace_file(paths[-1]) as temporary:
                write(temporary, table, result)
    return paths


def has_parquet() -> bool:
    """Return whether pyarrow is installed, so that Parquet can be written."""
    return find_spec("pyarrow") is not None


def _levels(result: BatchResult) -> Iterator[tuple[LevelEstimate, Row]]:
    """Yield estimates, each with the columns that all its rows share."""
    for level in (*result.repetitions, *result.campaigns, *result.pooled):
        shared = {
            "level": level.level,
            "arm": result.arms[level.arm].name,
            "arm_digest": level.arm,
            "campaign": level.campaign,
            "setup": level.setup,
            "archive": level.archive,
            "archive_sha256": level.sha256,
            "when": parse_time(level.when),
        }
        yield level, shared


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
        axes = {term.name: model.joint_names[term.owner] for term in model.friction.terms}
        columns = (level.names, level.units, level.values.tolist(), level.std.tolist())
        for k, (name, unit, value, std) in enumerate(zip(*columns, strict=True)):
            half = level.interval_factor * std
            yield {
                **shared,
                "parameter": name,
                "kind": "friction" if name in axes else "inertial",
                "axis": axes.get(name, ""),
                "unit": unit,
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


def _kinds(columns: str) -> dict[str, str]:
    """Return the kind of each column by name: after a colon, or text."""
    pairs = (one.partition(":") for one in columns.split())
    return {name: kind or "text" for name, _, kind in pairs}


_ESTIMATE: Final = "level arm arm_digest campaign setup archive archive_sha256 when:time"
TABLES: Final = (
    Table(
        "parameters",
        _kinds(
            f"{_ESTIMATE} parameter kind axis unit value:number std:number low:number high:number "
            "determined:truth archives:count samples:count condition:number relative_error:number "
            "unseen_relative_error:number method warnings estimator settings code software "
            "covariance:numbers"
        ),
        _parameter_rows,
    ),
    Table(
        "axes",
        _kinds(
            f"{_ESTIMATE} axis unit samples:count torque_rms:number error_std:number "
            "unseen_torque_rms:number unseen_error_rms:number"
        ),
        _axis_rows,
    ),
    Table("not_used", _kinds("path kind reason"), _unused_rows),
)


def _write_csv(path: Path, table: Table, result: BatchResult) -> None:
    """Write numbers in full precision, times in ISO 8601, and nothing for unknown values."""

    def text(value: Any) -> Any:
        if isinstance(value, datetime):
            return value.isoformat()
        return str(value).lower() if isinstance(value, bool) else _clean(value)

    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table.csv_columns)
        writer.writerows(
            [text(row[name]) for name in table.csv_columns] for row in table.rows(result)
        )


def _write_parquet(path: Path, table: Table, result: BatchResult) -> None:
    # Takes half a second to import, and is optional.
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
    with pyarrow.parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        while portion := list(islice(rows, _PORTION)):
            writer.write_table(pyarrow.Table.from_pylist(portion, schema=schema))


def _clean(value: Any) -> Any:
    """Return text without the bytes of a file name that are not UTF-8."""
    return value.encode("utf-8", "replace").decode("utf-8") if isinstance(value, str) else value
