"""Two wrist torques are exchanged; they are small compared with the shoulder torques."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from hil.identified.identified_arm import arm_from
from hil.importers.conclusions import Certainty
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions
from hil.look import look_at
from tests.hil.simulated_logs import simulate, urdf_path, write_log
from tests.jointed_arms import jointed_arm

TIME = np.arange(0.0, 20.0, 0.01)
LOADED_TIME = np.arange(0.0, 30.0, 0.008)
EXCHANGED = [0, 1, 2, 3, 5, 4, 6]


@pytest.mark.long
def test_an_identification_corrects_what_a_look_is_certain_of(tmp_path: Path) -> None:
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(jointed_arm("zyzyzyx"))
    simulated = simulate(urdf, TIME, seed=2, pace=1.5)
    torque = simulated.torque[:, EXCHANGED]
    log = write_log(tmp_path / "log.csv", ["t", "q{}", "tau{}"], TIME, simulated.position, torque)
    arm = arm_from(log, urdf, None, (), None, None, None)
    order = "torque columns belong to a1, a2, a3, a4, a6, a5, a7"
    (read,) = arm.results.recordings
    assert any(order in change for change in read.changes), read.changes


@pytest.mark.long
def test_a_heavy_load_is_no_exchanged_wrist(tmp_path: Path) -> None:
    """Of 5 kg, on a wrist of 0.2 kg: exchanged joints explain a third of what it changes."""
    urdf = urdf_path("ur5_robot.urdf")
    load = pin.Inertia(5.0, np.array([0.03, 0.0, 0.1]), 0.006 * np.eye(3))
    simulated = simulate(urdf, LOADED_TIME, seed=2, pace=1.5, load=load)
    columns = LOADED_TIME, simulated.position, simulated.torque
    log = write_log(tmp_path / "log.csv", ["t", "q{}", "tau{}"], *columns)
    looked = look_at(log, lambda _: Robot.from_urdf(urdf), ImportOptions())
    (order,) = [row for row in looked.rows if row.aspect == "order"]
    assert not order.is_changed or order.certainty is not Certainty.CERTAIN
    arm = arm_from(log, urdf, None, (), None, None, None)
    assert not arm.results.recordings[0].changes
