"""Cells whose motions another controller runs, and the files that a design leaves for it."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from ruamel.yaml import YAML
from typer.testing import CliRunner

from hil.campaign.trajectory_files import PLAYER, RATE, SCRIPT_RATE, trajectory_files
from hil.cell import Cell
from hil.cell.text import with_values
from hil.cli import app
from hil.motion_checks import current_model
from identification.model.motion import Motion
from planner import JointLimits, Move, plan_moves
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.new_cells import TWO_JOINTS
from tests.motion_table import MotionTable

Array = NDArray[np.float64]


def new_cell(folder: Path, urdf: str, *options: str) -> tuple[Path, dict[str, Any]]:
    """Cell and summary of `hil new --design-only`."""
    (folder / "arm.urdf").write_text(urdf)
    cell = folder / "cell.toml"
    words = ["new", "--design-only", "--urdf", str(folder / "arm.urdf"), "-o", str(cell), "--json"]
    result = CliRunner().invoke(app, [*words, *options], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return cell, json.loads(result.stdout)


WITH_SPEED = TWO_JOINTS.replace('velocity="0"', 'velocity="3"')


class TestDesignOnlyCell:
    """Nothing is asked that a design does not need."""

    def test_a_urdf_with_speeds_leaves_no_question(self, tmp_path: Path) -> None:
        path, summary = new_cell(tmp_path, WITH_SPEED)
        assert summary["unknown"] == []
        cell = Cell.load(path)
        assert cell.file.drive_train is None
        assert cell.file.controller is None
        assert {"workspace.floor", "limits.jerk_deg", "nominal.coulomb"} <= {
            *cell.file.cell.assumed
        }
        assert np.degrees(cell.joint_limits.upper)[1] == pytest.approx(180.0)

    def test_a_missing_speed_is_asked_for(self, tmp_path: Path) -> None:
        _, summary = new_cell(tmp_path, TWO_JOINTS)
        names = ("velocity_deg", "acceleration_deg", "jerk_deg")
        assert summary["unknown"] == [f"limits.{name}" for name in names]

    def test_joint_torques_are_limited_without_a_drive_train(self, tmp_path: Path) -> None:
        cell = Cell.load(new_cell(tmp_path, WITH_SPEED)[0])
        still = np.zeros((1, 2))
        fast = Motion(np.zeros(1), still, still, np.full((1, 2), 1e4))
        found = current_model(cell).check(fast)
        assert {(one.kind, one.bound) for one in found} == {("torque", 150.0), ("torque", 60.0)}

    def test_a_controller_beside_it_is_refused(self, tmp_path: Path) -> None:
        words = ["new", "--design-only", "--from-controller", "h", "--urdf", "a.urdf"]
        result = CliRunner().invoke(app, words)
        assert "--design-only and --from-controller: exclude each other" in str(result.exception)


@pytest.fixture(scope="module")
def files() -> dict[str, str]:
    """Of a motion there and back of six joints."""
    limits = Cell.load(CELL_PATH).joint_limits
    return trajectory_files(Cell.load(CELL_PATH), a_plan(limits))  # type: ignore[arg-type]


def a_plan(limits: JointLimits) -> SimpleNamespace:
    start = 0.5 * (limits.lower + limits.upper)
    motion = plan_moves(start, [Move(start + 0.2), Move(start)], limits).trajectory
    there = SimpleNamespace(trajectory=motion)
    return SimpleNamespace(excitation=there, validation=(there,))


def motion_of(files: dict[str, str]) -> Any:
    return MotionTable.of(files["excitation.csv"])


class TestFiles:
    """Each file is the motion, as the programs that read it understand it."""

    def test_every_motion_has_every_format(self, files: dict[str, str]) -> None:
        formats = ("csv", "yaml", "script")
        names = ("excitation", "validation_000")
        assert {*files} == {PLAYER, *(f"{name}.{one}" for name in names for one in formats)}

    def test_yaml_is_a_joint_trajectory(self, files: dict[str, str]) -> None:
        read = YAML(typ="safe").load(files["excitation.yaml"])
        assert read["joint_names"] == [f"joint_{k}" for k in range(1, 7)]
        time = np.array(
            [
                p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"]
                for p in read["points"]
            ]
        )
        motion = motion_of(files)
        assert time[0] == 0.0
        assert np.all(np.diff(time) > 0.0)
        assert time[-1] == pytest.approx(motion.duration, abs=1e-8)
        keys = ("positions", "velocities", "accelerations")
        for key, expected in zip(keys[:2], motion.sample(time), strict=False):
            found = np.array([point[key] for point in read["points"]])
            np.testing.assert_allclose(found, expected, atol=1e-4)
        assert all(len(point[key]) == 6 for point in read["points"] for key in keys)

    def test_urscript_makes_the_motion_as_often_as_asked(self, files: dict[str, str]) -> None:
        text = files["excitation.script"]
        repetitions = Cell.load(CELL_PATH).campaign.repetitions
        assert f"while repetition < {repetitions}:" in text
        found = np.array([json.loads(one) for one in re.findall(r"servoj\((\[.*?\])", text)])
        time = np.minimum(np.arange(len(found)) / SCRIPT_RATE, motion_of(files).duration)
        np.testing.assert_allclose(found, motion_of(files).sample(time)[0], atol=1e-4)
        opened = len(re.findall(r"^\s*(?:def|while)\b", text, re.MULTILINE))
        assert opened == len(re.findall(r"^\s*end$", text, re.MULTILINE))

    def test_the_player_sends_every_row_and_logs(
        self, files: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        arm = Arm()
        control = SimpleNamespace(RTDEControlInterface=lambda *_: arm)
        monkeypatch.setitem(sys.modules, "rtde_control", control)
        receive = SimpleNamespace(RTDEReceiveInterface=lambda *_: arm)
        monkeypatch.setitem(sys.modules, "rtde_receive", receive)
        (tmp_path / "motion.csv").write_text(files["excitation.csv"])
        monkeypatch.setattr(
            sys, "argv", ["play_ur.py", "host", str(tmp_path / "motion.csv"), "log"]
        )
        exec(compile(files[PLAYER], PLAYER, "exec"), {})
        calls = [name for name, _ in arm.calls]
        positions = motion_of(files).sample(np.arange(calls.count("servoJ")) / RATE)[0]
        sent = [given[0] for name, given in arm.calls if name == "servoJ"]
        np.testing.assert_allclose(sent, positions)
        assert calls[:2] == ["moveJ", "startFileRecording"]
        assert calls[-2:] == ["servoStop", "stopFileRecording"]
        assert len(files[PLAYER].splitlines()) <= 20

    def test_arms_of_other_kinds_get_no_urscript(self) -> None:
        limits = JointLimits(*np.array([[-1.0], [1.0], [1.0], [5.0], [50.0]]))
        cell = SimpleNamespace(joint_names=("one",))
        made = trajectory_files(cell, a_plan(limits))  # type: ignore[arg-type]
        assert {*made} == {f"{a}.{b}" for a in ("excitation", "validation_000")
                           for b in ("csv", "yaml")}  # fmt: skip


class Arm:
    """Remembers what a program asks of it."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, tuple[Any, ...]]] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *given: self.calls.append((name, given))


class TestCommand:
    """`hil design` of a cell without a controller."""

    def test_a_short_search_leaves_the_files(self, tmp_path: Path) -> None:
        path, _ = new_cell(tmp_path, WITH_SPEED)
        path.write_text(with_values(path.read_text(), {"campaign.candidates": 8}))
        words = [str(path), "--quick", "--repetitions", "3", "-o", str(tmp_path / "out"), "--json"]
        result = CliRunner().invoke(app, ["design", *words], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        summary = json.loads(result.stdout)
        assert summary["campaign"] is None
        assert summary["no_campaign"] is None
        for name in summary["trajectories"]:
            assert (tmp_path / "out" / name).exists()
        assert {"excitation.csv", "validation_001.yaml"} <= {*summary["trajectories"]}

    def test_quick_and_a_method_are_refused_together(self) -> None:
        words = ["design", str(CELL_PATH), "--quick", "--method", "b"]
        assert "--method and --quick: exclude each other" in str(
            CliRunner().invoke(app, words).exception
        )
