r"""Cramer-Rao bound of the parameters of a simulated arm, from pinocchio's regressor.

No unbiased estimate from torques :math:`y_j = W_j \pi + e_j` with the covariance
:math:`\sigma_j^2 R` of their noise has smaller variances than

.. math:: \Bigl(\sum_j \sigma_j^{-2} W_j^T R^{-1} W_j\Bigr)^{-1},

with every row of the log, the true motion, and a known delay. Least squares, which takes the
rows for equally uncertain, has :math:`A^{-1} (\sum_j \sigma_j^{-2} W_j^T R W_j) A^{-1}` with
:math:`A = \sum_j \sigma_j^{-2} W_j^T W_j`. Only the grouping of base parameters is the project's.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import pinocchio as pin
import scipy.linalg
from numpy.typing import NDArray

from identification.model.robot import RobotModel

Array = NDArray[np.float64]

PROJECT_ORDER: Final = (4, 5, 7, 6, 8, 9, 1, 2, 3, 0)  # of pinocchio's ten parameters of a body


def base_regressor(
    robot: Any, model: RobotModel, position: Array, velocity: Array, acceleration: Array
) -> Array:
    """Return the rows (n, m, r) of base parameters on a motion, rotors as armature.

    Args:
        robot: pinocchio's model of n joints.
        model: the project's, of which only names and grouping of parameters count.
        position: (m, n).
        velocity: (m, n).
        acceleration: (m, n).
    """
    m, n = position.shape
    data = robot.createData()
    layout = model.layout
    standard = np.zeros((m, n, layout.size))
    order = np.concatenate([10 * joint + np.array(PROJECT_ORDER) for joint in range(n)])
    places = layout.links.ravel()
    for row, state in enumerate(zip(position, velocity, acceleration, strict=True)):
        standard[row][:, places] = pin.computeJointTorqueRegressor(robot, data, *state)[:, order]
    joints = np.arange(n)
    standard[:, joints, layout.rotors] = acceleration
    # Torques depend on the grouped parameters only, so that W = W G^+ G.
    return np.asarray((standard @ np.linalg.pinv(model.base.grouping)).transpose(1, 0, 2))


def correlation(rows: int, keep: float) -> Array:
    """Return the correlations (rows,) of noise of which half the power has a memory.

    `keep` is the correlation of that half from one row to the next, zero of white noise.
    """
    lag = 0.5 * keep ** np.arange(rows)
    lag[0] = 1.0
    return np.asarray(lag)


def bound(rows: Array, noise: Array, keep: float) -> Array:
    """Return the least standard deviations (p,) of parameters by rows (n, m, p).

    `noise` are the standard deviations (n,) of the torques, `keep` as for :func:`correlation`.
    """
    white = whitened(rows / noise[:, None, None], keep)
    information = np.einsum("jmp,jmq->pq", white, white)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))))


def whitened(columns: Array, keep: float) -> Array:
    """Return columns (n, m, p) in units in which noise of :func:`correlation` is white.

    These are the innovations of a Kalman filter, whose state is the half with a memory.
    """
    state = np.zeros((columns.shape[0], columns.shape[2]))
    variance = 0.5
    white = np.empty_like(columns)
    for row in range(columns.shape[1]):
        innovation = columns[:, row] - state
        power = variance + 0.5
        white[:, row] = innovation / np.sqrt(power)
        state = keep * (state + variance / power * innovation)
        variance = keep**2 * variance * 0.5 / power + 0.5 * (1.0 - keep**2)
    return white


def least_squares_deviations(rows: Array, noise: Array, keep: float) -> Array:
    """Return the standard deviations (p,) of weighted least squares, arguments as of `bound`."""
    unit = rows / noise[:, None, None]
    inverse = np.linalg.inv(np.einsum("jmp,jmq->pq", unit, unit))
    lag = correlation(unit.shape[1], keep)
    noisy = np.array([scipy.linalg.matmul_toeplitz(lag, joint) for joint in unit])
    scatter = np.einsum("jmp,jmq->pq", unit, noisy)
    return np.asarray(np.sqrt(np.diag(inverse @ scatter @ inverse)))
