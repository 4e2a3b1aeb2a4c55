"""Logs of poses at rest: with the moves between them an arm is identified, without them refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import hil
from hil.base.errors import SourceError
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions
from hil.look import look_at
from tests.hil.simulated_logs import urdf_path, write_log

URDF = urdf_path("ur5_robot.urdf")
STEP = 0.01  # s
POSES, REST_ROWS, MOVE_ROWS = 25, 60, 80


def log_of(path: Path, *, with_moves: bool) -> Path:
    """Write poses with friction anywhere within its Coulomb torque, and moves between them."""
    model = pin.buildModelFromUrdf(str(URDF))
    data = model.createData()
    rng = np.random.default_rng(3)
    poses = rng.uniform(-1.4, 1.4, (POSES, model.nv))
    none = np.zeros(model.nv)
    weight = np.array([pin.rnea(model, data, pose, none, none) for pose in poses])
    coulomb = 0.15 * (weight.std(axis=0) + 0.1)
    rest = weight + coulomb * rng.uniform(-1.0, 1.0, poses.shape)
    s = np.arange(MOVE_ROWS)[:, None] / MOVE_ROWS
    blend = 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
    positions, torques = [], []
    for k, pose in enumerate(poses):
        if with_moves and k:
            q = poses[k - 1] + blend * (pose - poses[k - 1])
            v = np.gradient(q, STEP, axis=0)
            a = np.gradient(v, STEP, axis=0)
            rows = zip(q, v, a, strict=True)
            moving = [pin.rnea(model, data, *row) + coulomb * np.sign(row[1]) for row in rows]
            positions.append(q)
            torques.append(np.array(moving))
        positions.append(np.tile(pose, (REST_ROWS, 1)))
        torques.append(np.tile(rest[k], (REST_ROWS, 1)))
    q, torque = np.concatenate(positions), np.concatenate(torques)
    q += 2e-5 * rng.standard_normal(q.shape)
    torque += 0.02 * torque.std(axis=0) * rng.standard_normal(torque.shape)
    return write_log(path, ["t", "q{}", "tau{}"], STEP * np.arange(len(q)), q, torque)


def test_poses_alone_are_refused_with_what_to_record(tmp_path: Path) -> None:
    """No encoder jumps, and no torque is too small."""
    log = log_of(tmp_path / "poses.csv", with_moves=False)
    robot = Robot.from_urdf(URDF)
    with pytest.raises(SourceError, match="has 25 poses at rest") as refused:
        look_at(log, lambda _: robot, ImportOptions())
    assert "record the moves between the poses" in (refused.value.remedy or "")
    with pytest.raises(SourceError, match="has 25 poses at rest"):
        hil.identify(log, urdf=URDF)


@pytest.mark.long
def test_the_moves_between_poses_are_what_is_missing(tmp_path: Path) -> None:
    arm = hil.identify(log_of(tmp_path / "moves.csv", with_moves=True), urdf=URDF)
    assert not arm.verdict.reasons
