"""Faults of drives in logs without gear ratios: play of a joint, torque ripple of another one."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import hil
from tests.hil.simulated_logs import simulate, write_log

TIME = np.arange(0.0, 30.0, 0.004)
PERIODS = 200.0  # per turn: twice per turn of the motor behind a gear of 100
RIPPLE = 0.05
PLAY = np.radians(0.2)
PAN, WRIST = 0, 3


@pytest.mark.long
@pytest.mark.parametrize("with_faults", [False, True])
def test_play_and_ripple_are_named_with_their_joints(tmp_path: Path, with_faults: bool) -> None:
    """And nothing else is: no delay, spike, encoder or geometry."""
    simulated = simulate("ur5_robot.urdf", TIME, seed=1, pace=1.5)
    position, torque = simulated.position.copy(), simulated.torque.copy()
    if with_faults:
        quiet = simulate("ur5_robot.urdf", TIME, seed=1, pace=1.5, noise=0.0)
        velocity, size = quiet.velocity, quiet.size
        friction = 0.15 * size * np.sign(velocity) + 0.1 * size * velocity
        load = quiet.clean - friction - 0.02 * size * np.gradient(velocity, TIME, axis=0)
        position[:, PAN] += 0.5 * PLAY * np.sign(load[:, PAN])
        amplitude = RIPPLE * np.sqrt(2.0) * torque[:, WRIST].std()
        torque[:, WRIST] += amplitude * np.sin(PERIODS * quiet.position[:, WRIST])
    log = write_log(tmp_path / "log.csv", ["t", "q{}", "tau{}"], TIME, position, torque)
    arm = hil.identify(log, urdf=simulated.urdf)
    found = {each.key: each for each in arm.verdict.findings}
    assert ("play" in found, "ripple over the angle" in found) == (with_faults, with_faults)
    if with_faults:
        assert re.search(r": shoulder_pan_joint \(0\.2\d? ± [\d.]+ °", found["play"].words)
        ripple = found["ripple over the angle"].words
        assert re.search(r": wrist_1_joint \((199\.\d|200(\.\d)?) times per turn", ripple)
    others = {each.key for each in arm.verdict.findings if each.role == "cause"}
    assert not others - {"play", "ripple over the angle"}
