"""The demo's own link and its excitation."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hil.archive import open_archive
from hil.campaign import Campaign, MotionRefusedError
from hil.cell import Cell
from hil.cli import demo as demo_module
from hil.demo_link import SimulatorProcess
from hil.design import preset
from hil.outcome import FILES
from identification.excitation import Criteria, Excitation
from planner import FourierSeries
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


# --- `hil demo --excitation`: what may not run removes nothing, and what a design lacks is said

UNKNOWN = Criteria(log10_det=0.0, coupling_index=0.0, fitness=0.0, n_samples=1)


@pytest.fixture
def wild(cell: Cell) -> Excitation:
    series = FourierSeries(cell.home, np.full((6, 1), 2.0), np.full((6, 1), 3.0), 5.0, 1.0)
    return Excitation(series, UNKNOWN, method="a", seed=7, tried=1, rejected={})


def test_an_earlier_campaign_is_not_removed_for_a_motion_that_may_not_run(
    tmp_path: Path, wild: Excitation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever an earlier one left: what identification writes for other tools is no stranger."""
    earlier = tmp_path / "manifest.json"
    for name in ("manifest.json", "results.json", "report.html", *FILES):
        (tmp_path / name).write_text("{}")
    monkeypatch.setattr(demo_module, "_designed", lambda *arguments: wild)
    with pytest.raises(MotionRefusedError, match=r"the excitation .*design another motion\."):
        demo_module.demo(output=tmp_path, excitation=tmp_path / "x.toml", force=True, quiet=True)
    assert earlier.read_text() == "{}"


@pytest.mark.parametrize(
    ("constraints", "complete", "words"),
    [
        ({}, True, ()),
        ({"collision": False}, True, ("the arm itself not looked at",)),
        ({"current": False}, False, ("motor currents not looked at", "stopped before its end")),
    ],
)
def test_what_a_design_was_searched_without_is_said(
    cell: Cell,
    wild: Excitation,
    monkeypatch: pytest.MonkeyPatch,
    constraints: dict[str, bool],
    complete: bool,
    words: tuple[str, ...],
) -> None:
    result = SimpleNamespace(
        require_cell=lambda cell, path: None,
        settings=preset("a").replaced(constraints=constraints),
        complete=complete,
        excitation=replace(wild),
    )
    if not constraints:  # whatever the preset leaves out
        everything = {"collision": True, "current": True}
        result.settings = preset("a").replaced(constraints=everything)
    monkeypatch.setattr(
        demo_module, "DesignResult", SimpleNamespace(load=lambda path: result), raising=True
    )
    said: list[str] = []
    reporter = SimpleNamespace(say=said.append)
    demo_module._designed(Path("x"), cell, reporter)
    assert len(said) == bool(words)
    for word in words:
        assert word in said[0]
