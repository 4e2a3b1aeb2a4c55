"""Ordinary fit of an arm's dynamics by pinocchio, numpy and scipy, independent of `hil`.

Positions, and velocities where they were measured, go through a zero-phase Butterworth filter;
derivatives are differences. Every row is fitted, by least squares of minimum norm on pinocchio's
standard parameters with rotor inertia, Coulomb and viscous friction and an offset for each joint.
Each joint is weighted by the inverse variance of its own residual, iterated. The cut-off is the
one with which the first 70 % of what is fitted predict the rest of it best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import pinocchio as pin
import scipy.signal
from numpy.typing import NDArray

Array = NDArray[np.float64]

CUTOFFS: Final = (2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 40.0)  # Hz
INNER_SHARE: Final = 0.7
_ROUNDS: Final = 10  # of reweighting
_RANK: Final = 1e-10  # of the largest singular value; what is smaller is rounding


class Measured(NamedTuple):
    """m rows of n joints in pinocchio's order: time [s], position, velocity, torque (SI units)."""

    time: Array
    position: Array
    velocity: Array | None
    torque: Array


@dataclass(frozen=True, eq=False)
class PlainFit:
    """Cut-off [Hz] and parameters (14 n,): ten per link, then rotors, Coulomb, viscous, offset."""

    robot: Any
    cutoff: float
    parameters: Array

    def predicted_torque(self, measured: Measured) -> Array:
        """Torque (m, n) [N·m or N] of a motion, of which the torque is not looked at."""
        return np.asarray(regressor(self.robot, measured, self.cutoff) @ self.parameters)


def robot_from_urdf(
    urdf: str, gravity: Sequence[float] = (0.0, 0.0, -9.81), locked: Mapping[str, float] = {}
) -> Any:
    """Pinocchio's model, joints in `locked` held at their position [rad or m]."""
    whole = pin.buildModelFromXML(urdf)
    held = np.zeros(whole.nv)
    for name, position in locked.items():
        held[whole.joints[whole.getJointId(name)].idx_v] = position
    posture = pin.integrate(whole, pin.neutral(whole), held)
    robot = pin.buildReducedModel(whole, [whole.getJointId(name) for name in locked], posture)
    robot.gravity.linear = np.array(gravity)
    return robot


def fit(robot: Any, measured: Measured) -> PlainFit:
    """Choose the cut-off on the fitted part alone, then fit all of it."""
    cut = round(INNER_SHARE * len(measured.time))
    rate = 1.0 / np.median(np.diff(measured.time))
    tables = {f: regressor(robot, measured, f) for f in CUTOFFS if f < 0.45 * rate}

    def inner_error(cutoff: float) -> float:
        parameters = solve(tables[cutoff][:cut], measured.torque[:cut])
        return relative_error(measured.torque[cut:], tables[cutoff][cut:] @ parameters)

    best = min(tables, key=inner_error)
    return PlainFit(robot, best, solve(tables[best], measured.torque))


def regressor(robot: Any, measured: Measured, cutoff: float) -> Array:
    """Regressor (m, n, 14 n) of the filtered motion, columns as in `PlainFit`."""
    position, velocity, acceleration = filtered_motion(measured, cutoff)
    (m, n), data, neutral = position.shape, robot.createData(), pin.neutral(robot)
    table = np.zeros((m, n, 14 * n))
    for row, q, qd, qdd in zip(table, position, velocity, acceleration, strict=True):
        posture = pin.integrate(robot, neutral, q)
        row[:, : 10 * n] = pin.computeJointTorqueRegressor(robot, data, posture, qd, qdd)
    joint = np.arange(n)
    friction = (acceleration, np.sign(velocity), velocity, np.ones((m, n)))
    for block, columns in enumerate(friction, 10):
        table[:, joint, block * n + joint] = columns
    return table


def filtered_motion(measured: Measured, cutoff: float) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration (m, n)."""
    position = low_passed(measured.time, measured.position, cutoff)
    velocity = np.gradient(position, measured.time, axis=0)
    if measured.velocity is not None:
        velocity = low_passed(measured.time, measured.velocity, cutoff)
    return position, velocity, np.gradient(velocity, measured.time, axis=0)


def low_passed(time: Array, values: Array, cutoff: float) -> Array:
    """Values (m, n) through a Butterworth filter of order 4, forth and back."""
    rate = 1.0 / np.median(np.diff(time))
    sections = scipy.signal.butter(4, cutoff, fs=rate, output="sos")
    padding = min(len(time) - 1, round(rate / cutoff))
    return np.asarray(scipy.signal.sosfiltfilt(sections, values, axis=0, padlen=padding))


def solve(table: Array, torque: Array) -> Array:
    """Weighted least squares (14 n,) of minimum norm; a joint's weight is that of its residual."""
    joints = range(torque.shape[1])
    # One triangular factor per joint holds all that the iteration needs of its rows.
    factors = [np.linalg.qr(np.column_stack([table[:, j], torque[:, j]])).R for j in joints]
    least = 1e-9 * float(np.linalg.norm(torque)) or 1.0
    scale = np.ones(torque.shape[1])
    for _ in range(_ROUNDS):
        rows = np.vstack([factor / s for factor, s in zip(factors, scale, strict=True)])
        parameters = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=_RANK)[0]
        residual = [np.linalg.norm(factor @ np.append(parameters, -1.0)) for factor in factors]
        scale = np.maximum(residual, least)
    return np.asarray(parameters)


def relative_error(torque: Array, predicted: Array) -> float:
    """||tau - tau_hat|| / ||tau|| over all joints and rows."""
    return float(np.linalg.norm(torque - predicted) / np.linalg.norm(torque))
