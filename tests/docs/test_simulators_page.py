"""`docs/simulators.md` is run from its first block to its last, on an arm of two joints."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import matplotlib.image
import pytest
from typer.testing import CliRunner

from hil import Campaign, Cell
from hil.campaign import design
from hil.cli import app
from hil.progress import Silent
from tests.docs.typed import ROOT

BLOCKS = re.findall(
    r"```(sh|python)\n(.*?)```", (ROOT / "docs" / "simulators.md").read_text("utf-8"), re.DOTALL
)


def test_every_command_and_every_line_of_python_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    cell = Cell.load(ROOT / "examples" / "two_joints" / "cell.toml")
    cell = cell.with_campaign(repetitions=2, validation_runs=1)
    campaign = Campaign.create(tmp_path / "runs" / "demo", cell, design(cell, Silent()))
    campaign.run(unrehearsed=True, durable=False)  # in place of the demo's
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for language, block in BLOCKS:
        if language == "python":
            exec(compile(block, "docs/simulators.md", "exec"), names)
            continue
        for line in block.splitlines():
            program, command, *arguments = shlex.split(line)
            assert program == "hil"
            if command != "demo":
                result = CliRunner().invoke(app, [command, *arguments], catch_exceptions=False)
                assert result.exit_code == 0, result.output
    assert matplotlib.image.imread("rollout.png").std() > 0.0
    assert len(names["models"]) == 100  # type: ignore[arg-type]
    error = abs(names["simulated"] - names["position"])  # type: ignore[operator]
    assert error.max() < 0.1, error.max()  # rad: of a motion of more than one
