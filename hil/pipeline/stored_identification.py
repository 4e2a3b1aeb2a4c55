"""An identification that is read from its files: nothing is estimated again.

`results.json` has the settings that it chose, `parameters.json` what it estimated. With these and
the archives, exports, rollouts and :func:`hil.load` need no other identification.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hil.archive.campaign_archives import RecordedCampaign
from hil.base.arrays import Array
from hil.base.errors import HilError, InputError
from hil.base.files import file_digest
from hil.base.progress import Reporter
from hil.base.safe_input import parse_json, path_exists, read_text
from hil.base.terminal_text import one_line
from hil.cell import Cell
from hil.pipeline.identified_model import IdentifiedModel, arm_with, impossible_bodies, model_of
from hil.pipeline.identify_folder import identify_paths
from hil.pipeline.options import Options
from hil.pipeline.prepared import Prepared, prepared_with
from hil.pipeline.sources import gather_sources
from hil.results.provenance import (
    PARAMETERS_JSON,
    RESULTS,
    archive_digests,
    provenance_of,
)
from hil.results.results import Results, SettingsResult
from hil.results.series import ReportSeries, load_series
from identification.errors import IdentificationError
from identification.export.parameter_files import estimate_in
from identification.factor.estimate import Estimate
from identification.model.link_wrenches import LINK_SYMBOLS
from identification.validation.verdict import Verdict


def read_or_identify(
    paths: Sequence[Path],
    options: Options,
    reporter: Reporter,
    *,
    reuse: bool,
    predict: Sequence[Path] = (),
) -> IdentifiedModel:
    """Return the arm in the files of a folder, or identify it from the archives.

    Args:
        paths: a folder, or archives.
        options: of the identification.
        reporter: of progress.
        reuse: whether to read the files of an earlier identification.
        predict: archives that are held out.

    Raises:
        InputError: the archives cannot be used, or give no physically consistent parameters.
    """
    if reuse and len(paths) == 1 and paths[0].is_dir():
        try:
            return stored_identification(paths[0], reporter, predict).model()
        except NotReusableError as error:
            reporter.say(f"{paths[0]}: identified again: {error}")
    return model_of(identify_paths(paths, reporter, options, predict=predict))


class NotReusableError(Exception):
    """Why the files of an earlier identification do not belong to its archives."""


@dataclass(frozen=True, eq=False)
class StoredIdentification:
    """An identification from the files of a folder, with the samples of its archives."""

    folder: Path
    results: Results
    estimate: Estimate  #: in units of the torque of this arm
    prepared: Prepared  #: the archives by the settings that were chosen
    paths: tuple[Path, ...]  #: of the archives
    provenance: Mapping[str, str]
    content: Mapping[str, Any]  #: of `parameters.json`

    @property
    def cell(self) -> Cell:
        """The cell of the archives, with the friction law that was chosen."""
        return self.prepared.sources.cell

    @property
    def values(self) -> Array:
        """Parameters (p,)."""
        return self.estimate.values

    @property
    def verdict(self) -> Verdict:
        """Whether the model may be used."""
        judgement = self.results.judgement
        verdict = self.results.verdict
        return Verdict(
            verdict.good,
            verdict.line,
            tuple(verdict.reasons),
            tuple(verdict.warnings[: len(judgement.doubtful)]),  # remarks of the files follow them
            tuple(judgement.next_steps),
            tuple(judgement.findings),
            tuple(verdict.purposes),
            verdict.headline,
        )

    @cached_property
    def series(self) -> ReportSeries:
        """Data of the report's figures.

        Raises:
            InputError: they cannot be read.
        """
        return load_series(self.folder, len(self.results.joint_names))

    def model(self) -> IdentifiedModel:
        """Return the arm with possible bodies.

        Raises:
            NotReusableError: there are none in the files.
        """
        cell = self.cell
        try:
            standard, values = _stored_values(cell, self.content)
        except (ValueError, LookupError, TypeError) as error:
            raise NotReusableError(f"{PARAMETERS_JSON} cannot be used ({error})") from error
        program = self.results.software.get("hil", "an unknown version of hil")
        return IdentifiedModel(
            cell,
            arm_with(cell, standard, values, self.prepared.fitted),
            self.estimate,
            self.estimator,
            self.prepared.with_load(self.estimate.values),
            self.paths,
            self.provenance,
            self.results.verdict.line,
            self.results.verdict.good,
            f"from {self.folder / RESULTS} and {PARAMETERS_JSON}, identified by hil {program}; "
            "--again identifies again",
            tuple(self.results.contact_thresholds),
            file_digest(self.folder / PARAMETERS_JSON),
        )

    @property
    def estimator(self) -> str:
        """Name of the estimator."""
        assert self.results.settings is not None
        return self.results.settings.estimator


def stored_identification(
    folder: Path, reporter: Reporter, predict: Sequence[Path] = ()
) -> StoredIdentification:
    """Return `results.json` and `parameters.json` of a folder with its archives.

    `predict` are archives to hold out in place of those that were.

    Raises:
        NotReusableError: they are missing, or of other archives.
        InputError: the archives cannot be read.
    """
    results, content, provenance = _files_of(folder)
    settings = results.settings
    if settings is None:
        raise NotReusableError(f"{RESULTS} is of an earlier version, without settings")
    paths = _archives_of(folder, settings)
    present = provenance_of(results, paths)
    if archive_digests(provenance) != archive_digests(present):
        raise NotReusableError("its archives are not the ones that were identified")
    if provenance.get("verdict") != one_line(present["verdict"]):
        raise NotReusableError(
            f"{RESULTS} and {PARAMETERS_JSON} do not belong to one identification"
        )
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
        estimate = estimate_in(content)
    except (HilError, IdentificationError, ValueError, LookupError, TypeError) as error:
        raise NotReusableError(f"{PARAMETERS_JSON} cannot be used ({error})") from error
    if estimate.names != prepared.sources.cell.model.parameter_names:
        raise NotReusableError(f"the parameters of {PARAMETERS_JSON} differ")
    return StoredIdentification(folder, results, estimate, prepared, tuple(paths), present, content)


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
    """Return the archives that `hil identify` uses of a folder, or of its results next to it.

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
        raise ValueError("its parameters differ")
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
