"""Statistical checks of the torque residual: outliers, correlation, patterns and drift.

Means are tested by their scatter over blocks of time (cluster-robust, Liang and Zeger 1986);
repetitions of one motion share blocks, since errors that repeat are not independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.distributions import MAD_TO_STD, student_limit
from identification.estimators.friction_drift import TREND_PIECES, FrictionDrift, friction_trend
from identification.model.robot import RobotModel
from identification.signals.block_mean import BLOCK_SECONDS, BlockMean, block_mean
from identification.signals.samples import Samples
from identification.signals.spectrum import power_density
from identification.validation.prediction import PredictionError
from identification.validation.ripple import Ripple, joint_ripple, motor_ripple

Rows = NDArray[np.bool_]

RESIDUAL_BINS: Final = 12
# probability of a false finding per joint, over all its bins
FALSE_FINDING_PROBABILITY: Final = 0.001
# robust standard deviations; one normal sample in 500 million is beyond six
_OUTLIER_SIGMAS: Final = 6.0
_MOST_JUMPS: Final = 1000  # outliers that are looked at
_MEDIAN_ROWS: Final = 51  # of the running median that spikes and short steps do not move
# Longer than the settling of a move.
MAX_CORRELATION_LAG: Final = 0.5  # s
_MAX_LAGS: Final = 1000
_SPECTRUM_PART_SECONDS: Final = 4.0  # s, parts of a spectrum of the residual


class Profile(NamedTuple):
    """Mean residual of n joints in K bins of their own speed or position."""

    edges: Array  # (n, K + 1) [rad/s, m/s, rad or m]
    bins: BlockMean  # residual (n, K) [N·m or N], NaN with too few blocks

    @property
    def centres(self) -> Array:
        """Middle of each bin (n, K)."""
        return 0.5 * (self.edges[:, 1:] + self.edges[:, :-1])

    @property
    def rms(self) -> Array:
        """RMS of the residual that the bins explain (n,) [N·m or N], with noise subtracted."""
        seen = np.isfinite(self.bins.mean)
        rows = np.where(seen, self.bins.rows, 0.0)
        squares = np.where(seen, self.bins.mean**2 - self.bins.std**2, 0.0)
        total = np.maximum(rows.sum(axis=1), 1.0)
        return np.asarray(np.sqrt(np.maximum((rows * squares).sum(axis=1) / total, 0.0)))

    @property
    def significant(self) -> Rows:
        """Whether the mean of some bin differs from zero (n,): Student's t, all bins together."""
        seen = np.isfinite(self.bins.mean)
        freedom = np.maximum(self.bins.blocks - 1, 1)
        limit = student_limit(
            0.5 * FALSE_FINDING_PROBABILITY / np.maximum(seen.sum(axis=1), 1)[:, None], freedom
        )
        return np.asarray((self._certainty > limit).any(axis=1))

    def worst(self, joint: int) -> tuple[float, float]:
        """Return centre and mean residual of the most significant bin of a joint."""
        k = int(self._certainty[joint].argmax())
        return float(self.centres[joint, k]), float(np.nan_to_num(self.bins.mean[joint, k]))

    @property
    def _certainty(self) -> Array:
        """Mean over standard error (n, K), zero where unknown."""
        std = np.nan_to_num(self.bins.std)
        return np.abs(np.nan_to_num(self.bins.mean)) / np.where(std > 0.0, std, np.inf)


def _profile(
    runs: Sequence[Samples], residuals: Sequence[Array], over: Sequence[Array], repeated: int
) -> Profile:
    """Average residuals (m, n) of usable rows in equal bins of each joint's own quantity."""
    lowest = np.full(over[0].shape[1], np.inf)
    highest = -lowest
    for run, values in zip(runs, over, strict=True):
        for joint, usable in enumerate(run.usable.T):
            moving = values[usable, joint]
            lowest[joint] = moving.min(initial=lowest[joint])
            highest[joint] = moving.max(initial=highest[joint])
    moved = np.isfinite(lowest) & (highest > lowest)
    lowest = np.where(moved, lowest, 0.0)
    highest = np.where(moved, highest, 1.0)
    edges = np.linspace(lowest, highest, RESIDUAL_BINS + 1, axis=1)
    sums = []
    for run, residual, quantity in zip(runs, residuals, over, strict=True):
        block = run.blocks(BLOCK_SECONDS)
        binned_sums = np.zeros((2, int(block[-1]) + 1, len(edges), RESIDUAL_BINS))
        for joint, usable in enumerate(run.usable.T):
            bins = np.searchsorted(edges[joint, 1:-1], quantity[:, joint], side="right")
            cell = block * RESIDUAL_BINS + bins
            for table, weights in zip(binned_sums, (residual[:, joint], usable), strict=True):
                some = np.bincount(cell, np.where(usable, weights, 0.0), len(table) * RESIDUAL_BINS)
                table[:, joint] = some.reshape(-1, RESIDUAL_BINS)
        sums.append(binned_sums)
    return Profile(edges, block_mean(sums, repeated))


def _drift_sums(
    model: RobotModel, values: Array, samples: Samples, residual: Array, pieces: int
) -> Array:
    """Sum friction times residual (m, n), and friction squared, over P parts (2, P, n)."""
    torque = samples.predicted_torque(model, values, model.friction_columns)
    edges = np.linspace(0, len(residual), pieces + 1).astype(np.intp)[:-1]
    sums = np.empty((2, len(edges), model.n_joints))
    for joint, usable in enumerate(samples.usable.T):  # one by one, as recordings can be long
        friction = np.where(usable, torque[:, joint], 0.0)
        for joint_sums, factor in zip(sums, (residual[:, joint], friction), strict=True):
            joint_sums[:, joint] = np.add.reduceat(friction * factor, edges)
    return sums


class Outliers(NamedTuple):
    """Samples with a residual beyond six robust standard deviations of the joint."""

    share: Array  # share of usable samples (n,)
    power: Array  # their share of the squared residual (n,)
    without: PredictionError  # prediction error without outliers
    of_positions: Rows  # whether the predicted torque jumps there, not the measured one (n,)


def find_outliers(torque: Array, residual: Array, usable: Rows) -> Outliers:
    """Find outliers of measured torque and residual (m, n) in usable rows (m, n)."""
    far = np.zeros_like(usable)
    total = np.zeros(residual.shape[1])
    outlying = np.zeros_like(total)
    of_positions = np.zeros(len(total), dtype=np.bool_)
    for joint, rows in enumerate(usable.T):
        if rows.any():
            error = residual[:, joint]
            distance = np.abs(error - np.median(error[rows]))
            limit = _OUTLIER_SIGMAS * MAD_TO_STD * float(np.median(distance[rows]))
            far[:, joint] = rows & (distance > max(limit, np.finfo(np.float64).tiny))
            total[joint] = (error[rows] ** 2).sum()
            outlying[joint] = (error[far[:, joint]] ** 2).sum()
            measured = torque[:, joint]
            jumps = [_jumps(each, far[:, joint]) for each in (measured, measured - error)]
            of_positions[joint] = jumps[1] > jumps[0]
    return Outliers(
        share=np.count_nonzero(far, axis=0) / np.maximum(np.count_nonzero(usable, axis=0), 1),
        power=outlying / np.where(total > 0.0, total, 1.0),
        without=PredictionError.between(torque, torque - residual, usable & ~far),
        of_positions=of_positions,
    )


def _jumps(torque: Array, rows: NDArray[np.bool_]) -> float:
    """Return how far a torque (m,) is from its running median in some rows, squared and summed."""
    some = np.flatnonzero(rows)
    some = some[:: max(1, len(some) // _MOST_JUMPS)]
    half = _MEDIAN_ROWS // 2
    window = np.clip(some[:, None] + np.arange(-half, half + 1), 0, len(torque) - 1)
    return float(((torque[some] - np.median(torque[window], axis=1)) ** 2).sum())


class Autocorrelation(NamedTuple):
    """Autocorrelation of the residual of n joints at L + 1 lags."""

    lag: Array  # (L + 1,) [s], from zero
    correlation: Array  # NaN for a joint without rows
    rows: Indices  # samples (n,)

    @property
    def time(self) -> Array:
        """Integrated correlation time (n,) [s] (initial positive sequence, Geyer 1992)."""
        pairs = self.correlation[: len(self.lag) // 2 * 2].reshape(-1, 2, len(self.rows)).sum(1)
        positive = np.cumprod(pairs > 0.0, axis=0)
        return np.asarray(self.lag[1] * ((pairs * positive).sum(axis=0) - 0.5))

    @property
    def effective_rows(self) -> Array:
        """Number of independent samples with the same standard error of the mean (n,)."""
        return np.asarray(self.rows / np.maximum(2.0 * self.time / self.lag[1], 1.0))


def autocorrelation(
    residuals: Sequence[tuple[Array, Rows]], step: float, longest: float = MAX_CORRELATION_LAG
) -> Autocorrelation:
    """Return the autocorrelation of residuals and usable rows (m, n) up to the longest lag [s]."""
    lags = max(2, min(_MAX_LAGS, round(longest / step)))
    shape = (lags + 1, residuals[0][0].shape[1])
    products, pairs = np.zeros((2, *shape))
    for residual, usable in residuals:
        for joint, (column, rows) in enumerate(zip(residual.T, usable.T, strict=True)):
            products[:, joint] += _products(np.where(rows, column, 0.0), lags)
            pairs[:, joint] += _products(rows.astype(np.float64), lags)
    pairs = np.rint(pairs)
    covariance = products / np.maximum(pairs, 1.0)
    power = covariance[0]
    return Autocorrelation(
        lag=np.asarray(step * np.arange(lags + 1), dtype=np.float64),
        correlation=np.where(power > 0.0, covariance / np.where(power > 0.0, power, 1.0), np.nan),
        rows=pairs[0].astype(np.intp),
    )


def _products(values: Array, lags: int) -> Array:
    """Return sums of x(t) x(t + l) of values (m,) for l = 0 .. lags (lags + 1,)."""
    m = len(values)
    products = np.zeros(lags + 1)
    reach = min(lags, m - 1)
    length = 1 << (m + reach - 1).bit_length()  # zero-padded against wrap-around
    power = np.abs(np.fft.rfft(values, length)) ** 2
    products[: reach + 1] = np.fft.irfft(power, length)[: reach + 1]
    return products


@dataclass(frozen=True, eq=False)
class ResidualChecks:
    """Patterns of the torque residual of all recordings."""

    torque_rms: Array  # of usable rows (n,) [N·m or N]
    rms: Array  # (n,) [N·m or N]
    autocorrelation: Autocorrelation  # of the fitted recordings
    speed: Profile  # over the joint's own speed
    position: Profile  # over the joint's own position
    ripple: Ripple  # over the motor angle, without gear ratios over the joint angle
    drift: FrictionDrift | None  # None with too few recordings
    friction_share: Array  # friction over measured torque of the fitted recordings (n,)
    outliers: Outliers  # of the unseen motion, or of the fitted one without it

    def share(self, size: Array) -> Array:
        """Return a residual (n,) as a share of the torque; zero for a joint without rows."""
        torque = self.torque_rms
        return np.where(torque > 0.0, size / np.where(torque > 0.0, torque, 1.0), 0.0)


def check_residuals(
    model: RobotModel,
    values: Array,
    training: Sequence[Samples],
    held_out: Sequence[Samples] = (),
    *,
    same_motion: bool = False,
    motor_from_joint: Array | None = None,
) -> ResidualChecks:
    """Check the residuals of parameters on all recordings.

    Args:
        model: of the arm.
        values: parameters (p,).
        training: recordings that were fitted, in the order in which drift is tested.
        held_out: recordings of unseen motion.
        same_motion: whether the training repeats one motion.
        motor_from_joint: motor angles per joint angle (n, n); None without gear ratios.
    """
    runs = [*training, *held_out]
    fitted = len(training)
    residuals = [
        np.where(run.usable, run.torque - run.predicted_torque(model, values), 0.0) for run in runs
    ]
    torque = np.array(
        [np.einsum("mj,mj,mj->j", run.torque, run.torque, run.usable) for run in runs]
    )
    rows = np.maximum(sum(np.count_nonzero(run.usable, axis=0) for run in runs), 1)
    repeated = fitted if same_motion else 1
    pieces = -(-TREND_PIECES // fitted)
    drift = [
        _drift_sums(model, values, *pair, pieces) for pair in zip(training, residuals, strict=False)
    ]
    if motor_from_joint is None:
        ripple = joint_ripple(model, runs, residuals)
    else:
        ripple = motor_ripple(runs, residuals, motor_from_joint, repeated)
    friction_power = sum(run_sums[1].sum(axis=0) for run_sums in drift)
    seen = torque[:fitted].sum(axis=0)
    judged = slice(fitted if held_out else 0, None)
    usable = [run.usable for run in runs]
    outliers = find_outliers(
        _joined([run.torque for run in runs[judged]]),
        _joined(residuals[judged]),
        _joined(usable[judged]),
    )
    steps = [np.median(np.diff(run.motion.time)) for run in training]
    return ResidualChecks(
        torque_rms=np.sqrt(torque.sum(axis=0) / rows),
        rms=np.sqrt(
            sum(np.einsum("mj,mj->j", residual, residual) for residual in residuals) / rows
        ),
        autocorrelation=autocorrelation(
            list(zip(residuals[:fitted], usable[:fitted], strict=True)), float(np.median(steps))
        ),
        speed=_profile(runs, residuals, [run.motion.velocity for run in runs], repeated),
        position=_profile(runs, residuals, [run.motion.position for run in runs], repeated),
        ripple=ripple,
        drift=friction_trend(drift),
        friction_share=np.sqrt(friction_power / np.where(seen > 0.0, seen, 1.0)),
        outliers=outliers,
    )


def _length(segment: slice) -> int:
    return int(segment.stop - segment.start)


class FoldedNoise(NamedTuple):
    """Noise of the torque that reaches half the sampling rate."""

    share: float  # of the squared residual at the frequencies of the motion
    error: float  # residual over measured torque


def folded_noise(
    model: RobotModel, values: Array, recordings: Sequence[Samples], bandwidth: float
) -> FoldedNoise:
    """Return what noise without a filter adds to the residual below a bandwidth.

    Sampling folds the noise above half the rate below it (Shannon 1949), where it is white: below
    the bandwidth it has at least the smallest density of all octaves above. No share where half
    the rate is within the first of these.

    Args:
        model: of the arm.
        values: parameters (p,).
        recordings: prepared.
        bandwidth: [Hz].
    """
    squares, power, noise, low = np.zeros(4)
    for run in recordings:
        error = np.where(run.usable, run.torque - run.predicted_torque(model, values), 0.0)
        squares += float((error**2).sum())
        power += float((run.torque[run.usable] ** 2).sum())
        part = max(run.segments, key=_length, default=slice(0, 0))
        if _length(part) < 2:
            continue
        step = float(np.median(np.diff(run.motion.time[part])))
        highest = 0.5 / step
        length = min(_length(part), round(_SPECTRUM_PART_SECONDS / step))
        if highest < 2.0 * bandwidth or length * step * bandwidth < 1.0:
            continue
        frequency, density = power_density(error[part], 1.0 / step, length)
        octave = np.floor(np.log2(frequency / bandwidth)).astype(np.intp)
        complete = range(int(np.log2(highest / bandwidth)))
        within = frequency < bandwidth
        floor = np.min([density[octave == k].mean(axis=0) for k in complete], axis=0)
        noise += float(floor.sum()) * np.count_nonzero(within)
        low += float(density[within].sum())
    return FoldedNoise(noise / low if low else 0.0, np.sqrt(squares / power) if power else 0.0)


def _joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Concatenate arrays, or return the only one."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
