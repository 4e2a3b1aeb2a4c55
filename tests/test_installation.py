"""The package as a user installs it: into a new environment, out of a copy of its files."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hil.results.results import Results

ROOT = Path(__file__).parents[1]
LEFT_OUT = (".*", "build", "runs", "*.egg-info", "__pycache__", "tests")

pytestmark = pytest.mark.slow


def test_installed_into_a_new_environment_it_runs_the_demo(tmp_path: Path) -> None:
    """With no file of the project but those that were installed; pip loads what it depends on."""
    source = tmp_path / "source"
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(*LEFT_OUT))
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", environment], check=True)
    pip = [environment / "bin" / "python", "-m", "pip", "--disable-pip-version-check", "install"]
    constraints = ["--constraint", ROOT / "constraints.txt"]
    subprocess.run([*pip, "--quiet", *constraints, source], check=True)
    shutil.rmtree(source)
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    hil = environment / "bin" / "hil"
    arguments = ["demo", "--repetitions", "2", "--validation", "1", "--json", "-o", "out"]
    done = subprocess.run(
        [hil, *arguments],
        cwd=tmp_path,
        env=variables,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert Results.load(tmp_path / "out" / "results.json").verdict.good
    for name in ("report.html", "identified.urdf"):
        assert (tmp_path / "out" / name).stat().st_size > 0
