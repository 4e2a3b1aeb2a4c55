"""A trend of a fleet for programs: JSON, and a table of every value."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any, Final

from hil.base.files import replace_file
from hil.fleet.trend import FleetTrend, QuantityTrend

COLUMNS: Final = (
    *("robot", "joint", "quantity", "unit", "speed", "when", "value", "std", "adjusted", "fitted"),
    *("change", "half", "rate", "rate_half", "p_value", "changed", "explained"),
)


def as_dict(fleet: FleetTrend) -> dict[str, Any]:
    """Return the content of ``--json``; None for what is unknown."""
    return {
        "changed": bool(fleet.changed),
        "simulated": fleet.simulated,
        "covariates": list(fleet.covariates),
        "seasonal": fleet.seasonal,
        "dated_by_file": fleet.dated_by_file,
        "recordings": fleet.recordings,
        "robots": [
            {
                "robot": robot.robot,
                "changed": robot.changed,
                "recordings": robot.recordings,
                "first": robot.first,
                "last": robot.last,
                "trends": [_trend(each) for each in robot.trends],
            }
            for robot in fleet.robots
        ],
        "broken": [each.as_json() for each in fleet.broken],
        "skipped": [each.as_json() for each in fleet.skipped],
    }


def _trend(trend: QuantityTrend) -> dict[str, Any]:
    numbers = {
        name: _known(getattr(trend, name))
        for name in ("reference", "change", "half", "rate", "rate_half", "p_value")
    }
    return {
        "joint": trend.joint,
        "quantity": trend.quantity,
        "unit": trend.unit,
        "speed": trend.speed,
        **numbers,
        "changed": trend.changed,
        "explained": trend.explained,
        "changes": [vars_of(change) for change in trend.changes],
        "effects": dict(trend.effects),
        "limits": [
            {
                "quantity": each.limit.quantity,
                "share": each.limit.share,
                "date": each.date,
                "earliest": each.earliest,
                "latest": each.latest,
            }
            for each in trend.limits
        ],
        "dates": list(trend.dates),
        "values": [_known(value) for value in trend.values.tolist()],
        "stds": [_known(value) for value in trend.stds.tolist()],
        "adjusted": [_known(value) for value in trend.adjusted.tolist()],
        "fitted": [_known(value) for value in trend.fitted.tolist()],
    }


def vars_of(change: Any) -> dict[str, Any]:
    """Return the fields of a change."""
    return {name: getattr(change, name) for name in ("kind", "begin", "earliest", "latest", "size")}


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def write_table(path: Path, fleet: FleetTrend) -> None:
    """Write every value of every series as CSV, a row each; the file is replaced atomically.

    Raises:
        OSError: it cannot be written.
    """
    with (
        replace_file(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for robot in fleet.robots:
            for trend in robot.trends:
                of_series = (
                    trend.change, trend.half, trend.rate, trend.rate_half, trend.p_value,
                    str(trend.changed).lower(), str(trend.explained).lower(),
                )  # fmt: skip
                names = (robot.robot, trend.joint, trend.quantity, trend.unit)
                speed = "" if trend.speed is None else trend.speed
                rows = zip(
                    trend.dates, trend.values.tolist(), trend.stds.tolist(),
                    trend.adjusted.tolist(), trend.fitted.tolist(), strict=True,
                )  # fmt: skip
                writer.writerows([*names, speed, *row, *of_series] for row in rows)
