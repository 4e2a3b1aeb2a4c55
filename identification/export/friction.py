"""The identified friction as a curve over speed, and in the recorded torque."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

SPEEDS: Final = 120
"""Points of a curve in each direction."""


class FrictionCurve(NamedTuple):
    """Friction of one joint, with offset, without presliding and coupled motors."""

    speed: Array  # (2 SPEEDS,) [rad/s or m/s], densest around zero
    torque: Array  # at these speeds (2 SPEEDS,) [N·m or N]


def friction_curve(
    model: RobotModel, values: Array, joint: int, low: float, high: float
) -> FrictionCurve:
    """Return the curve of a joint, from 0, for parameters (p,).

    Speeds reach from `low`, at most zero, to `high`, at least zero [rad/s or m/s].
    """
    law = model.friction.laws[joint]
    table = model.friction.table(values[model.friction_part])
    steps = np.linspace(0.0, 1.0, SPEEDS) ** 2
    steps[0] = 1e-6 * steps[1]  # both sides of the jump at zero
    speed = np.concatenate([low * steps[::-1], high * steps])
    columns = law.columns(speed, law.sign(speed))
    return FrictionCurve(speed, np.array([*table[joint].values()]) @ columns)


def friction_torque(model: RobotModel, values: Array, samples: Samples) -> Array:
    """Return measured minus predicted torque (m, n) of parameters (p,) without joint friction."""
    without = values.copy()
    without[model.friction_part] *= [term.motor for term in model.friction.terms]
    return samples.torque - samples.predicted_torque(model, without)
