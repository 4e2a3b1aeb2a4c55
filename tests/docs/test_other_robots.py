"""`docs/other-robots.md` is typed, with a log of the motions that it designed."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.cell import Cell
from hil.cli import app
from hil.results import Results
from tests.docs.typed import ROOT
from tests.motion_table import MotionTable

BLOCKS = re.findall(
    r"```(sh|toml)\n(.*?)```", (ROOT / "docs" / "other-robots.md").read_text("utf-8"), re.DOTALL
)


def log(motion: str, path: str) -> None:
    """What an arm of the URDF, with friction, logs of a designed motion: twice, with noise."""
    cell = Cell.load("cell.toml")
    trajectory = MotionTable.of(Path("runs/motion", motion).read_text())
    once = np.arange(0.0, trajectory.duration + 0.5, 2e-3)
    time = np.arange(2 * len(once)) * 2e-3
    q, qd, qdd = (np.tile(one, (2, 1)) for one in trajectory.sample(once))
    n = len(cell.joint_names)
    values = cell.parameter_values(
        rotor_inertia=np.full(n, 0.3), coulomb=np.full(n, 5.0), viscous=np.full(n, 3.0),
        third=np.zeros(n),
    )  # fmt: skip
    noise = np.random.default_rng(len(motion)).standard_normal((2, *q.shape))
    torque = cell.model.torque(values, q, qd, qdd) + 0.2 * noise[0]
    table = np.column_stack([time, q + 1e-5 * noise[1], torque])
    np.savetxt(path, table, delimiter=",", header="t,q1,q2,tau1,tau2", comments="")


def test_every_command_runs_from_a_urdf_to_a_good_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    for language, block in BLOCKS:
        if language == "toml":
            Path(block.splitlines()[0].removeprefix("# ")).write_text(block)
            log("excitation.csv", "log.csv")
            log("validation_000.csv", "other.csv")
            continue
        for line in block.splitlines():
            program, *arguments = shlex.split(line)
            assert program == "hil"
            result = CliRunner().invoke(app, arguments, catch_exceptions=False)
            assert result.exit_code == 0, (line, result.output)
    assert Results.load(Path("result/results.json")).verdict.good
    assert "<robot" in Path("result/arm.urdf").read_text()
