"""The long run itself, for some seconds: real processes, real time, a real journal."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.endurance.journal import read_journal
from tests.endurance.verdict import PROCESSES

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_some_seconds_of_it_leave_archives_and_a_journal(tmp_path: Path) -> None:
    journal = tmp_path / "long.jsonl"
    done = subprocess.run(
        [sys.executable, "-m", "tests.endurance", "--minutes", "0.3", "--journal", str(journal),
         "--folder", str(tmp_path / "work"), "--rate", "500", "--json"],
        cwd=ROOT, capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    said = json.loads(done.stdout)
    assert said["faults"] == []
    assert said["archives"]["archives"] > 0
    (piece,) = read_journal(journal)
    assert piece.ended is not None
    assert piece.ended["reason"] == ""
    assert set(piece.samples[-1].processes) == set(PROCESSES)
    # Every packet answered is in the histogram, but for the one under way.
    assert abs(sum(piece.samples[-1].latencies) - piece.samples[-1].counters["answered"]) <= 50
