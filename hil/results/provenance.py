"""Origin of a result: its archives by their digests, software and verdict; names of its files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from hil.base.files import file_digest
from hil.base.safe_input import path_exists
from hil.base.terminal_text import one_line
from hil.results.results import Results

RESULTS = "results.json"


PARAMETERS_JSON = "parameters.json"


def archive_digests(provenance: Mapping[str, str]) -> set[str]:
    """Return the archives of a provenance, each with its digest, in any order."""
    return set(one_line(provenance.get("archives", "")).split(", "))


def provenance_of(results: Results, archives: Sequence[Path]) -> dict[str, str]:
    """Return the origin of a result: cell, archives with digests, software and verdict.

    Archives of imported recordings have none before the result is saved.
    """
    digests = (
        f"{path.name} sha256 {file_digest(path)}" if path_exists(path) else f"{path.name} unsaved"
        for path in archives
    )
    return {
        "robot": results.cell,
        "simulated": "yes" if results.simulated else "no",
        "archives": ", ".join(digests),
        "software": ", ".join(f"{name} {version}" for name, version in results.software.items()),
        "verdict": ("good" if results.verdict.good else "NOT GOOD") + f": {results.verdict.line}",
    }
