"""Tables of the result of a batch as CSV; `docs/batch.md` describes every column."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from hil.files import replace_file
from hil.reading import parse_time
from hil.version import software

from .run import BatchResult, LevelEstimate, relative_error

Row = dict[str, Any]

_ESTIMATE: Final = "level arm arm_digest campaign setup archive archive_sha256 when"
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


def write_tables(folder: Path, result: BatchResult) -> list[Path]:
    """Write all tables into an existing folder, and return their paths.

    Numbers have full precision, times are in ISO 8601, and unknown values are empty. Each file is
    replaced atomically.

    Raises:
        OSError: a file cannot be written.
    """
    rows = {
        "parameters": _parameter_rows(result),
        "axes": _axis_rows(result),
        "not_used": (
            {**one._asdict(), "kind": kind}
            for kind, ones in (("broken", result.broken), ("skipped", result.skipped))
            for one in ones
        ),
    }
    paths = []
    for name, columns in COLUMNS.items():
        paths.append(folder / f"{name}.csv")
        with (
            replace_file(paths[-1]) as temporary,
            temporary.open("w", encoding="utf-8", newline="") as file,
        ):
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(
                {key: _text(value) for key, value in row.items()} for row in rows[name]
            )
    return paths


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
        for name, unit, value, std in zip(*columns, strict=True):
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


def _text(value: Any) -> Any:
    """Return a value for CSV; text without the bytes of a file name that are not UTF-8."""
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, bool):
        return str(value).lower()
    return value.encode("utf-8", "replace").decode("utf-8") if isinstance(value, str) else value
