"""`hil demo --link`: the same demonstration over real sockets, in real time."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hil.archive import open_archive
from hil.campaign import Campaign
from hil.demo_link import SimulatorProcess
from sim_fixtures.ns16 import CELL_PATH


def demo(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "hil", "demo", "--output", str(folder), *options],
        capture_output=True, text=True, timeout=300, env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("link", ["udp", "can"])
def test_the_demo_runs_over_a_real_link_and_its_model_is_good(tmp_path: Path, link: str) -> None:
    folder = tmp_path / "demo"
    done = demo(folder, "--link", link, "--repetitions", "2", "--validation", "1")
    for _ in range(3):
        # A pause of this machine is a missed answer, and a motion that is refused or lost: the
        # rest is run again.
        if done.returncode != 4:
            break
        done = demo(folder, "--resume")
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"over {link}, in real time" in done.stdout
    campaign = Campaign.open(folder)
    assert campaign.cell.controller.transport == link
    assert len(campaign.folder.completed("excitation")) == 2
    for path in campaign.folder.completed("excitation"):
        archive = open_archive(path)
        assert archive.outcome is not None
        assert archive.outcome.entries["records_lost"] == "0"


def test_a_simulated_controller_that_fails_says_why() -> None:
    simulator = SimulatorProcess.start(CELL_PATH, "--udp", "127.0.0.1:1", "--fault", "rain@10")
    try:
        assert simulator.process.wait(60) == 2
        assert "is not a fault" in (simulator.failure() or "")
        simulator.finish()  # nothing is left to be asked
    finally:
        simulator.end()
