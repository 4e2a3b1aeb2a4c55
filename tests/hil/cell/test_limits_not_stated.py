"""A range that a URDF does not state is none, for import, `hil new` and cells alike."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.cell import Cell
from hil.cli import app
from identification.model.joint_ranges import urdf_limits
from tests.hil.fast_cell import CELL
from tests.hil.fast_cell import URDF as FAST
from tests.hil.importers.moving_log import JOINTS, POSITION, URDF, imported, rows, text

RANGE = re.compile("lower='[^']*' upper='[^']*'")
NOT_STATED = {
    "both zero": "lower='0' upper='0'",
    "exchanged": "lower='3' upper='-3'",
    "absent": "",
}


@pytest.mark.parametrize("kind", NOT_STATED)
class TestRanges:
    def urdf(self, folder: Path, kind: str) -> Path:
        path = folder / "three.urdf"
        content, count = RANGE.subn(NOT_STATED[kind], URDF)
        assert count == len(JOINTS)
        path.write_text(content)
        return path

    def test_of_a_urdf_are_infinite(self, tmp_path: Path, kind: str) -> None:
        limits = urdf_limits(self.urdf(tmp_path, kind).read_text(), JOINTS)
        assert np.isneginf(limits.lower).all() and np.isposinf(limits.upper).all()

    def test_exclude_no_recorded_position(self, tmp_path: Path, kind: str) -> None:
        content = text(rows(position=POSITION + 7.0))
        archive = imported(tmp_path / "log.csv", content, self.urdf(tmp_path, kind))
        assert archive.columns["position"] == pytest.approx(POSITION + 7.0, abs=1e-6)
        assert open_archive(tmp_path / "log.mcap").header.joint_names == JOINTS

    def test_are_unknown_values_of_a_new_cell(self, tmp_path: Path, kind: str) -> None:
        output = tmp_path / "cell.toml"
        line = ["new", "--urdf", str(self.urdf(tmp_path, kind)), "-o", str(output)]
        assert CliRunner().invoke(app, line, catch_exceptions=False).exit_code == 0
        limits = tomllib.loads(output.read_text())["limits"]
        assert limits["lower_deg"] == limits["upper_deg"] == ["?"] * len(JOINTS)

    def test_leave_those_of_a_cell_as_they_are(self, tmp_path: Path, kind: str) -> None:
        """A cell's limits must lie within those of its URDF, if it has any."""
        content, count = re.subn('lower="[^"]*" upper="[^"]*"', NOT_STATED[kind], FAST)
        assert count > 0
        (tmp_path / "fast.urdf").write_text(content)
        (tmp_path / "cell.toml").write_text(CELL)
        cell = Cell.load(tmp_path / "cell.toml")
        assert np.isfinite(cell.joint_limits.lower).all()
