"""What an identification leaves in a folder: exports, results and the report."""

from __future__ import annotations

from pathlib import Path

from hil.files import write_together
from hil.identify import Identification
from hil.identify.exports import exports_of, provenance_of
from hil.progress import Reporter
from hil.report import report_bytes
from hil.results import Results

RESULTS, REPORT = "results.json", "report.html"


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
    page = report_bytes(results, found.series)
    write_together(folder, {**exports.contents, RESULTS: results.to_json(), REPORT: page})
    for name, why in exports.withheld.items():
        reporter.say(f"{name} was not written: {why}")
    reporter.say(f"written to {folder}: {RESULTS}, {', '.join(exports.written)}")
    reporter.say(f"report: {folder / REPORT}")
    return results
