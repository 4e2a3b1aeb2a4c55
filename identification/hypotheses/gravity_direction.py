"""The direction of gravity that recordings show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.factor.columns import standard_factor, under_gravity
from identification.factor.factor import Factor
from identification.factor.normal_equations import solve_with_ridge
from identification.model.robot import STANDARD_GRAVITY, RobotModel
from identification.signals.samples import Samples

MAX_ERROR_RATIO: Final = 0.5
"""Squared error on unseen motion with the best gravity over the declared one, where it is wrong."""
MIN_ANGLE: Final = 1.0
"""Degrees between the two. Other faults on the NS 16: up to 0.06."""
_MAX_RECORDINGS: Final = 3  # enough to determine gravity
_FRICTION_PASSES: Final = 2
_MAX_TURNS: Final = 20
_STEP_SHARES: Final = (1.0, 0.5, 0.1)  # of a Gauss-Newton step that are tried
_SAME_FIT_TOLERANCE: Final = 0.1  # difference of twice the log likelihood that is none
# Of each column's information: combinations of standard parameters of a condition above 10^4.5
# count as undetermined.
_RIDGE: Final = 1e-9


@dataclass(frozen=True, eq=False)
class GravityDirection:
    """Direction of gravity that fits the recordings best."""

    declared: Array  # gravity of the model (3,) [m/s²]
    best: Array  # gravity that fits the training motion best, of the same size (3,) [m/s²]
    # squared error on unseen motion under `best` over `declared`, geometric mean over the joints
    # that moved in both
    ratio: float

    @property
    def angle(self) -> float:
        """Angle between the two [rad], zero if none is declared."""
        size = float(np.linalg.norm(self.declared) * np.linalg.norm(self.best))
        if size == 0.0:
            return 0.0
        return float(np.arccos(np.clip(self.declared @ self.best / size, -1.0, 1.0)))


def standard_parameters(factor: Factor, weights: Array) -> Array:
    """Return standard parameters, of about least norm where they are undetermined."""
    equations = factor.weighted(weights)
    return solve_with_ridge(equations.A, equations.b, _RIDGE)


def tilted_gravity(model: RobotModel, recordings: Sequence[Samples]) -> GravityDirection | None:
    """Return the gravity that recordings show instead of the declared one; None if they do not.

    It is fitted to the first part of each, and must predict the rest much better.
    """
    parts = [samples.to_fit_and_predict() for samples in recordings[:_MAX_RECORDINGS]]
    found = find_gravity(
        model, *(standard_factor(model, part) for part in zip(*parts, strict=True))
    )
    is_tilted = found.ratio < MAX_ERROR_RATIO and np.degrees(found.angle) > MIN_ANGLE
    return found if is_tilted else None


def find_gravity(model: RobotModel, training: Factor, held_out: Factor) -> GravityDirection:
    """Fit the training motion under all directions of gravity, and predict the held-out one."""

    def fitted(gravity: Array) -> tuple[Array, Array]:
        """Return parameters, joints weighted by their residuals, and the squared errors (n,)."""
        factor = under_gravity(training, gravity)
        errors = factor.gram[:, -1, -1]
        values = np.empty(0)
        floor = 1e-12 * errors + 1e-300
        for _ in range(_FRICTION_PASSES):
            values = standard_parameters(factor, training.samples / np.maximum(errors, floor))
            errors = factor.squared_errors(values)
        return values, np.maximum(errors, floor)

    def misfit(gravity: Array) -> float:
        """Return twice the negative log likelihood, maximised over the noise variances."""
        return float(training.samples @ np.log(fitted(gravity)[1]))

    def unseen(gravity: Array) -> Array:
        factor = under_gravity(held_out, gravity)
        errors = factor.squared_errors(fitted(gravity)[0])
        return np.maximum(np.maximum(errors, 1e-12 * factor.gram[:, -1, -1]), 1e-300)

    size = float(np.linalg.norm(model.gravity)) or -STANDARD_GRAVITY[2]
    starts = [model.gravity, *(size * sign * axis for axis in np.eye(3) for sign in (1.0, -1.0))]
    first = min(starts, key=misfit)
    if not np.any(first):
        return GravityDirection(model.gravity, model.gravity, 1.0)
    best = first
    least = misfit(first)
    for _ in range(_MAX_TURNS):
        values, errors = fitted(best)
        turn = _turn(training, best, values, training.samples / errors)
        for share in _STEP_SHARES:
            turned = _turned(best, share * turn)
            height = misfit(turned)
            if height < least - _SAME_FIT_TOLERANCE:
                break
        else:
            break
        best = turned
        least = height
    # In slow motion bodies that push upwards in the opposite gravity fit alike: none of an arm do.
    if _weight_agreement(training, best, fitted(best)[0], model.nominal) < 0.0:
        other = fitted(-best)[0]
        best = -best if _weight_agreement(training, -best, other, model.nominal) > 0.0 else best
    counts = (held_out.samples > 0) & (training.samples > 0)
    errors = np.log(unseen(best))
    torque = np.log(np.maximum(held_out.gram[:, -1, -1], 1e-300))
    # An error above the torque itself tells nothing, however much less it is than another one.
    if not counts.any() or np.mean((errors - torque)[counts]) >= 0.0:
        return GravityDirection(model.gravity, best, 1.0)
    change = errors - np.log(unseen(model.gravity))
    return GravityDirection(model.gravity, best, float(np.exp(change[counts].mean())))


def _weight_agreement(factor: Factor, gravity: Array, values: Array, nominal: Array) -> float:
    """Return the product of the torques of gravity of fitted and nominal bodies, over all rows.

    The factor is a :func:`standard_factor`; it is zero for an arm without nominal masses.
    """
    s = len(values)
    bodies = len(nominal)
    weight = np.kron(np.append(0.0, gravity), np.eye(s)[:bodies]).T  # (4 s, bodies)
    gram = factor.gram[:, :-1, :-1].sum(axis=0)
    return float((weight @ values[:bodies]) @ gram @ (weight @ nominal))


def _turn(factor: Factor, gravity: Array, values: Array, weights: Array) -> Array:
    """Return the change of gravity (3,) of a Gauss-Newton step, at a right angle to it.

    The factor is a :func:`standard_factor`, with joints weighted (n,); values (s,) are those of the
    fit under this gravity.
    """
    s = len(values)
    across = np.linalg.svd(gravity[None, :])[2][1:]
    # Columns [W | torque of values by gravity along each direction across | y].
    change = np.zeros((4 * s + 1, s + 3))
    change[: 4 * s, :s] = np.kron(np.append(1.0, gravity)[:, None], np.eye(s))
    change[s : 4 * s, s : s + 2] = np.kron(across.T, values[:, None])
    change[-1, -1] = 1.0
    names = (*factor.parameter_names[:s], "turn 1", "turn 2")
    both = standard_parameters(
        Factor.of_gram(factor.products(change), factor.samples, names), weights
    )
    return np.asarray(both[s:] @ across)


def _turned(gravity: Array, turn: Array) -> Array:
    """Return a gravity turned by a change at a right angle, at most by 45 degrees."""
    size = float(np.linalg.norm(gravity))
    turn = turn * min(1.0, size / max(float(np.linalg.norm(turn)), 1e-300))
    return np.asarray(size * (gravity + turn) / np.linalg.norm(gravity + turn))
