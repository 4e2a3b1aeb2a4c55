"""Identified parameters as JSON and CSV, with units, covariance and where they come from.

Numbers are SI. What is infinite or was not determined stands as "Infinity" or "NaN", as JSON has
no such numbers; a parameter that the data do not determine has an infinite standard deviation.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from identification.consistent import ConsistentEstimate
from identification.errors import IdentificationError
from identification.estimation import Estimate
from identification.friction_text import friction_in_words
from identification.model import RobotModel
from identification.wrench import LINK_SYMBOLS

Array = NDArray[np.float64]

SCHEMA: Final = "hil-parameters-1"
CONVENTION: Final = (
    "Link parameters are about the origin of the link's joint frame (URDF), in its axes: I is the"
    " inertia tensor (off-diagonals are minus the products of inertia), mc mass times centre of"
    " mass, m the mass; Im is the rotor inertia seen from the link side. Joints count from 1,"
    " depth first."
)
_N_LINK: Final = len(LINK_SYMBOLS)


def parameters_dict(
    model: RobotModel,
    estimate: Estimate,
    *,
    consistent: ConsistentEstimate | None = None,
    provenance: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Return everything about an estimate, of plain values that `json` can write.

    Args:
        model: the robot.
        estimate: of the model's parameters, with its covariance.
        consistent: adds the full standard parameters, rotor inertias included.
        provenance: what the parameters come from: recordings, versions, digests.

    Raises:
        IdentificationError: the estimate is of other parameters.
    """
    if estimate.names != model.parameter_names:
        raise IdentificationError("the estimate is not of the model's parameters")
    return {
        "schema": SCHEMA,
        "provenance": dict(provenance or {}),
        "joints": list(model.joint_names),
        "gravity": [float(x) for x in model.gravity],
        "convention": CONVENTION,
        "method": estimate.method,
        "interval_factor": estimate.interval_factor,
        "condition": _plain(estimate.condition),
        "noise_std": _plain(estimate.noise_std),
        "samples": [int(count) for count in estimate.samples],
        "undetermined": list(estimate.undetermined),
        "friction_law": friction_in_words(model, estimate.values[model.base.rank :]),
        "parameters": [
            {
                "name": name,
                "expression": expression,
                "unit": unit,
                "value": _plain(value),
                "std": _plain(std),
            }
            for name, expression, unit, value, std in _rows(model, estimate)
        ],
        "covariance": _plain(estimate.covariance),
        "standard": None if consistent is None else _standard(model, consistent),
    }


def parameters_json(
    model: RobotModel,
    estimate: Estimate,
    *,
    consistent: ConsistentEstimate | None = None,
    provenance: Mapping[str, str] | None = None,
) -> str:
    """Return :func:`parameters_dict` as JSON text."""
    content = parameters_dict(model, estimate, consistent=consistent, provenance=provenance)
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def parameters_csv(
    model: RobotModel, estimate: Estimate, *, provenance: Mapping[str, str] | None = None
) -> str:
    """Return a table, one row per parameter, its row of the covariance matrix behind it.

    Lines in front that begin with # say where it comes from (pandas: ``comment="#"``).

    Raises:
        IdentificationError: the estimate is of other parameters.
    """
    if estimate.names != model.parameter_names:
        raise IdentificationError("the estimate is not of the model's parameters")
    out = io.StringIO()
    remarks = {**(provenance or {}), "method": estimate.method, "convention": CONVENTION}
    _write_remarks(out, remarks)
    table = csv.writer(out, lineterminator="\n")
    covariances = [f"cov({name})" for name in estimate.names]
    table.writerow(["name", "unit", "value", "std", "expression", *covariances])
    for line, row in zip(_rows(model, estimate), estimate.covariance, strict=True):
        name, expression, unit, value, std = line
        numbers = (repr(float(x)) for x in row)
        table.writerow([name, unit, repr(value), repr(std), expression, *numbers])
    return out.getvalue()


def standard_csv(
    model: RobotModel,
    consistent: ConsistentEstimate,
    *,
    provenance: Mapping[str, str] | None = None,
) -> str:
    """Return a table of the full standard parameters, one row per joint, consistent by link."""
    out = io.StringIO()
    _write_remarks(out, {**(provenance or {}), "convention": CONVENTION})
    table = csv.writer(out, lineterminator="\n")
    symbols = (*LINK_SYMBOLS, *(("Im",) if model.rotor_inertia else ()))
    table.writerow(["joint", *symbols, "margin", "reference"])
    rows = consistent.standard.reshape(model.n_joints, -1)
    for joint, link, margin, words in zip(
        model.joint_names, rows, consistent.margin, consistent.reference, strict=True
    ):
        table.writerow([joint, *(repr(float(x)) for x in link), repr(float(margin)), words])
    return out.getvalue()


def _write_remarks(out: io.StringIO, remarks: Mapping[str, str]) -> None:
    """Write one line that begins with # per remark, line ends within it removed."""
    for key, value in remarks.items():
        out.write(f"# {' '.join(f'{key}: {value}'.split())}\n")


def _rows(model: RobotModel, estimate: Estimate) -> list[tuple[str, str, str, float, float]]:
    """Return name, expression, unit, value and standard deviation of each parameter."""
    friction = estimate.names[model.base.rank :]
    expressions = (*model.base.expressions(), *friction)
    return list(
        zip(
            estimate.names,
            expressions,
            estimate.units,
            estimate.values.tolist(),
            estimate.std.tolist(),
            strict=True,
        )
    )


def _standard(model: RobotModel, consistent: ConsistentEstimate) -> dict[str, Any]:
    """Return the consistent standard parameters and friction, joint by joint."""
    rows = consistent.standard.reshape(model.n_joints, -1)
    symbols = model.friction.symbols
    friction = consistent.friction.reshape(len(symbols), model.n_joints)
    links = []
    for joint, name in enumerate(model.joint_names):
        links.append(
            {
                "joint": name,
                **{s: float(x) for s, x in zip(LINK_SYMBOLS, rows[joint], strict=False)},
                "rotor_inertia": float(rows[joint, _N_LINK]) if model.rotor_inertia else None,
                "friction": {s: float(friction[k, joint]) for k, s in enumerate(symbols)},
                "margin": float(consistent.margin[joint]),
                "reference": consistent.reference[joint],
            }
        )
    return {
        "links": links,
        "status": consistent.status,
        "relative_error": consistent.relative_error,
        "unconstrained_relative_error": consistent.unconstrained_relative_error,
        "covariance": "that of the unconstrained parameters: inequalities have none of their own;"
        " what the data do not determine is the nominal's",
    }


def _plain(values: float | Array) -> Any:
    """Return floats and nested lists of them, with words for what JSON cannot write."""
    if isinstance(values, np.ndarray):
        return (
            [_plain(value) for value in values.tolist()]
            if values.ndim == 1
            else [_plain(row) for row in values]
        )
    number = float(values)
    if math.isfinite(number):
        return number
    return "NaN" if math.isnan(number) else "Infinity" if number > 0.0 else "-Infinity"
