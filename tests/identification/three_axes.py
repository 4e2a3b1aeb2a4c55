"""A simulated arm of three parallel axes, and its motion."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from identification import RobotModel
from identification.model.motion import Motion

Floats = NDArray[np.float64]
NAMES = ("hip", "knee", "ankle")
TIME = np.arange(0.0, 6.0, 0.015)


def urdf() -> str:
    """Three parallel axes, whose masses the description has."""
    bodies = "".join(
        f"<link name='l{name}'><inertial><mass value='{mass}'/><origin xyz='0 0 0.2'/>"
        "<inertia ixx='0.1' iyy='0.1' izz='0.1' ixy='0' ixz='0' iyz='0'/></inertial></link>"
        f"<joint name='{name}' type='revolute'><parent link='{parent}'/><child link='l{name}'/>"
        "<origin xyz='0 0 0.4'/><axis xyz='0 1 0'/>"
        "<limit lower='-3' upper='3' effort='99' velocity='9'/></joint>"
        for name, parent, mass in zip(NAMES, ("base", "lhip", "lknee"), (3, 2, 1), strict=True)
    )
    return f"<robot name='three'><link name='base'/>{bodies}</robot>"


@cache
def model(gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)) -> RobotModel:
    return RobotModel.from_urdf(urdf(), gravity=gravity)


@cache
def motion(factors: tuple[float, ...] = (1.0, 1.0, 1.0)) -> tuple[Floats, Floats, Floats]:
    """Positions, torque of bodies with friction and noise, and that of gravity.

    The bodies are those of the description times a factor each.
    """
    robot = model()
    rng = np.random.default_rng(0)
    rate = rng.uniform(2.0, 8.0, (3, 3))
    angle = rate * TIME[:, None, None] + rng.uniform(0.0, 6.0, rate.shape)
    q = 0.3 * np.sin(angle).sum(axis=1)
    v = 0.3 * (rate * np.cos(angle)).sum(axis=1)
    a = -0.3 * (rate**2 * np.sin(angle)).sum(axis=1)
    values = np.zeros(robot.n_parameters)
    bodies = np.repeat(factors, robot.layout.width) * robot.nominal
    values[: robot.base.rank] = robot.base.grouping @ bodies
    torque = robot.torque(values, Motion.of_states(q, v, a)) + 0.4 * np.sign(v) + 0.2 * v
    torque += rng.normal(0.0, 0.02, v.shape)
    return q, torque, robot.torque(values, Motion.at_rest(q))


HIP = np.array([1.0, 0.0, 0.0])
KNEE = np.array([0.0, 1.0, 0.0])
