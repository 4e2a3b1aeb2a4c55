"""An identified arm and what it was identified from: just found, or read from its files.

`results.json` has the settings that an identification chose, `parameters.json` what it estimated.
With these and the archives, exports and rollouts need no other identification.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hil.archive.recorded_campaign import RecordedCampaign
from hil.base.arrays import Array
from hil.base.errors import HilError, InputError
from hil.base.files import file_digest
from hil.base.progress import Reporter
from hil.base.safe_input import parse_json, path_exists, read_text
from hil.cell import Cell
from hil.cell.text import urdf_limits
from hil.pipeline.cell_context import torque_limits
from hil.pipeline.estimating import posterior_of
from hil.pipeline.estimators import OF_PRIOR
from hil.pipeline.identify_folder import identify_paths
from hil.pipeline.options import Options
from hil.pipeline.prepared import Prepared, prepared_with
from hil.pipeline.run import Identification
from hil.pipeline.sources import gather_sources
from hil.results.provenance import (
    PARAMETERS_JSON,
    RESULTS,
    archive_digests,
    provenance_of,
    single_line,
)
from hil.results.results import Results, SettingsResult
from identification import Estimate, Factor, Samples
from identification.errors import IdentificationError
from identification.estimators.consistent import ConsistentEstimate
from identification.estimators.ensemble import Ensemble, draw_ensemble
from identification.export.arm import ExportedArm, Ranges
from identification.export.friction import median_load
from identification.export.parameters import estimate_in
from identification.factor.blocks import FINE_BLOCK, fine_blocks
from identification.model.link_wrenches import LINK_SYMBOLS
from identification.model.pseudo_inertia import margin
from identification.model.robot import RobotModel
from identification.purposes.thresholds import ContactThreshold
from identification.reduction.posterior import Posterior
from identification.selection.folds import FOLDS
from identification.validation.prediction import driving_residual


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
        """Return what moves joints otherwise than predicted (m, n), for each fitted recording.

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
        folds = [fold[fine_blocks(samples) // length] for samples in fitted]
        residuals = [np.empty(samples.torque.shape) for samples in fitted]
        for k in range(parts):
            values = self.posterior.values(total.without(fold == k))
            for samples, fold_of_row, residual in zip(fitted, folds, residuals, strict=True):
                error = driving_residual(model, samples, values)
                residual[fold_of_row == k] = error[fold_of_row == k]
        return residuals


def predicted_parts(duration: float, shortest: float) -> int:
    """Return in how many parts, two or more, a motion [s] is predicted from its rest."""
    return int(np.clip(duration / shortest, 2, FOLDS))


def consistent_of(identification: Identification) -> ConsistentEstimate:
    """Return the physically consistent parameters of an identification, or raise InputError."""
    if isinstance(identification.consistency, str):
        raise InputError(
            identification.paths[0],
            f"there are no physically consistent parameters: {identification.consistency}",
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
    """Return an arm of parameters, standard (s,) and all (p,), with the limits of its cell or URDF.

    Friction that grows with the load is that of the fitted motion.
    """
    described = urdf_limits(cell.urdf, cell.joint_names)
    efforts = cell.torque_limit
    if efforts is None:
        known_limits = torque_limits(cell)
        efforts = (
            described.effort if known_limits is None else np.nan_to_num(known_limits, nan=np.inf)
        )
    limits = described if cell.file.limits is None else cell.joint_limits
    ranges = Ranges(limits.lower, limits.upper, limits.velocity, efforts)
    return ExportedArm(
        cell.urdf, cell.model, standard, values, ranges, median_load(cell.model, values, fitted)
    )


def remarks_of(model: IdentifiedModel) -> tuple[str, ...]:
    """Return what a file of the arm states in a comment."""
    unknown = ", ".join(model.estimate.undetermined)
    return (
        "Identified by hil; bodies are physically consistent parameters.",
        *([f"Not determined by the data: {unknown}."] if unknown else []),
        *(" ".join(f"{key}: {value}".split()) for key, value in model.provenance.items()),
    )


def ensemble_of(model: IdentifiedModel, count: int, seed: int) -> Ensemble:
    """Draw arms from the posterior of an identification.

    Raises:
        InputError: it has another estimator than a posterior.
    """
    belief = model.posterior.prior.belief
    return draw_ensemble(model.cell.model, belief, model.estimate, model.factor, count, seed)


def read_or_identify(
    paths: Sequence[Path],
    options: Options,
    reporter: Reporter,
    *,
    reuse: bool,
    predict: Sequence[Path] = (),
) -> IdentifiedModel:
    """Return the arm in the files of a folder if `reuse`, else identify it from the archives.

    `predict` are archives that are held out.

    Raises:
        InputError: the archives cannot be used, or give no physically consistent parameters.
    """
    if reuse and len(paths) == 1 and paths[0].is_dir():
        try:
            return stored_model(paths[0], reporter, predict)
        except NotReusableError as error:
            reporter.say(f"{paths[0]}: identified again: {error}")
    return model_of(identify_paths(paths, reporter, options, predict=predict))


class NotReusableError(Exception):
    """Why the files of an earlier identification are not those of its archives."""


def stored_model(folder: Path, reporter: Reporter, predict: Sequence[Path] = ()) -> IdentifiedModel:
    """Return the arm in `results.json` and `parameters.json` of a folder with its archives.

    Raises:
        NotReusableError: they are missing, of other archives, or without consistent parameters.
        InputError: the archives cannot be read.
    """
    results, content, provenance = _files_of(folder)
    settings = results.settings
    if settings is None:
        raise NotReusableError(f"{RESULTS} is of an earlier version, without settings")
    paths = _archives_of(folder, settings)
    present = provenance_of(results, paths)
    if archive_digests(provenance) != archive_digests(present):
        raise NotReusableError("its archives are others than those that were identified")
    if provenance.get("verdict") != single_line(present["verdict"]):
        raise NotReusableError(f"{RESULTS} and {PARAMETERS_JSON} are not of one identification")
    try:
        used = settings.decided()
    except ValueError as error:
        raise NotReusableError(f"{RESULTS} has other settings ({error})") from error
    by_use: dict[bool, list[Path]] = {True: [], False: []}
    for path in paths:
        by_use[path.name in settings.predicted].append(path)
    # If all of the first was fitted, another is held out, and this share means nothing.
    sources = gather_sources(
        by_use[False],
        settings.split,
        predict or by_use[True],
        in_sample=settings.in_sample and not predict,
    )
    try:
        prepared = prepared_with(sources, used, reporter)
        cell = prepared.sources.cell
        standard, values = _stored_values(cell, content)
        estimate = estimate_in(content)
    except (HilError, IdentificationError, ValueError, LookupError, TypeError) as error:
        raise NotReusableError(f"{PARAMETERS_JSON} cannot be used ({error})") from error
    program = results.software.get("hil", "an unknown version of hil")
    return IdentifiedModel(
        cell,
        arm_with(cell, standard, values, prepared.fitted),
        estimate,
        settings.estimator,
        prepared.with_load(estimate.values),
        tuple(paths),
        present,
        results.verdict.line,
        results.verdict.good,
        f"from {folder / RESULTS} and {PARAMETERS_JSON}, identified by hil {program}; "
        "--again identifies again",
        tuple(results.contact_thresholds),
        file_digest(folder / PARAMETERS_JSON),
    )


def _files_of(folder: Path) -> tuple[Results, Mapping[str, Any], Mapping[str, str]]:
    """Return results, parameters and their provenance of a folder, or raise NotReusableError."""
    for name in (RESULTS, PARAMETERS_JSON):
        if not path_exists(folder / name):
            raise NotReusableError(f"there is no {name}")
    try:
        results = Results.load(folder / RESULTS)
        content = parse_json(read_text(folder / PARAMETERS_JSON))
        provenance = {str(key): str(text) for key, text in content["provenance"].items()}
    except (InputError, OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise NotReusableError(f"its files cannot be read ({error})") from error
    return results, content, provenance


def _archives_of(folder: Path, settings: SettingsResult) -> list[Path]:
    """Return the archives that `hil identify` uses of a folder, or those of its results beside it.

    Raises:
        NotReusableError: there are none.
    """
    if path_exists(folder / "manifest.json"):
        campaign = RecordedCampaign(folder)
        kinds = ("excitation", "validation", "standstill")
        return [path for kind in kinds for path in campaign.completed(kind)]
    inside = sorted(folder.glob("*.mcap"))
    beside = [folder.resolve().parent / name for name in settings.archives]
    archives = inside or [path for path in beside if path_exists(path)]
    if not archives:
        raise NotReusableError(f"there is none of its archives ({', '.join(settings.archives)})")
    return archives


def _stored_values(cell: Cell, content: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return the physically consistent parameters, standard (s,) and all (p,)."""
    stored = content["standard"]
    if stored is None:
        raise ValueError("it has no physically consistent parameters")
    model = cell.model
    layout = model.layout
    links = stored["links"]
    motors = stored["motor_friction"]
    if [entry["name"] for entry in content["parameters"]] != list(model.parameter_names):
        raise ValueError("its parameters are others")
    standard = np.zeros(layout.size)
    standard[layout.links] = [[link[symbol] for symbol in LINK_SYMBOLS] for link in links]
    if layout.rotor_inertia:
        standard[layout.rotors] = [link["rotor_inertia"] for link in links]
    for index in layout.couplings:
        standard[index] = stored["coupling_inertia"][layout.names[index]]
    friction = [
        motors[term.name] if term.motor else links[term.owner]["friction"][term.symbol]
        for term in model.friction.terms
    ]
    elements = [stored["elements"][name] for name in model.elements.names]
    values = np.concatenate([model.base.grouping @ standard, friction, elements])
    if not np.isfinite(values).all() or not np.isfinite(standard).all():
        raise ValueError("it has numbers that are not finite")
    impossible = impossible_bodies(model, standard)
    if impossible:
        raise ValueError(f"the body of {', '.join(impossible)} cannot exist")
    return standard, values


def impossible_bodies(model: RobotModel, standard: Array) -> list[str]:
    """Return the joints whose bodies are not physically consistent, or rotors negative."""
    layout = model.layout
    possible = margin(standard[layout.links]) > 0.0
    if layout.rotor_inertia:
        possible &= standard[layout.rotors] >= 0.0
    return [name for name, exists in zip(model.joint_names, possible, strict=True) if not exists]
