"""What is watched of every axis: how much friction it has, and how well its torque is explained."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from identification import RobotModel
from identification.factor.factor import Factor
from identification.model.friction import Viscous

Array = NDArray[np.float64]

# Speed [rad/s, m/s] where the data cannot say how fast an axis went: it has no viscous friction.
_ANY_SPEED = 0.5


def speed_rms(model: RobotModel, factor: Factor) -> Array:
    """Root mean square speed per axis (n,) [rad/s, m/s], from the columns of viscous friction.

    That of the motor where only the coupled motor has friction; NaN where no column is a speed.
    """
    squares = np.full(model.n_joints, np.nan)
    for k, term in enumerate(model.friction.terms):
        if isinstance(term.term, Viscous) and (not term.motor or np.isnan(squares[term.owner])):
            column = model.base.rank + k
            squares[term.owner] = factor.gram[term.owner, column, column]
    return _rms(squares, factor.samples)


def friction_weights(model: RobotModel, speed: Array) -> Array:
    """Weights G (n, p): ``G @ values`` is the friction of each axis at a speed [N·m, N].

    The mean of forwards and backwards, so that an offset and a difference by direction are no
    part of it. Where coupled motors have friction, that of the axis' own motor counts as well.

    Args:
        model: the robot.
        speed: of each axis (n,) [rad/s, m/s], above zero; NaN for half a radian or metre a second.
    """
    weights = np.zeros((model.n_joints, model.n_parameters))
    for k, term in enumerate(model.friction.terms):
        own = float(speed[term.owner])
        at = own if math.isfinite(own) and own > 0.0 else _ANY_SPEED
        forwards, backwards = term.term.column(np.array([at, -at]), np.array([1.0, -1.0]))
        weights[term.owner, model.base.rank + k] = 0.5 * (forwards - backwards)
    return weights


def friction_of(values: Array, covariance: Array, weights: Array) -> tuple[Array, Array]:
    """Friction of each axis and its standard deviation, each (n,) [N·m, N].

    NaN for an axis without friction, or with a coefficient that the data do not determine.

    Args:
        values: parameters (p,).
        covariance: (p, p), infinite variances of what is undetermined.
        weights: (n, p), see :func:`friction_weights`.
    """
    known = np.isfinite(np.diag(covariance))
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    variance = np.einsum("ji,ik,jk->j", weights, finite, weights)
    whole = weights.any(axis=1) & ~weights[:, ~known].any(axis=1)
    value = np.where(whole, weights @ values, np.nan)
    return value, np.where(whole, np.sqrt(np.maximum(variance, 0.0)), np.nan)


def _rms(squares: Array, rows: NDArray[np.intp]) -> Array:
    return np.where(rows > 0, np.sqrt(squares / np.maximum(rows, 1)), np.nan)
