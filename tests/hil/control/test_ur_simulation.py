"""`hil simulate --link rtde:...`: a Universal Robots controller for programs that read it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from socket import create_server
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.transports.base import TransportError
from drivers.transports.simulated import SimulatedTransport
from drivers.ur.identity import ask_identity
from drivers.ur.reader import RtdeReader
from drivers.ur.torque_constants import stated_constants
from drivers.ur.transport import RtdeSpec
from hil.base.errors import ControllerError, InputError
from hil.cell import Cell
from hil.cli import app
from hil.control.motion_watch import Stop
from hil.control.simulated_cell import with_simulation
from hil.control.ur_simulation import UrPeer, arm_truth, served_arm, simulated_ur
from hil.control.virtual_link import VirtualLink
from sim_fixtures.ur import CELL_PATH, UR5E_URDF, UrArmTruth, UrFault
from tests.tiers import quick_ones

HOST = "127.0.0.1"


def at_free_ports(**values: Any) -> Cell:
    """The cell of the simulated arm at ports that are free."""
    listeners = [create_server((HOST, 0)) for _ in range(3)]
    ports = [listener.getsockname()[1] for listener in listeners]
    for listener in listeners:
        listener.close()
    table = dict(zip(("port", "primary_port", "dashboard_port"), ports, strict=True))
    return Cell.load(CELL_PATH).with_link(rtde=table).with_values(values)


def test_the_arm_is_that_of_the_cell_file() -> None:
    cell = at_free_ports(**{"cell.serial_number": "7", "controller.rtde.model": "UR10e"})
    with served_arm(cell, own_speed=0.3, seed=4).running() as server:
        table = cell.controller.rtde
        identity = ask_identity(HOST, primary=table.primary_port, dashboard=table.dashboard_port)
        with RtdeReader.connect(RtdeSpec(HOST, table.port)) as reader:
            reader.start()
            values = reader.fetch(10.0, 100).values
        assert server.most_clients == 1
    assert (identity.serial_number, identity.named(5)) == ("7", "UR10e")
    constants = stated_constants(
        values["target_moment"], values["target_current"], values["target_qd"]
    )
    loaded = np.isfinite(constants)
    assert loaded.sum() >= 3
    np.testing.assert_allclose(constants[loaded], UrArmTruth().stated_constant[loaded], rtol=1e-6)


@pytest.mark.parametrize("own_speed", quick_ones([0.3], [0.05, 0.3, 1.0]))
def test_its_program_keeps_to_the_limits(own_speed: float) -> None:
    cell = at_free_ports(**{"limits.upper_deg": [20.0, -70.0, 130.0, -60.0, 0.0, 90.0]})
    server = served_arm(cell, own_speed=own_speed)
    robot = server.controller
    limits = cell.joint_limits
    targets = []
    for _ in range(7000):
        robot.step()
        outputs = robot.outputs()
        targets.append((outputs["target_q"], outputs["target_qd"]))
    server.close()
    q, qd = np.array(targets).transpose(1, 0, 2)
    assert np.all(q <= limits.upper) and np.all(q >= limits.lower)
    assert np.all(np.ptp(q, axis=0) > 0.01)
    # While it fades in, the slope of the fade is added to that of the sines.
    assert np.all(np.abs(qd[2000:5000]) <= own_speed * limits.velocity)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("--fault", "explode@5"), "KIND@CYCLE"),
        (("--mode", "4"), "--mode: does not apply"),
        (("--repeat",), "--repeat: does not apply"),
    ],
)
def test_what_does_not_apply_is_refused(options: tuple[str, ...], problem: str) -> None:
    command = ["simulate", str(CELL_PATH), "--link", "rtde:127.0.0.1", *options]
    result = CliRunner().invoke(app, command)
    assert isinstance(result.exception, InputError) and problem in str(result.exception)


def test_a_cell_of_another_number_of_joints_is_refused(two_joints: Cell) -> None:
    with pytest.raises(InputError, match="has 2 joints"):
        served_arm(with_simulation(two_joints))


@pytest.fixture
def two_joints() -> Cell:
    path = Path(__file__).parents[3] / "examples" / "two_joints" / "cell.toml"
    return Cell.load(path).with_link(transport="rtde", cycle_ms=2)


def test_it_serves_until_ctrl_c(tmp_path: Path) -> None:
    cell = at_free_ports()
    path = tmp_path / "cell.toml"
    path.write_text(cell.text)
    (tmp_path / "ur5e.urdf").write_text(UR5E_URDF)
    link = f"rtde:{HOST}:{cell.controller.rtde.port}"
    command = [sys.executable, "-m", "hil", "simulate", str(path), "--link", link, "--own-motion"]
    command += ["--json", "--fault", "gap@50x5"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        with connected(RtdeSpec(HOST, cell.controller.rtde.port)) as reader:
            reader.start()
            assert len(reader.fetch(20.0, 50).values) >= 50
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=60.0)
    finally:
        process.kill()
    figures = json.loads(said)
    assert process.returncode == 0
    assert figures["clients"] == 1 and figures["skipped"] == 0 and figures["cycles"] >= 50


def connected(spec: RtdeSpec) -> RtdeReader:
    """A reader of a controller that may still be starting."""
    deadline = time.monotonic() + 60.0
    while True:
        try:
            return RtdeReader.connect(spec)
        except TransportError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def test_an_arm_without_power_is_switched_on_at_its_pendant() -> None:
    cell = Cell.load(CELL_PATH).with_values({"controller.transport": "simulated"})
    peer = UrPeer(simulated_ur(cell, faults=[UrFault("power-off", 0)]))
    link = VirtualLink.over(SimulatedTransport(peer), cell, finish=peer.finish)
    said: list[str] = []
    link.connection.report = said.append
    with pytest.raises(ControllerError, match="not ready within 10 s") as refused:
        link.connect(Stop(), timeout=10.0)
    (waiting,) = said
    for text in (str(refused.value), waiting):
        assert "release its brakes at the pendant (hil does not)" in text
        assert "drive" not in text.lower().replace("drive_off", "")
    assert not peer.controller.playing and peer.controller.robot_mode_name == "POWER_OFF"


def test_the_payload_of_a_cell_is_carried_once() -> None:
    payload = {"frame": "flange", "mass": 3.0, "centre": [0.0, 0.0, 0.05]}
    cell = Cell.load(CELL_PATH)
    arms = [
        simulated_ur(each, truth=arm_truth(each, exact=True)).arm
        for each in (cell, cell.with_values({"robot.payload": payload}))
    ]
    masses = [sum(body.mass for body in arm.plant.model.inertias) for arm in arms]
    assert masses[1] - masses[0] == pytest.approx(3.0)
    model = [sum(body.mass for body in arm._model.inertias) for arm in arms]
    assert model[1] - model[0] == pytest.approx(3.0)
