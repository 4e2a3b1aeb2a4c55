"""`hil run` of a UR5e over real ports: slowed, held, stopped, and completed by a second run."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.base.progress import Silent
from hil.campaign import Campaign, Stop
from hil.campaign.dry_run_record import DryRunRecord
from hil.campaign.operator import RunStatus
from hil.campaign.plan import design
from hil.cell import Cell
from hil.cli import app
from hil.control.errors import MotionFailedError
from hil.control.motion_watch import OperatorRequest
from hil.control.simulator_process import free_port
from sim_fixtures.ur import CELL_PATH, UR5E_URDF
from tests.hil.fast_cell import pass_rehearsal

pytestmark = pytest.mark.safety

SHORT = {
    "repetitions": 1, "validation_runs": 1, "n_via": 2, "candidates": 30, "standstill_s": 0.2,
    "settle_s": 0.3, "approach_speed": 0.5, "warmup_drift": 0,
}  # fmt: skip
PATIENCE = 0.5
"""Longest extension of a cycle of the simulated controller, s: this computer is busy."""


class Hand:
    """An operator who slows and holds the first repetition, and looks at `hil status` meanwhile.

    Attributes:
        seen: what `hil status` said while the arm was held.
        overrides: speeds at which the motion was shown to run.
    """

    can_answer = True

    def __init__(self, folder: Path, stop: Stop | None = None) -> None:
        self._folder = folder
        self._stop = stop
        self._shown = 0
        self.seen: dict[str, Any] = {}
        self.overrides: set[float] = set()
        self.held = 0

    def show(self, status: RunStatus) -> None:
        if status.phase != "repetition" or status.motion is None:
            return
        self._shown += 1
        self.overrides.add(status.motion.override)
        if self._stop is not None and self._shown == 10:
            self._stop.requested = True

    def request(self) -> OperatorRequest:
        if self._stop is not None or not 3 <= self._shown <= 30:
            return OperatorRequest()
        if self._shown <= 12:
            return OperatorRequest(0.5)
        if not self.seen:
            result = CliRunner().invoke(app, ["status", str(self._folder), "--json"])
            self.seen = json.loads(result.stdout)
        self.held += 1
        return OperatorRequest(1.0, held=self._shown <= 20)

    def accept_dry_run(self, record: DryRunRecord) -> bool:
        return record.accepted is not None


@pytest.fixture
def cell() -> Cell:
    ports = {name: free_port() for name in ("port", "primary_port", "dashboard_port")}
    values = {f"controller.rtde.{name}": port for name, port in ports.items()}
    values |= {f"campaign.{name}": value for name, value in SHORT.items()}
    return Cell.load(CELL_PATH).with_values(values)


def wait_until_it_listens(process: subprocess.Popen[str], port: int) -> None:
    latest = time.monotonic() + 60.0
    while process.poll() is None and time.monotonic() < latest:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
            return
        except ConnectionRefusedError:
            time.sleep(0.1)
    raise AssertionError("the simulated controller does not listen")


@pytest.fixture
def simulated(cell: Cell, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """`hil simulate` of that arm, until Ctrl-C."""
    path = tmp_path / "cell.toml"
    path.write_text(cell.text)
    (tmp_path / "ur5e.urdf").write_text(UR5E_URDF)
    command = [sys.executable, "-m", "hil", "simulate", str(path), "--json", "--link"]
    command += [f"rtde:127.0.0.1:{cell.controller.rtde.port}", "--patience", str(PATIENCE)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        wait_until_it_listens(process, cell.controller.rtde.port)
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60.0)


def run(campaign: Campaign, hand: Hand, stop: Stop) -> Any:
    return Campaign.open(campaign.folder.root).run(
        None, stop, Silent(), operator=hand, unrehearsed=True, durable=False
    )


def require_states(columns: Mapping[str, Any], cell: Cell) -> None:
    """Each record has the state of the arm in its cycle."""
    stamps = columns["controller_time"]
    period = cell.period
    np.testing.assert_allclose(np.diff(stamps), period * np.diff(columns["cycle"]), atol=1e-9)
    assert {*columns["robot_mode"]} == {7} and {*columns["safety_mode"]} == {1}
    assert {*columns["speed_scaling"]} == {*columns["speed_fraction"]} == {1.0}
    assert np.all(columns["joint_temperature"] > 20.0)
    # The controller's current is that of its own torque and friction, by its own constants.
    rests = (np.abs(columns["velocity"]) < 1e-2).all(axis=1)
    ratio = columns["target_moment"][rests, 1] / columns["model_current"][rests, 1]
    np.testing.assert_allclose(np.median(ratio), 9.84, rtol=0.02)


def test_a_campaign_over_the_ports_runs_to_its_end(
    cell: Cell, simulated: subprocess.Popen[str], tmp_path: Path
) -> None:
    folder = tmp_path / "campaign"
    campaign = Campaign.create(folder, cell, design(cell, Silent()))
    pass_rehearsal(campaign.folder)
    stop = Stop()
    with pytest.raises(MotionFailedError, match="was stopped: a stop was requested"):
        run(campaign, Hand(folder, stop), stop)
    hand = Hand(folder)
    second = run(campaign, hand, Stop())
    assert second.complete
    (rejected,) = second.rejected
    assert "held or slowed" in rejected.reason
    assert {step["name"] for step in hand.seen["steps"]} and hand.seen["next_command"]
    assert {0.5, 1.0} <= hand.overrides and hand.held

    kinds = ("standstill", "excitation", "validation")
    archives = [path for kind in kinds for path in campaign.folder.completed(kind)]
    assert len(archives) == 3
    for path in archives:
        archive = open_archive(path)
        assert archive.complete
        assert np.isfinite(archive.columns["position"]).all()
        assert "ur_arm.json" in archive.attachments
        require_states(archive.columns, cell)
    assert simulated.poll() is None
