"""A trend of a fleet for programs: JSON."""

from __future__ import annotations

import math
from typing import Any

from hil.batch.messages import batch_lines
from hil.fleet.trend import FleetTrend, QuantityTrend, RobotTrend


def as_dict(fleet: FleetTrend) -> dict[str, Any]:
    """Return the content of ``--json``; None for what is unknown."""
    return {
        "changed": bool(fleet.changed),
        "simulated": fleet.sources.simulated,
        "covariates": list(fleet.covariates),
        "unknown": list(fleet.unknown),
        "seasonal": fleet.seasonal,
        "dated_by_file": fleet.sources.dated_by_file,
        "in_several_places": {name: list(places) for name, places in fleet.sources.twice.items()},
        "recordings": fleet.recordings,
        "robots": [
            {
                "robot": robot.robot,
                "type": robot.kind,
                "changed": robot.changed,
                "recordings": len(robot.recordings),
                "first": robot.recordings[0].when,
                "last": robot.recordings[-1].when,
                "trends": [_trend(each) for each in robot.trends],
            }
            for robot in fleet.robots
        ],
        "all_robots": [_together(robot) for robot in fleet.together],
        "broken": [each.as_json() for each in fleet.sources.broken],
        "skipped": [each.as_json() for each in fleet.sources.skipped],
        "warnings": batch_lines(fleet.sources.warnings),
    }


def _together(robots: RobotTrend) -> dict[str, Any]:
    trends = [_trend(each) for each in robots.trends]
    return {"type": robots.kind, "changed": robots.changed, "trends": trends}


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
