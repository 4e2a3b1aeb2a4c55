"""The objective of a search: information on selected parameters, with that of earlier archives."""

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
    """Evaluates motions by the information on a model's parameters.

    The paper's criteria use all parameters, no weights (section 3.1) and information per sample,
    so that motions of different length compare (section 3.2). In a sequential design (`earlier`)
    the information of earlier archives is added. N is then theirs, so that more information never
    lowers the criterion, and rows of joints at rest are left out (:meth:`RobotModel.moving`).
    """

    model: RobotModel  #: the robot, with p parameters
    parameters: NDArray[np.intp] | None = None  #: indices (e,) of those in the criteria; None: all
    joint_weights: Array | None = None  #: 1 / variance of each joint's torque (n,); None: equal
    #: Gram matrix (p, p) of earlier archives with the same weights, at one sample per
    #: SAMPLE_PERIOD (divide one of 1 kHz by 8)
    earlier: Array | None = None
    earlier_samples: int = 0  #: N of the earlier archives, at the same rate
    repetitions: int = 1  #: planned runs of the new motion; without effect if `earlier` is None

    @property
    def n_parameters(self) -> int:
        """Number e of parameters in the criteria."""
        return self.model.n_parameters if self.parameters is None else len(self.parameters)

    def information(self, motion: Motion) -> Array:
        """Return the information (e, e) of a uniformly sampled motion and the earlier archives.

        Raises:
            ShapeError: an array of the motion has the wrong shape.
        """
        total = self._gram(motion)
        if self.earlier is not None:
            total *= self.repetitions * _step(motion) / SAMPLE_PERIOD
            total += self.earlier
        return total if self.parameters is None else total[np.ix_(self.parameters, self.parameters)]

    def n_samples(self, motion: Motion) -> int:
        """Return N of the criteria: samples of the motion, or of the earlier archives."""
        return motion.n_samples if self.earlier is None else self.earlier_samples

    def measures(self, motion: Motion) -> dict[str, float]:
        """Return the `CRITERIA` of a sampled motion by name (see :meth:`information`)."""
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
        at_rest = None if self.earlier is None else ~model.moving(states[1])
        sums = [np.zeros((len(used), len(used))) for used in model.plan.columns]
        for part, rows in model.plan.chunks(*states):
            for joint, block in enumerate(rows):
                if at_rest is not None:
                    np.copyto(block, 0.0, where=at_rest[part, joint])
                sums[joint] += block @ block.T
        total = np.zeros((model.n_parameters, model.n_parameters))
        weights = np.ones(model.n_joints) if self.joint_weights is None else self.joint_weights
        for weight, block_index, gram in zip(weights, self._block_indices, sums, strict=True):
            total[block_index] += weight * gram
        return total

    @cached_property
    def _block_indices(self) -> list[tuple[NDArray[np.intp], ...]]:
        """Index of each joint's block in the Gram matrix."""
        return [np.ix_(used, used) for used in self.model.plan.columns]


def _step(motion: Motion) -> float:
    """Return the sample period [s]."""
    steps = max(1, motion.n_samples - 1)
    return float(motion.time[-1] - motion.time[0]) / steps or SAMPLE_PERIOD
