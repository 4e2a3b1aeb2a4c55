"""How well a model predicts torque on motion it was not fitted to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.model import RobotModel
from identification.preprocessing import Samples
from identification.smoothing_spline import low_pass

Array = NDArray[np.float64]

FRICTION_CHANGE: Final = 0.10
FIGURE_BANDWIDTH: Final = 30.0  # Hz, the paper's Fig. 4


@dataclass(frozen=True, eq=False)
class PredictionError:
    """Sums over the rows of a prediction error e = measured - predicted, per joint (n,).

    Kept as sums, so that runs add up: the error over all runs is the sum of theirs.

    Attributes:
        rows: rows that counted.
        absolute: sum of |e|.
        signed: sum of e.
        squared: sum of e².
        torque_squared: sum of measured torque².
    """

    rows: NDArray[np.intp]
    absolute: Array
    signed: Array
    squared: Array
    torque_squared: Array

    @classmethod
    def between(
        cls, measured: Array, predicted: Array, usable: NDArray[np.bool_] | None = None
    ) -> PredictionError:
        """Error of predicted (m, n) against measured torque (m, n), over usable rows (m, n)."""
        if measured.shape != predicted.shape:
            raise ShapeError("predicted", predicted.shape, f"{measured.shape}, as measured")
        counts = np.ones(measured.shape, dtype=np.bool_) if usable is None else usable
        error = np.where(counts, measured - predicted, 0.0)
        return cls(
            rows=np.count_nonzero(counts, axis=0),
            absolute=np.abs(error).sum(axis=0),
            signed=error.sum(axis=0),
            squared=(error**2).sum(axis=0),
            torque_squared=(np.where(counts, measured, 0.0) ** 2).sum(axis=0),
        )

    def __add__(self, other: PredictionError) -> PredictionError:
        """Error over both sets of rows."""
        return PredictionError(
            self.rows + other.rows,
            self.absolute + other.absolute,
            self.signed + other.signed,
            self.squared + other.squared,
            self.torque_squared + other.torque_squared,
        )

    @property
    def mean_absolute(self) -> Array:
        """Mean |e| (n,) [N·m or N], the paper's Fig. 3."""
        return self.absolute / np.maximum(self.rows, 1)

    @property
    def mean(self) -> Array:
        """Mean e (n,) [N·m or N]: what the prediction is off by on average."""
        return self.signed / np.maximum(self.rows, 1)

    @property
    def rms(self) -> Array:
        """Root mean square of e (n,) [N·m or N]."""
        return np.sqrt(self.squared / np.maximum(self.rows, 1))

    @property
    def torque_rms(self) -> Array:
        """Root mean square of the measured torque (n,) [N·m or N]."""
        return np.sqrt(self.torque_squared / np.maximum(self.rows, 1))

    @property
    def relative(self) -> Array:
        """||e|| / ||tau|| of each joint (n,); NaN where a joint has no row: not tested."""
        tiny = np.finfo(np.float64).tiny
        share = np.sqrt(self.squared / np.maximum(self.torque_squared, tiny))
        return np.where(self.rows > 0, share, np.nan)

    @property
    def overall(self) -> float:
        """||e|| / ||tau|| over all joints stacked: the relative torque error."""
        return float(np.sqrt(self.squared.sum() / max(self.torque_squared.sum(), 1e-300)))


def residual(
    model: RobotModel, values: Array, samples: Samples, bandwidth: float | None = None
) -> Array:
    """Torque measured less predicted (m, n), zero where a row is not usable.

    Args:
        model: the robot.
        values: parameters (p,).
        samples: one recording.
        bandwidth: of a zero-phase low-pass on the result [Hz]; None for none.
    """
    return _usable_part(
        samples, samples.torque - samples.predicted_torque(model, values), bandwidth
    )


def _usable_part(samples: Samples, torque: Array, bandwidth: float | None) -> Array:
    """Torque (m, n) with zero for the rows that are not usable, then low-passed."""
    torque = np.where(samples.usable, torque, 0.0)
    if bandwidth is None:
        return torque
    slow = np.zeros_like(torque)
    for segment in samples.segments:
        if samples.usable[segment].any():
            slow[segment] = low_pass(samples.motion.time[segment], torque[segment], bandwidth)
    return slow


class SlowError(NamedTuple):
    """Slow error of a prediction, and what a change of friction explains of it.

    Attributes:
        error: what is left.
        friction_change: share by which each joint's friction torque would have to be larger than
            predicted (n,), within `FRICTION_CHANGE`.
    """

    error: PredictionError
    friction_change: Array


def slow_error(model: RobotModel, values: Array, samples: Samples, bandwidth: float) -> SlowError:
    """Low-passed error of a prediction, apart from a change of friction since the fit.

    Friction follows the temperature of the gears: between training and validation it may differ
    by some per cent without anything being wrong with the model. Each joint's whole friction
    torque may therefore be scaled, by one number, before the error is taken.

    Args:
        model: the robot.
        values: parameters (p,).
        samples: one run.
        bandwidth: of the low-pass [Hz].
    """
    error = residual(model, values, samples, bandwidth)
    is_friction = [name.startswith(("f0_", "f1_", "f2_")) for name in model.parameter_names]
    friction = samples.predicted_torque(model, np.where(is_friction, values, 0.0))
    friction = _usable_part(samples, friction, bandwidth)
    usable = samples.usable
    power = (friction**2 * usable).sum(axis=0)
    change = (friction * error * usable).sum(axis=0) / np.where(power > 0.0, power, 1.0)
    change = np.clip(change, -FRICTION_CHANGE, FRICTION_CHANGE)
    left = error - change * friction
    return SlowError(PredictionError.between(samples.torque, samples.torque - left, usable), change)


def prediction_error(
    model: RobotModel,
    values: Array,
    runs: Iterable[Samples],
    *,
    bandwidth: float | None = None,
    all_rows: bool = False,
) -> tuple[PredictionError, ...]:
    """Prediction error of parameters (p,) on each of several runs.

    Args:
        model: the robot.
        values: parameters (p,).
        runs: motions that were not used to estimate the values, if the error is to mean much.
        bandwidth: of a low-pass on the error [Hz], but not on the torque it is related to.
        all_rows: count rows at standstill and near ends as well, where no model of sliding
            friction can be right; without `bandwidth` only.
    """
    if all_rows:
        return tuple(
            PredictionError.between(run.torque, run.predicted_torque(model, values)) for run in runs
        )
    return tuple(
        PredictionError.between(
            run.torque, run.torque - residual(model, values, run, bandwidth), run.usable
        )
        for run in runs
    )


def over_all(runs: Iterable[PredictionError]) -> PredictionError:
    """Error over all runs together.

    Raises:
        IdentificationError: no runs.
    """
    errors = list(runs)
    if not errors:
        raise IdentificationError("there is no run to validate on")
    total = errors[0]
    for error in errors[1:]:
        total = total + error
    return total


def for_figure(time: Array, torque: Array, bandwidth: float = FIGURE_BANDWIDTH) -> Array:
    """Torque (m, n) through a zero-phase low-pass, as the paper draws it (Fig. 4)."""
    return low_pass(time, torque, bandwidth)
