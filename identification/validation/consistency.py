"""What physical consistency costs an estimate, and what of the machine stands in its way.

Where the data leave parameters open, the nearest possible machine fits them as well. Where it
predicts worse, the bound that stops it names what the data ask for in vain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.estimators.consistent import ConsistentEstimate, consistent_estimate
from identification.factor.factor import Estimate, Factor
from identification.model.pseudo_inertia import pseudo_inertia, reference_bodies
from identification.model.robot import RobotModel
from identification.validation.finding import joined

Array = NDArray[np.float64]

# Smallest second moment of a link, against the nominal body's, at which it counts as at the edge
# of what is possible: the data push a hundred times harder than the prior of one row.
_EDGE: Final = 0.01
# Standard deviations by which a parameter must have been moved for that to be no chance.
_MOVED: Final = 3.0
_SHOWN_BOUNDS: Final = 4
# Rise of the held-out torque error over all joints, as a fraction of the torque, and of one joint,
# as a fraction of its own, above which consistency costs something; and above which no machine has
# such parameters. Simulated NS 16 campaigns without a fault: below 0.0001 over all joints. With the
# torque or the position of one joint turned: 0.13 and more over all joints for joints 1 and 2, on
# a wrist joint 0.004 to 0.02 over all, but more than 0.5 of that joint's own torque.
_COSTLY: Final = (0.001, 0.005)
_IMPOSSIBLE: Final = (0.02, 0.1)
_NEGATIVE: Final = {
    "I{}m": "rotor inertia",
    "f0_{}": "Coulomb friction",
    "f1_{}": "viscous friction",
}


@dataclass(frozen=True, eq=False)
class ConsistencyCheck:
    """A consistent estimate beside the unconstrained one, on motion that neither was fitted to."""

    consistent: ConsistentEstimate  # the estimate
    held_out: float  # its relative torque error on held-out motion
    unconstrained_held_out: float  # that of the estimate without inequalities
    held_out_rise: Array  # rise of the relative error of each joint (n,), NaN for one without rows
    # smallest second moment of each link over the nominal body's in the same direction (n,): 1
    # where it is the nominal body, 0 at the edge of what is possible
    room: Array
    # names of the parameters that were moved by more than three standard deviations
    moved: tuple[str, ...]
    # what the unconstrained estimate asks for and no machine has, in words, that of the joint
    # with the largest rise first
    bounds: tuple[str, ...]
    judged_on: str = "held-out"  # "held-out", or "in-sample" where that motion was fitted after all

    @property
    def cost(self) -> float:
        """Rise of the relative torque error on held-out motion, over all joints."""
        return self.held_out - self.unconstrained_held_out

    @property
    def costly(self) -> bool:
        """Whether the possible machine predicts noticeably worse."""
        return self._beyond(*_COSTLY)

    @property
    def impossible(self) -> bool:
        """Whether no machine predicts the held-out motion about as well as the estimate does."""
        return self._beyond(*_IMPOSSIBLE)

    def _beyond(self, overall: float, axis: float) -> bool:
        worse_axis = self.cost > 0.0 and bool(np.any(self.held_out_rise > axis))
        return self.cost > overall or worse_axis

    @property
    def sentence(self) -> str:
        """What was found, in words."""
        points = round(100.0 * self.cost, 2) + 0.0
        error = f"{self.judged_on} torque error {points:+.2f} points"
        if not self.costly:
            better = self.cost < -_COSTLY[0]
            return f"a possible machine predicts {'better' if better else 'as well'} ({error})"
        start = (
            "no machine fits these parameters"
            if self.impossible
            else "the parameters are not those of a possible machine, and the nearest one predicts"
            " worse"
        )
        return f"{start} ({error}): {joined(self.bounds, _SHOWN_BOUNDS)}".removesuffix(": ")


def check_consistency(
    model: RobotModel,
    training: Factor,
    held_out: Factor,
    unconstrained: Estimate,
    *,
    weights: Array | None = None,
) -> ConsistencyCheck:
    """Find the physically consistent estimate and what it costs beside an unconstrained one.

    Weights (n,) are by default the inverse residual variances of an ordinary fit.

    Raises:
        IdentificationError: see
            :func:`identification.estimators.consistent.consistent_estimate`.
    """
    found = consistent_estimate(model, training, unconstrained, weights=weights)
    ours, free = found.estimate.values, unconstrained.values
    shift, links = np.abs(found.shift), model.layout.links
    rise = held_out.relative_errors(ours) - held_out.relative_errors(free)
    # In axes in which the pseudo-inertia of the reference is the unit matrix.
    frames = reference_bodies(model.nominal[links], model.chain.translation).frames
    inner = np.linalg.solve(frames, pseudo_inertia(found.standard[links]))
    inner = np.linalg.solve(frames, inner.transpose(0, 2, 1))
    room = np.asarray(np.linalg.eigvalsh(inner)[:, 0])
    bounds: list[str] = []
    single = np.count_nonzero(model.base.grouping, axis=1) == 1
    for joint in np.argsort(-np.nan_to_num(rise), kind="stable").tolist():
        name = model.joint_names[joint]
        for pattern, what in _NEGATIVE.items():
            if (parameter := pattern.format(joint + 1)) in unconstrained.names:
                k = unconstrained.names.index(parameter)
                alone = k >= model.base.rank or bool(single[k])
                if alone and free[k] < -_MOVED * unconstrained.std[k]:
                    bounds.append(f"{what} of {name} would be negative ({free[k]:.3g})")
        if room[joint] < _EDGE:
            bounds.append(f"the link of {name} would need a negative mass or moment of inertia")
    return ConsistencyCheck(
        consistent=found,
        held_out=held_out.relative_error(ours),
        unconstrained_held_out=held_out.relative_error(free),
        held_out_rise=rise,
        room=room,
        moved=tuple(
            unconstrained.names[k] for k in np.argsort(-shift, kind="stable") if shift[k] > _MOVED
        ),
        bounds=tuple(bounds),
    )
