"""Cells whose motions another controller runs, and the files that a design leaves for it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from hil.campaign.trajectory_files import SCRIPT_RATE, SLOW_SPEED_SHARE, trajectory_files
from hil.cell import Cell
from hil.cell.toml_edits import with_values
from hil.cli import app
from hil.control.motion_checks import current_model
from identification.model.motion import Motion
from planner import JointLimits, Move, plan_moves
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.new_cells import TWO_JOINTS
from tests.motion_table import MotionTable

pytestmark = pytest.mark.long

WITH_SPEED = TWO_JOINTS.replace('velocity="0"', 'velocity="3"')


def new_cell(folder: Path, urdf: str) -> tuple[Path, dict[str, Any]]:
    """Cell and summary of `hil new --design-only`."""
    (folder / "arm.urdf").write_text(urdf)
    cell = folder / "cell.toml"
    arguments = [
        "new",
        "--design-only",
        "--urdf",
        str(folder / "arm.urdf"),
        "-o",
        str(cell),
        "--json",
    ]
    arguments += ["--force"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return cell, json.loads(result.stdout)


@pytest.mark.parametrize(
    "wanted", [["--quick", "--precision", "parameters 5 % absolute"], ["--for", "payload"]]
)
def test_a_cell_for_designs_has_motions_for_a_precision(tmp_path: Path, wanted: list[str]) -> None:
    cell, _ = new_cell(tmp_path, WITH_SPEED)
    arguments = ["design", str(cell), *wanted, "-o", str(tmp_path / "out"), "--workers", "1"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "assuming the scale of the recorded torques to 3 %" in result.output.replace("\n", " ")


def test_a_cell_for_designs_asks_only_for_missing_speeds(tmp_path: Path) -> None:
    _, summary = new_cell(tmp_path, TWO_JOINTS)
    names = ("velocity_deg", "acceleration_deg", "jerk_deg")
    assert summary["unknown"] == [f"limits.{name}" for name in names]
    path, summary = new_cell(tmp_path, WITH_SPEED)
    assert summary["unknown"] == []
    cell = Cell.load(path)
    assert cell.file.drive_train is cell.file.controller is None
    assert {"workspace.floor", "limits.jerk_deg", "nominal.coulomb"} <= {*cell.file.cell.assumed}
    assert np.degrees(cell.joint_limits.upper)[1] == pytest.approx(180.0)
    still = np.zeros((1, 2))
    violations = current_model(cell).check(Motion(np.zeros(1), still, still, np.full((1, 2), 1e4)))
    assert {(violation.kind, violation.bound) for violation in violations} == {
        ("torque", 150.0),
        ("torque", 60.0),
    }


@pytest.mark.parametrize(
    ("command_line", "problem"),
    [
        ("new --design-only --from-controller h --urdf a.urdf", "--design-only and --from-cont"),
        (f"design {CELL_PATH} --quick --method b", "--method and --quick"),
    ],
)
def test_contradicting_options_are_refused(command_line: str, problem: str) -> None:
    result = CliRunner().invoke(app, command_line.split())
    assert problem in str(result.exception) and "exclude each other" in str(result.exception)


def files_of(cell: Any, limits: JointLimits) -> dict[str, str]:
    """Files of a motion there and back."""
    start = 0.5 * (limits.lower + limits.upper)
    motion = plan_moves(start, [Move(start + 0.2), Move(start)], limits).trajectory
    there = SimpleNamespace(trajectory=motion)
    plan: Any = SimpleNamespace(excitation=there, validation=(there,))
    return trajectory_files(cell, plan)


def test_each_file_is_the_motion_for_the_programs_that_read_it() -> None:
    cell = Cell.load(CELL_PATH)
    files = files_of(cell, cell.joint_limits)
    names = [f"{a}.{b}" for a in ("excitation", "validation_000") for b in ("csv", "yaml")]
    names += [name.replace(".", "_slow.") for name in names]
    scripts = ["excitation.script", "validation_000.script"]
    assert {*files} == {*names, *scripts, "README.txt"}
    motion = MotionTable.of(files["excitation.csv"])

    read = YAML(typ="safe").load(files["excitation.yaml"])
    assert read["joint_names"] == [*cell.joint_names]
    stamps = [p["time_from_start"] for p in read["points"]]
    time = np.array([stamp["sec"] + 1e-9 * stamp["nanosec"] for stamp in stamps])
    assert time[0] == 0.0 and np.all(np.diff(time) > 0.0)
    assert time[-1] == pytest.approx(motion.duration, abs=1e-8)
    for key, expected in zip(("positions", "velocities"), motion.sample(time), strict=False):
        rows_read = np.array([point[key] for point in read["points"]])
        np.testing.assert_allclose(rows_read, expected, atol=1e-4)
    assert all(len(point["accelerations"]) == 6 for point in read["points"])

    text = files["excitation.script"]
    assert f"  repetitions = {cell.campaign.repetitions}\n" in text
    sent = np.array([json.loads(row) for row in re.findall(r"^    move_on\((.*)\)", text, re.M)])
    time = np.minimum(np.arange(len(sent)) / SCRIPT_RATE, motion.duration)
    np.testing.assert_allclose(sent, motion.sample(time)[0], atol=1e-4)
    opened = len(re.findall(r"^\s*(?:def|while|if)\b", text, re.MULTILINE))
    assert opened == len(re.findall(r"^\s*end$", text, re.MULTILINE))

    limits = JointLimits(*np.array([[-1.0], [1.0], [1.0], [5.0], [50.0]]))
    small = SimpleNamespace(joint_names=("one",), name="small")
    assert {*files_of(small, limits)} == {*names, "README.txt"}, "no URScript"


def test_each_file_is_slow_at_first_and_says_what_it_is() -> None:
    cell = Cell.load(CELL_PATH)
    files = files_of(cell, cell.joint_limits)
    fast, slow = (MotionTable.of(files[f"excitation{end}.csv"]) for end in ("", "_slow"))
    assert slow.duration == pytest.approx(fast.duration / SLOW_SPEED_SHARE)
    time = np.linspace(0.0, fast.duration, 50)
    for k, (quick, stretched) in enumerate(
        zip(fast.sample(time), slow.sample(time / SLOW_SPEED_SHARE), strict=True)
    ):
        np.testing.assert_allclose(stretched, SLOW_SPEED_SHARE**k * quick, atol=2e-3)

    for name in ("excitation.script", "excitation.yaml", "excitation_slow.yaml", "README.txt"):
        text = files[name]
        assert cell.name in text and "made by: hil" in text and "duration: " in text
        assert "emergency stop" in text


def test_the_program_asks_first_and_its_speed_scales_time() -> None:
    """The few statements of the program, run as Python."""
    cell = Cell.load(CELL_PATH)
    text = files_of(cell, cell.joint_limits)["excitation.script"]
    assert text.index("popup(") < text.index("movej(")
    assert "blocking=True" in text
    assert f"  global speed = {SLOW_SPEED_SHARE:g}\n" in text

    def commands(speed: float) -> list[tuple[str, Any]]:
        """Names and targets of the commands that the program gives at a speed."""
        lines = [line for line in text.splitlines() if line.strip() != "end"]
        program = re.sub(r"speed = .*", f"speed = {speed}", "\n".join(lines), count=1)
        program = program.replace("while repetition < repetitions", "while repetition < 1")
        program = program.replace("  halt", "  return")
        for name in {*re.findall(r"global (\w+)", program)}:
            program = re.sub(rf"\b(?:global )?{name}\b(?!\w*=[^=])", f"state['{name}']", program)
        given: list[tuple[str, Any]] = []
        names: dict[str, Any] = {"state": {}}
        for name in ("popup", "movej", "servoj", "stopj", "sleep"):
            names[name] = lambda *values, name=name, **_: given.append((name, values[0]))
        exec(program + "\nexcitation()", names)
        return given

    full = commands(1.0)
    slow = commands(0.2)
    assert [name for name, _ in full[:2]] == ["popup", "movej"]
    paths = [np.array([target for name, target in run if name == "servoj"]) for run in (full, slow)]
    assert len(paths[1]) == 5 * len(paths[0])
    np.testing.assert_allclose(paths[1][4::5], paths[0], atol=1e-12)
    largest = [np.abs(np.diff(path, axis=0)).max() for path in paths]
    assert largest[1] == pytest.approx(largest[0] / 5)

    path = np.array([target for name, target in commands(0.8) if name == "servoj"])
    assert len(path) == pytest.approx(len(paths[0]) / 0.8, abs=1.0)
    goals = np.vstack([paths[0][:1], paths[0]])
    places = 0.8 * np.arange(1.0, 1.0 + len(path))
    expected = [np.interp(places, np.arange(len(goals)), column) for column in goals.T]
    np.testing.assert_allclose(path, np.transpose(expected), atol=1e-9)
    for speed in (0.0, -0.2, 1.5):
        assert [name for name, _ in commands(speed)] == ["popup"]


def test_a_short_search_leaves_the_files(tmp_path: Path) -> None:
    path, _ = new_cell(tmp_path, WITH_SPEED)
    path.write_text(with_values(path.read_text(), {"campaign.candidates": 8}))
    arguments = [str(path), "--quick", "--repetitions", "3", "-o", str(tmp_path / "out"), "--json"]
    result = CliRunner().invoke(app, ["design", *arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert summary["campaign"] is summary["no_campaign"] is None
    assert all((tmp_path / "out" / name).exists() for name in summary["trajectories"])
    assert {"excitation.csv", "validation_001.yaml"} <= {*summary["trajectories"]}
