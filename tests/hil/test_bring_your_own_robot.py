"""`docs/bring-your-own-robot.md` is run from its first block to its last."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from hil.campaign import Campaign
from hil.cli import app
from hil.results import Results
from tests.hil.simulated_logs import simulate
from tests.hil.test_gains_command import CENTRE, MASS, archive

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "bring-your-own-robot.md").read_text(encoding="utf-8")
BALANCER = re.compile(r"## An arm with a balancer\n.*?(?=^## )", re.DOTALL | re.MULTILINE)
"""Needs a recording of such an arm: `test_balancer_recording.py` types its commands."""
BLOCKS = re.findall(r"```(sh|python|toml)\n(.*?)```", BALANCER.sub("", TEXT), re.DOTALL)


@pytest.fixture
def workplace(tmp_path: Path, campaign: Campaign) -> Path:
    """A checkout in which `hil demo` was run, and recordings with and without a payload."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "demo").symlink_to(campaign.folder.root)
    (tmp_path / "sim_fixtures").symlink_to(ROOT / "sim_fixtures")
    time = np.arange(0.0, 20.0, 8e-3)
    load = pin.Inertia(MASS, np.array(CENTRE), np.zeros((3, 3)))
    archive(tmp_path, "empty", simulate("ur5_robot.urdf", time, seed=1))
    archive(tmp_path, "full", simulate("ur5_robot.urdf", time, seed=2, load=load))
    return tmp_path


def test_every_command_and_every_line_of_python_runs(
    workplace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(workplace)
    ran = []
    for language, block in BLOCKS:
        if language == "python":
            exec(compile(block, "docs/bring-your-own-robot.md", "exec"), {})
        elif language == "toml":
            name = block.splitlines()[0].removeprefix("# ")
            (workplace / name).write_text(block)
        else:
            for line in block.splitlines():
                program, command, *arguments = shlex.split(line)
                assert program == "hil"
                ran.append(command)
                if command != "demo":  # a campaign of the fixture stands in its place
                    result = CliRunner().invoke(app, [command, *arguments])
                    assert result.exit_code in (0, 5), (line, result.output, result.exception)
    assert ran == ["demo", "import", "import", "identify", "gains"]
    results = Results.load(workplace / "result" / "results.json")
    assert [one.archive for one in results.validation] == ["other.mcap"]
    assert (workplace / "result" / "report.html").is_file()
    errors = [one.overall_relative_error for one in results.validation]
    assert max(errors) < 0.1, errors  # of the rest of a motion of seconds, with its noise


def test_the_demo_that_it_names_is_a_command_with_such_options() -> None:
    result = CliRunner().invoke(app, ["demo", "--help"], env={**os.environ, "COLUMNS": "200"})
    demo = next(block for language, block in BLOCKS if "hil demo" in block and language == "sh")
    for option in re.findall(r"--[a-z-]+", demo):
        assert option in result.output


def test_every_option_it_mentions_exists() -> None:
    helps = "".join(
        CliRunner().invoke(app, [*command, "--help"], env={**os.environ, "COLUMNS": "200"}).output
        for command in (
            ("import", "log"),
            ("import", "rosbag2"),
            ("identify",),
            ("gains",),
            ("demo",),
        )
    )
    for option in set(re.findall(r"(?<![\w-])--[a-z]+(?:-[a-z]+)*", TEXT)):
        assert option in helps, option
