"""Lines and branches that the tests of a package reach, each by itself, from `coverage json`.

``python -m tests.coverage_figures FILE PACKAGE...`` prints both for each package, and ends with
exit status 1 if one of them is below 90 %: `coverage report --fail-under` adds lines and branches
up, so that many lines can hide few branches.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

LEAST: Final = 90.0
"""%"""
PARTS: Final = {
    "lines": ("covered_lines", "num_statements"),
    "branches": ("covered_branches", "num_branches"),
}


def figures(report: dict[str, Any], package: str) -> dict[str, float]:
    """Shares of lines and of branches in the files of a package [%].

    Raises:
        ValueError: none of them was measured.
    """
    files = report["files"].items()
    summaries = [entry["summary"] for path, entry in files if Path(path).parts[:1] == (package,)]
    if not summaries:
        raise ValueError(f"no file of {package} was measured")
    sums = {
        part: [sum(summary[key] for summary in summaries) for key in PARTS[part]] for part in PARTS
    }
    return {part: 100.0 * reached / max(1, total) for part, (reached, total) in sums.items()}


def main(arguments: Sequence[str]) -> int:
    """Print them; returns the exit status."""
    file, *packages = arguments
    report = json.loads(Path(file).read_text("utf-8"))
    shares_of = {package: figures(report, package) for package in packages}
    for package, shares in shares_of.items():
        texts = (f"{share:.1f} % of {part}" for part, share in shares.items())
        sys.stdout.write(f"{package}: {', '.join(texts)}\n")
    return int(min(min(shares.values()) for shares in shares_of.values()) < LEAST)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
