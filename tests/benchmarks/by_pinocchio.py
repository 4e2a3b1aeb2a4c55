"""Least squares that shares nothing with the package: pinocchio's regressor and numpy's lstsq."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.signals.samples import Samples

Array = NDArray[np.float64]


def rows(urdf: str, samples: Samples) -> Array:
    """Rows (m, n, 14 n): pinocchio's regressor, then rotors, Coulomb, viscous and offset."""
    robot = pin.buildModelFromXML(urdf)
    data = robot.createData()
    q, qd, qdd = samples.motion[1:4]
    m, n = q.shape
    table = np.zeros((m, n, 14 * n))
    for k in range(m):
        table[k, :, : 10 * n] = pin.computeJointTorqueRegressor(robot, data, q[k], qd[k], qdd[k])
    joint = np.arange(n)
    for block, columns in enumerate((qdd, np.sign(qd), qd, np.ones_like(qd))):
        table[:, joint, (10 + block) * n + joint] = columns
    return table


def fitted_torque(urdf: str, samples: Samples, weights: Array) -> Array:
    """Torque of the usable rows that the fit with these joint weights (n,) predicts.

    The columns are many more than the motion determines. The solution is that of least norm,
    which the predicted torque does not depend on.
    """
    usable = samples.usable
    table = rows(urdf, samples)[usable]
    length = np.linalg.norm(table, axis=0)
    # What only rounding has put there must not be scaled up to a column.
    acting = length > 1e-10 * length.max()
    table = table[:, acting] / length[acting]
    scale = np.broadcast_to(np.sqrt(weights), usable.shape)[usable]
    solution = np.linalg.lstsq(scale[:, None] * table, scale * samples.torque[usable], rcond=1e-10)[
        0
    ]
    return np.asarray(table @ solution)
