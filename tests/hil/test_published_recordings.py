"""The published recordings of `docs/bring-your-own-robot.md`, by the commands that stand there."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.cli import app
from hil.cli.verdict import NOT_GOOD
from hil.results import FittedResult, Results
from tests.hil.simulated_logs import urdf_path

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
TEXT = (ROOT / "docs" / "bring-your-own-robot.md").read_text(encoding="utf-8")
SECTION = TEXT.split("## Two published recordings")[1].split("\n## ")[0]
COMMANDS = re.findall(r"^\$ hil (.*)$", SECTION, re.MULTILINE)


def fitted_by(commands: list[str], output: Path) -> FittedResult:
    """Run an import and an identification, and read the errors of the fit."""
    for command in commands:
        arguments = shlex.split(command)
        status = 0
        if arguments[0] == "identify":
            arguments, status = [*arguments, "--output", str(output)], NOT_GOOD
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == status, (command, result.output, result.exception)
    fitted = Results.load(output / "results.json").fitted
    assert fitted is not None
    return fitted


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    if not (DATA / "tx40").is_dir() or not (DATA / "ur10_unisa").is_dir():
        pytest.skip(f"there are no recordings below {DATA}")
    files = [*(DATA / "tx40").iterdir(), *(DATA / "ur10_unisa").iterdir()]
    for file in [*files, urdf_path("ur10_robot.urdf")]:
        (tmp_path / file.name).symlink_to(file)
    (block,) = re.findall(r"```toml\n(.*?)```", SECTION, re.DOTALL)
    (tmp_path / "tx40.toml").write_text(block)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_page_has_the_commands_of_three_identifications() -> None:
    assert [command.split()[0] for command in COMMANDS] == ["import", "identify"] * 3


@pytest.mark.slow
def test_the_ur10_in_sample(workplace: Path) -> None:
    """At most 5.15 % over all joints and every row."""
    assert fitted_by(COMMANDS[:2], workplace / "ur10").all_rows_relative_error <= 0.0515


@pytest.mark.slow
def test_the_tx40_in_sample_with_its_coupling_and_without(workplace: Path) -> None:
    """At most 10.9 % with, 14.3 % without, of the torque through 40 Hz, every row."""
    coupled = fitted_by(COMMANDS[2:4], workplace / "coupled").smoothed_overall_relative_error
    alone = fitted_by(COMMANDS[4:6], workplace / "alone").smoothed_overall_relative_error
    assert coupled is not None and alone is not None
    assert coupled <= 0.109
    assert coupled < alone <= 0.143
