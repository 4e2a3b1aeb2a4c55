"""Servos that are read from their results: nothing is identified again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from hil.base.errors import InputError
from hil.base.safe_input import path_exists
from hil.cell import Cell
from hil.pipeline.identified_model import arm_with, impossible_bodies
from hil.pipeline.options import friction_from
from hil.pipeline.sources import Sources, gather_sources
from hil.results.provenance import RESULTS
from hil.results.servo_result import ServoResults, SimulatorServo, is_servo_result
from identification.export.actuators import Actuators, FieldRange, Quantity
from identification.export.exported_arm import ExportedArm
from identification.servo.intervals import sampled
from identification.servo.parameters import NAMES, PLACE

_TERMS: Final[Mapping[Quantity, str]] = {
    "stiffness": "kp",
    "limit": "limit",
    "friction": "coulomb",
    "viscous": "viscous",
    "armature": "armature",
    "delay": "delay",
    "offset": "offset",
}
_MIN_INTERVAL_DRAWS: Final = 2000  # for the interval of a sum


def servo_folder(paths: Sequence[Path]) -> Path | None:
    """Return the folder of results of an arm without torque, None if it has no such results."""
    if len(paths) == 1 and paths[0].is_dir() and is_servo_result(paths[0] / RESULTS):
        return paths[0]
    return None


def servo_sources(folder: Path, results: ServoResults, predict: Sequence[Path] = ()) -> Sources:
    """Return the archives of a result, fitted and held out.

    Args:
        folder: of the result.
        results: of the identification.
        predict: archives that are held out in place of its own.

    Raises:
        InputError: an archive is missing.
    """
    fitted = [folder / name for name in results.archives]
    predicted = [*predict] or [folder / name for name in results.predicted]
    for path in (*fitted, *predicted):
        if not path_exists(path):
            remedy = "keep archives and results in one folder, or identify again"
            raise InputError(path, "is missing: the results were computed from it", remedy=remedy)
    return gather_sources(
        fitted,
        results.split,
        predicted,
        in_sample=results.in_sample and not predict,
        with_torque=False,
    )


def actuators_of(
    servo: SimulatorServo, cell: Cell, windows: int, count: int, seed: int
) -> Actuators:
    """Return the servo with the terms of an engine as fields of simulators, with draws.

    A limit of the torque that the motion does not determine is infinite.

    Args:
        servo: with the terms of the engine.
        cell: of the arm.
        windows: that were fitted.
        count: number of draws.
        seed: of the draws.
    """
    names = cell.joint_names
    rows = {(value.name, value.joint): value for value in servo.servo}

    def field(term: str) -> FieldRange:
        values = [rows[term, joint] for joint in names]
        return FieldRange(
            np.array([value.value for value in values]),
            np.array([value.lower for value in values]),
            np.array([value.upper for value in values]),
            np.array([value.determined for value in values]),
        )

    fields = {quantity: field(term) for quantity, term in _TERMS.items()}
    limit = fields["limit"]
    # A limit that no motion reached is none: the fit's own is where positions would show one.
    value, upper = (np.where(limit.from_data, end, np.inf) for end in (limit.value, limit.upper))
    limit = fields["limit"] = replace(limit, value=value, upper=upper)
    posterior = servo.posterior
    posterior_samples = sampled(
        np.array(posterior.coordinates),
        np.array(posterior.present),
        np.array(posterior.covariance),
        max(1, windows - 1),
        max(count, _MIN_INTERVAL_DRAWS),
        seed,
    )
    delays = posterior_samples[:, :, PLACE["delay"]]
    np.maximum(delays, 0.0, out=delays)
    by_term = dict(zip(NAMES, np.moveaxis(posterior_samples, 2, 0), strict=True))
    draws = {quantity: by_term[term][:count] for quantity, term in _TERMS.items()}
    if count:
        draws["limit"] = np.where(limit.from_data, draws["limit"], np.inf)
    above = field("static")
    resting = by_term["coulomb"] + by_term["static"]
    lower, upper = np.quantile(resting, [0.025, 0.975], axis=0)
    fields["static"] = FieldRange(
        fields["friction"].value + above.value,
        lower,
        upper,
        fields["friction"].from_data & (above.from_data | (above.value == 0.0)),
    )
    draws["static"] = resting[:count]
    turning = np.asarray(cell.model.chain.revolute, np.bool_)
    return Actuators(tuple(names), turning, fields, draws if count else {})


def servo_arm(cell: Cell, actuators: Actuators) -> ExportedArm:
    """Return the arm with the URDF's bodies, and with friction and rotors of actuators."""
    cell = cell.with_friction(**friction_from("coulomb,viscous"))
    model = cell.model
    standard = model.nominal.copy()
    standard[model.layout.rotors] = actuators.value("armature")
    values = np.zeros(model.n_parameters)
    values[: model.base.rank] = model.base.grouping @ standard
    friction = {"f0": actuators.value("friction"), "f1": actuators.value("viscous")}
    values[model.friction_part] = [
        friction[term.symbol][term.owner] if term.symbol in friction else 0.0
        for term in model.friction.terms
    ]
    arm = arm_with(cell, standard, values, [])
    return replace(arm, balanced=bool(impossible_bodies(model, standard)))
