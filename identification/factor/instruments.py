r"""What instrumental variables need of the samples: per joint the Gram matrix of [Z | W | y].

.. math:: G_j = \sum_t \begin{bmatrix} Z_j & W_j & y_j \end{bmatrix}^T
                       \begin{bmatrix} Z_j & W_j & y_j \end{bmatrix}

W is the regressor of the measured motion, whose noise it carries, and Z that of a motion without
measurement noise (:mod:`identification.estimators.instrument_motion`), column by column the same
functions. Sums are stored by short blocks of time (:mod:`identification.estimators.covariance`)
and only over the columns that act on a joint: a third of all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.factor.augmented_rows import augmented_rows
from identification.factor.phases import (
    PhaseFactor,
    add_grams,
    equal_runs,
    fine_blocks,
    samples_by_cell,
)
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class InstrumentFactor:
    """Gram matrices of [Z | W | y] by blocks of time since the motion's origin.

    Repetitions, even of several motions, add up at equal times since their origin.

    Attributes:
        gram: per joint j the sums over B blocks, shape (B, 2 c_j + 1, 2 c_j + 1).
        columns: per joint the parameter index of each of its columns, shape (c_j,).
        samples: rows, shape (B, n).
        parameter_names: (p,).
    """

    gram: tuple[Array, ...]
    columns: tuple[NDArray[np.intp], ...]
    samples: NDArray[np.intp]
    parameter_names: tuple[str, ...]

    @classmethod
    def from_samples(
        cls,
        model: RobotModel,
        samples: Samples,
        instrument: Motion,
        usable: NDArray[np.bool_] | None = None,
    ) -> InstrumentFactor:
        """Reduce a recording.

        Args:
            model: the robot.
            samples: the measured motion and torque.
            instrument: motion without measurement noise, in the rows of the samples.
            usable: where the instrument is known (m, n); everywhere without it. Rows count in
                which the samples are usable and the instrument moves as well: which rows count
                must not depend on the noise.

        Raises:
            ShapeError: the instrument does not have the rows and joints of the samples.
        """
        shape = samples.torque.shape
        if instrument.position.shape != shape:
            raise ShapeError("instrument", instrument.position.shape, str(shape))
        rows = samples.usable & model.moving(instrument.velocity)
        if usable is not None:
            rows &= usable
        index = fine_blocks(samples)
        count = int(index[-1]) + 1 if len(index) else 0
        columns = model.plan.columns
        gram = tuple(np.zeros((count, 2 * len(c) + 1, 2 * len(c) + 1)) for c in columns)
        measured = augmented_rows(model, replace(samples, usable=rows))
        # Of the same rows, and through the same torque channel.
        planned = augmented_rows(model, replace(samples, motion=instrument, usable=rows))
        for (part, blocks), (_, clean) in zip(measured, planned, strict=True):
            runs = equal_runs(index[part])
            for total, noisy, quiet in zip(gram, blocks, clean, strict=True):
                add_grams(total, np.concatenate([quiet[:-1], noisy]), runs)
        return cls(gram, columns, samples_by_cell(index, rows), model.parameter_names)

    @property
    def n_parameters(self) -> int:
        """Number p of parameters."""
        return len(self.parameter_names)

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return len(self.gram)

    def __add__(self, other: InstrumentFactor) -> InstrumentFactor:
        """Blocks of both at equal times since the origin.

        Raises:
            IdentificationError: the two belong to different models.
        """
        if self.parameter_names != other.parameter_names or self.n_joints != other.n_joints:
            raise IdentificationError("factors with different joints or parameters cannot be added")
        count = max(len(self.samples), len(other.samples))
        gram = tuple(
            _longer(a, count) + _longer(b, count)
            for a, b in zip(self.gram, other.gram, strict=True)
        )
        samples = _longer(self.samples, count) + _longer(other.samples, count)
        return InstrumentFactor(gram, self.columns, samples, self.parameter_names)

    def places(self, joint: int) -> NDArray[np.intp]:
        """Where the columns of a joint's Gram stand among all 2 p + 1 of [Z | W | y]."""
        used, p = self.columns[joint], self.n_parameters
        return np.concatenate([used, p + used, [2 * p]])

    def weighted(self, weights: Array) -> Array:
        """Gram matrices of the blocks (B, 2 p + 1, 2 p + 1) with one weight per joint (n,)."""
        width = 2 * self.n_parameters + 1
        total = np.zeros((len(self.samples), width * width))
        for joint, (weight, gram) in enumerate(zip(weights, self.gram, strict=True)):
            place = self.places(joint)
            flat = (place[:, None] * width + place).ravel()
            total[:, flat] += weight * gram.reshape(len(gram), -1)
        return total.reshape(-1, width, width)

    def total(self, weights: Array) -> Array:
        """Gram matrix of all blocks (2 p + 1, 2 p + 1) with one weight per joint (n,)."""
        width = 2 * self.n_parameters + 1
        total = np.zeros((width, width))
        for joint, (weight, gram) in enumerate(zip(weights, self.gram, strict=True)):
            place = self.places(joint)
            total[place[:, None], place] += weight * gram.sum(axis=0)
        return total

    @property
    def measured(self) -> PhaseFactor:
        """The part without instruments, [W | y]: what least squares on the same rows sees."""
        gram = tuple(
            own[:, len(used) :, len(used) :]
            for own, used in zip(self.gram, self.columns, strict=True)
        )
        return PhaseFactor(gram, self.columns, self.samples, self.parameter_names)


def _longer(blocks: NDArray, count: int) -> NDArray:  # type: ignore[type-arg]
    """Blocks (B, ...) with zeros behind, shape (count, ...)."""
    longer = np.zeros((count, *blocks.shape[1:]), dtype=blocks.dtype)
    longer[: len(blocks)] = blocks
    return longer
