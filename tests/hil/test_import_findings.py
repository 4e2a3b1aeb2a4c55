"""Slips of a column map are said when the log is imported: units, sides, order, clock."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive import Samples, open_archive
from hil.cli import app
from hil.importers import Findings
from hil.importers.findings import examine
from tests.hil.simulated_logs import Simulated, simulate


@pytest.fixture(scope="module")
def arm() -> Simulated:
    return simulate("ur5_robot.urdf", np.arange(0.0, 20.0, 0.01))


def doubts(
    arm: Simulated, *, position=1.0, velocity=1.0, torque=1.0, clock=1.0, order=None
) -> list[str]:
    stamp = np.rint(arm.time * clock * 1e9).astype(np.int64)
    joints = range(6) if order is None else order
    samples = Samples(
        stamp,
        arm.position * position,
        velocity=arm.velocity[:, list(joints)] * velocity,
        torque=arm.torque * torque,
    )
    return list(examine(samples, arm.joint_names, arm.urdf.read_text()).doubts)


def test_a_log_without_a_slip_raises_no_doubt(arm: Simulated) -> None:
    assert doubts(arm) == []


@pytest.mark.parametrize(
    ("slip", "sentence"),
    [
        ({"position": 57.29578}, "degrees read as radians"),
        ({"position": 1 / 57.29578}, "no joint moves further than"),
        ({"velocity": 57.29578}, "57.3 times the slope of its position: degrees read as radians"),
        ({"velocity": 9.5493}, "revolutions per minute read as radians per second"),
        ({"velocity": -1.0}, "-1 times the slope of its position: a sign?"),
        ({"velocity": 0.0}, "does not follow its position"),
        ({"order": (1, 0, 2, 3, 4, 5)}, "does not follow its position.*in the same order"),
        ({"torque": 1000.0}, "its limit in the URDF is 150 N·m.*is its unit right"),
        ({"torque": 0.0}, "is zero throughout"),
        ({"clock": 1e3}, "0.1 samples a second is unusual"),
        ({"clock": 1e-3}, "1e\\+05 samples a second is unusual"),
    ],
)
def test_a_slip_is_named(arm: Simulated, slip: dict[str, float], sentence: str) -> None:
    found = doubts(arm, **slip)  # type: ignore[arg-type]
    assert any(re.search(sentence, doubt) for doubt in found), found


def test_the_command_says_what_it_read_and_the_archive_keeps_it(
    arm: Simulated, tmp_path: Path
) -> None:
    np.savez(tmp_path / "log.npz", q=np.degrees(arm.position), t=arm.time)
    (tmp_path / "map.toml").write_text(
        '[time]\ncolumn = "t"\n[position]\ncolumns = "q"\n'  # the unit is missing
    )
    arguments = ["import", "npz", str(tmp_path / "log.npz"), "-o", str(tmp_path / "log.mcap")]
    arguments += ["--map", str(tmp_path / "map.toml"), "--urdf", str(arm.urdf)]
    result = CliRunner().invoke(app, [*arguments, "--kind", "validation"])
    assert result.exit_code == 0
    assert "2000 samples in 19.99 s, 100 Hz" in result.stdout
    assert 'write unit = "deg"' in result.stdout
    metadata = open_archive(tmp_path / "log.mcap").metadata
    assert metadata["use"] == "validation"
    assert any("deg" in doubt for doubt in Findings.of(metadata).doubts)
    assert json.loads(metadata["source"]) == ["log.npz"]
