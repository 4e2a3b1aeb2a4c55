"""Parts of a predicted torque: inertia, Coriolis and centrifugal, gravity, friction."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

SPEEDS: Final = 120
"""Points of a curve in each direction."""
TRAVELS: Final = 60
"""Points of a curve after a velocity reversal."""
_TURNED: Final = 6.0  # presliding displacements until the change is complete to 1 %


class FrictionCurve(NamedTuple):
    """Friction torque of one joint [N·m or N], with offset, without coupled motors."""

    speed: Array  # (2 SPEEDS,) [rad/s or m/s], densest around zero
    sliding: Array  # torque at these speeds (2 SPEEDS,)
    travel: Array  # displacement after a reversal (TRAVELS,) [rad or m]; NaN without presliding
    turning: Array  # torque there (TRAVELS,), at a small positive speed after a negative one


def friction_curve(
    model: RobotModel, values: Array, joint: int, low: float, high: float
) -> FrictionCurve:
    """Return the curve of a joint, from 0, for parameters (p,).

    Speeds reach from `low`, at most zero, to `high`, at least zero [rad/s or m/s].
    """
    law = model.friction.laws[joint]
    table = model.friction.table(values[model.friction_part])
    coefficients = np.array([*table[joint].values()])
    steps = np.linspace(0.0, 1.0, SPEEDS) ** 2
    steps[0] = 1e-6 * steps[1]  # both sides of the jump at zero
    speed = np.concatenate([low * steps[::-1], high * steps])
    sliding = coefficients @ law.columns(speed, law.sign(speed))
    share = np.linspace(0.0, _TURNED, TRAVELS)  # of the presliding displacement
    travel = share * (law.presliding or np.nan)
    state = np.where(np.isnan(travel), np.nan, 1.0 - 2.0 * np.exp(-share))
    turning = coefficients @ law.columns(np.zeros(TRAVELS), state) + 0.0 * travel
    return FrictionCurve(speed, sliding, travel, turning)


def friction_torque(model: RobotModel, values: Array, samples: Samples) -> Array:
    """Return measured minus predicted torque (m, n) of parameters (p,) without joint friction."""
    without = values.copy()
    without[model.friction_part] *= [term.motor for term in model.friction.terms]
    return samples.torque - samples.predicted_torque(model, without)


class TorqueParts(NamedTuple):
    """Parts of a predicted torque, each (m, n) [N·m or N]; their sum is the prediction."""

    inertia: Array  # of accelerations at rest
    coriolis: Array  # of velocities, centrifugal torque included
    gravity: Array
    friction: Array  # of joints and coupled motors, offsets included


def torque_parts(model: RobotModel, values: Array, samples: Samples) -> TorqueParts:
    """Return the parts of the predicted torque of parameters (p,), as the channel records it."""
    if samples.parent is not None:
        parent, part = samples.parent
        return TorqueParts(*(one[part] for one in torque_parts(model, values, parent)))
    inertial = np.where(np.arange(model.n_parameters) < model.base.rank, values, 0.0)
    motion = samples.motion
    rest = np.zeros_like(motion.velocity)

    def torque(parameters: Array, velocity: Array, acceleration: Array) -> Array:
        moved = motion._replace(velocity=velocity, acceleration=acceleration)
        return replace(samples, motion=moved).predicted_torque(model, parameters)

    gravity = torque(inertial, rest, rest)
    inertia = torque(inertial, rest, motion.acceleration) - gravity
    moving = torque(inertial, motion.velocity, motion.acceleration)
    friction = torque(values - inertial, motion.velocity, motion.acceleration)
    return TorqueParts(inertia, moving - gravity - inertia, gravity, friction)
