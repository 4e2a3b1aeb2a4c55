"""The command as a person types it, for the tests of it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[2]


def process_death(*options: str) -> tuple[dict[str, Any], str]:
    """What `python -m tests.process_death --json` prints, and its standard error."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.process_death", "--json", *options],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    assert done.returncode == (1 if report["failed"] else 0)
    return report, done.stderr


def require_unbroken(first: int, count: int) -> None:
    """Some rounds, three at a time: most of their time is waiting."""
    report, errors = process_death("--start", str(first), "--rounds", str(count), "--jobs", "3")
    assert report["ran"] == count
    assert not report["failed"], errors
    assert report["nobody_killed"] <= count // 4, "the rounds must come to their kills"
