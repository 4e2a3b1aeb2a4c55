"""Identified parameters as JSON and CSV, with units (SI), covariance and provenance."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from identification.estimators.consistent import ConsistentEstimate
from identification.estimators.torque_scale import absolute
from identification.export.parameter_table import ParameterRow, parameter_table
from identification.export.urdf import not_in_urdf
from identification.factor.estimate import Estimate
from identification.factor.estimation_method import EstimationMethod
from identification.factor.messages import method_words, status_words
from identification.model.link_wrenches import LINK_SYMBOLS
from identification.model.robot import RobotModel

SCHEMA: Final = "hil-parameters-1"
CONVENTION: Final = (
    "Link parameters are about the origin of the link's joint frame (URDF), in its axes: I is the"
    " inertia tensor (off-diagonals are minus the products of inertia), mc mass times centre of"
    " mass, m the mass; Im is the rotor inertia on the link side; I45 is the coupling inertia of"
    " joints 4 and 5 by coupled motors. Joints are numbered from 1, in the order of `joints`."
)


def parameters_json(
    model: RobotModel,
    estimate: Estimate,
    *,
    consistent: ConsistentEstimate | None = None,
    essential: Collection[str] | None = None,
    provenance: Mapping[str, str] | None = None,
) -> str:
    """Return an estimate as JSON text.

    Args:
        model: of the arm.
        estimate: of its parameters.
        consistent: physically consistent estimate, if any.
        essential: names of the essential parameters, if known.
        provenance: what the estimate is from.

    Raises:
        IdentificationError: the estimate is of other parameters.
    """
    change = estimate.scale_change
    content = {
        "schema": SCHEMA,
        "provenance": dict(provenance or {}),
        "joints": list(model.joint_names),
        "locked_joints": {name: float(position) for name, position in model.locked.items()},
        "payload": None if model.payload is None else dataclasses.asdict(model.payload),
        "elements": [
            {
                "law": type(placed.element).__name__,
                **dataclasses.asdict(placed.element),
                "parameters": list(model.elements.names[placed.part]),
            }
            for placed in model.elements.placed
        ],
        "gravity": model.gravity.tolist(),
        "friction_laws": [law.table() for law in model.friction.laws],
        "motor_speeds": model.friction.motor_speeds().tolist(),
        "convention": CONVENTION,
        "method": method_words(estimate.method),
        "estimation": estimate.method.as_json(),
        "interval_factor": estimate.interval_factor,
        "condition": estimate.condition,
        "noise_std": estimate.noise_std.tolist(),
        "samples": estimate.samples.tolist(),
        "undetermined": list(estimate.undetermined),
        "parameters": [
            {
                "name": row.name,
                "expression": row.expression,
                "unit": row.unit,
                "value": row.estimate,
                "std": row.std,
                "absolute_std": row.absolute_std,
                "determined": row.name not in estimate.undetermined,
                "essential": None if essential is None else row.name in essential,
            }
            for row in parameter_table(model, estimate)
        ],
        "covariance": estimate.covariance.tolist(),
        "absolute_covariance": absolute(estimate).covariance.tolist(),
        "scale_change": None if change is None else change.tolist(),
        "standard": None if consistent is None else _standard(model, consistent),
    }
    return json.dumps(_finite(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def parameters_csv(
    model: RobotModel, estimate: Estimate, *, provenance: Mapping[str, str] | None = None
) -> str:
    """Return a table with one row per parameter, see :class:`ParameterRow`.

    Provenance is in lines at the beginning that start with # (pandas: ``comment="#"``).

    Raises:
        IdentificationError: the estimate is of other parameters.
    """
    columns = [field.name for field in dataclasses.fields(ParameterRow)]
    rows = map(dataclasses.astuple, parameter_table(model, estimate))
    return _table(_remarks(estimate, provenance), [columns, *rows])


def covariance_csv(estimate: Estimate, *, provenance: Mapping[str, str] | None = None) -> str:
    """Return the covariance in units of the torque of the arm, a row and column per parameter."""
    rows: list[list[object]] = [["name", *estimate.names]]
    rows += [
        [name, *row] for name, row in zip(estimate.names, estimate.covariance.tolist(), strict=True)
    ]
    return _table(_remarks(estimate, provenance), rows)


def _remarks(estimate: Estimate, provenance: Mapping[str, str] | None) -> dict[str, str]:
    return {**(provenance or {}), "method": method_words(estimate.method), "convention": CONVENTION}


def _table(remarks: Mapping[str, str], rows: Iterable[Sequence[object]]) -> str:
    """Return CSV after one line per remark that starts with #."""
    out = io.StringIO()
    for key, value in remarks.items():
        line = " ".join(f"{key}: {value}".split())
        # Otherwise a spreadsheet may take a part for a formula.
        out.write("# " + re.sub(r"(?<=[,;])[=+@-]", r"'\g<0>", line) + "\n")
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def _standard(model: RobotModel, consistent: ConsistentEstimate) -> dict[str, Any]:
    """Return the consistent standard parameters and friction, joint by joint."""
    layout = model.layout
    standard = consistent.standard
    inertial = standard[layout.links].tolist()
    rotors = standard[layout.rotors].tolist()
    at_bound = layout.rotors_at_bound(standard)
    terms = list(zip(model.friction.terms, consistent.friction.tolist(), strict=True))
    elements = consistent.estimate.values[model.element_part].tolist()
    return {
        "method": method_words(consistent.estimate.method),
        "links": [
            {
                "joint": name,
                **dict(zip(LINK_SYMBOLS, inertial[joint], strict=True)),
                "rotor_inertia": rotors[joint] if rotors else None,
                "rotor_at_bound": bool(at_bound[joint]),
                "friction": {
                    term.symbol: value
                    for term, value in terms
                    if term.owner == joint and not term.motor
                },
                "margin": float(consistent.margin[joint]),
                "reference": consistent.reference[joint],
            }
            for joint, name in enumerate(model.joint_names)
        ],
        "coupling_inertia": {layout.names[k]: float(standard[k]) for k in layout.couplings},
        "rotor_matrix": layout.rotor_matrix(standard).tolist(),
        "motor_friction": {term.name: value for term, value in terms if term.motor},
        "elements": dict(zip(model.elements.names, elements, strict=True)),
        "not_in_urdf": list(not_in_urdf(model)),
        "status": status_words(consistent.fits),
        "relative_error": consistent.relative_error,
        "unconstrained_relative_error": consistent.unconstrained_relative_error,
        "covariance": "that of the unconstrained parameters; undetermined directions are nominal",
    }


def _finite(content: Any) -> Any:
    """Return the content with "Infinity" and "NaN" in place of numbers that are not finite."""
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return "NaN" if math.isnan(content) else "Infinity" if content > 0.0 else "-Infinity"
    return content


def estimate_in(content: Mapping[str, Any]) -> Estimate:
    """Return the estimate in the content of :func:`parameters_json`.

    Raises:
        LookupError, TypeError, ValueError: it is none.
    """
    parameters = content["parameters"]
    change = content["scale_change"]  # not in files whose covariance has the scale of torques
    return Estimate(
        tuple(str(parameter["name"]) for parameter in parameters),
        tuple(str(parameter["unit"]) for parameter in parameters),
        # "Infinity" and "NaN" are numbers to float()
        np.array([float(parameter["value"]) for parameter in parameters]),
        np.array([[float(value) for value in row] for row in content["covariance"]]),
        np.array([float(value) for value in content["noise_std"]]),
        np.array(content["samples"], dtype=np.intp),
        EstimationMethod.of_json(content.get("estimation", {})),  # not in earlier files
        float(content["condition"]),
        tuple(str(name) for name in content["undetermined"]),
        float(content["interval_factor"]),
        None if change is None else np.array(change, dtype=np.float64),
    )
