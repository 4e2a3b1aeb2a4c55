"""Logs of a simulated arm of two joints, noise and all, small enough to be identified at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

from benchmarks.joint_log import JointLog
from hil.importers import Robot

URDF = Path(__file__).resolve().parents[2] / "examples" / "two_joints" / "robot.urdf"
COULOMB, VISCOUS, ROTOR = np.array([4.0, 2.0]), np.array([2.0, 1.0]), np.array([0.5, 0.2])


def two_joint_log(seed: int, *, noise: float = 1.0, seconds: float = 10.0) -> JointLog:
    """A motion of sines with friction and rotors, at 100 Hz."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.01)
    rate = 2.0 * np.pi * random.uniform(0.1, 0.6, (3, 2))
    angle = rate * time[:, None, None] + random.uniform(0.0, 2.0 * np.pi, (3, 2))
    size = 0.4
    q = size * np.sin(angle).sum(axis=1)
    qd = size * (rate * np.cos(angle)).sum(axis=1)
    qdd = -size * (rate**2 * np.sin(angle)).sum(axis=1)
    robot = pin.buildModelFromUrdf(str(URDF))
    data = robot.createData()
    torque = np.array([pin.rnea(robot, data, *row) for row in zip(q, qd, qdd, strict=True)])
    torque += COULOMB * np.sign(qd) + VISCOUS * qd + ROTOR * qdd
    return JointLog(
        robot=Robot.from_urdf(URDF),
        time=time,
        position=q + noise * 1e-5 * random.standard_normal(q.shape),
        velocity=qd,
        torque=torque + noise * 0.3 * random.standard_normal(q.shape),
        rated_payload=5.0,
    )
