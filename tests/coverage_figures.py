"""Lines and branches that the tests of a package reach, each by itself, from `coverage json`.

``python -m tests.coverage_figures FILE PACKAGE...`` prints both for each package, and ends with
exit status 1 if one of them is below 90 %: `coverage report --fail-under` adds lines and branches
up, so that many lines can hide few branches.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

LEAST: Final = 90.0
"""%"""


def figures(report: dict[str, Any], package: str) -> tuple[float, float]:
    """Shares of lines and of branches in the files of a package [%].

    Raises:
        ValueError: none of them was measured.
    """
    found = [
        one["summary"]
        for path, one in report["files"].items()
        if Path(path).parts[:1] == (package,)
    ]
    if not found:
        raise ValueError(f"no file of {package} was measured")
    return (
        _share(found, "covered_lines", "num_statements"),
        _share(found, "covered_branches", "num_branches"),
    )


def _share(found: list[dict[str, int]], reached: str, all_of_them: str) -> float:
    total = sum(one[all_of_them] for one in found)
    return 100.0 * sum(one[reached] for one in found) / total if total else 100.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Print them; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.coverage_figures", description=__doc__)
    parser.add_argument("file", type=Path, help="what `coverage json` has written")
    parser.add_argument("packages", nargs="+")
    given = parser.parse_args(arguments)
    try:
        report = json.loads(given.file.read_text("utf-8"))
        found = {package: figures(report, package) for package in given.packages}
    except (OSError, ValueError, KeyError, TypeError) as error:
        parser.error(f"{given.file} cannot be used: {error}")
    for package, (lines, branches) in found.items():
        sys.stdout.write(f"{package}: {lines:.1f} % of lines, {branches:.1f} % of branches\n")
    return int(min(min(shares) for shares in found.values()) < LEAST)


if __name__ == "__main__":
    sys.exit(main())
