"""Two wrist torques are exchanged; they are small compared with the shoulder torques."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.identified.identified_arm import arm_from
from tests.hil.simulated_logs import simulate, write_log
from tests.jointed_arms import jointed_arm

TIME = np.arange(0.0, 20.0, 0.01)
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
