"""Output files of an identification: exports, results, report and its series."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from hil.archive import open_archive
from hil.archive.check import recording_date
from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.files import convert_write_errors, file_digest, write_files
from hil.base.output_folder import SOURCES
from hil.base.progress import Reporter
from hil.base.safe_input import path_exists
from hil.base.terminal_text import one_line
from hil.cell import Cell
from hil.pipeline.identification import Identification
from hil.pipeline.notes import NotConsistent, NotEssential
from hil.report.page import report_bytes
from hil.results.provenance import PARAMETERS_JSON, RESULTS, provenance_of
from hil.results.results import ExportResult, OccasionResult, Results, SettingsResult
from hil.results.rollout_result import ROLLOUT, RolloutResult
from hil.results.series import SERIES, load_series
from identification import Estimate, IdentificationError
from identification.estimators.consistent import ConsistentEstimate
from identification.export.friction_curve import median_load
from identification.export.parameter_files import covariance_csv, parameters_csv, parameters_json
from identification.export.urdf import write_urdf

REPORT = "report.html"


def write_outcome(folder: Path, identification: Identification, reporter: Reporter) -> Results:
    """Write exports, `results.json` and report together; OutputError if impossible."""
    consistency = identification.consistency
    essential = identification.essential
    occasion = occasion_of(identification)
    origin = provenance_of(identification.results, identification.paths)
    exports = exports_of(
        identification.cell,
        identification.estimation.stated,
        consistency.reason if isinstance(consistency, NotConsistent) else consistency.consistent,
        essential=None if isinstance(essential, NotEssential) else essential.estimate.names,
        provenance={**origin, **occasion.entries()},
        load=median_load(
            identification.cell.model,
            identification.estimate.pooled.values,
            identification.prepared.fitted,
        ),
    )
    results = identification.results.model_copy(
        update={
            "exports": exports.result,
            "occasion": occasion,
            "settings": settings_result(identification),
        }
    )
    files = {
        **exports.contents,
        RESULTS: results.to_json(),
        SERIES: identification.series.to_bytes(),
        REPORT: report_bytes(results, identification.series),
    }
    write_files(folder, files)
    for name, reason in exports.withheld.items():
        reporter.say(f"{name} was not written: {reason}")
    reporter.say(f"written to {folder}: {RESULTS}, {', '.join(exports.result.written)}")
    reporter.say(f"report: {folder / REPORT}")
    return results


def copy_outcome(folder: Path, place: Path, archives: Collection[Path]) -> None:
    """Copy results, report, exports and archives to another folder.

    Raises:
        OutputError: it cannot be written to.
    """
    if folder.resolve() == place.resolve():
        return
    names = (RESULTS, SERIES, REPORT, *EXPORT_FILES, SOURCES, "map.toml")
    paths = [folder / name for name in names]
    write_files(place, {path.name: path.read_bytes() for path in paths if path_exists(path)})
    with convert_write_errors(place):
        for archive in archives:
            shutil.copyfile(archive, place / archive.name)


def occasion_of(identification: Identification) -> OccasionResult:
    """Return dates of recording and identification, and the free fields of the cell file."""
    archives = (open_archive(path, fields=()) for path in identification.paths)
    dates = sorted(filter(None, map(recording_date, archives)))
    cell = identification.cell.file.cell
    return OccasionResult(
        recorded_from=dates[0] if dates else None,
        recorded_to=dates[-1] if dates else None,
        identified_at=datetime.now(UTC).isoformat(timespec="seconds"),
        operator=cell.operator,
        serial_number=cell.serial_number,
        notes=cell.notes,
    )


def settings_result(identification: Identification) -> SettingsResult:
    """Return what the identification used, for exports and rollouts."""
    sources = identification.prepared.sources
    first = identification.prepared.sources.training[0]
    fitted = {source.path for source in sources.training}
    predicted = {source.path for source in sources.held_out} - fitted
    return SettingsResult(
        archives=[path.name for path in identification.paths],
        predicted=[path.name for path in identification.paths if path in predicted],
        split=first.recording.n_samples / first.whole.n_samples,
        in_sample=sources.in_sample,
        estimator=identification.estimation.estimator,
        settings=SettingsResult.entries(identification.prepared.settings),
    )


def is_of_report(folder: Path, rollout: RolloutResult) -> bool:
    """Return whether a rollout belongs to the parameters in the report of a folder."""
    parameters = folder / PARAMETERS_JSON
    reported = path_exists(parameters) and path_exists(folder / SERIES)
    return reported and rollout.parameters == file_digest(parameters)


def _rollout_in(folder: Path) -> RolloutResult | None:
    """Return the rollout for the report of a folder, if there is one."""
    if not path_exists(folder / ROLLOUT):
        return None
    rollout = RolloutResult.load(folder / ROLLOUT)
    return rollout if is_of_report(folder, rollout) else None


def rewrite_report(folder: Path) -> Results:
    """Create the report again from results, series and rollout in a folder.

    Raises:
        InputError: one of them cannot be read.
        OutputError: the report cannot be written.
    """
    results = Results.load(folder / RESULTS)
    series = load_series(folder, len(results.joint_names))
    rollout = _rollout_in(folder)
    try:
        page = report_bytes(results, series, rollout)
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        # For example lists of unequal length in an edited file.
        problem = f"contains values that a report cannot show ({error})"
        remedy = "identify again from the archives (`hil identify`)"
        raise InputError(folder / RESULTS, problem, remedy=remedy) from error
    write_files(folder, {REPORT: page})
    return results


URDF = "identified.urdf"
PARAMETERS_CSV = "parameters.csv"
COVARIANCE_CSV = "parameters_covariance.csv"
EXPORT_FILES = (PARAMETERS_JSON, PARAMETERS_CSV, COVARIANCE_CSV, URDF)
"""Exports of an identification."""


@dataclass(frozen=True)
class Exports:
    """Files for other tools."""

    contents: Mapping[str, str | None]  #: text by name; None: remove a file of other parameters
    withheld: Mapping[str, str]  #: reason by name of each file that is not written

    @property
    def result(self) -> ExportResult:
        """Entry of `results.json`."""
        written = [name for name, text in self.contents.items() if text is not None]
        return ExportResult(written=written, withheld=dict(self.withheld))


def exports_of(
    cell: Cell,
    estimate: Estimate,
    consistent: ConsistentEstimate | str,
    *,
    essential: Collection[str] | None = None,
    provenance: Mapping[str, str] | None = None,
    load: Array | None = None,
) -> Exports:
    """Return the exports of an identified model.

    Args:
        cell: of the arm.
        estimate: of its parameters.
        consistent: physically consistent estimate, which the URDF needs, or why there is none.
        essential: names of the essential parameters.
        provenance: see :func:`provenance_of`.
        load: of the gears, as in :func:`write_urdf`.

    Raises:
        IdentificationError: the estimate is of another model.
    """
    model = cell.model
    origin = {key: one_line(value) for key, value in (provenance or {}).items()}
    possible = None if isinstance(consistent, str) else consistent
    contents: dict[str, str | None] = {
        PARAMETERS_JSON: parameters_json(
            model, estimate, consistent=possible, essential=essential, provenance=origin
        ),
        PARAMETERS_CSV: parameters_csv(model, estimate, provenance=origin),
        COVARIANCE_CSV: covariance_csv(estimate, provenance=origin),
    }
    withheld = {}
    if possible is None:
        withheld[URDF] = f"there are no physically consistent parameters: {consistent}"
    else:
        try:
            contents[URDF] = _urdf(cell, estimate, possible, origin, load)
        except IdentificationError as error:
            withheld[URDF] = str(error)
    return Exports({**contents, **dict.fromkeys(withheld)}, withheld)


def _urdf(
    cell: Cell,
    estimate: Estimate,
    consistent: ConsistentEstimate,
    origin: Mapping[str, str],
    load: Array | None,
) -> str:
    """Return the user's URDF with the consistent parameters and a comment."""
    model = cell.model
    names = model.parameter_names[model.friction_part]
    # A joint that did not move has the friction of its URDF.
    unknown = np.array([name in estimate.undetermined for name in names], dtype=np.bool_)
    friction = np.where(unknown, np.nan, consistent.friction)
    lines = ["Inertia and joint friction were identified by hil; everything else is unchanged."]
    if undetermined := ", ".join(estimate.undetermined):
        lines.append(f"Nominal values, not determined by the data: {undetermined}.")
    lines += [f"{key}: {value}" for key, value in origin.items()]
    return write_urdf(cell.urdf, model, consistent.standard, friction, lines, load)
