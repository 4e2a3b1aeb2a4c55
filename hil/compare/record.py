"""A comparison as JSON holds it."""

from __future__ import annotations

import math
from typing import Any

from .comparison import AxisChange, Comparison, ParameterChange
from .words import caveat, findings, names, verdict


def to_dict(found: Comparison) -> dict[str, Any]:
    """Everything in SI units; null for what is not known. Lists follow `campaigns`."""
    payload = found.payload
    return {
        "arm": found.arm,
        "simulated": found.simulated,
        "changed": found.changed,
        "friction_changed": found.friction_changed,
        "friction_slight": found.friction_slight,
        "load_changed": found.load_changed,
        "verdict": verdict(found),
        "told": [vars(one) for one in findings(found)],
        "caveat": caveat(found),
        "doubts": list(found.doubts),
        "campaigns": [
            {
                "name": name,
                "folder": one.campaign,
                "when": one.when or None,
                "repetitions": one.repetitions,
                "stated": one.setup,
            }
            for name, one in zip(names(found), found.campaigns, strict=True)
        ],
        "axes": [_axis(axis) for axis in found.axes],
        "payload": {
            "untested": payload.untested or None,
            "changed": [bool(x) for x in payload.changed],
            "other_inertia": [bool(x) for x in payload.other],
            "mass": [_number(x) for x in payload.mass],
            "mass_std": [_number(x) for x in payload.mass_std],
            "p_value": [None if c is None else _number(c.p_value) for c in payload.changes],
        },
        "parameters": [_parameter(one) for one in found.parameters],
        "prediction": {
            "overall": [[_number(x) for x in row] for row in found.prediction.overall],
            "joints": [
                [[_number(x) for x in cell] for cell in row] for row in found.prediction.joints
            ],
        },
    }


def _axis(axis: AxisChange) -> dict[str, Any]:
    changes = [None, *(axis.relative(k) for k in range(1, len(axis.known)))]
    return {
        "joint": axis.joint,
        "unit": axis.unit,
        "speed": _number(axis.speed),
        "friction": [_number(one.value) for one in axis.known],
        "std": [_number(one.std) for one in axis.known],
        "repetitions": [[_number(x) for x in own] for own in axis.repetitions],
        "change": [None if one is None else _number(one[0]) for one in changes],
        "interval": [None if one is None else [_number(x) for x in one[1:]] for one in changes],
        "p_value": [_number(p) for p in axis.p_values],
        "changed": list(axis.changed),
        "slight": list(axis.slight),
        "smallest": [_number(x) for x in axis.smallest],
    }


def _parameter(one: ParameterChange) -> dict[str, Any]:
    return {
        "name": one.name,
        "unit": one.unit,
        "friction": one.is_friction,
        "value": [_number(each.value) for each in one.known],
        "std": [_number(each.std) for each in one.known],
        "p_value": [_number(p) for p in one.p_values],
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
