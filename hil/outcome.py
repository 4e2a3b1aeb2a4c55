"""What an identification leaves in a folder: exports, results, the report and its series."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from hil.errors import InputError
from hil.files import write_together
from hil.identify import Identification
from hil.identify.exports import exports_of, provenance_of
from hil.progress import Reporter
from hil.reading import opened
from hil.report import ReportSeries, report_bytes
from hil.results import Results

RESULTS, REPORT, SERIES = "results.json", "report.html", "report_series.npz"
_WORDS: Final = ("example_archive", "replay_words")
_LARGEST: Final = 1 << 30
"""Bytes of series that are read; those of a campaign of 30 repetitions have a hundredth of it."""


def write_outcome(folder: Path, found: Identification, reporter: Reporter) -> Results:
    """Write files for other tools, `results.json` and the page, or nothing; say where they are.

    Raises:
        OutputError: the folder cannot be written to; nothing in it was changed.
    """
    consistency, essential = found.consistency, found.essential
    exports = exports_of(
        found.cell,
        found.estimate.pooled,
        consistency if isinstance(consistency, str) else consistency.consistent,
        essential=None if isinstance(essential, str) else essential.elimination.estimate.names,
        provenance=provenance_of(found.results, found.paths),
    )
    results = found.results.model_copy(update={"exports": exports.result})
    files = {
        **exports.contents,
        RESULTS: results.to_json(),
        SERIES: _series_bytes(found.series),
        REPORT: report_bytes(results, found.series),
    }
    write_together(folder, files)
    for name, why in exports.withheld.items():
        reporter.say(f"{name} was not written: {why}")
    reporter.say(f"written to {folder}: {RESULTS}, {', '.join(exports.written)}")
    reporter.say(f"report: {folder / REPORT}")
    return results


def rewrite_report(folder: Path) -> Results:
    """Make the page anew from the results and series that lie in a folder.

    Raises:
        InputError: they are not there, or cannot be read.
        OutputError: the folder cannot be written to.
    """
    results = Results.load(folder / RESULTS)
    series = _load_series(folder / SERIES, len(results.joint_names))
    try:
        page = report_bytes(results, series)
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        # What was written by us can be drawn; what somebody wrote has lists of any length.
        raise InputError(
            folder / RESULTS,
            f"holds what no page can be drawn from ({error})",
            remedy="identify again from the archives (`hil identify`)",
        ) from error
    write_together(folder, {REPORT: page})
    return results


def report_replay(
    folder: Path,
    results: Results,
    replay: Callable[[ReportSeries], ReportSeries],
    reporter: Reporter,
) -> None:
    """Add a replay to the report in a folder, if it has the same parameters.

    Raises:
        InputError: results or series cannot be read.
        OutputError: the folder cannot be written to.
    """
    there = Results.load(folder / RESULTS)
    if [p.estimate for p in there.parameters] != [p.estimate for p in results.parameters]:
        reporter.say(f"note: {folder / REPORT} is of another identification; it stays as it is")
        return
    series = replay(_load_series(folder / SERIES, len(there.joint_names)))
    pages = {SERIES: _series_bytes(series), REPORT: report_bytes(there, series)}
    write_together(folder, pages)
    reporter.say(f"report: {folder / REPORT}")


def _series_bytes(series: ReportSeries) -> bytes:
    """The series behind the figures as a `.npz` file."""
    content = BytesIO()
    np.savez_compressed(content, **asdict(series))
    return content.getvalue()


def _load_series(path: Path, n_joints: int) -> ReportSeries:
    try:
        with opened(path) as stream:
            _require_bounded(stream)
            with np.load(stream, allow_pickle=False) as found:
                arrays = {name: found[name] for name in found.files}
        words = {name: str(one) for name, one in arrays.items() if name in _WORDS}
        series = ReportSeries(**(arrays | words))
        return series.checked_for(n_joints)
    except Exception as error:  # a forged archive makes its readers raise anything
        raise InputError(
            path,
            f"does not hold the series of a report ({error})",
            remedy="identify again from the archives (`hil identify`)",
        ) from error


def _require_bounded(stream: BinaryIO) -> None:
    """Refuse a file that would become much larger than any of ours."""
    with zipfile.ZipFile(stream) as members:
        size = sum(member.file_size for member in members.infolist())
    if size > _LARGEST:
        raise ValueError(f"it would take {size} bytes")
    stream.seek(0)
