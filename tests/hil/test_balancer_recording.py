"""The heavy arm with a balancer of `docs/bring-your-own-robot.md`, by the commands there."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.cli import app
from hil.cli.verdict import NOT_GOOD
from hil.results import Results

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data" / "kr300"
TEXT = (ROOT / "docs" / "bring-your-own-robot.md").read_text(encoding="utf-8")
SECTION = TEXT.split("## An arm with a balancer")[1].split("\n## ")[0]
FILES = {
    "one.csv": "A.csv",
    "other.csv": "B.csv",
    "map.toml": "map.toml",
    "robot.urdf": "robot.urdf",
}


@pytest.mark.slow
class TestBalancer:
    def test_a_known_one_predicts_another_motion(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """At most 14.0 % of the unseen motion's torque, over all joints and every row."""
        if not DATA.is_dir():
            pytest.skip(f"there is no recording {DATA}")
        for name, file in FILES.items():
            (tmp_path / name).symlink_to(DATA / file)
        (cell,) = re.findall(r"```toml\n(.*?)```", SECTION, re.DOTALL)
        (tmp_path / "heavy.toml").write_text(cell, encoding="utf-8")
        monkeypatch.chdir(tmp_path)
        for command in re.findall(r"^hil (.*)$", SECTION, re.MULTILINE):
            arguments, status = shlex.split(command), 0
            if arguments[0] == "identify":
                arguments, status = [*arguments, "--output", "found"], NOT_GOOD
            result = CliRunner().invoke(app, arguments)
            assert result.exit_code == status, (command, result.output, result.exception)
        (unseen,) = Results.load(tmp_path / "found" / "results.json").validation
        assert unseen.all_rows_relative_error <= 0.14
