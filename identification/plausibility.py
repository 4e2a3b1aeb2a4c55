"""Whether estimated parameters can belong to a machine at all.

Signs that nature does not make: friction that drives, negative masses, an arm that could be
accelerated at a gain of energy. Each is asked for with the estimate's own uncertainty, so that
a parameter that is merely not known is no offence.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from identification.estimation import Estimate
from identification.model import RobotModel

Array = NDArray[np.float64]

# More standard deviations for what was searched for among many directions and postures.
_SEARCHED = 2.0

# Never negative, whatever the axes: masses, rotor inertias, moments of inertia about an axis.
_NEVER_NEGATIVE = re.compile(r"m\d+|I\d+(m|xx|yy|zz)")


def implausibilities(
    model: RobotModel, estimate: Estimate, position: Array, speed: Array, sigmas: float = 3.0
) -> tuple[str, ...]:
    """Say in words what about an estimate is physically impossible.

    Args:
        model: the robot.
        estimate: of the model's parameters.
        position: postures to look at the inertia matrix in (k, n).
        speed: highest measured speed per joint (n,): friction is looked at up to there.
        sigmas: standard deviations beyond which the wrong sign counts.
    """
    return (
        *_friction(model, estimate, speed, sigmas),
        *_inertial(model, estimate, sigmas),
        *_inertia_matrix(model, estimate, position, sigmas),
    )


def _variance(estimate: Estimate, direction: Array) -> float:
    """Variance of direction · parameters, infinite where an undetermined one takes part."""
    known = np.isfinite(np.diag(estimate.covariance))
    if np.any(direction[~known]):
        return np.inf
    part = direction[known]
    return float(part @ estimate.covariance[np.ix_(known, known)] @ part)


def _is_negative(estimate: Estimate, direction: Array, sigmas: float) -> bool:
    value = float(direction @ estimate.values)
    return value < -sigmas * float(np.sqrt(_variance(estimate, direction)))


def _friction(model: RobotModel, estimate: Estimate, speed: Array, sigmas: float) -> list[str]:
    """Coulomb friction below zero, and friction at top speed below half of Coulomb's.

    Friction may fall with speed (Stribeck) before it rises, by a quarter perhaps; at top speed
    that is over, and less than half is a viscous coefficient with the wrong sign.
    """
    found = []
    symbols = model.friction.symbols
    at_speed = np.zeros((len(symbols), model.n_joints))
    model.friction.columns(speed, at_speed)
    for joint, name in enumerate(model.joint_names):
        top = np.zeros(len(estimate.values))
        coulomb = np.zeros(len(estimate.values))
        for symbol, column in zip(symbols, at_speed[:, joint], strict=True):
            index = estimate.names.index(f"{symbol}_{joint + 1}")
            if symbol != "fo":
                top[index] = column
            if symbol == "f0":
                coulomb[index] = 1.0
        if _is_negative(estimate, coulomb, sigmas):
            found.append(
                f"Coulomb friction of {name} is negative ({coulomb @ estimate.values:.3g}): a"
                " torque or a direction has the wrong sign"
            )
        elif _is_negative(estimate, top - 0.5 * coulomb, sigmas):
            found.append(
                f"friction of {name} is {top @ estimate.values:.3g} at {speed[joint]:.3g} rad/s,"
                f" less than half of its Coulomb friction {coulomb @ estimate.values:.3g}"
            )
    return found


def _inertial(model: RobotModel, estimate: Estimate, sigmas: float) -> list[str]:
    """Base parameters that stand for one standard parameter alone and have its wrong sign."""
    found = []
    for index, row in enumerate(model.base.grouping):
        alone = np.count_nonzero(row) == 1
        name = model.base.names[index]
        if not alone or not _NEVER_NEGATIVE.fullmatch(name):
            continue
        direction = np.zeros(len(estimate.values))
        direction[index] = 1.0
        if _is_negative(estimate, direction, sigmas):
            found.append(
                f"{name} is negative: {estimate.values[index]:.3g} ± {estimate.std[index]:.2g}"
                f" {estimate.units[index]}"
            )
    return found


def _inertia_matrix(
    model: RobotModel, estimate: Estimate, position: Array, sigmas: float
) -> list[str]:
    """A posture in which the inertia matrix has a negative direction."""
    columns = _inertia_columns(model, position)  # (k, n, n, p)
    matrices = columns @ estimate.values
    matrices = 0.5 * (matrices + matrices.transpose(0, 2, 1))
    eigenvalues, vectors = np.linalg.eigh(matrices)
    worst = int(np.argmin(eigenvalues[:, 0]))
    along = vectors[worst, :, 0]
    direction = np.einsum("i,ijp,j->p", along, columns[worst], along)
    if not _is_negative(estimate, direction, sigmas + _SEARCHED):
        return []
    joint = model.joint_names[int(np.argmax(np.abs(along)))]
    return [
        f"the inertia seen by {joint} is negative ({eigenvalues[worst, 0]:.3g}) in a posture of"
        " the validation motion: a torque or a direction has the wrong sign"
    ]


def _inertia_columns(model: RobotModel, position: Array) -> Array:
    """Inertia matrix as a linear map of the parameters: (k, n, n, p)."""
    k, n = position.shape
    zero = np.zeros((k, n))
    p = model.n_parameters
    gravity = model.regressor(position, zero, zero).dense(p)
    columns = np.empty((k, n, n, p))
    for joint in range(n):
        unit = zero.copy()
        unit[:, joint] = 1.0
        columns[:, :, joint] = model.regressor(position, zero, unit).dense(p) - gravity
    return columns
