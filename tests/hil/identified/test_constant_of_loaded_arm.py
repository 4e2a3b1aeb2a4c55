"""A torque constant is wrong while the flange carries a load that nobody stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from hil.identified.identified_arm import arm_from
from hil.pipeline.identification import Identification
from tests.hil.simulated_logs import simulate, urdf_path, write_log

SMALL_LOAD = 2.0  # kg, which changes the constant by as much as noise does
TIME = np.arange(0.0, 30.0, 0.008)


@pytest.mark.long
@pytest.mark.parametrize(
    ("joint", "gain", "mass"), [(0, 0.8, 5.0), (4, 1.6, 5.0), (2, 1.25, 0.0), (1, 0.6, 2.0)]
)
def test_its_size_is_right_or_left_open(
    tmp_path: Path, joint: int, gain: float, mass: float
) -> None:
    """The load changes the torques that the constant is compared with."""
    urdf = urdf_path("ur5_robot.urdf")
    load = pin.Inertia(max(mass, 1e-6), np.array([0.03, 0.0, 0.1]), 1.2e-3 * mass * np.eye(3))
    simulated = simulate(urdf, TIME, seed=2, pace=1.5, load=load)
    torque = simulated.torque.copy()
    torque[:, joint] *= gain
    log = write_log(tmp_path / "log.csv", ["t", "q{}", "tau{}"], TIME, simulated.position, torque)
    arm = arm_from(log, urdf, None, (), None, None, None)
    assert isinstance(arm.identification, Identification)
    diagnosis = arm.identification.validation.evidence.diagnosis
    assert diagnosis is not None
    (constant,) = [each for each in diagnosis.explanations if each.change.is_constant]
    assert constant.change.joints == (joint,)
    if mass > SMALL_LOAD:
        assert constant.size is None
    else:
        assert constant.size is not None
        assert abs(1.0 + constant.size - gain) < constant.half_interval
