"""Torque prediction errors of a model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import reduce
from itertools import pairwise
from operator import add
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.model.robot import RobotModel
from identification.signals.noise import noiseless_above
from identification.signals.samples import Samples
from identification.signals.smoothing import low_pass

MAX_FRICTION_CHANGE: Final = 0.10
# Hz. The torque of a rigid arm lies below, torque ripple and current noise above.
SLOW_BANDWIDTH: Final = 10.0
# s, shorter than what lies between two reversals, jumps or spikes
_FLOOR_BLOCK_SECONDS: Final = 0.1
_MIN_FLOOR_ROWS: Final = 10  # of a block, at least
_MIN_FLOOR_BLOCKS: Final = 5  # of which a median says more than a mean
_ROWS_AT_ONCE: Final = 30_000  # of a low-pass
_ROWS_COMPARED: Final = 8192  # at once
FIGURE_BANDWIDTH: Final = 30.0  # Hz, the paper's Fig. 4


@dataclass(frozen=True, eq=False)
class PredictionError:
    """Sums over the rows of an error e = measured - predicted, per joint (n,); they add up."""

    rows: NDArray[np.intp]  #: usable rows
    absolute: Array  #: sum of |e|
    signed: Array  #: sum of e
    squared: Array  #: sum of e²
    torque_sum: Array  #: sum of measured torque
    torque_squared: Array  #: sum of measured torque²

    @classmethod
    def between(
        cls, measured: Array, predicted: Array, usable: NDArray[np.bool_] | None = None
    ) -> PredictionError:
        """Compare predicted with measured torque (m, n) over usable rows (m, n)."""
        total = cls._of_rows(measured[:0], predicted[:0], None)
        # A long recording is never copied whole.
        for start in range(0, len(measured), _ROWS_COMPARED):
            rows = slice(start, start + _ROWS_COMPARED)
            part = None if usable is None else usable[rows]
            total = total + cls._of_rows(measured[rows], predicted[rows], part)
        return total

    @classmethod
    def _of_rows(
        cls, measured: Array, predicted: Array, usable: NDArray[np.bool_] | None
    ) -> PredictionError:
        counts = np.ones(measured.shape, dtype=np.bool_) if usable is None else usable
        error = np.where(counts, measured - predicted, 0.0)
        torque = np.where(counts, measured, 0.0)
        sums = (np.abs(error), error, error**2, torque, torque**2)
        return cls(np.count_nonzero(counts, axis=0), *(terms.sum(axis=0) for terms in sums))

    def __add__(self, other: PredictionError) -> PredictionError:
        """Return the error over both sets of rows."""
        names = [field.name for field in fields(self)]
        return PredictionError(*(getattr(self, name) + getattr(other, name) for name in names))

    @property
    def mean_absolute(self) -> Array:
        """Mean |e| (n,) [N·m or N], the paper's Fig. 3."""
        return self.absolute / np.maximum(self.rows, 1)

    @property
    def mean(self) -> Array:
        """Mean e (n,) [N·m or N]."""
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
        """||e|| / ||tau|| of each joint (n,); NaN for a joint without a row or without torque."""
        loaded = (self.rows > 0) & (self.torque_squared > 0.0)
        share = self.squared / np.where(loaded, self.torque_squared, 1.0)
        return np.where(loaded, np.sqrt(share), np.nan)

    @property
    def explained(self) -> Array:
        """Share of each joint's torque variance that the prediction explains (n,), R²."""
        varies = self.torque_squared - self.torque_sum**2 / np.maximum(self.rows, 1)
        varying = (self.rows > 0) & (varies > 1e-12 * self.torque_squared)
        return np.where(varying, 1.0 - self.squared / np.where(varying, varies, 1.0), np.nan)

    @property
    def overall(self) -> float:
        """||e|| / ||tau|| over all joints stacked; NaN without a row or without torque."""
        torque = float(self.torque_squared.sum())
        return float(np.sqrt(self.squared.sum() / torque)) if torque > 0.0 else float("nan")


def residual(
    model: RobotModel, values: Array, samples: Samples, bandwidth: float | None = None
) -> Array:
    """Return measured minus predicted torque (m, n); 0 in unusable rows.

    Args:
        model: of the arm.
        values: parameters (p,).
        samples: of the recording.
        bandwidth: of a low-pass of the residual [Hz].
    """
    return _usable_part(
        samples, samples.torque - samples.predicted_torque(model, values), bandwidth
    )


def _usable_part(samples: Samples, torque: Array, bandwidth: float | None) -> Array:
    torque = np.where(samples.usable, torque, 0.0)
    if bandwidth is None:
        return torque
    slow = np.zeros_like(torque)
    for segment in samples.segments:
        count = max(1, (segment.stop - segment.start) // _ROWS_AT_ONCE)
        edges = np.linspace(segment.start, segment.stop, count + 1).astype(np.intp).tolist()
        for start, stop in pairwise(edges):
            part = slice(start, stop)
            if samples.usable[part].any():
                slow[part] = low_pass(samples.motion.time[part], torque[part], bandwidth)
    return slow


def driving_residual(model: RobotModel, samples: Samples, values: Array) -> Array:
    """Return measured minus predicted torque (m, n), as far as it would move a joint.

    The dry friction of a joint at rest holds any torque between those of sliding either way, and
    what a fit leaves of it there is no error of joints that move.
    """
    residual = samples.torque - samples.predicted_torque(model, values)
    at_rest = ~model.moving(samples.motion.velocity)
    if not at_rest.any():
        return residual
    ends = [samples.sliding(model, sign).predicted_torque(model, values) for sign in (-1.0, 1.0)]
    held = np.clip(samples.torque, np.minimum(*ends), np.maximum(*ends))
    return np.where(at_rest, samples.torque - held, residual)


def noise_floor(
    model: RobotModel,
    values: Array,
    recordings: Sequence[Samples],
    repeated: Array | None = None,
) -> Array | None:
    """Return the standard deviation of torque noise per joint (n,) [N·m or N], NaN without rows.

    It is that of the residual above `SLOW_BANDWIDTH`, as of white noise, and that between
    repetitions below, if given; None if the torque has no noise because it was filtered. The median
    over short blocks: play, spikes and jumps of some blocks are faults, no noise.

    Args:
        model: of the arm.
        values: parameters (p,).
        recordings: prepared.
        repeated: noise between repetitions (n,).
    """
    first = recordings[0]
    if repeated is None and noiseless_above(first.motion.time, first.torque, first.segments):
        return None
    parts = []
    for samples in recordings:
        fast = residual(model, values, samples) - residual(model, values, samples, SLOW_BANDWIDTH)
        step = float(np.median(np.diff(samples.motion.time)))
        share = max(
            1.0 - 2.0 * step * SLOW_BANDWIDTH, 0.5
        )  # share of white noise above the bandwidth
        length = max(_MIN_FLOOR_ROWS, round(_FLOOR_BLOCK_SECONDS / step))
        edges = np.arange(0, len(fast), length)
        squares = np.add.reduceat(np.where(samples.usable, fast**2, 0.0), edges, axis=0) / share
        parts.append((squares, np.add.reduceat(samples.usable.astype(np.intp), edges, axis=0)))
    white = _usual_mean(*map(np.concatenate, zip(*parts, strict=True)))
    return np.sqrt(white if repeated is None else white + np.nan_to_num(repeated) ** 2)


def _usual_mean(sums: Array, rows: NDArray[np.intp]) -> Array:
    """Return the mean square of a usual block (n,), of sums and rows by block (B, n).

    The median, over that of chi-squared of as many rows (Wilson and Hilferty 1931); of joints with
    few such blocks the mean.
    """
    usual = np.full(rows.shape[1], np.nan)
    for joint, (column, counts) in enumerate(zip(sums.T, rows.T, strict=True)):
        whole = counts >= _MIN_FLOOR_ROWS // 2
        if np.count_nonzero(whole) >= _MIN_FLOOR_BLOCKS:
            median = (1.0 - 2.0 / (9.0 * counts[whole])) ** 3
            usual[joint] = np.median(column[whole] / counts[whole] / median)
        elif counts.any():
            usual[joint] = column.sum() / counts.sum()
    return usual


class SlowError(NamedTuple):
    """Low-frequency error of a prediction, with the part that a change of friction explains."""

    error: PredictionError  # what is left
    friction_change: Array  # relative change of each joint's friction (n,), not limited
    apart: PredictionError  # error without this change


def slow_error(model: RobotModel, values: Array, samples: Samples, bandwidth: float) -> SlowError:
    """Return the error of parameters below a bandwidth, apart from changed friction.

    Friction varies with gear temperature, so the friction torque of each joint may be scaled by one
    factor within `MAX_FRICTION_CHANGE`.

    Args:
        model: of the arm.
        values: parameters (p,).
        samples: of the recording.
        bandwidth: [Hz].
    """
    error = residual(model, values, samples, bandwidth)
    friction = samples.predicted_torque(model, values, model.friction_columns)
    friction = _usable_part(samples, friction, bandwidth)
    usable = samples.usable
    power = (friction**2 * usable).sum(axis=0)
    change = (friction * error * usable).sum(axis=0) / np.where(power > 0.0, power, 1.0)

    def less(share: Array) -> PredictionError:
        remainder = error - share * friction
        return PredictionError.between(samples.torque, samples.torque - remainder, usable)

    forgiven = np.clip(change, -MAX_FRICTION_CHANGE, MAX_FRICTION_CHANGE)
    return SlowError(less(forgiven), change, less(change))


def prediction_error(
    model: RobotModel, values: Array, runs: Iterable[Samples], *, all_rows: bool = False
) -> tuple[PredictionError, ...]:
    """Return the error of parameters on each recording.

    Args:
        model: of the arm.
        values: parameters (p,).
        runs: prepared recordings.
        all_rows: also at standstill.
    """
    return tuple(
        PredictionError.between(
            run.torque, run.predicted_torque(model, values), None if all_rows else run.usable
        )
        for run in runs
    )


def pooled_error(runs: Iterable[PredictionError]) -> PredictionError:
    """Return the error over all recordings together, at least one."""
    return reduce(add, runs)


def for_figure(time: Array, torque: Array) -> Array:
    """Filter torque (m, n) by a zero-phase low-pass, as in the paper (Fig. 4)."""
    return low_pass(time, torque, FIGURE_BANDWIDTH)
