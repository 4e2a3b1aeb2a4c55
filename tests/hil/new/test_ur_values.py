"""`hil new --controller ur`: a cell file by what an arm states of itself."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from hil.base.errors import InputError
from hil.base.progress import Silent
from hil.campaign.plan import design
from hil.cell import Cell
from hil.cell.errors import UnknownFieldsError
from hil.cell.schema import RtdeTable
from hil.cli import app, new
from hil.control.motion_checks import MotionChecks
from hil.control.motion_watch import Stop
from hil.control.ur_recording import ConstantsFound, listening, record_arm
from sim_fixtures.plant import build_model
from sim_fixtures.ur import (
    UR5E_URDF,
    SimulatedUr,
    UrArmTruth,
    UrProgram,
    UrServer,
    UrSettings,
)
from sim_fixtures.ur.controller import UrPayload


def made_by(
    server: UrServer, folder: Path, monkeypatch: pytest.MonkeyPatch, *options: str
) -> tuple[dict[str, Any], Path]:
    """What the command says of the arm at these ports, and the cell file."""
    ports = {f"{name}_port": server.ports.get(name, 1) for name in ("primary", "dashboard")}
    monkeypatch.setattr(new, "RtdeTable", partial(RtdeTable, **ports))
    path = folder / "cell.toml"
    host = f"127.0.0.1:{server.ports['rtde']}"
    command = ["new", "--controller", "ur", "--host", host, "-o", str(path), "--json", *options]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout), path


@pytest.fixture
def server() -> Iterator[UrServer]:
    """An arm at rest in a posture that loads its joints."""
    settings = UrSettings(payload=UrPayload(1.5, (0.0, 0.01, 0.04)))
    with UrServer(SimulatedUr(settings), real_time=False).running() as running:
        yield running


def test_without_a_urdf_the_arm_states_its_kinematics(
    server: UrServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said, path = made_by(server, tmp_path, monkeypatch)
    assert said["unknown"] == []
    cell = Cell.load(path)
    assert cell.file.cell.serial_number == "20235500123"
    table = cell.controller
    assert (table.transport, table.cycle_ms, table.rtde.model) == ("rtde", 2, "UR5e")
    assert table.rtde.calibration.startswith("1f2e3d4c")
    np.testing.assert_allclose(np.degrees(cell.joint_limits.upper), [360, 360, 180, 360, 360, 360])
    np.testing.assert_allclose(cell.joint_limits.acceleration, 40.0, rtol=1e-6)
    payload = cell.file.robot.payload
    assert payload is not None and payload.frame == "flange"
    assert (payload.mass, payload.centre) == (1.5, (0.0, 0.01, 0.04))


def test_its_kinematics_are_those_of_the_makers_urdf(
    server: UrServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, path = made_by(server, tmp_path, monkeypatch)
    places = []
    q = np.array([0.3, -1.1, 0.9, 0.4, -0.7, 0.2])
    for urdf in (path.with_suffix(".urdf").read_text(), UR5E_URDF):
        model = build_model(urdf, (0.0, 0.0, -9.81), np.zeros(6))
        data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        places.append(data.oMf[model.getFrameId("flange")].homogeneous)
    np.testing.assert_allclose(places[0], places[1], atol=1e-7)


def test_constants_are_those_that_the_arm_states(
    server: UrServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said, path = made_by(server, tmp_path, monkeypatch)
    cell = Cell.load(path)
    np.testing.assert_allclose(
        101.0 * cell.drive_train.torque_constant, UrArmTruth().stated_constant, rtol=1e-5
    )
    assert cell.drive_table.torque_uncertainty == 0.1
    assert "drive_train.torque_constant" in cell.file.cell.assumed
    assert any("weigh a known payload" in note for note in said["notes"])


def cell_with_masses(server: UrServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cell:
    urdf = tmp_path / "ur5e.urdf"
    urdf.write_text(UR5E_URDF)
    _, path = made_by(server, tmp_path, monkeypatch, "--urdf", str(urdf))
    return Cell.load(path)


def test_a_urdf_gives_masses_and_the_arm_the_rest(
    server: UrServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = cell_with_masses(server, tmp_path, monkeypatch)
    assert cell.file.cell.urdf == "ur5e.urdf" and cell.urdf == UR5E_URDF
    assert cell.file.cell.serial_number == "20235500123"


def test_a_moving_arm_states_no_constants(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.new.ur_values.REST_WAIT_SECONDS", 2.0)
    robot = SimulatedUr(program=UrProgram(rest=0.0, periods=100))
    with UrServer(robot, real_time=False).running() as server:
        for _ in range(100):
            robot.step()
        said, path = made_by(server, tmp_path, monkeypatch)
    assert said["unknown"] == ["drive_train.torque_constant", "drive_train.current_limit"]
    assert any("hold the arm still" in note for note in said["notes"])
    with pytest.raises(UnknownFieldsError) as refused:
        Cell.load(path)
    assert str(refused.value).count("hil new --controller ur") == 2
    assert "--from-controller" not in str(refused.value)


@pytest.mark.long
def test_a_pause_of_its_program_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = SimulatedUr(program=UrProgram(rest=1.5, periods=1))
    with UrServer(robot, real_time=False).running() as server:
        for _ in range(round(5.0 / robot.period)):
            robot.step()
        said, _ = made_by(server, tmp_path, monkeypatch)
    assert said["unknown"] == []


@pytest.mark.long
def test_a_motion_is_found_for_the_new_cell_as_it_is(
    server: UrServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a floor, with a margin of 2 cm: joints that turn twice need one turn."""
    cell = cell_with_masses(server, tmp_path, monkeypatch)
    assert (cell.workspace.floor, cell.workspace.margin) == (0.0, 0.02)
    assert cell.campaign.range_share == 0.5
    plan = design(cell, Silent())
    checks = MotionChecks.of(cell)
    for motion in (plan.excitation, *plan.validation):
        assert checks.refusal(motion.trajectory) is None


def test_without_services_a_urdf_is_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = SimulatedUr()
    with UrServer(robot, primary=None, dashboard=None, real_time=False).running() as server:
        monkeypatch.setattr(new, "RtdeTable", partial(RtdeTable, primary_port=1, dashboard_port=1))
        host = f"127.0.0.1:{server.ports['rtde']}"
        command = ["new", "--controller", "ur", "--host", host, "-o", str(tmp_path / "c.toml")]
        result = CliRunner().invoke(app, command)
    assert isinstance(result.exception, InputError)
    assert "give its URDF: --urdf" in str(result.exception)


@pytest.mark.parametrize("options", [(), ("--host", ""), ("--host", "arm:x")])
def test_an_address_is_needed(options: tuple[str, ...], tmp_path: Path) -> None:
    output = tmp_path / "cell.toml"
    result = CliRunner().invoke(app, ["new", "--controller", "ur", "-o", str(output), *options])
    assert isinstance(result.exception, InputError)
    assert "--host" in str(result.exception)


def test_a_cell_that_was_made_records_its_arm(
    server: UrServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, path = made_by(server, tmp_path, monkeypatch)
    ports = {f"{name}_port": server.ports[name] for name in ("primary", "dashboard")}
    cell = Cell.load(path).with_link(rtde=ports)
    archive = tmp_path / "standstill_000_a1.mcap"
    lines: list[str] = []
    with listening(cell, stop=Stop()) as arm:
        assert arm.notes == ("this version does not send actual_current_as_torque",)
        record_arm(
            arm, cell, archive, kind="standstill", stop=Stop(), duration=1.0, durable=False,
            report=lines.append,
        )  # fmt: skip
    assert lines == []  # the payload is that of the cell
    found = ConstantsFound.of(archive, cell)
    assert found.are_doubtful and not found.differ
    other = cell.with_values({"drive_train.torque_constant": [0.2] * 6})
    assert ConstantsFound.of(archive, other).differ
    weighed = cell.with_values({"drive_train.torque_uncertainty": 0.02})
    assert not ConstantsFound.of(archive, weighed).are_doubtful
