"""The objective of a search: information on selected parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from identification.excitation.constraints import midpoints
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
    so that motions of different length compare (section 3.2).
    """

    model: RobotModel  #: the robot, with p parameters
    parameters: NDArray[np.intp] | None = None  #: indices (e,) of those in the criteria; None: all

    @property
    def n_parameters(self) -> int:
        """Number e of parameters in the criteria."""
        return self.model.n_parameters if self.parameters is None else len(self.parameters)

    def information(self, motion: Motion) -> Array:
        """Return the information (e, e) of a uniformly sampled motion.

        Raises:
            ShapeError: an array of the motion has the wrong shape.
        """
        total = self._gram(motion)
        return total if self.parameters is None else total[np.ix_(self.parameters, self.parameters)]

    def measures(self, motion: Motion) -> dict[str, float]:
        """Return the `CRITERIA` of a sampled motion by name (see :meth:`information`)."""
        return measures(self.information(motion), motion.n_samples)

    def criteria(self, trajectory: Trajectory, period: float) -> Criteria:
        """Return all criteria of a planned motion, sampled every `period` [s]."""
        motion = midpoints(trajectory, period)
        return Criteria.of_gram(self.information(motion), motion.n_samples)

    def _gram(self, motion: Motion) -> Array:
        """Return the Gram matrix (p, p) of the motion."""
        model = self.model
        states = joint_arrays(
            model.n_joints,
            position=motion.position,
            velocity=motion.velocity,
            acceleration=motion.acceleration,
        )
        sums = [np.zeros((len(used), len(used))) for used in model.plan.columns]
        for _, rows in model.plan.chunks(*states):
            for joint, block in enumerate(rows):
                sums[joint] += block @ block.T
        total = np.zeros((model.n_parameters, model.n_parameters))
        for block_index, gram in zip(self._block_indices, sums, strict=True):
            total[block_index] += gram
        return total

    @cached_property
    def _block_indices(self) -> list[tuple[NDArray[np.intp], ...]]:
        """Index of each joint's block in the Gram matrix."""
        return [np.ix_(used, used) for used in self.model.plan.columns]
