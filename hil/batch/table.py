"""Tables of the result of a batch, CSV and Parquet; `docs/batch.md` describes every column."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from hil.base.files import replace_file
from hil.base.safe_input import parse_time
from hil.base.version import software
from hil.batch.graph import BatchResult
from identification.factor.messages import method_words

from .estimates import BatchEstimate, relative_error
from .messages import batch_lines, setup_words

Row = dict[str, Any]

_ESTIMATE: Final = "level arm arm_digest robot arm_type campaign setup archive archive_sha256 when"
COLUMNS: Final = {
    "parameters": (
        f"{_ESTIMATE} parameter kind axis unit value std low high determined archives samples"
        " condition relative_error unseen_relative_error method warnings estimator settings code"
        " software"
    ).split(),
    "axes": (
        f"{_ESTIMATE} axis unit samples torque_rms error_std unseen_torque_rms unseen_error_rms"
    ).split(),
    "not_used": ["path", "kind", "reason"],
}
"""Columns by table: estimates by parameter, estimates by joint, archives that were left out."""


_NUMBERS: Final = frozenset(
    {
        *("value", "std", "low", "high", "condition", "relative_error", "unseen_relative_error"),
        *("torque_rms", "error_std", "unseen_torque_rms", "unseen_error_rms"),
    }
)
_COUNTS: Final = frozenset(("archives", "samples"))
_BLOCK_BYTES: Final = 1 << 24  # bytes of a table in memory at a time


def write_tables(folder: Path, result: BatchResult) -> list[Path]:
    """Write all tables into an existing folder, and return their paths.

    Numbers have full precision. In CSV times are in ISO 8601, and unknown values are empty. Each
    file is replaced atomically.

    Raises:
        OSError: a file cannot be written.
    """
    rows: dict[str, Callable[[], Iterator[Row]]] = {
        "parameters": lambda: _parameter_rows(result),
        "axes": lambda: _axis_rows(result),
        "not_used": lambda: _unused_rows(result),
    }
    paths = []
    for name, columns in COLUMNS.items():
        tables = [folder / f"{name}.{suffix}" for suffix in ("csv", "parquet")]
        with replace_file(tables[0]) as temporary:
            _write_csv(temporary, columns, rows[name]())
        with replace_file(tables[1]) as temporary:
            _write_parquet(temporary, columns, tables[0])
        paths += tables
    return paths


def _write_csv(path: Path, columns: Sequence[str], rows: Iterator[Row]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _text(value) for key, value in row.items()} for row in rows)


def _write_parquet(path: Path, columns: Sequence[str], table: Path) -> None:
    """Write the rows of a CSV, typed. Arrow would import pandas to take them from Python."""
    import pyarrow  # a tenth of a second, only where tables are written
    from pyarrow import csv as arrow_csv
    from pyarrow import parquet

    def kind(name: str) -> pyarrow.DataType:
        if name in _NUMBERS:
            return pyarrow.float64()
        if name in _COUNTS:
            return pyarrow.int64()
        if name == "determined":
            return pyarrow.bool_()
        return pyarrow.timestamp("us", tz="UTC") if name == "when" else pyarrow.string()

    schema = pyarrow.schema([(name, kind(name)) for name in columns])
    parts = arrow_csv.open_csv(
        table,
        read_options=arrow_csv.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES),
        parse_options=arrow_csv.ParseOptions(newlines_in_values=True),
        convert_options=arrow_csv.ConvertOptions(column_types=schema, null_values=[""]),
    )
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for part in parts:
            writer.write_batch(part)


def _unused_rows(result: BatchResult) -> Iterator[Row]:
    for kind, archives in (("broken", result.broken), ("skipped", result.skipped)):
        for unused in archives:
            yield {**unused.as_json(), "kind": kind}


def _levels(result: BatchResult) -> Iterator[tuple[BatchEstimate, Row]]:
    """Yield estimates, each with the columns that all its rows share."""
    for level in (
        *result.repetitions,
        *result.campaigns,
        *result.pooled,
        *result.siblings,
    ):
        shared = {
            "level": level.level,
            "arm": result.arms[level.arm].name,
            "arm_digest": level.arm,
            "robot": result.arms[level.arm].robot,
            "arm_type": result.arms[level.arm].arm_type or level.arm,
            "campaign": level.campaign,
            "setup": setup_words(level.setup),
            "archive": level.archive,
            "archive_sha256": level.sha256,
            "when": parse_time(level.when),
        }
        yield level, shared


def _parameter_rows(result: BatchResult) -> Iterator[Row]:
    made_with = ", ".join(f"{name} {version}" for name, version in software().items())
    for level, shared in _levels(result):
        model = result.arms[level.arm].cell.model
        estimate = level.estimate
        shared |= {
            "archives": level.repetitions,
            "samples": int(estimate.samples.sum()),
            "condition": estimate.condition,
            "relative_error": relative_error(
                estimate.noise_std, level.torque_rms, estimate.samples
            ),
            "unseen_relative_error": relative_error(level.unseen_rms, level.unseen_torque_rms),
            "method": method_words(estimate.method),
            "warnings": "; ".join(batch_lines(level.warnings)),
            "estimator": result.estimator,
            "settings": level.settings,
            "code": result.code,
            "software": made_with,
        }
        axes = {term.name: model.joint_names[term.owner] for term in model.friction.terms}
        std_of = estimate.std.tolist()
        columns = (estimate.names, estimate.units, estimate.values.tolist(), std_of)
        for name, unit, value, std in zip(*columns, strict=True):
            half = estimate.interval_factor * std
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
            }


def _axis_rows(result: BatchResult) -> Iterator[Row]:
    for level, shared in _levels(result):
        model = result.arms[level.arm].cell.model
        for j, joint in enumerate(model.joint_names):
            yield {
                **shared,
                "axis": joint,
                "unit": "N·m" if model.chain.revolute[j] else "N",
                "samples": int(level.estimate.samples[j]),
                "torque_rms": float(level.torque_rms[j]),
                "error_std": float(level.estimate.noise_std[j]),
                "unseen_torque_rms": float(level.unseen_torque_rms[j]),
                "unseen_error_rms": float(level.unseen_rms[j]),
            }


def _text(value: Any) -> Any:
    """Return a value for CSV."""
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):  # without the bytes of a file name that are not UTF-8
        return value.encode("utf-8", "replace").decode("utf-8")
    return value
