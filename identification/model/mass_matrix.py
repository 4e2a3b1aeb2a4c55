"""Mass matrix of an arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from identification.arrays import Array
from identification.model.motion import Motion
from identification.model.robot import RobotModel


def mass_matrices(model: RobotModel, values: Array, position: Array) -> Array:
    """Return mass matrices (k, n, n) with rotors, of parameters (p,) at positions (k, n)."""
    rest = Motion.at_rest(position)
    static_torque = model.torque(values, rest)
    columns = [
        model.torque(values, replace(rest, acceleration=rest.acceleration + axis)) - static_torque
        for axis in np.eye(model.n_joints)
    ]
    return np.stack(columns, axis=2)
