"""Predicted torque split: inertia, Coriolis and centrifugal, gravity, friction."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]


class TorqueParts(NamedTuple):
    """What a predicted torque is made of; each (m, n) [N·m or N], together the prediction.

    Attributes:
        inertia: of accelerations at rest.
        coriolis: of velocities, centrifugal torque included.
        gravity: of positions.
        friction: of joints and coupled motors, offsets included.
    """

    inertia: Array
    coriolis: Array
    gravity: Array
    friction: Array


def torque_parts(model: RobotModel, values: Array, samples: Samples) -> TorqueParts:
    """Take the torque apart that parameters (p,) predict, as the torque channel would record it."""
    if samples.whole is not None:
        whole, part = samples.whole
        return TorqueParts(*(one[part] for one in torque_parts(model, values, whole)))
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
