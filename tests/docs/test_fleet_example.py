"""The example of a fleet: thirty small logs, of which one robot wears."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.docs.typed import ROOT

pytestmark = pytest.mark.long


def test_the_worn_robot_is_named_first(tmp_path) -> None:
    script = ROOT / "examples" / "08_fleet.py"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.startswith("Changed: robot3 (1 of 5 robots).")
    assert "robot3, elbow: friction +3" in ran.stdout
    assert "30 recordings of 5 robots; 0 skipped, 0 failed" in ran.stdout
    output = tmp_path / "runs" / "examples"
    assert (output / "08_fleet.png").stat().st_size > 10_000
    assert (output / "fleet" / "trend.html").is_file()
