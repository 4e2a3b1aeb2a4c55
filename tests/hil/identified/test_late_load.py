"""A load that is taken up within the motion on which a model is judged."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from hil.identified.identified_arm import arm_from
from tests.hil.simulated_logs import simulate, write_log
from tests.jointed_arms import jointed_arm

TIME = np.arange(0.0, 24.0, 0.008)
LOAD = pin.Inertia(3.0, np.array([0.05, 0.02, 0.03]), 0.003 * np.eye(3))


@pytest.mark.long
@pytest.mark.parametrize(("begin", "pace"), [(0.85, 0.5), (0.85, 1.5)])
def test_its_mass_is_right_or_not_said(tmp_path: Path, begin: float, pace: float) -> None:
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(jointed_arm("zyyx", "zzxx"))
    bare, loaded = (simulate(urdf, TIME, seed=1, pace=pace, load=load) for load in (None, LOAD))
    is_late = np.arange(len(TIME)) >= begin * len(TIME)
    torque = np.where(is_late[:, None], loaded.torque, bare.torque)
    log = write_log(tmp_path / "log.csv", ["t", "q{}", "tau{}"], TIME, bare.position, torque)
    verdict = arm_from(log, urdf, None, (), None, None, None).verdict
    assert not verdict.good
    words = " ".join(each.words for each in verdict.findings)
    for mass, half in re.findall(r"carried ([\d.]+) ± ([\d.]+) kg", words):
        assert abs(float(mass) - LOAD.mass) <= float(half), words
