"""What physical consistency costs an estimate, and what of the machine stands in its way.

Least squares may end at parameters that no machine has: a link thinner than nothing, a rotor of
negative inertia. Where the data leave these parameters open, the nearest possible machine fits
them as well, and nothing is wrong. Where they do not, the possible machine predicts worse, and
the bound that stops it names what the data ask for in vain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.estimators.consistent import (
    Consistency,
    ConsistentEstimate,
    consistent_estimate,
    link_parameters,
)
from identification.factor.factor import Estimate, Factor
from identification.model.pseudo_inertia import pseudo_inertia, reference_bodies
from identification.model.robot import RobotModel
from identification.selection.essential import relative_error
from identification.validation.finding import joined

Array = NDArray[np.float64]

# Smallest second moment of a link, against the nominal body's, at which it counts as at the edge
# of what is possible: the data push a hundred times harder than the prior of one row.
_EDGE: Final = 0.01
# Standard deviations by which a parameter must have been moved for that to be no chance.
_MOVED: Final = 3.0
_SHOWN_LINKS: Final = 2


@dataclass(frozen=True)
class ConsistencyRule:
    """Rise of the held-out torque error that consistency may cost.

    Simulated NS 16 campaigns without a fault: below 0.0001 over all joints. With the torque or
    the position of one joint turned: 0.13 and more over all joints for joints 1 and 2, on a
    wrist joint 0.004 to 0.02 over all, but more than 0.5 of that joint's own torque.

    Attributes:
        costly: over all joints, as a fraction of the torque: above it consistency costs something.
        costly_axis: the same of one joint, as a fraction of its torque.
        impossible: over all joints; above it no machine has such parameters.
        impossible_axis: the same of one joint.
    """

    costly: float = 0.001
    costly_axis: float = 0.005
    impossible: float = 0.02
    impossible_axis: float = 0.1


@dataclass(frozen=True, eq=False)
class ConsistencyCheck:
    """A consistent estimate beside the unconstrained one, on motion that neither was fitted to.

    Attributes:
        consistent: the estimate.
        held_out: its relative torque error on held-out motion.
        unconstrained_held_out: that of the estimate without inequalities.
        held_out_rise: rise of the relative error of each joint (n,), NaN for one without rows.
        room: smallest second moment of each link over the nominal body's in the same direction
            (n,): 1 where it is the nominal body, 0 at the edge of what is possible.
        moved: names of the parameters that were moved by more than three standard deviations.
        bounds: what the unconstrained estimate asks for and no machine has, in words, that of the
            joint with the largest rise first.
        joint_names: (n,).
        rule: when consistency counts as costly.
        judged_on: "held-out", or "in-sample" where that motion was fitted after all.
    """

    consistent: ConsistentEstimate
    held_out: float
    unconstrained_held_out: float
    held_out_rise: Array
    room: Array
    moved: tuple[str, ...]
    bounds: tuple[str, ...]
    joint_names: tuple[str, ...]
    rule: ConsistencyRule = ConsistencyRule()
    judged_on: str = "held-out"

    @property
    def cost(self) -> float:
        """Rise of the relative torque error on held-out motion, over all joints."""
        return self.held_out - self.unconstrained_held_out

    @property
    def costly(self) -> bool:
        """Whether the possible machine predicts noticeably worse."""
        return self._beyond(self.rule.costly, self.rule.costly_axis)

    @property
    def impossible(self) -> bool:
        """Whether no machine predicts the held-out motion about as well as the estimate does."""
        return self._beyond(self.rule.impossible, self.rule.impossible_axis)

    @property
    def sentence(self) -> str:
        """What was found, in words."""
        if self.impossible:
            return f"no machine fits these parameters: {self._why}"
        if self.costly:
            return (
                "the parameters are not those of a possible machine, and the nearest one predicts"
                f" worse: {self._why}"
            )
        change = f"{self.judged_on} torque error {_points(self.cost)}"
        if self.cost < -self.rule.costly:
            return f"a possible machine predicts better ({change})"
        if self.moved:
            several = "s" if len(self.moved) > 1 else ""
            return (
                f"a possible machine predicts as well ({change}), although the parameter{several}"
                f" {', '.join(self.moved)} had to move by more than three standard deviations"
            )
        return f"a possible machine predicts as well ({change})"

    @property
    def _why(self) -> str:
        text = f"{self.judged_on} torque error {_points(self.cost)}"
        if np.any(self.held_out_rise > 0.0):
            worst = int(np.nanargmax(self.held_out_rise))
            text += f", {self.joint_names[worst]} {100.0 * self.held_out_rise[worst]:+.1f}"
        return "; ".join([text, *self._asked])

    @property
    def _asked(self) -> list[str]:
        """What no machine has, the links in one sentence, those of the worst joints by name."""
        link_of = {_link_words(name): name for name in self.joint_names}
        links = [link_of[bound] for bound in self.bounds if bound in link_of]
        words = [bound for bound in self.bounds if bound not in link_of]
        if len(links) == 1:
            words.append(_link_words(links[0]))
        elif links:
            words.append(
                f"the links of {joined(links, _SHOWN_LINKS)} would need a negative mass or moment"
                " of inertia"
            )
        return words

    def _beyond(self, overall: float, axis: float) -> bool:
        worse_axis = self.cost > 0.0 and bool(np.any(self.held_out_rise > axis))
        return self.cost > overall or worse_axis


def check_consistency(
    model: RobotModel,
    training: Factor,
    held_out: Factor,
    unconstrained: Estimate,
    *,
    weights: Array | None = None,
    options: Consistency = Consistency(),  # noqa: B008 - frozen
) -> ConsistencyCheck:
    """Find the physically consistent estimate and what it costs.

    Args:
        model: the robot.
        training: the samples that were fitted.
        held_out: samples that were not.
        unconstrained: the estimate to compare with, of the model's parameters.
        weights: per joint (n,); by default the inverse residual variances of an ordinary fit.
        options: prior and bounds.

    Raises:
        IdentificationError: see :func:`identification.estimators.consistent.consistent_estimate`.
    """
    found = consistent_estimate(model, training, unconstrained, weights=weights, options=options)
    shift, names = np.abs(found.shift), unconstrained.names
    room = _room(model, found, options)
    rise = _joint_errors(held_out, found.estimate.values) - _joint_errors(
        held_out, unconstrained.values
    )
    return ConsistencyCheck(
        consistent=found,
        held_out=relative_error(held_out, found.estimate.values),
        unconstrained_held_out=relative_error(held_out, unconstrained.values),
        held_out_rise=rise,
        room=room,
        moved=tuple(names[k] for k in np.argsort(-shift, kind="stable") if shift[k] > _MOVED),
        bounds=_bounds(model, found, room, np.argsort(-np.nan_to_num(rise), kind="stable")),
        joint_names=model.joint_names,
    )


def _joint_errors(factor: Factor, values: Array) -> Array:
    """Relative torque error of each joint (n,), NaN without rows or torque."""
    augmented = np.append(-values, 1.0)
    squares = np.maximum(np.einsum("i,jik,k->j", augmented, factor.gram, augmented), 0.0)
    power = factor.gram[:, -1, -1]
    known = power > 0.0
    return np.where(known, np.sqrt(squares / np.where(known, power, 1.0)), np.nan)


def _room(model: RobotModel, found: ConsistentEstimate, options: Consistency) -> Array:
    """Smallest eigenvalue of each pseudo-inertia in axes in which the reference's is 1 (n,)."""
    nominal = model.nominal if options.nominal is None else np.asarray(options.nominal)
    frames = reference_bodies(link_parameters(model, nominal), model.chain.translation).frames
    matrices = pseudo_inertia(link_parameters(model, found.standard))
    inner = np.linalg.solve(frames, np.linalg.solve(frames, matrices).transpose(0, 2, 1))
    return np.asarray(np.linalg.eigvalsh(inner)[:, 0])


def _bounds(
    model: RobotModel, found: ConsistentEstimate, room: Array, order: NDArray[np.intp]
) -> tuple[str, ...]:
    """What the unconstrained estimate asks for and no machine has, joint after joint."""
    words: list[str] = []
    for joint in order.tolist():
        name = model.joint_names[joint]
        words += [
            f"{what} of {name} would be negative ({value:.3g})"
            for what, value in _negative(model, found, joint + 1)
        ]
        if room[joint] < _EDGE:
            words.append(_link_words(name))
    return tuple(words)


def _link_words(joint: str) -> str:
    return f"the link of {joint} would need a negative mass or moment of inertia"


def _points(change: float) -> str:
    """A change of a relative error; without sign and figure where that rounds to nothing."""
    points = round(100.0 * change, 2)
    return f"{points:+.2f} points" if points else "unchanged"


def _negative(
    model: RobotModel, found: ConsistentEstimate, joint: int
) -> Iterator[tuple[str, float]]:
    """Rotor inertia and friction of a joint that the unconstrained estimate has below zero."""
    free = found.unconstrained
    single = np.count_nonzero(model.base.grouping, axis=1) == 1
    for parameter, what in (
        (f"I{joint}m", "rotor inertia"),
        (f"f0_{joint}", "Coulomb friction"),
        (f"f1_{joint}", "viscous friction"),
    ):
        if parameter not in free.names:
            continue
        k = free.names.index(parameter)
        alone = k >= model.base.rank or bool(single[k])
        if alone and free.values[k] < -_MOVED * free.std[k]:
            yield what, float(free.values[k])
