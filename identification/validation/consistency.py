"""What physical consistency costs: the torque error, and the parameters that prevent it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, root_mean_square
from identification.distributions import SIGNIFICANT_SIGMAS
from identification.estimators.consistent import ConsistentEstimate, consistent_estimate
from identification.estimators.prior import BodyPrior
from identification.factor.estimate import Estimate
from identification.factor.factor import Factor
from identification.hypotheses.little_torque import little_torque
from identification.model.motion import Motion
from identification.model.pseudo_inertia import pseudo_inertia, reference_bodies
from identification.model.robot import RobotModel

# Smallest second moment of a link relative to the nominal body's at which a bound counts as active.
_MIN_MOMENT_RATIO: Final = 0.01
# Rise of the relative held-out torque error over all joints, and of one joint, that is noticeable,
# or means that no consistent parameters exist. NS 16 campaigns without a fault: below 0.0001 over
# all joints. With torque or position of one joint negated: at least 0.13 for joints 1 and 2; for
# wrist joints 0.004 to 0.02, but more than 0.5 of their own torque.
_COSTLY_ERROR_RISE: Final = (0.001, 0.005)
_IMPOSSIBLE_ERROR_RISE: Final = (0.02, 0.1)
Quantity = Literal["rotor inertia", "Coulomb friction", "viscous friction", "body"]

_NEGATIVE: Final[Mapping[str, Quantity]] = {
    "I{}m": "rotor inertia",
    "f0_{}": "Coulomb friction",
    "f1_{}": "viscous friction",
}
# Least torque of gravity, over the measured one, of an axis that gravity loads; below, friction and
# inertia dominate.
_MIN_GRAVITY_SHARE: Final = 0.2
_POSTURES: Final = 50


@dataclass(frozen=True)
class ImpossibleParameter:
    """A parameter of the unconstrained estimate that no body or drive can have.

    Attributes:
        quantity: what is negative; a mass or a moment of inertia of a "body".
        joint: whose link or drive it is.
        value: of the parameter [SI]; None for a body.
    """

    quantity: Quantity
    joint: str
    value: float | None = None


@dataclass(frozen=True, eq=False)
class ConsistencyCheck:
    """Consistent estimate compared with the unconstrained one on held-out motion."""

    consistent: ConsistentEstimate
    held_out: float  # relative torque error on held-out motion
    unconstrained_held_out: float  # error of the unconstrained estimate
    held_out_rise: Array  # rise per joint (n,), NaN without rows or with little torque
    # smallest second moment of each link over the nominal body's in the same direction (n,), zero
    # at the bound
    margin: Array
    shifted_parameters: tuple[str, ...]  # changed by more than three standard deviations
    # impossible parameters of the unconstrained estimate, by rise of the joint's error
    violations: tuple[ImpossibleParameter, ...]
    judged_on: str = "held-out"  # "held-out" or "in-sample"
    # the joint that gravity loads, if the rise of the error is mostly its own; else empty
    overloaded: str = ""

    @property
    def cost(self) -> float:
        """Rise of the relative torque error on held-out motion, over all joints."""
        return self.held_out - self.unconstrained_held_out

    @property
    def costly(self) -> bool:
        """Whether the consistent estimate predicts noticeably worse."""
        return self._beyond(*_COSTLY_ERROR_RISE)

    @property
    def impossible(self) -> bool:
        """Whether no consistent estimate predicts the held-out motion well."""
        return self._beyond(*_IMPOSSIBLE_ERROR_RISE)

    def _beyond(self, overall: float, axis: float) -> bool:
        worse_axis = self.cost > 0.0 and bool(np.any(self.held_out_rise > axis))
        return self.cost > overall or worse_axis

    @property
    def predicts_better(self) -> bool:
        """Whether the consistent estimate predicts noticeably better."""
        return self.cost < -_COSTLY_ERROR_RISE[0]

    @property
    def is_balanced(self) -> bool:
        """Whether one joint bears a weight that no body explains, as with a spring or balancer."""
        return bool(self.overloaded) and self.costly


def check_consistency(
    model: RobotModel,
    training: Factor,
    held_out: Factor,
    unconstrained: Estimate,
    *,
    weights: Array | None = None,
    prior: BodyPrior | None = None,
    design_effect: float = 1.0,
    in_sample: bool = False,
) -> ConsistencyCheck:
    """Compare the physically consistent estimate with an unconstrained one.

    Args:
        model: of the arm.
        training: factor of the fitted motion.
        held_out: factor of unseen motion.
        unconstrained: estimate from the training.
        weights: of the joints (n,); by default the inverse residual variances of an ordinary fit.
        prior: as for :func:`identification.estimators.consistent.consistent_estimate`.
        design_effect: likewise.
        in_sample: whether the held-out motion is the training.

    Raises:
        IdentificationError: see :func:`identification.estimators.consistent.consistent_estimate`.
    """
    consistent = consistent_estimate(
        model, training, unconstrained, weights=weights, prior=prior, design_effect=design_effect
    )
    values = consistent.estimate.values
    free = unconstrained.values
    shift = np.abs(consistent.shift)
    links = model.layout.links
    rise = _rise(held_out, values, free)
    torque = np.sqrt(held_out.gram[:, -1, -1] / np.maximum(held_out.samples, 1))
    rise[little_torque(torque, ~model.chain.revolute)] = np.nan
    # In axes in which the reference's pseudo-inertia is the unit matrix.
    frames = reference_bodies(model.nominal[links], model.chain.translation).frames
    inner = np.linalg.solve(frames, pseudo_inertia(consistent.standard[links]))
    inner = np.linalg.solve(frames, inner.transpose(0, 2, 1))
    margin = np.asarray(np.linalg.eigvalsh(inner)[:, 0])
    violations: list[ImpossibleParameter] = []
    single = np.count_nonzero(model.base.grouping, axis=1) == 1
    for joint in np.argsort(-np.nan_to_num(rise), kind="stable").tolist():
        name = model.joint_names[joint]
        for pattern, quantity in _NEGATIVE.items():
            if (parameter := pattern.format(joint + 1)) in unconstrained.names:
                k = unconstrained.names.index(parameter)
                alone = k >= model.base.rank or bool(single[k])
                if alone and free[k] < -SIGNIFICANT_SIGMAS * unconstrained.std[k]:
                    violations.append(ImpossibleParameter(quantity, name, float(free[k])))
        if margin[joint] < _MIN_MOMENT_RATIO:
            violations.append(ImpossibleParameter("body", name))
    return ConsistencyCheck(
        consistent=consistent,
        held_out=held_out.relative_error(values),
        unconstrained_held_out=held_out.relative_error(free),
        held_out_rise=rise,
        margin=margin,
        shifted_parameters=tuple(
            unconstrained.names[k]
            for k in np.argsort(-shift, kind="stable")
            if shift[k] > SIGNIFICANT_SIGMAS
        ),
        violations=tuple(violations),
        judged_on="in-sample" if in_sample else "held-out",
        overloaded=_overloaded(model, training, held_out, values, free),
    )


def _rise(held_out: Factor, values: Array, free: Array) -> Array:
    """Return by how much the error of each joint rises (n,), NaN where the torque is zero."""
    errors = held_out.relative_errors(values), held_out.relative_errors(free)
    known = np.asarray(np.isfinite(errors).all(axis=0))
    return np.asarray(np.subtract(*errors, out=np.full(len(known), np.nan), where=known))


def _overloaded(
    model: RobotModel, training: Factor, held_out: Factor, values: Array, free: Array
) -> str:
    """Return the joint under gravity with most of the increase of the squared error."""
    rise = np.maximum(held_out.squared_errors(values) - held_out.squared_errors(free), 0.0)
    joint = int(rise.argmax())
    alone = rise[joint] > 0.5 * rise.sum() and _gravity_loaded(model, training, free)[joint]
    return model.joint_names[joint] if alone else ""


def _gravity_loaded(model: RobotModel, motion: Factor, values: Array) -> NDArray[np.bool_]:
    """Return the joints (n,) whose torque is largely weight, by parameters (p,)."""
    rng = np.random.default_rng(0)
    position = rng.uniform(-1.0, 1.0, (_POSTURES, model.n_joints))
    rigid = np.where(model.friction_columns, 0.0, values)
    weight = model.torque(rigid, Motion.at_rest(position))
    measured = np.sqrt(motion.gram[:, -1, -1] / np.maximum(motion.samples, 1))
    return np.asarray(root_mean_square(weight) > _MIN_GRAVITY_SHARE * measured)
