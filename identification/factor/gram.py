r"""What a fit needs of the samples: per joint the Gram matrix of [W | y].

.. math:: G_j = \sum_t \begin{bmatrix} W_j & y_j \end{bmatrix}^T
                       \begin{bmatrix} W_j & y_j \end{bmatrix}

Factors add: over chunks, repetitions, archives and machines. Joint weights (eq. 4 with a
diagonal W, one value per joint) are applied afterwards, so no weight needs a second pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.model.motion import Motion
from identification.model.regressor import joint_arrays
from identification.model.robot import RobotModel

Array = NDArray[np.float64]


class NormalEquations(NamedTuple):
    """``A pi = b`` of a weighted least-squares problem.

    Attributes:
        A: sum of the weighted ``W^T W``, shape (p, p).
        b: sum of the weighted ``W^T y``, shape (p,).
        yy: sum of the weighted ``y^T y``.
        n: number of rows (one joint at one instant) in the sums.
    """

    A: Array
    b: Array
    yy: float
    n: int


@dataclass(frozen=True, eq=False)
class Factor:
    """Gram matrices of [W | y], one per joint.

    Attributes:
        gram: shape (n, p + 1, p + 1), symmetric.
        samples: rows summed per joint, shape (n,).
        parameter_names: the p columns of W, shape (p,).
    """

    gram: Array
    samples: NDArray[np.intp]
    parameter_names: tuple[str, ...]

    @classmethod
    def zero(cls, model: RobotModel) -> Factor:
        """Return the factor of no samples: what a sum starts from."""
        n, p = model.n_joints, model.n_parameters
        return cls(np.zeros((n, p + 1, p + 1)), np.zeros(n, dtype=np.intp), model.parameter_names)

    @classmethod
    def from_samples(
        cls,
        model: RobotModel,
        motion: Motion,
        torque: Array,
        mask: NDArray[np.bool_] | None = None,
    ) -> Factor:
        """Reduce m samples.

        Args:
            model: the robot.
            motion: m samples of its joints.
            torque: what W pi should equal [N·m, N], shape (m, n).
            mask: which rows count, shape (m, n); all without it. See :meth:`RobotModel.moving`.

        Raises:
            ShapeError: an array does not have the shape it should have.
        """
        q, qd, qdd, torque = joint_arrays(
            model.n_joints,
            position=motion.position,
            velocity=motion.velocity,
            acceleration=motion.acceleration,
            torque=torque,
        )
        if mask is not None and mask.shape != q.shape:
            raise ShapeError("mask", mask.shape, str(q.shape))
        columns = model.plan.columns
        sums = [np.zeros((len(c) + 1, len(c) + 1)) for c in columns]
        for part, rows in model.plan.chunks(q, qd, qdd, motion.direction, response=torque):
            for joint, block in enumerate(rows):
                if mask is not None:
                    # Assigned, not multiplied: a row left out may hold NaN.
                    block[:, np.flatnonzero(~mask[part, joint])] = 0.0
                sums[joint] += block @ block.T
        factor = cls.zero(model)
        for joint, (total, used) in enumerate(zip(sums, columns, strict=True)):
            index = np.append(used, model.n_parameters)
            factor.gram[joint][np.ix_(index, index)] = total
        factor.samples[:] = len(q) if mask is None else np.count_nonzero(mask, axis=0)
        return factor

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return int(self.gram.shape[0])

    @property
    def n_parameters(self) -> int:
        """Number p of parameters."""
        return int(self.gram.shape[1]) - 1

    def __add__(self, other: Factor) -> Factor:
        """Return the factor of both sets of samples.

        Raises:
            IdentificationError: the two belong to different models.
        """
        if self.gram.shape != other.gram.shape or self.parameter_names != other.parameter_names:
            raise IdentificationError(
                "two factors with different joints or parameters cannot be added: "
                f"{self.n_joints} joints and {self.n_parameters} parameters, "
                f"{other.n_joints} joints and {other.n_parameters} parameters"
            )
        return Factor(self.gram + other.gram, self.samples + other.samples, self.parameter_names)

    def weighted(self, weights: Array) -> NormalEquations:
        """Return the normal equations with one weight per joint, shape (n,): 1/variance."""
        weights = np.asarray(weights, dtype=np.float64)
        if weights.shape != (self.n_joints,):
            raise ShapeError("weights", weights.shape, f"({self.n_joints},)")
        total = np.tensordot(weights, self.gram, axes=1)
        return NormalEquations(
            A=total[:-1, :-1], b=total[:-1, -1], yy=float(total[-1, -1]), n=int(self.samples.sum())
        )
