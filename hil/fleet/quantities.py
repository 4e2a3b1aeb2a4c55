"""Quantities of each joint that a trend follows, as functions of a recording's estimate."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, get_args

import numpy as np

from hil.base.arrays import Array
from hil.batch.archive_reduction import Summary
from hil.compare.comparison import FRICTION_SPEEDS, friction_weights, projected
from identification import RobotModel
from identification.factor.estimate import Estimate
from identification.model.motion import Motion

QuantityName = Literal[
    "friction", "coulomb", "viscous", "gravity load", "torque scale", "reference error"
]
QUANTITIES: Final[tuple[QuantityName, ...]] = get_args(QuantityName)
CAUSES: Final[Mapping[QuantityName, int]] = {"friction": 0, "gravity load": 0, "torque scale": 1}
"""Quantities that say what changed, in their order: a load also changes the scale of torque. The
others are parts of friction, and an error."""
_RANDOM_STATES: Final = 200  # postures of gravity, and states of the scale of torque
_RMS_SPEED: Final = 1.0  # rad/s or m/s, root mean square of these states
_RMS_ACCELERATION: Final = 3.0  # rad/s² or m/s²
_SAMPLED_RECORDINGS: Final = 40  # recordings that choose the speed of friction
_MIN_GRAVITY_SHARE: Final = 0.02  # of the largest joint's gravity, below which a joint carries none


class FollowedQuantity(NamedTuple):
    """One quantity of one joint.

    Attributes:
        joint: its name.
        quantity: what it is.
        unit: of its values.
        speed: of friction [rad/s or m/s], None of others.
    """

    joint: str
    quantity: QuantityName
    unit: str
    speed: float | None = None


@dataclass(frozen=True, eq=False)
class TrackedQuantity:
    """A quantity as a function of estimates.

    Attributes:
        followed: the quantity.
        number: of the joint, from 0.
        weights: (p,); their product with the parameters is the value; empty for the error of the
            reference model.
    """

    followed: FollowedQuantity
    number: int
    weights: Array

    def in_estimates(self, estimates: Sequence[Estimate]) -> tuple[Array, Array]:
        """Return values and variances (m,) in estimates, NaN where unknown."""
        pairs = [projected(estimate, self.weights[None]) for estimate in estimates]
        values, variances = np.array(pairs)[:, :, 0].T
        return values, variances

    def of(self, summaries: Sequence[Summary], first: int) -> tuple[Array, Array]:
        """Return values and variances (m,) of the recordings of a robot, NaN where unknown.

        The reference model is the mean of the `first` recordings.
        """
        if self.followed.quantity == "reference error":
            return self._reference_errors(summaries, first)
        return self.in_estimates([each.fit for each in summaries if each.fit is not None])

    def _reference_errors(self, summaries: Sequence[Summary], first: int) -> tuple[Array, Array]:
        """Return the torque errors of one model in all recordings; their noise is by day."""
        fits = [summary.fit.values for summary in summaries[:first] if summary.fit is not None]
        reference = np.mean(fits, axis=0)
        errors = []
        for summary in summaries:
            rows = summary.total.samples[self.number]
            squares = summary.total.squared_errors(reference)[self.number]
            errors.append(float(np.sqrt(squares / rows)) if rows > 0 else np.nan)
        return np.array(errors), np.zeros(len(errors))


def tracked_quantities(
    model: RobotModel, fits: Sequence[Estimate], reference: Array
) -> Iterator[TrackedQuantity]:
    """Yield the quantities of each joint.

    Args:
        model: of the type.
        fits: estimates that choose the speed of friction.
        reference: parameters (p,) close to all robots.

    Friction is that at the speed at which the recordings determine it best; Coulomb friction that
    of a joint that begins to move, viscous friction what it gains up to that speed. Gravity load
    and torque scale are the projections of gravity torques over postures, and of torques of motions
    without friction, on those of the reference.
    """
    friction = friction_weights(model, FRICTION_SPEEDS)
    at_rest = friction_weights(model, np.zeros(1))[0]
    gravity, motion = _rigid_weights(model, reference)
    loads = np.array([float(np.sqrt(weights @ reference)) for weights in gravity.values()])
    for j, (joint, turns) in enumerate(zip(model.joint_names, model.chain.revolute, strict=True)):
        unit, per_speed = ("N·m", "N·m·s/rad") if turns else ("N", "N·s/m")
        if friction[:, j].any():
            best = _best_speed(fits, friction[:, j])
            speed = float(FRICTION_SPEEDS[best])
            weights = friction[best, j]
            yield TrackedQuantity(FollowedQuantity(joint, "friction", unit, speed), j, weights)
            if at_rest[j].any():
                yield TrackedQuantity(FollowedQuantity(joint, "coulomb", unit), j, at_rest[j])
            slope = (weights - at_rest[j]) / speed
            if slope.any():
                viscous = FollowedQuantity(joint, "viscous", per_speed)
                yield TrackedQuantity(viscous, j, slope)
        if loads[j] > _MIN_GRAVITY_SHARE * loads.max():
            weights = gravity[j] / loads[j]
            yield TrackedQuantity(FollowedQuantity(joint, "gravity load", unit), j, weights)
        size = float(motion[j] @ reference)
        if size > 0.0:
            scale = FollowedQuantity(joint, "torque scale", "1")
            yield TrackedQuantity(scale, j, motion[j] / size)
        yield TrackedQuantity(FollowedQuantity(joint, "reference error", unit), j, np.empty(0))


def mean_parameters(fits: Sequence[Estimate]) -> Array:
    """Return the mean parameters of estimates (p,), each where it is determined."""
    values = np.array([fit.values for fit in fits])
    stds = np.array([fit.std for fit in fits])
    usable = np.isfinite(stds) & (stds > 0.0)
    weights = np.where(usable, 1.0 / np.maximum(stds, 1e-300) ** 2, 0.0)
    total = weights.sum(axis=0)
    return np.asarray((weights * values).sum(axis=0) / np.where(total > 0.0, total, 1.0))


def _best_speed(fits: Sequence[Estimate], weights: Array) -> int:
    """Return the speed at which friction is largest relative to its standard deviation."""
    step = max(1, len(fits) // _SAMPLED_RECORDINGS)
    ratios = []
    for fit in fits[::step]:
        value, variance = projected(fit, weights)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios.append(np.nan_to_num(np.abs(value) / np.sqrt(variance)))
    return int(np.argmax(np.median(ratios, axis=0)))


def _rigid_weights(
    model: RobotModel, reference: Array
) -> tuple[dict[int, Array], dict[int, Array]]:
    """Return by joint weights (p,) whose product with the reference is the mean square torque.

    Of gravity over postures, and of motions, both without friction.
    """
    random = np.random.default_rng(0)
    n = model.n_joints
    position = random.uniform(-np.pi, np.pi, (_RANDOM_STATES, n))
    velocity = _RMS_SPEED * random.standard_normal((_RANDOM_STATES, n))
    acceleration = _RMS_ACCELERATION * random.standard_normal((_RANDOM_STATES, n))
    rank = model.base.rank
    frictional = slice(rank, rank + len(model.friction.terms))
    weights = []
    for motion in (
        Motion.at_rest(position),
        Motion.of_states(position, velocity, acceleration),
    ):
        rows = model.regressor(motion).dense(model.n_parameters)
        rows[:, :, frictional] = 0.0
        torque = rows @ reference
        means = np.einsum("mjp,mj->jp", rows, torque) / _RANDOM_STATES
        weights.append(dict(enumerate(means)))
    return weights[0], weights[1]
