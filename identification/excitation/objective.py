"""What a motion is to be good at: which parameters it excites, and what is known already."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from identification.excitation.constraints import SAMPLE_PERIOD, midpoints
from identification.excitation.criteria import Criteria, measures
from identification.model.motion import Motion
from identification.model.regressor import joint_arrays
from identification.model.robot import RobotModel
from planner import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Objective:
    """Judges motions by the information on a model's parameters.

    The paper's criteria are those of all parameters, unweighted (section 3.1) and without
    anything known before: information per sample, so that motions of any length compare
    (section 3.2). For a sequential design the information of earlier archives is added to that
    of the new motion, which then does best where the earlier ones said least. It is the
    information of both together and not per second: what is known already is spent, so N is
    theirs alone, and a motion that says more about everything never counts for less. Its
    duration is bounded by the constraints instead. As a fit leaves out what stands
    (:meth:`RobotModel.moving`), so do the rows of a motion beside `earlier`.
    """

    model: RobotModel  #: the robot, with p parameters
    #: indices of the essential ones (e,): the others are assumed to be zero, so that their
    #: columns are left out. None for all
    parameters: NDArray[np.intp] | None = None
    #: 1 / variance of each joint's torque (n,). None leaves joints unweighted
    joint_weights: Array | None = None
    #: Gram matrix (p, p) of earlier archives, all parameters, weighted alike, and as if sampled
    #: every SAMPLE_PERIOD: one of 1 kHz is to be divided by 8. A second of the new motion counts
    #: like one of theirs, however densely it is sampled
    earlier: Array | None = None
    earlier_samples: int = 0  #: N, the time samples in it, at the same rate
    #: how often the new motion is going to be run. It matters beside `earlier` only: repeating
    #: everything changes neither criterion (section 3.2)
    repetitions: int = 1

    @property
    def n_parameters(self) -> int:
        """Number e of parameters that are judged: the p of the coupling index's maximum."""
        return self.model.n_parameters if self.parameters is None else len(self.parameters)

    def information(self, motion: Motion) -> Array:
        """Return the information (e, e) of a motion, uniform in time, earlier archives included.

        Raises:
            ShapeError: an array does not have the shape it should have.
        """
        total = self._gram(motion)
        if self.earlier is not None:
            total *= self.repetitions * _step(motion) / SAMPLE_PERIOD
            total += self.earlier
        return total if self.parameters is None else total[np.ix_(self.parameters, self.parameters)]

    def n_samples(self, motion: Motion) -> int:
        """Return N of the criteria: the motion's own samples, or those of the earlier archives."""
        return motion.n_samples if self.earlier is None else self.earlier_samples

    def measures(self, motion: Motion) -> dict[str, float]:
        """Return `CRITERIA` of a sampled motion (see :meth:`information`), by name."""
        return measures(self.information(motion), self.n_samples(motion))

    def criteria(self, trajectory: Trajectory, period: float) -> Criteria:
        """Return all criteria of a planned motion, sampled every `period` [s]."""
        motion = midpoints(trajectory, period)
        return Criteria.of_gram(self.information(motion), self.n_samples(motion))

    def _gram(self, motion: Motion) -> Array:
        """Return the weighted Gram matrix (p, p) of the motion alone."""
        model = self.model
        states = joint_arrays(
            model.n_joints,
            position=motion.position,
            velocity=motion.velocity,
            acceleration=motion.acceleration,
        )
        still = None if self.earlier is None else ~model.moving(states[1])
        sums = [np.zeros((len(used), len(used))) for used in model.plan.columns]
        for part, rows in model.plan.chunks(*states):
            for joint, block in enumerate(rows):
                if still is not None:
                    np.copyto(block, 0.0, where=still[part, joint])
                sums[joint] += block @ block.T
        total = np.zeros((model.n_parameters, model.n_parameters))
        weights = np.ones(model.n_joints) if self.joint_weights is None else self.joint_weights
        for weight, place, own in zip(weights, self._places, sums, strict=True):
            total[place] += weight * own
        return total

    @cached_property
    def _places(self) -> list[tuple[NDArray[np.intp], ...]]:
        """Where each joint's columns stand in the Gram matrix."""
        return [np.ix_(used, used) for used in self.model.plan.columns]


def _step(motion: Motion) -> float:
    """Return the time between samples that are uniform in time [s]."""
    steps = max(1, motion.n_samples - 1)
    return float(motion.time[-1] - motion.time[0]) / steps or SAMPLE_PERIOD
