"""Parts of the fitted recordings, each predicted from the others, and the errors of that.

Each recording is cut into `FOLDS` segments. Parameters are estimated from all segments but one and
predict all rows of that one, including rest. An error is ``||e|| / ||tau||`` over all joints,
geometric mean over the segments, so that no hard one decides alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.factor.blocks import add_grams, count_by_block, equal_runs
from identification.factor.factor import Factor
from identification.factor.rows import augmented_rows
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Rows = NDArray[np.bool_]

FOLDS: Final = 10


@dataclass(frozen=True, eq=False)
class Errors:
    """Prediction errors of the segments."""

    squares: Array  # of the errors of each segment and joint (FOLDS, n); infinite if not predicted
    torque: Array  # squares of the torque (FOLDS, n)

    @property
    def segments(self) -> Array:
        """``||e|| / ||tau||`` over all joints of each segment with torque (k,)."""
        loaded = self.torque.sum(axis=1) > 0.0
        return _relative(self.squares.sum(axis=1)[loaded], self.torque.sum(axis=1)[loaded])

    def segments_of(self, joint: int) -> Array:
        """``||e|| / ||tau||`` of a joint in each segment in which it has torque (k,)."""
        loaded = self.torque[:, joint] > 0.0
        return _relative(self.squares[loaded, joint], self.torque[loaded, joint])

    @property
    def joints(self) -> Array:
        """Geometric mean over the joints of their relative error in each segment (k,)."""
        both = self.torque > 0.0
        ratio = _relative(self.squares, np.where(both, self.torque, 1.0))
        count = np.maximum(both.sum(axis=1), 1)
        means = np.exp(np.where(both, np.log(ratio), 0.0).sum(axis=1) / count)
        return np.asarray(means[both.any(axis=1)])

    @property
    def overall(self) -> float:
        """Geometric mean of the segments' errors, infinite if a segment is not predicted."""
        return mean_error(self.segments)


def mean_error(errors: Array) -> float:
    """Return the geometric mean of errors (k,), NaN of none."""
    return float(np.exp(np.mean(np.log(errors)))) if errors.size else math.nan


def _relative(squares: Array, torque: Array) -> Array:
    """Return relative errors of sums of squares with torque, above zero."""
    return np.sqrt(np.maximum(squares / torque, np.finfo(np.float64).tiny))


@dataclass(frozen=True, eq=False)
class Folds:
    """Factors by segment."""

    fitted: Factor  # of usable rows, a block for each segment
    predicted: Factor  # of all rows

    @classmethod
    def of(
        cls, model: RobotModel, recordings: Iterable[Samples], fast: Array | None = None
    ) -> Folds:
        """Reduce recordings, each cut into `FOLDS` segments of equal length.

        With speeds `fast` (n,), slower rows are fitted and faster ones are predicted.
        """
        fitted = Factor.zero(model, FOLDS)
        beside = Factor.zero(model, FOLDS)
        for samples in recordings:
            usable = samples.usable
            others = ~samples.usable
            if fast is not None:
                others = np.abs(samples.motion.velocity) > fast
                usable = usable & ~others
            edges = np.linspace(0, len(usable), FOLDS + 1).round().astype(int)
            index = np.repeat(np.arange(FOLDS), np.diff(edges))
            fitted.counts[:] += count_by_block(index, usable)
            beside.counts[:] += count_by_block(index, others)
            for part, rows in augmented_rows(model, replace(samples, usable=usable | others)):
                for joint, table in enumerate(rows):
                    # The fewer rows are those that are not fitted.
                    some = np.flatnonzero(others[part, joint])
                    add_grams(beside.matrices[joint], table[:, some], equal_runs(index[part][some]))
                    table[:, ~usable[part, joint]] = 0.0
                fitted.add_rows(index[part], rows)
        return cls(fitted, fitted + beside if fast is None else beside)

    def without(self, k: int) -> Factor:
        """Return the factor of all segments but k."""
        return self.fitted.without(slice(k, k + 1))

    @property
    def separable(self) -> bool:
        """Whether rows are fitted without any one of the segments."""
        others = self.fitted.samples - self.fitted.counts
        return bool(others.any(axis=1).all())

    def errors(self, estimate: Callable[[Factor], Array], targets: Factor) -> Errors:
        """Return errors of ``estimate(factor without a segment)`` on its part of the targets."""
        values = np.array([estimate(self.without(k)) for k in range(FOLDS)])
        torque = np.array([table[:, -1, -1] for table in targets.matrices]).T
        return Errors(targets.squared_errors_by_block(values), torque)


PredictedRows = Literal["all", "fitted", "moving"]
"""Rows that are predicted; moving rows are the sliding ones, whichever are fitted."""
