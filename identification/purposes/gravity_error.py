"""Error of the gravity torque over the workspace, against the dry friction of each joint."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import scipy

from identification.arrays import Array
from identification.distributions import normal_limit
from identification.export.friction_curve import equivalent_coulomb
from identification.factor.estimate import Estimate
from identification.model.friction import COULOMB, STRIBECK
from identification.model.motion import Motion
from identification.model.robot import RobotModel

RANDOM_POSTURES: Final = 500
"""Postures of a workspace."""
COVERED_SHARE: Final = 0.95
"""Fraction of postures, and of arms that the covariance allows, with a smaller error."""
_SEED: Final = 20140901


class GravityError(NamedTuple):
    """Error of the gravity torque of each joint, and what holds the joint."""

    error: Array  # that `COVERED_SHARE` stay below (n,) [N·m or N]; infinite where undetermined
    friction: Array  # dry friction of `COVERED_SHARE` of the postures (n,) [N·m or N]


def workspace(lower: Array, upper: Array) -> Array:
    """Return postures (`RANDOM_POSTURES`, n) between joint limits (n,) [rad or m]."""
    random = np.random.default_rng(_SEED)
    return lower + (upper - lower) * random.random((RANDOM_POSTURES, len(lower)))


def gravity_error(model: RobotModel, estimate: Estimate, postures: Array) -> GravityError:
    """Return the error of the gravity torque at postures (m, n).

    The torque at rest is that of gravity, springs and offsets. Its error has a normal distribution
    at each posture; over all of them it is a mixture of these.
    """
    std = torque_deviation(model, estimate, postures)
    # Covariances of few data have longer tails.
    std *= estimate.interval_factor / float(normal_limit(0.025))
    error = np.array([mixture_limit(column, COVERED_SHARE) for column in std.T])
    return GravityError(error, dry_friction(model, estimate.values, postures))


def torque_deviation(model: RobotModel, estimate: Estimate, postures: Array) -> Array:
    """Return the standard deviation (m, n) of the torque at rest by the covariance."""
    covariance = estimate.covariance
    known = np.isfinite(np.diag(covariance))
    covariance = np.where(np.outer(known, known), covariance, 0.0)
    blocks, columns = model.regressor(Motion.at_rest(postures))
    std = np.empty(postures.shape)
    for joint, (block, used) in enumerate(zip(blocks, columns, strict=True)):
        variance = ((block @ covariance[np.ix_(used, used)]) * block).sum(axis=1)
        open_rows = np.any(block[:, ~known[used]] != 0.0, axis=1)
        std[:, joint] = np.where(open_rows, np.inf, np.sqrt(np.maximum(variance, 0.0)))
    return std


def mixture_limit(std: Array, share: float) -> float:
    """Return what `share` of normal variables with deviations (m,) stay below in size."""
    spread = std[std > 0.0]
    finite = spread[np.isfinite(spread)]
    if len(spread) <= (1.0 - share) * len(std):
        return 0.0
    if len(spread) - len(finite) > (1.0 - share) * len(std):
        return float("inf")

    def beyond(limit: float) -> float:
        tails = 2.0 * scipy.special.ndtr(-limit / spread)
        return float(tails.sum()) / len(std) - (1.0 - share)

    # By bisection to the last digit: `scipy.optimize` takes longer to import.
    low, high = 0.0, 40.0 * float(finite.max())
    while low < (middle := 0.5 * (low + high)) < high:
        if beyond(middle) > 0.0:
            low = middle
        else:
            high = middle
    return high


def dry_friction(model: RobotModel, values: Array, postures: Array) -> Array:
    """Return the dry friction (n,) [N·m or N] that `COVERED_SHARE` of postures (m, n) reach.

    Coulomb friction with that of low speed, with that of the load in a posture, and with that of
    coupled motors, of parameters (p,).
    """
    n = model.n_joints
    load = np.zeros(n)
    if model.friction.has_load:
        torque = model.gear_torque(values, Motion.at_rest(postures))
        load = np.quantile(np.abs(torque), 1.0 - COVERED_SHARE, axis=0)
    rows = equivalent_coulomb(model, values[model.friction_part], load)
    dry = np.array([row.get(COULOMB.symbol, 0.0) + row.get(STRIBECK.symbol, 0.0) for row in rows])
    return np.asarray(dry[:n] + np.abs(model.friction.motor_speeds()).T @ dry[n:])
