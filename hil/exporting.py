"""Files of the identified arm for simulators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.campaign.folder import CampaignFolder
from hil.cell import Cell
from hil.cell.text import urdf_limits
from hil.errors import HilError, InputError
from hil.files import make_folder, write_files
from hil.identify import Identification, Options, identify_paths
from hil.identify.cell_context import torque_limits
from hil.identify.options import FIXED
from hil.identify.prepared import prepare_sources
from hil.identify.sources import cell_of, gather_sources
from hil.outcome import PARAMETERS_JSON, RESULTS, archive_digests, provenance_of, single_line
from hil.progress import Reporter
from hil.reading import parse_json, path_exists, read_text
from hil.results import Results
from identification import Samples
from identification.errors import IdentificationError
from identification.estimators.consistent import ConsistentEstimate
from identification.estimators.ensemble import Ensemble, draw_ensemble
from identification.export.arm import Arm, Ranges
from identification.export.friction import median_load
from identification.export.simulators import (
    FORMATS,
    MISSING,
    STATES,
    Comparison,
    Format,
    compare,
    pinocchio_arm,
    read_back,
)
from identification.model.motion import Motion
from identification.model.regressor import LINK_SYMBOLS

Array = NDArray[np.float64]
FormatName = Literal["mjcf", "urdf", "sdf", "pinocchio"]

_ENSEMBLE_STATES: Final = 50  # random states at which each drawn arm is read back
_MOST_ROWS: Final = 2000  # of the recorded motion, enough for root mean squares


@dataclass(frozen=True, eq=False)
class Exported:
    """Summary of a written file."""

    path: Path
    joint_names: tuple[str, ...]
    units: tuple[str, ...]  # of torque per joint
    comparison: Comparison | str  # or why there is none
    verdict: str
    origin: str = ""  # of the parameters, where they were not identified for this file

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        unit = " or ".join(sorted(set(self.units)))

        def row(torque: Array) -> str:
            return f"{', '.join(f'{one:.3g}' for one in torque)} {unit}"

        lines = [*([f"parameters: {self.origin}"] if self.origin else [])]
        lines.append(f"written: {self.path}")
        if isinstance(self.comparison, str):
            lines.append(f"warning: not read back: {self.comparison}")
        else:
            lines += [
                f"read back: torque error at most {self.comparison.difference:.1e} of the joint's"
                f" largest torque, at {STATES} random states",
                *(f"left out: {k}: {row(v)} rms" for k, v in self.comparison.left_out.items()),
                f"whole torque of the recorded motion: {row(self.comparison.torque)} rms",
            ]
        return [*lines, self.verdict]

    def to_dict(self) -> dict[str, object]:
        """Return the summary for JSON."""
        compared = None if isinstance(self.comparison, str) else self.comparison
        return {
            "path": str(self.path),
            "joints": [*self.joint_names],
            "read_back": compared and compared.difference,
            "not_read_back": self.comparison if compared is None else None,
            "left_out": {k: v.tolist() for k, v in compared.left_out.items()} if compared else {},
            "torque": compared and compared.torque.tolist(),
            "verdict": self.verdict,
            "parameters_from": self.origin or None,
        }


def consistent_of(found: Identification) -> ConsistentEstimate:
    """Return the physically consistent parameters of an identification, or raise InputError."""
    if isinstance(found.consistency, str):
        raise InputError(
            found.paths[0],
            f"there are no physically consistent parameters: {found.consistency}",
            remedy="see the verdict of `hil identify`",
        )
    return found.consistency.consistent


def arm_of(cell: Cell, consistent: ConsistentEstimate, fitted: Sequence[Samples]) -> Arm:
    """Return the identified arm with the limits of its cell, or of its URDF.

    Friction that grows with the load is that of the fitted motion.
    """
    values = consistent.estimate.values
    return _arm(cell, consistent.standard, values, median_load(cell.model, values, fitted))


def _arm(cell: Cell, standard: Array, values: Array, load: Array) -> Arm:
    described, efforts = urdf_limits(cell.urdf, cell.joint_names), cell.torque_limit
    if efforts is None:
        found = torque_limits(cell)
        efforts = described.effort if found is None else np.nan_to_num(found, nan=np.inf)
    limits = described if cell.file.limits is None else cell.joint_limits
    ranges = Ranges(limits.lower, limits.upper, limits.velocity, efforts)
    return Arm(cell.urdf, cell.model, standard, values, ranges, load)


def pinocchio_of(found: Identification) -> pin.Model:
    """Return the arm of an identification as pinocchio's model, with armature and friction.

    Raises:
        InputError: there are no physically consistent parameters.
    """
    arm = arm_of(found.cell, consistent_of(found), found.prepared.fitted)
    return pinocchio_arm(arm, found.cell.name)


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """An identified arm, as found or as read from the files of an identification."""

    name: str  #: of the cell
    arm: Arm
    undetermined: tuple[str, ...]  #: parameters that the data do not determine
    provenance: Mapping[str, str]
    motion: Motion  #: recorded, of which the torque is compared
    verdict: str
    good: bool
    origin: str = ""  #: where it was read from, or why it was identified again


def model_of(found: Identification) -> IdentifiedModel:
    """Return the arm of an identification.

    Raises:
        InputError: there are no physically consistent parameters.
    """
    return IdentifiedModel(
        found.cell.name,
        arm_of(found.cell, consistent_of(found), found.prepared.fitted),
        found.estimate.pooled.undetermined,
        provenance_of(found.results, found.paths),
        _motion(found.prepared.held_out),
        found.verdict.line,
        found.verdict.good,
    )


def export_model(found: Identification | IdentifiedModel, output: Path, to: FormatName) -> Exported:
    """Write an identified arm, read it back and compare.

    Raises:
        InputError: there are no physically consistent parameters.
        IdentificationError: the arm cannot be written, or reads back with other parameters.
    """
    model = found if isinstance(found, IdentifiedModel) else model_of(found)
    form, arm = FORMATS[to], model.arm
    make_folder(output.parent)
    text = form.write(arm, model.name, _remarks(model))
    try:
        comparison: Comparison | str = compare(text, form, arm, model.motion)
    except MISSING as error:
        comparison = str(error)
    write_files(output.parent, {output.name: text})
    units = tuple("N·m" if turns else "N" for turns in arm.model.chain.revolute)
    return Exported(output, arm.model.joint_names, units, comparison, model.verdict, model.origin)


def _remarks(model: IdentifiedModel) -> tuple[str, ...]:
    unknown = ", ".join(model.undetermined)
    return (
        "Identified by hil; bodies are physically consistent parameters.",
        *([f"Not determined by the data: {unknown}."] if unknown else []),
        *(" ".join(f"{key}: {value}".split()) for key, value in model.provenance.items()),
    )


@dataclass(frozen=True, eq=False)
class ExportedEnsemble:
    """Summary of the written arms of an ensemble."""

    path: Path  #: of the folder, or of the .npz file
    ensemble: Ensemble
    seed: int
    joint_names: tuple[str, ...]
    difference: float | str  #: largest difference read back, or why it was not
    verdict: str

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        arms = self.ensemble
        spread = ", ".join(f"{share:.2f}" for share in arms.spread)
        pooled = float(np.sqrt(np.nanmean(arms.spread**2)))
        lines = [
            f"written: {len(arms)} arms drawn with seed {self.seed} in {self.path}",
            f"moved to the nearest physically consistent arm: {np.count_nonzero(arms.moved)}",
            "spread of their torque on the fitted motion over that of the stated intervals:"
            f" {pooled:.2f} over all joints ({spread})",
        ]
        if isinstance(self.difference, str):
            lines.append(f"warning: not read back: {self.difference}")
        else:
            lines.append(
                f"read back: torque error at most {self.difference:.1e} of the joint's largest"
                f" torque, at {_ENSEMBLE_STATES} random states of each arm"
            )
        return [*lines, self.verdict]

    def to_dict(self) -> dict[str, object]:
        """Return the summary for JSON."""
        read = not isinstance(self.difference, str)
        return {
            "path": str(self.path),
            "joints": [*self.joint_names],
            "arms": len(self.ensemble),
            "seed": self.seed,
            "moved": int(np.count_nonzero(self.ensemble.moved)),
            "widened": self.ensemble.widened,
            "spread": [None if np.isnan(one) else float(one) for one in self.ensemble.spread],
            "read_back": self.difference if read else None,
            "not_read_back": None if read else self.difference,
            "verdict": self.verdict,
        }


def ensemble_of(found: Identification, count: int, seed: int) -> Ensemble:
    """Draw arms from the posterior of an identification.

    Raises:
        InputError: it has another estimator than a posterior.
    """
    estimation = found.estimation
    if estimation.estimator not in ("auto", "prior"):
        raise InputError(
            found.paths[0],
            f"the estimator {estimation.estimator} has no posterior to draw arms from",
            field="--estimator",
            remedy="use auto or prior",
        )
    return draw_ensemble(
        found.cell.model,
        estimation.posterior.prior,
        estimation.stated,
        estimation.result.factor,
        count,
        seed,
    )


def export_ensemble(
    found: Identification, output: Path, to: FormatName, count: int, seed: int
) -> ExportedEnsemble:
    """Write drawn arms as files in a folder, or as arrays if the output is an .npz file.

    Raises:
        InputError: there are no physically consistent parameters, or no posterior.
        IdentificationError: an arm cannot be written, or reads back with other parameters.
    """
    model = model_of(found)
    ensemble = ensemble_of(found, count, seed)
    names = model.arm.model
    difference: float | str = 0.0
    if output.suffix == ".npz":
        difference = "arrays have no reader"
        content = BytesIO()
        np.savez_compressed(
            content,
            standard=ensemble.standard,
            standard_names=names.layout.names,
            parameters=ensemble.values,
            parameter_names=names.parameter_names,
            joint_names=names.joint_names,
            seed=seed,
        )
        make_folder(output.parent)
        write_files(output.parent, {output.name: content.getvalue()})
    else:
        texts, difference = _ensemble_texts(model, ensemble, FORMATS[to], seed)
        make_folder(output)
        write_files(output, texts)
    return ExportedEnsemble(output, ensemble, seed, names.joint_names, difference, model.verdict)


def _ensemble_texts(
    model: IdentifiedModel, ensemble: Ensemble, form: Format, seed: int
) -> tuple[dict[str, str], float | str]:
    """Return the files of the arms, and their largest difference when read back."""
    texts, difference, missing = dict[str, str](), 0.0, ""
    digits = len(str(len(ensemble)))
    for k, (standard, values) in enumerate(
        zip(ensemble.standard, ensemble.values, strict=True), start=1
    ):
        arm = replace(model.arm, standard=standard, values=values)
        remark = f"Arm {k} of {len(ensemble)} drawn from the posterior with seed {seed}."
        text = form.write(arm, model.name, (remark, *_remarks(model)))
        texts[f"arm_{k:0{digits}}{form.suffix}"] = text
        if not missing:
            try:
                difference = max(difference, read_back(text, form, arm, _ENSEMBLE_STATES))
            except MISSING as error:
                missing = str(error)
    return texts, missing or difference


def model_for_export(
    paths: Sequence[Path], options: Options, reporter: Reporter, *, reuse: bool
) -> IdentifiedModel:
    """Return the arm in the files of a folder if `reuse`, else identify it from the archives.

    Raises:
        InputError: the archives cannot be used, or give no physically consistent parameters.
    """
    if reuse and len(paths) == 1 and paths[0].is_dir():
        try:
            return stored_model(paths[0], reporter)
        except NotReusableError as error:
            reporter.say(f"{paths[0]}: identified again: {error}")
    return model_of(identify_paths(paths, reporter, options))


class NotReusableError(Exception):
    """Why the files of an earlier identification are not those of its archives."""


def stored_model(folder: Path, reporter: Reporter) -> IdentifiedModel:
    """Return the arm in `results.json` and `parameters.json` of a folder with its archives.

    Raises:
        NotReusableError: they are missing, of other archives, or without consistent parameters.
        InputError: the archives cannot be read.
    """
    for name in (RESULTS, PARAMETERS_JSON):
        if not path_exists(folder / name):
            raise NotReusableError(f"there is no {name}")
    try:
        results = Results.load(folder / RESULTS)
        content = parse_json(read_text(folder / PARAMETERS_JSON))
        provenance = {str(key): str(text) for key, text in content["provenance"].items()}
    except (InputError, OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise NotReusableError(f"its files cannot be read ({error})") from error
    by_kind = archives_by_kind(folder)
    paths = [path for paths in by_kind.values() for path in paths]
    present = provenance_of(results, paths)
    if archive_digests(provenance) != archive_digests(present):
        raise NotReusableError("its archives are others than those that were identified")
    if provenance.get("verdict") != single_line(present["verdict"]):
        raise NotReusableError(f"{RESULTS} and {PARAMETERS_JSON} are not of one identification")
    cell = cell_of(open_archive(paths[0]))
    try:
        cell, standard, values = _stored_values(cell, content)
        undetermined = tuple(str(name) for name in content["undetermined"])
    except (HilError, IdentificationError, ValueError, LookupError, TypeError) as error:
        raise NotReusableError(f"{PARAMETERS_JSON} is not of this arm ({error})") from error
    first, unseen = by_kind["excitation"][:1], by_kind.get("validation")
    sources = gather_sources([*first, *unseen] if unseen else paths, FIXED.split)
    prepared = prepare_sources(sources, FIXED, reporter)
    program = results.software.get("hil", "an unknown version of hil")
    return IdentifiedModel(
        cell.name,
        _arm(cell, standard, values, median_load(cell.model, values, prepared.fitted)),
        undetermined,
        present,
        _motion(prepared.held_out),
        results.verdict.line,
        results.verdict.good,
        f"from {folder / RESULTS} and {PARAMETERS_JSON}, identified by hil {program}; "
        "--again identifies again",
    )


def archives_by_kind(folder: Path) -> dict[str, list[Path]]:
    """Return the archives that `hil identify` uses of a folder, by kind."""
    if path_exists(folder / "manifest.json"):
        campaign = CampaignFolder(folder)
        kinds = ("excitation", "validation", "standstill")
        return {kind: list(campaign.completed(kind)) for kind in kinds}
    return {"excitation": sorted(folder.glob("*.mcap"))}


def _stored_values(cell: Cell, content: Mapping[str, Any]) -> tuple[Cell, Array, Array]:
    """Return the cell with the identified friction law, standard (s,) and all (p,) parameters."""
    stored = content["standard"]
    if stored is None:
        raise ValueError("it has no physically consistent parameters")
    cell = cell.with_friction_laws(content["friction_laws"])
    model = cell.model
    layout, links, motors = model.layout, stored["links"], stored["motor_friction"]
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
    if not np.isfinite(values).all():
        raise ValueError("it has numbers that are not finite")
    return cell, standard, values


def default_output(sources: Sequence[Path], to: FormatName, *, ensemble: bool = False) -> Path:
    """Return the default path: in the campaign folder, or in the working directory."""
    folder = sources[0] if sources[0].is_dir() else Path()
    if ensemble:
        return folder / "identified_ensemble"
    return folder / f"identified{FORMATS[to].suffix}"


def _motion(held_out: Sequence[Samples]) -> Motion:
    """Return some rows of the predicted motion, from all its recordings."""
    parts = [samples.motion for samples in held_out]
    step = -(-sum(motion.n_samples for motion in parts) // _MOST_ROWS)
    some = [motion.rows(slice(None, None, step)) for motion in parts]
    columns = [np.concatenate(column) for column in zip(*(one[:4] for one in some), strict=True)]
    directions = [one.direction for one in some if one.direction is not None]
    direction = np.concatenate(directions) if len(directions) == len(some) else None
    return Motion(*columns)._replace(direction=direction)
