"""Logs without fault and without noise: no finding complains of them.

Torques are those of the URDF by pinocchio, written with all digits.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

import hil
from hil.cli import app
from hil.identified.identified_arm import IdentifiedArm
from tests.hil.importers.moving_log import URDF
from tests.hil.simulated_logs import urdf_path
from tests.tiers import quick_ones

COMPLAINTS = {"resolution", "outliers", "generalisation", "joint order"}


def write_clean_log(path: Path, urdf: Path, *, repeated: bool, smooth: float = 0.0) -> Path:
    """Write the torques of the URDF's own rigid model; every second stamp may repeat another.

    With a speed `smooth` [rad/s] there is friction, which reverses as in simulators.
    """
    model = pin.buildModelFromUrdf(str(urdf))
    data = model.createData()
    random = np.random.default_rng(0)
    time = np.arange(2500) / 250.0
    rate = random.uniform(1.0, 4.0, (3, model.nv))
    angle = rate * time[:, None, None] + random.uniform(0.0, 6.0, rate.shape)
    position = 0.25 * np.sin(angle).sum(axis=1)
    velocity = 0.25 * (rate * np.cos(angle)).sum(axis=1)
    acceleration = -0.25 * (rate**2 * np.sin(angle)).sum(axis=1)
    states = zip(position, velocity, acceleration, strict=True)
    torque = np.array([pin.rnea(model, data, *state) for state in states])
    if smooth:
        size = np.sqrt(np.mean(torque**2, axis=0))
        torque += size * (0.2 * np.tanh(velocity / smooth) + 0.05 * velocity)
    stamps = np.repeat(time[::2], 2) if repeated else time
    np.savez(path, time=stamps, position=position, velocity=velocity, torque=torque)
    return path


LIFT = (
    "<link name='ground'/><joint name='lift' type='prismatic'><parent link='ground'/>"
    "<child link='base'/><axis xyz='0 0 1'/>"
    "<limit lower='-1' upper='1' effort='900' velocity='2'/></joint><link name='base'><inertial>"
    "<mass value='5'/><inertia ixx='0.1' iyy='0.1' izz='0.1' ixy='0' ixz='0' iyz='0'/></inertial>"
    "</link>"
)
"""A prismatic joint along gravity below the three joints."""


ARMS = ["three joints", "on a lift", "UR5", "UR5, stamps repeated", "smooth 0.05", "smooth 0.2"]


@pytest.fixture(
    scope="module",
    params=quick_ones(("three joints", "smooth 0.05"), ARMS),
)
def arm(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> IdentifiedArm:
    folder = tmp_path_factory.mktemp("clean")
    urdf = urdf_path("ur5_robot.urdf")
    if not request.param.startswith("UR5"):
        urdf = folder / "three.urdf"
        lifted = URDF.replace("<link name='base'/>", LIFT)
        urdf.write_text(lifted if request.param == "on a lift" else URDF)
    kind, _, speed = request.param.partition("smooth ")
    smooth = float(speed or 0.0)
    log = write_clean_log(folder / "log.npz", urdf, repeated="repeated" in kind, smooth=smooth)
    return hil.identify(log, urdf=urdf)  # without a warning of numpy, which would be an error


def test_nothing_is_wrong(arm: IdentifiedArm) -> None:
    """Positions are not coarse, an error of 0.0 % has no outliers and has not grown."""
    findings = [finding for finding in arm.verdict.findings if finding.level != "good"]
    assert arm.verdict.good and not [finding for finding in findings if finding.level == "wrong"]
    assert not COMPLAINTS & {finding.check for finding in findings}
    words = ("order", "coarse", "low-pass")
    assert not [finding for finding in findings if any(word in finding.words for word in words)]


@pytest.mark.long
def test_it_is_exported(arm: IdentifiedArm, tmp_path: Path) -> None:
    folder = arm.save(tmp_path / "result")
    line = ["export", str(folder), "--to", "urdf", "-o", str(tmp_path / "arm.urdf")]
    done = CliRunner().invoke(app, line)
    assert done.exit_code == 0, (done.output, done.exception)
    assert (tmp_path / "arm.urdf").read_text().startswith("<")
