"""An identified arm with its samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.cell import Cell
from hil.pipeline.cell_context import torque_limits
from hil.pipeline.estimating import posterior_of
from hil.pipeline.estimators import OF_PRIOR
from hil.pipeline.identification import Identification
from hil.pipeline.notes import NotConsistent
from hil.pipeline.prepared import Prepared
from hil.results.provenance import (
    provenance_of,
)
from identification import Estimate, Factor, Samples
from identification.estimators.consistent import ConsistentEstimate
from identification.estimators.ensemble import Ensemble, draw_ensemble
from identification.export.exported_arm import ExportedArm
from identification.export.friction_curve import median_load
from identification.factor.blocks import FINE_BLOCK
from identification.model.joint_ranges import JointRanges, urdf_limits
from identification.model.pseudo_inertia import margin
from identification.model.robot import RobotModel
from identification.purposes.thresholds import ContactThreshold
from identification.reduction.posterior import Posterior
from identification.selection.folds import FOLDS
from identification.validation.prediction import driving_residual

NO_ROTORS: Final = (
    "The armature (rotor inertia) of {} is 0, its bound: the torque shows none. Torque sensors on"
    " the joint side of the gear do not see rotors."
)


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """An identified arm with its samples, as found or as read from the files of an identification.

    Raises:
        InputError: there are no physically consistent parameters.
    """

    cell: Cell  #: with the friction law that was chosen
    arm: ExportedArm  #: physically consistent
    estimate: Estimate  #: in units of the torque of this arm, as its simulations need it
    estimator: str  #: of `hil.pipeline.options.Estimator`
    prepared: Prepared
    paths: tuple[Path, ...]  #: of the archives
    provenance: Mapping[str, str]
    verdict: str
    good: bool
    origin: str = ""  #: where it was read from
    thresholds: tuple[ContactThreshold, ...] = ()  #: of contacts, from held-out motion
    parameters_digest: str = ""  #: SHA-256 of the `parameters.json` that it was read from

    @property
    def name(self) -> str:
        """Name of the cell."""
        return self.cell.name

    @cached_property
    def factor(self) -> Factor:
        """Sums over the fitted rows."""
        return self.prepared.total.factor

    @cached_property
    def posterior(self) -> Posterior:
        """Prior and strength of a posterior estimate.

        Raises:
            InputError: the estimator has none.
        """
        if self.estimator not in OF_PRIOR:
            raise InputError(
                self.paths[0],
                f"the estimator {self.estimator} has no posterior to draw arms from",
                field="--estimator",
                remedy="use auto or prior",
            )
        strength = self.prepared.settings.strength
        return posterior_of(self.cell, self.factor, self.estimator, strength)

    def predicted_residuals(self, shortest: float) -> list[Array]:
        """Return the torque that the model does not predict (m, n), for each fitted recording.

        That is measured minus predicted torque (`driving_residual`). Each tenth of the rows is
        predicted from the others: what was fitted leaves too little. Of a short recording the parts
        are fewer, so that none is shorter than `shortest` [s].

        Raises:
            InputError: the estimator has no posterior.
        """
        total = self.factor
        model = self.cell.model
        fitted = self.prepared.fitted
        rows = total.counts.sum(axis=1)
        before = np.cumsum(rows) - 0.5 * rows
        duration = sum(float(np.ptp(samples.motion.time)) for samples in fitted)
        parts = predicted_parts(duration, shortest)
        fold = np.minimum(np.floor(parts * before / rows.sum()).astype(np.intp), parts - 1)
        length = round(total.block / FINE_BLOCK)
        folds = [fold[samples.blocks(FINE_BLOCK) // length] for samples in fitted]
        residuals = [np.empty(samples.torque.shape) for samples in fitted]
        for k in range(parts):
            values = self.posterior.values(total.without(fold == k))
            for samples, fold_of_row, residual in zip(fitted, folds, residuals, strict=True):
                error = driving_residual(model, samples, values)
                residual[fold_of_row == k] = error[fold_of_row == k]
        return residuals


def predicted_parts(duration: float, shortest: float) -> int:
    """Return into how many parts, two or more, a motion [s] is split for cross-validation."""
    return int(np.clip(duration / shortest, 2, FOLDS))


def consistent_of(identification: Identification) -> ConsistentEstimate:
    """Return the physically consistent parameters of an identification, or raise InputError."""
    if isinstance(identification.consistency, NotConsistent):
        raise InputError(
            identification.paths[0],
            f"there are no physically consistent parameters: {identification.consistency.reason}",
            remedy="see the verdict of `hil identify`",
        )
    return identification.consistency.consistent


def model_of(identification: Identification) -> IdentifiedModel:
    """Return the arm of an identification.

    Raises:
        InputError: there are no physically consistent parameters.
    """
    consistent = consistent_of(identification)
    fitted = identification.prepared.fitted
    return IdentifiedModel(
        identification.cell,
        arm_with(identification.cell, consistent.standard, consistent.estimate.values, fitted),
        identification.estimation.stated,
        identification.estimation.estimator,
        identification.prepared,
        identification.paths,
        provenance_of(identification.results, identification.paths),
        identification.verdict.line,
        identification.verdict.good,
        thresholds=identification.validation.thresholds,
    )


def arm_with(cell: Cell, standard: Array, values: Array, fitted: Sequence[Samples]) -> ExportedArm:
    """Return an arm with the limits of its cell or URDF.

    Args:
        cell: of the arm.
        standard: standard parameters (s,).
        values: all parameters (p,).
        fitted: motion whose load friction has that grows with the load.
    """
    described = urdf_limits(cell.urdf, cell.joint_names)
    efforts = cell.torque_limit
    if efforts is None:
        known_limits = torque_limits(cell)
        efforts = (
            described.effort if known_limits is None else np.nan_to_num(known_limits, nan=np.inf)
        )
    limits = described if cell.file.limits is None else cell.joint_limits
    ranges = JointRanges(limits.lower, limits.upper, limits.velocity, efforts)
    return ExportedArm(
        cell.urdf, cell.model, standard, values, ranges, median_load(cell.model, values, fitted)
    )


def remarks_of(model: IdentifiedModel) -> tuple[str, ...]:
    """Return what a file of the arm states in a comment."""
    unknown = ", ".join(model.estimate.undetermined)
    at_bound = model.cell.model.layout.rotors_at_bound(model.arm.standard)
    rotorless = ", ".join(np.array(model.cell.joint_names)[at_bound])
    return (
        "Identified by hil; bodies are physically consistent parameters.",
        *([f"Not determined by the data: {unknown}."] if unknown else []),
        *([NO_ROTORS.format(rotorless)] if rotorless else []),
        *(" ".join(f"{key}: {value}".split()) for key, value in model.provenance.items()),
    )


def ensemble_of(model: IdentifiedModel, count: int, seed: int) -> Ensemble:
    """Draw arms from the posterior of an identification.

    Raises:
        InputError: it has another estimator than a posterior.
    """
    belief = model.posterior.prior.belief
    return draw_ensemble(model.cell.model, belief, model.estimate, model.factor, count, seed)


def impossible_bodies(model: RobotModel, standard: Array) -> list[str]:
    """Return the joints whose bodies are not physically consistent, or rotors negative."""
    layout = model.layout
    possible = margin(standard[layout.links]) > 0.0
    if layout.rotor_inertia:
        possible &= standard[layout.rotors] >= 0.0
    return [name for name, exists in zip(model.joint_names, possible, strict=True) if not exists]
