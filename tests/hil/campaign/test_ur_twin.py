"""A rehearsal of a UR5e is on the simulated controller of a UR5e."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.archive import open_archive
from hil.campaign.twin import Twin
from hil.cell import Cell
from hil.cli.demo import simulated_arm
from hil.control.motion_watch import Stop
from hil.control.move import plan_move, send
from sim_fixtures.ur import CELL_PATH


@pytest.mark.parametrize("table", ["rtde", "simulated"])
def test_a_rehearsal_knows_the_lag_of_servoj(table: str, tmp_path: Path) -> None:
    cell = Cell.load(CELL_PATH).with_values({"controller.transport": table})
    twin = Twin.of(cell, seed=3, repetitions=2)
    assert twin.cell.is_ur and twin.cell.controller.transport == "simulated"
    link = twin.link(10.0, effects=False)
    start = link.connect(Stop())
    target = start + np.radians([25.0, 0, 0, 0, 0, 0])
    planned = plan_move(twin.cell, start, target, speed=0.5)
    path = tmp_path / "a.mcap"
    ended = send(planned, twin.cell, link, path, stop=Stop(), durable=False)
    assert ended.outcome == "completed", ended
    names = ("commanded_position", "position")
    columns = open_archive(path, fields=names).recorded(*names)
    commanded, position = (columns[name][:, 0] for name in names)
    moving = np.flatnonzero(np.abs(np.diff(commanded)) > 1e-4)
    lags = range(30)
    errors = [np.abs(position[moving + lag] - commanded[moving]).max() for lag in lags]
    # 30 ms of servoj's filter and two cycles until a set-point is used
    assert lags[int(np.argmin(errors))] * cell.period == pytest.approx(0.033, abs=0.006)


def test_the_demo_has_an_arm_for_either_controller() -> None:
    assert simulated_arm("ur").is_ur and not simulated_arm("c4g").is_ur
    assert simulated_arm("ur").only_simulated
