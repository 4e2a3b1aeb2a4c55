"""What a look says of a slightly wrong torque constant, of changes in a log, of a tilted arm."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from hil.cli.look import screen
from hil.importers.conclusions import Certainty
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions
from hil.look import look_at
from hil.look.messages import as_json, row_text
from hil.look.readings import FoundChange
from hil.look.result import Look, Row
from tests.hil.simulated_logs import Simulated, simulate, urdf_path, write_log

URDF = urdf_path("ur5_robot.urdf")
TIME = np.arange(0.0, 16.0, 0.008)
LOAD = 2.0  # kg

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def plain() -> Simulated:
    return simulate(URDF, TIME, seed=2, pace=1.5)


@pytest.fixture(scope="module")
def loaded() -> Simulated:
    load = pin.Inertia(LOAD, np.array([0.0, 0.05, 0.02]), 0.002 * np.eye(3))
    return simulate(URDF, TIME, seed=2, pace=1.5, load=load)


def look(folder: Path, simulated: Simulated) -> Look:
    columns = simulated.time, simulated.position, simulated.torque
    log = write_log(folder / "log.csv", ["t", "q{}", "tau{}"], *columns)
    robot = Robot.from_urdf(URDF)
    return look_at(log, lambda _: robot, ImportOptions())


def found_in(looked: Look) -> list[Row]:
    return [row for row in looked.rows if isinstance(row.reading, FoundChange)]


def test_an_arm_on_a_slope_is_found_with_its_gravity(tmp_path: Path) -> None:
    gravity = (0.0, -4.905, -8.496)  # 30 degrees
    looked = look(tmp_path, simulate(URDF, TIME, seed=2, pace=1.5, gravity=gravity))
    (row,) = [row for row in looked.rows if row.aspect == "mounting"]
    assert row_text(row).reading == "tilted by 30°"
    assert row.certainty is Certainty.CERTAIN
    assert looked.gravity == pytest.approx(gravity, abs=0.1)
    assert not any(row.is_changed for row in looked.rows if row.aspect != "mounting")


def test_nothing_is_said_of_a_log_without_a_fault(tmp_path: Path, plain: Simulated) -> None:
    assert not found_in(look(tmp_path, plain))


def test_a_constant_that_is_too_large_has_a_row(tmp_path: Path, plain: Simulated) -> None:
    factors = np.ones(6)
    factors[2] = 1.15
    looked = look(tmp_path, replace(plain, torque=plain.torque * factors))
    (row,) = found_in(looked)
    assert isinstance(row.reading, FoundChange)
    found = row.reading.explanation
    assert (row.aspect, row.certainty) == ("scale", Certainty.LIKELY)
    assert found.change.joints == (2,)
    assert found.size == pytest.approx(0.15, abs=2.0 * found.half_interval)
    assert any("elbow_joint 1." in line for line in screen(looked))


@pytest.mark.parametrize("share", [0.5, 0.85])
def test_a_load_in_a_part_has_a_row(
    tmp_path: Path, plain: Simulated, loaded: Simulated, share: float
) -> None:
    begin = round(share * len(TIME))
    torque = np.concatenate([plain.torque[:begin], loaded.torque[begin:]])
    looked = look(tmp_path, replace(plain, torque=torque))
    (row,) = found_in(looked)
    assert isinstance(row.reading, FoundChange)
    found = row.reading.explanation
    assert (row.aspect, row.certainty) == ("changed part", Certainty.LIKELY)
    assert found.change.meaning == "payload"
    assert found.change.part is not None
    assert found.change.part.start == pytest.approx(TIME[begin], abs=1.0)
    assert found.size == pytest.approx(LOAD, abs=2.0 * found.half_interval)
    row_of = [each for each in as_json(looked)["rows"] if each["aspect"] == "changed part"]
    assert "kg more from" in json.dumps(row_of)
