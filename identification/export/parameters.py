"""Identified parameters as JSON and CSV, with units, covariance and where they come from.

Numbers are SI. What is infinite or was not determined stands as "Infinity" or "NaN", as JSON has
no such numbers; a parameter that the data do not determine has an infinite standard deviation.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import re
from collections.abc import Collection, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.consistent import ConsistentEstimate
from identification.export.friction import friction_in_words
from identification.export.urdf import not_in_urdf
from identification.factor.factor import Estimate
from identification.model.regressor import LINK_SYMBOLS
from identification.model.robot import RobotModel

Array = NDArray[np.float64]

SCHEMA: Final = "hil-parameters-1"
CONVENTION: Final = (
    "Link parameters are about the origin of the link's joint frame (URDF), in its axes: I is the"
    " inertia tensor (off-diagonals are minus the products of inertia), mc mass times centre of"
    " mass, m the mass; Im is the rotor inertia seen from the link side; I45 is the inertia that"
    " coupled motors add between joints 4 and 5. Joints count from 1, in the order of `joints`."
)


def parameters_dict(
    model: RobotModel,
    estimate: Estimate,
    *,
    consistent: ConsistentEstimate | None = None,
    essential: Collection[str] | None = None,
    provenance: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Return everything about an estimate, of values that `json` can write.

    Args:
        model: the robot.
        estimate: of the model's parameters, with its covariance.
        consistent: adds the full standard parameters, rotor inertias included.
        essential: names of the essential parameters, where they were looked for.
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
        "locked_joints": {name: float(position) for name, position in model.locked.items()},
        # Known, and in none of the parameters.
        "payload": None if model.payload is None else dataclasses.asdict(model.payload),
        "elements": [
            {
                "law": type(one.element).__name__,
                **dataclasses.asdict(one.element),
                "parameters": list(model.elements.names[one.part]),
            }
            for one in model.elements.placed
        ],
        "gravity": [float(x) for x in model.gravity],
        "convention": CONVENTION,
        "method": estimate.method,
        "interval_factor": estimate.interval_factor,
        "condition": _json_value(estimate.condition),
        "noise_std": _json_value(estimate.noise_std),
        "samples": [int(count) for count in estimate.samples],
        "undetermined": list(estimate.undetermined),
        "friction_law": friction_in_words(model, estimate.values[model.friction_part]),
        "parameters": [
            {
                "name": name,
                "expression": expression,
                "unit": unit,
                "value": _json_value(value),
                "std": _json_value(std),
                "determined": name not in estimate.undetermined,
                "essential": None if essential is None else name in essential,
            }
            for name, expression, unit, value, std in _rows(model, estimate)
        ],
        "covariance": _json_value(estimate.covariance),
        "standard": None if consistent is None else _standard(model, consistent),
    }


def parameters_json(
    model: RobotModel,
    estimate: Estimate,
    *,
    consistent: ConsistentEstimate | None = None,
    essential: Collection[str] | None = None,
    provenance: Mapping[str, str] | None = None,
) -> str:
    """Return :func:`parameters_dict` as JSON text."""
    content = parameters_dict(
        model, estimate, consistent=consistent, essential=essential, provenance=provenance
    )
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
    """Return a table of the full standard parameters, one row per joint, consistent by link.

    A name that a spreadsheet would compute has an apostrophe in front.
    """
    out = io.StringIO()
    _write_remarks(out, {**(provenance or {}), "convention": CONVENTION})
    table = csv.writer(out, lineterminator="\n")
    inertial, rotors, couplings = _parts(model, consistent)
    # In front of the table: behind it a comment would be a row of its own to some readers.
    units = dict(zip(model.layout.names, model.layout.units, strict=True))
    _write_remarks(out, {name: f"{value!r} {units[name]}" for name, value in couplings.items()})
    table.writerow(["joint", *LINK_SYMBOLS, *(["Im"] if rotors else []), "margin", "reference"])
    for joint, name in enumerate(model.joint_names):
        numbers = [*inertial[joint], *rotors[joint : joint + 1], float(consistent.margin[joint])]
        table.writerow(
            [_harmless(name), *map(repr, numbers), _harmless(consistent.reference[joint])]
        )
    return out.getvalue()


def _write_remarks(out: io.StringIO, remarks: Mapping[str, str]) -> None:
    """Write one line that begins with # per remark, line ends within it removed."""
    for key, value in remarks.items():
        line = " ".join(f"{key}: {value}".split())
        out.write("# " + re.sub(r"(?<=[,;])[=+@-]", r"'\g<0>", line) + "\n")


def _harmless(text: str) -> str:
    """Return text on one line that no spreadsheet takes for a formula, which can call programs."""
    line = "".join(c if c.isprintable() else " " for c in text)
    return f"'{line}" if line.lstrip().startswith(("=", "+", "-", "@")) else line


def _rows(model: RobotModel, estimate: Estimate) -> list[tuple[str, str, str, float, float]]:
    """Return name, expression, unit, value and standard deviation of each parameter."""
    expressions = (*model.base.expressions(), *estimate.names[model.base.rank :])
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
    inertial, rotors, couplings = _parts(model, consistent)
    terms = list(zip(model.friction.terms, consistent.friction.tolist(), strict=True))
    return {
        "method": consistent.estimate.method,
        "links": [
            {
                "joint": name,
                **dict(zip(LINK_SYMBOLS, inertial[joint], strict=True)),
                "rotor_inertia": rotors[joint] if rotors else None,
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
        "coupling_inertia": couplings,
        "rotor_matrix": _json_value(model.layout.rotor_matrix(consistent.standard)),
        "motor_friction": {term.name: value for term, value in terms if term.motor},
        "elements": dict(
            zip(
                model.elements.names,
                consistent.estimate.values[model.element_part].tolist(),
                strict=True,
            )
        ),
        "not_in_urdf": list(not_in_urdf(model)),
        "status": consistent.status,
        "relative_error": consistent.relative_error,
        "unconstrained_relative_error": consistent.unconstrained_relative_error,
        "covariance": "that of the unconstrained parameters: inequalities have none of their own;"
        " what the data do not determine is the nominal's",
    }


def _parts(
    model: RobotModel, consistent: ConsistentEstimate
) -> tuple[list[list[float]], list[float], dict[str, float]]:
    """Return the ten parameters of each link, the rotors, and inertias between joints by name."""
    layout, standard = model.layout, consistent.standard
    couplings = {layout.names[k]: float(standard[k]) for k in layout.couplings}
    return standard[layout.links].tolist(), standard[layout.rotors].tolist(), couplings


def _json_value(values: float | Array) -> Any:
    """Return floats and nested lists of them, with words for what JSON cannot write."""
    if isinstance(values, np.ndarray):
        return (
            [_json_value(value) for value in values.tolist()]
            if values.ndim == 1
            else [_json_value(row) for row in values]
        )
    number = float(values)
    if math.isfinite(number):
        return number
    return "NaN" if math.isnan(number) else "Infinity" if number > 0.0 else "-Infinity"
