"""Gravity and load that recordings show: its direction, and a body on the last link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.estimators.payload_estimate import mass_difference
from identification.estimators.payload_problem import Run
from identification.factor.columns import under_gravity
from identification.factor.factor import Factor
from identification.factor.normal_equations import solve_with_ridge
from identification.model.link_wrenches import LINK_SYMBOLS
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.validation.finding import Thresholds

_STANDARD: Final = 9.81  # m/s²
_PASSES: Final = 2
_MOST_TURNS: Final = 20
_SHARES: Final = (1.0, 0.5, 0.1)  # of a Gauss-Newton step that are tried
_SAME_FIT: Final = 0.1  # difference of twice the log likelihood that is none
# Of each column's information: combinations of standard parameters of a condition above 10^4.5
# count as undetermined.
_RIDGE: Final = 1e-9
_FEWEST_ROWS: Final = 50  # of a joint whose usual error is known
_GROWN: Final = 4.0  # power ratio beyond which a joint's error exceeds that of the fit


@dataclass(frozen=True, eq=False)
class GravityDirection:
    """Direction of gravity that fits the recordings best."""

    declared: Array  # gravity of the model (3,) [m/s²]
    best: Array  # gravity that fits the training motion best, of the same size (3,) [m/s²]
    # squared error on unseen motion under `best` over `declared`, geometric mean over the joints
    # that moved
    ratio: float

    @property
    def angle(self) -> float:
        """Angle between the two [rad], zero if none is declared."""
        size = float(np.linalg.norm(self.declared) * np.linalg.norm(self.best))
        if size == 0.0:
            return 0.0
        return float(np.arccos(np.clip(self.declared @ self.best / size, -1.0, 1.0)))


def _solved(factor: Factor, weights: Array) -> Array:
    """Return standard parameters, of about least norm where they are undetermined."""
    equations = factor.weighted(weights)
    return solve_with_ridge(equations.A, equations.b, _RIDGE)


def find_gravity(model: RobotModel, training: Factor, held_out: Factor) -> GravityDirection:
    """Fit the training motion under all directions of gravity, and predict the held-out one."""

    def fitted(gravity: Array) -> tuple[Array, Array]:
        """Return parameters, joints weighted by their residuals, and the squared errors (n,)."""
        factor = under_gravity(training, gravity)
        errors = factor.gram[:, -1, -1]
        values = np.empty(0)
        floor = 1e-12 * errors + 1e-300
        for _ in range(_PASSES):
            values = _solved(factor, training.samples / np.maximum(errors, floor))
            errors = factor.squared_errors(values)
        return values, np.maximum(errors, floor)

    def misfit(gravity: Array) -> float:
        """Return twice the negative log likelihood, maximised over the noise variances."""
        return float(training.samples @ np.log(fitted(gravity)[1]))

    def unseen(gravity: Array) -> Array:
        factor = under_gravity(held_out, gravity)
        errors = factor.squared_errors(fitted(gravity)[0])
        return np.maximum(np.maximum(errors, 1e-12 * factor.gram[:, -1, -1]), 1e-300)

    size = float(np.linalg.norm(model.gravity)) or _STANDARD
    starts = [model.gravity, *(size * sign * axis for axis in np.eye(3) for sign in (1.0, -1.0))]
    first = min(starts, key=misfit)
    if not np.any(first):
        return GravityDirection(model.gravity, model.gravity, 1.0)
    best = first
    least = misfit(first)
    for _ in range(_MOST_TURNS):
        values, errors = fitted(best)
        turn = _turn(training, best, values, training.samples / errors)
        for share in _SHARES:
            turned = _turned(best, share * turn)
            height = misfit(turned)
            if height < least - _SAME_FIT:
                break
        else:
            break
        best = turned
        least = height
    # In slow motion bodies that push upwards in the opposite gravity fit alike: none of an arm do.
    if _weight_agreement(training, best, fitted(best)[0], model.nominal) < 0.0:
        other = fitted(-best)[0]
        best = -best if _weight_agreement(training, -best, other, model.nominal) > 0.0 else best
    counts = held_out.samples > 0
    change = np.log(unseen(best)) - np.log(unseen(model.gravity))
    ratio = float(np.exp(change[counts].mean())) if counts.any() else 1.0
    return GravityDirection(model.gravity, best, ratio)


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
    both = _solved(Factor.of_gram(factor.products(change), factor.samples, names), weights)
    return np.asarray(both[s:] @ across)


def _turned(gravity: Array, turn: Array) -> Array:
    """Return a gravity turned by a change at a right angle, at most by 45 degrees."""
    size = float(np.linalg.norm(gravity))
    turn = turn * min(1.0, size / max(float(np.linalg.norm(turn)), 1e-300))
    return np.asarray(size * (gravity + turn) / np.linalg.norm(gravity + turn))


class CarriedLoad(NamedTuple):
    """Body on the last link that explains errors on unseen motion only."""

    mass: float  # mass difference to the fitted motion [kg]
    explained: float  # share of the additional error on unseen motion that it explains
    axes: int  # number of joints whose error is far above that of the fit
    half_interval: float = np.inf  # of the mass, 95 % [kg]; infinite if unknown


def find_load(
    model: RobotModel,
    training: Sequence[Samples],
    held_out: Sequence[Samples],
    fitted: Factor,
    predicted: Factor,
) -> CarriedLoad:
    """Fit the training motion, then ten parameters of the last link to the unseen motion."""
    seen, unseen = (under_gravity(factor, model.gravity) for factor in (fitted, predicted))
    values = _solved(seen, fitted.samples / np.maximum(seen.gram[:, -1, -1], 1e-300))
    # Squared error of the fit, scaled to as many rows.
    floor = 1e-12 * unseen.gram[:, -1, -1] + 1e-300
    usual = seen.squared_errors(values) * predicted.samples / np.maximum(fitted.samples, 1.0)
    # What the fitted motion did not move has no usual error.
    fits = fitted.samples >= _FEWEST_ROWS
    weights = np.where(fits, predicted.samples / np.maximum(usual, floor), 0.0)
    before = unseen.squared_errors(values)
    last = model.layout.links[-1]
    # Columns [last link | residual].
    change = np.zeros((unseen.n_parameters + 1, len(last) + 1))
    change[last, range(len(last))] = 1.0
    change[:, -1] = np.append(-values, 1.0)
    left = Factor.of_gram(unseen.products(change), unseen.samples, LINK_SYMBOLS)
    body = _solved(left, weights)
    after = left.squared_errors(body)
    beyond = weights @ np.maximum(before - usual, 0.0)
    load = CarriedLoad(
        mass=float(body[LINK_SYMBOLS.index("m")]),
        explained=float(weights @ (before - after) / beyond) if beyond > 0.0 else 0.0,
        axes=int(np.count_nonzero(fits & (before > _GROWN * np.maximum(usual, floor)))),
    )
    if load.explained <= Thresholds().load:
        return load
    try:
        runs = [
            Run.of(str(k), model, samples, None, loaded=loaded)
            for loaded, some in ((False, training), (True, held_out))
            for k, samples in enumerate(some)
        ]
        mass, _, high = mass_difference(model, runs)
    except IdentificationError:
        return load
    return load._replace(mass=mass, half_interval=high - mass) if np.isfinite(high) else load
