r"""Constant delay of the torque or current channel relative to the positions.

The torque of all axes is recorded with a delay d, as by one logger:

.. math:: \tau(t) = W\bigl(q, \dot q, \ddot q\bigr)(t - d)\,\pi + e(t)

The minimum of a residual profile is refined by Gauss-Newton steps on parameters and delay together,
with the column :math:`-d\tau/dt`, and on what resembles a delay and is none, such as the scales of
torques, zeros of encoders and friction that changes (:mod:`.delay_nuisances`).

The motion is interpolated at other times, not the torque, whose noise that would smooth. Rows near
a velocity reversal are left out: presliding friction is similar to a delay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import fisher_limit, student_limit
from identification.errors import IdentificationError
from identification.estimators.covariance import block_length, spread
from identification.estimators.delay_nuisances import Nuisances, nuisances
from identification.estimators.load_friction import fit_with_load
from identification.factor.blocks import FOLDS, count_by_block, merged
from identification.factor.estimate import Estimate, estimate, inverse_variance, residual_variance
from identification.factor.factor import Factor, no_rows_message, time_blocks
from identification.factor.normal_equations import NormalEquations, Solution, solve
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.masks import REVERSAL_PERIODS, near_any_reversal
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, Samples, prepare

Rows = NDArray[np.bool_]

MAX_ESTIMATED_DELAY: Final = 0.05  # s, either way
# Encoder noise correlates with the torque through the servo loop. Simulated NS 16, delay 0.2 ms,
# four seeds: mean 0.18 ms at 10 Hz, 0.155 at 15 and 0.16 at 40 Hz, where wrist axes deviate by 0.3
# ms.
DELAY_BANDWIDTH: Final = 10.0  # Hz
# Of a smoother that leaves nine tenths of an amplitude at the bandwidth above.
_SMOOTH_MOTION_BANDWIDTH: Final = 14.0  # Hz
# Half a 95 % interval of a determined delay.
MAX_HALF_INTERVAL: Final = 1e-3  # s
# Averaging interval of torques, symmetric in time. The model is sampled between: a longer interval
# displaces steps of friction, which the low-pass spreads.
_BIN_SECONDS: Final = 0.005  # s
# Minima of the profile are wider.
_PROFILE_STEP: Final = 0.01  # s
_MAX_ITERATIONS: Final = 12
_FIRST_ITERATIONS: Final = 3  # iterations
# Half a 95 % interval that less noise of the positions may make that of a determined delay.
_REACHABLE_HALF_INTERVAL: Final = 3e-3  # s
# s, a tenth of `CLOSED_LOOP_BIAS`
_CONVERGED_SECONDS: Final = 1e-5
_CONVERGED_STD_SHARE: Final = 0.1  # share of the standard deviation
# Rows of low-passed torques in a period of their bandwidth, which lose nothing: at half that rate
# the smoother leaves a hundredth of an amplitude.
_ROWS_PER_PERIOD: Final = 6.5
# difference of log variance up to which two minima are equally good
_EQUAL_LOG_VARIANCE: Final = 0.05
_SAME_NUISANCES_STEP: Final = 1e-3  # s, step of the delay that hardly moves what resembles it
_SAME_WEIGHTS_STEP: Final = 1e-4  # s, step that hardly changes the residuals
_TIME_BLOCKS: Final = 80  # blocks of time
_ROWS_AT_ONCE: Final = 8192
_STEP_ROUNDING: Final = 1e-6  # relative deviation of a step of an even clock
_FALSE_DELAY_PROBABILITY: Final = 0.005  # one-sided probability of a false delay
CLOSED_LOOP_BIAS: Final = 1e-4
"""Standard deviation [s] of an estimate's error in addition to its interval: encoder noise in the
closed loop, elastic gears, ripple. Simulated NS 16, UR5, Panda and arm of two joints with effects,
cycles of 1 and 2 ms: nine runs, 0.01 to 0.17 ms, RMS 0.1 ms."""


def read_at(time: Array, values: Array, at: Array) -> Array:
    """Interpolate values (m, ...) of one segment at times (k,), constant outside."""
    # Hermite cubics, which are local: a global spline oscillates at Coulomb friction steps.
    slope = np.gradient(values, time, axis=0)
    at = np.clip(at, time[0], time[-1])
    left = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    column = (-1,) + (1,) * (values.ndim - 1)
    step = (time[left + 1] - time[left]).reshape(column)
    share = (at - time[left]).reshape(column) / step
    start = values[left]
    end = values[left + 1]
    bend = step * (1.0 - share) * slope[left] - step * share * slope[left + 1]
    bend += (2.0 * share - 1.0) * (end - start)
    return np.asarray(start + share * (end - start) + share * (1.0 - share) * bend)


def predicted_rate(samples: Samples, torque: Array) -> Array:
    """Return the time derivative of torques (m, ...), zero in segments of one sample."""
    rate = np.zeros_like(torque)
    for segment in samples.segments:
        if segment.stop - segment.start > 1:
            rate[segment] = _gradient(samples.motion.time[segment], torque[segment])
    return rate


def _gradient(time: Array, values: Array) -> Array:
    """Return ``np.gradient`` of values (m, ...); at even times, but for rounding, much faster."""
    step = float(time[-1] - time[0]) / (len(time) - 1)
    if np.abs(np.diff(time) - step).max() > _STEP_ROUNDING * step:
        return np.asarray(np.gradient(values, time, axis=0))
    rate = np.empty_like(values)
    np.subtract(values[2:], values[:-2], out=rate[1:-1])
    rate[[0, -1]] = 2.0 * (values[[1, -1]] - values[[0, -2]])
    rate *= 0.5 / step
    return rate


def rate_products(model: RobotModel, samples: Samples) -> Array:
    """Return sums ``W' d[W | t]/dt`` per joint (n, p, p + 1); t is of the known payload.

    Of all rows: over a stretch they do not cancel as they do over a whole motion.
    """
    return factor_and_rates(model, samples, with_factor=False)[1]


def factor_and_rates(
    model: RobotModel, samples: Samples, *, with_factor: bool = True
) -> tuple[Factor, Array]:
    """Return the factor of samples by time, and their :func:`rate_products`, by one regressor."""
    products = np.zeros((model.n_joints, model.n_parameters, model.n_parameters + 1))
    index, duration = time_blocks(samples)
    factor = replace(Factor.zero(model, int(index.max(initial=-1)) + 1), block=duration)
    factor.counts[:] = count_by_block(index, samples.usable)
    for part, rows, inside in _with_neighbours(samples):
        load = part.known_torque(model)
        tables = []
        for joint, (block, columns) in enumerate(zip(*part.regressor(model), strict=True)):
            # Rows of memory are columns here, as the regressor has them.
            rate = predicted_rate(part, np.vstack([block.T, load[:, joint]]).T)[inside]
            table = np.vstack([block[inside].T, part.torque[inside, joint]])
            table[:, ~part.usable[inside, joint]] = 0.0  # they may be NaN
            places = np.ix_(columns, np.append(columns, model.n_parameters))
            products[joint][places] += table[:-1] @ rate
            tables.append(table)
        if with_factor:
            factor.add_rows(index[rows], tables)
    return factor, products


def _with_neighbours(samples: Samples) -> Iterator[tuple[Samples, slice, slice]]:
    """Yield parts of samples with a row more on each side, their rows, and where these are."""
    m = len(samples.torque)
    # A low-pass needs all rows at once; otherwise the regressor of a long recording is never whole.
    length = m if samples.torque_bandwidth is not None else _ROWS_AT_ONCE
    for start in range(0, m, max(1, length)):
        stop = min(start + length, m)
        first = max(start - 1, 0)  # a rate needs the neighbouring rows
        part = samples.between(first, min(stop + 1, m))
        yield part, slice(start, stop), slice(start - first, stop - first)


def delay_sensitivity(
    estimate: Estimate, factor: Factor, products: Array, precision: Array | None = None
) -> Array:
    """Return the change of the parameters (p,) with the given delay, per second.

    They change by the fit of the torque's rate.

    Args:
        estimate: with the given delay.
        factor: of the samples.
        products: `rate_products` of these samples (n, p, p + 1).
        precision: information of a prior (p, p).
    """
    weights = inverse_variance(estimate.noise_std**2)
    rate = np.tensordot(weights, products, axes=1) @ np.append(estimate.values, 1.0)
    equations = factor.weighted(weights)._replace(b=rate)
    if precision is not None:
        equations = equations._replace(A=equations.A + precision)
    moved = solve(equations).values
    return np.where(np.isfinite(np.diag(estimate.covariance)), moved, 0.0)


def with_uncertain_delay(
    estimate: Estimate,
    factor: Factor,
    products: Array,
    variance: float,
    precision: Array | None = None,
) -> Estimate:
    """Return an estimate whose covariance includes the variance of the given delay.

    Args:
        estimate: with the given delay.
        factor: of the samples.
        products: `rate_products` of these samples (n, p, p + 1).
        variance: of the delay [s²].
        precision: information of a prior (p, p).
    """
    sensitivity = delay_sensitivity(estimate, factor, products, precision)
    return replace(
        estimate, covariance=estimate.covariance + variance * np.outer(sensitivity, sensitivity)
    )


@dataclass(frozen=True)
class CombinedDelay:
    """Delay of the torque of all axes, combined from an estimate and a stated value."""

    mean: float  # [s]
    variance: float  # [s²]

    def mean_square_error(self, used: float) -> float:
        """Return the mean square error of a delay that is used [s²]."""
        return (self.mean - used) ** 2 + self.variance


class UndeterminedDelay(Enum):
    """Why a delay is not determined; :mod:`.delay_messages` words it."""

    INSEPARABLE = "not separable from the parameters"
    WIDE_INTERVAL = "wide interval"
    AT_LIMIT = "at the longest delay tested"
    OTHER_MINIMUM = "another minimum is as deep"


@dataclass(frozen=True, eq=False)
class DelayEstimate:
    """Delay of the torque of all axes relative to the position."""

    delay: float  # [s]
    std: float  # cluster-robust standard deviation [s]; infinite if undetermined
    assumed: float  # delay with which the samples were prepared [s]
    cycle: float  # usual step of the clock [s]
    interval_factor: float  # standard deviations in half a 95 % interval
    reason: UndeterminedDelay | None  # None: it is determined
    # whether the delay differs from `assumed` at 99 % and predicts left-out blocks better
    significant: bool
    # whether it differs so and does not predict left-out blocks better; without a prior, parts
    # that determine little are predicted badly with any delay
    unconfirmed: bool = False
    other: float = float("nan")  # delay of another minimum as deep [s]; NaN without one

    @property
    def determined(self) -> bool:
        """Whether the delay is determined."""
        return self.reason is None

    @property
    def applied(self) -> float:
        """Delay to compensate [s]: that assumed unless significant."""
        return self.delay if self.significant else self.assumed

    @property
    def half_interval(self) -> float:
        """Half a 95 % interval [s]."""
        return self.interval_factor * self.std

    @property
    def variance(self) -> float:
        """Variance of the delay [s²], at most of a uniform one within `MAX_ESTIMATED_DELAY`.

        Also the error variance of an assumed delay inside the interval.
        """
        return float(np.fmin(self.std**2, MAX_ESTIMATED_DELAY**2 / 3.0))

    def excludes(self, delay: float) -> bool:
        """Return whether the 95 % interval does not hold another delay [s]."""
        return abs(self.delay - delay) > self.half_interval

    def combined(self, stated: float, bound: float, bias: float = 0.0) -> CombinedDelay:
        """Combine the estimated delay with a stated one [s].

        Errors of the stated value are Gaussian, with the variance of uniform ones of up to `bound`
        either way; the estimate, significant or not, has its own and a `bias` (standard deviation).
        A determined estimate may also show the stated value to be wrong: before it, errors of up to
        `MAX_ESTIMATED_DELAY` are as likely. A minimum at a limit, or next to another, tells
        nothing.
        """
        near = bound**2 / 3.0
        narrow = self.half_interval <= MAX_HALF_INTERVAL
        if not np.isfinite(self.std) or (narrow and not self.determined):
            return CombinedDelay(stated, near)
        variance = self.std**2 + bias**2
        difference = self.delay - stated
        priors = np.array([near, MAX_ESTIMATED_DELAY**2 / 3.0] if self.determined else [near])
        spreads = priors + variance
        shares = priors / spreads
        logarithms = -0.5 * (difference**2 / spreads + np.log(spreads))
        odds = np.exp(logarithms - logarithms.max()) if self.determined else np.ones(1)
        odds /= odds.sum()
        mean = float(odds @ shares) * difference
        variances = priors * (1.0 - shares) + (shares * difference - mean) ** 2
        return CombinedDelay(stated + mean, float(odds @ variances))


def estimate_delay(
    recording: Recording,
    model: RobotModel,
    *,
    noise_variance: Array | None = None,
    options: Preprocessing = Preprocessing(),  # noqa: B008 - frozen
) -> DelayEstimate:
    """Estimate the delay of a recording's torque relative to its position.

    Args:
        recording: with torque.
        model: of the arm.
        noise_variance: of the positions (n,), as for :func:`identification.signals.samples.smooth`.
        options: of the smoothing and the torque's low-pass, with the assumed delay.

    Raises:
        RecordingError: see :func:`identification.signals.samples.prepare`.
        IdentificationError: no usable row.
    """
    # Reversals are left out below, less widely than a smoother of this bandwidth requires.
    options = replace(_narrow(options), exclude_rows="halts")
    estimate = _estimated(recording, model, noise_variance, options)
    is_far = not estimate.half_interval < _REACHABLE_HALF_INTERVAL
    if estimate.determined or is_far or options.rigid_bandwidth <= _SMOOTH_MOTION_BANDWIDTH:
        return estimate
    # Noise of positions turns friction at slow motion: a smoother motion may show the delay.
    smooth = replace(options, rigid_bandwidth=_SMOOTH_MOTION_BANDWIDTH)
    return min(
        (estimate, _estimated(recording, model, noise_variance, smooth)),
        key=lambda either: either.std,
    )


def _estimated(
    recording: Recording, model: RobotModel, noise_variance: Array | None, options: Preprocessing
) -> DelayEstimate:
    p = model.n_parameters
    assumed = options.torque_delay
    samples = prepare(recording, model, noise_variance=noise_variance, options=options)
    ends = (-MAX_ESTIMATED_DELAY - assumed, MAX_ESTIMATED_DELAY - assumed)
    # Where the fit's own smoother is the low-pass, measured torques have passed it as well.
    narrow = samples.torque_bandwidth if options.smooth_torque else None
    reader, (grid, heights, values) = _profiled(model, samples, narrow, ends)
    shift = float(grid[np.argmin(heights)])
    beside: Nuisances | None = None
    is_weighted = True  # by residuals of a fit nearby
    for iteration in range(_MAX_ITERATIONS):
        blocks = reader.linearised(shift, values, beside=beside)
        solution = blocks.solution()
        values = np.delete(solution.values, p)
        step = np.clip(solution.values[p], -_PROFILE_STEP, _PROFILE_STEP)
        previous = shift
        shift = float(np.clip(shift + step, *ends))
        # The first values are of a fit without what resembles a delay.
        is_near = iteration > 0 and abs(shift - previous) < _SAME_NUISANCES_STEP
        beside = blocks.beside if is_near else None
        tolerance = _CONVERGED_STD_SHARE * float(np.sqrt(solution.inverse[p, p]))
        if is_weighted and abs(shift - previous) <= max(_CONVERGED_SECONDS, tolerance):
            break
        is_weighted = abs(shift - previous) < _SAME_WEIGHTS_STEP
        # What is far from determined need not settle, and often does not.
        if iteration >= _FIRST_ITERATIONS and blocks.delay_std(solution)[0] > MAX_HALF_INTERVAL:
            break
    other = _other_minimum(reader, grid, heights, shift)
    std, count = blocks.delay_std(solution)
    factor, by_chance = (
        float(student_limit(share, count - 1)) for share in (0.025, _FALSE_DELAY_PROBABILITY)
    )
    at_limit = shift <= ends[0] or shift >= ends[1]

    differs = not at_limit and bool(np.isnan(other)) and abs(shift) > by_chance * std
    confirmed = False
    if differs:
        unshifted = reader.linearised(0.0, values, blocks.weights)
        confirmed = blocks.predicted() < unshifted.predicted(with_delay=False)
    return DelayEstimate(
        delay=shift + assumed,
        std=std,
        assumed=assumed,
        cycle=reader.cycle,
        interval_factor=factor,
        reason=_undetermined_reason(factor * std, at_limit, other),
        significant=differs and confirmed,
        unconfirmed=differs and not confirmed,
        other=other + assumed,
    )


def _narrow(options: Preprocessing) -> Preprocessing:
    """Return options that limit torque and motion to `DELAY_BANDWIDTH` alike.

    The torque of a narrowed motion lacks what that motion has above the bandwidth, and half of the
    squares of acceleration in it; the measured torque has it. So torque and regressor are filtered,
    unless a low-pass of the recorded torque is known, which both have then.
    """
    known = options.torque_bandwidth
    if known is None:
        return replace(options, smooth_torque=True, torque_bandwidth=DELAY_BANDWIDTH)
    if known <= DELAY_BANDWIDTH:
        return replace(options, smooth_torque=False)
    narrow = min(options.rigid_bandwidth, DELAY_BANDWIDTH)
    return replace(options, smooth_torque=False, rigid_bandwidth=narrow)


def _profiled(
    model: RobotModel, samples: Samples, bandwidth: Array | None, ends: tuple[float, float]
) -> tuple[_Reader, _Profile]:
    """Return a reader of the samples, with their load, and its profile between two shifts."""
    # Friction that grows with load resembles a delay of some milliseconds.
    loaded = fit_with_load(
        model, (samples,), lambda parts: _Reader.of(model, parts[0], bandwidth).whole_profile(ends)
    )
    return _Reader.of(model, loaded.samples[0], bandwidth), loaded.result


def _other_minimum(reader: _Reader, grid: Array, heights: Array, shift: float) -> float:
    """Return another minimum of a profile that is as deep as the one found, NaN without one."""
    padded = np.concatenate([[np.inf], heights, [np.inf]])
    valley = (heights <= padded[:-2]) & (heights <= padded[2:])
    valleys = np.flatnonzero(valley & (np.abs(grid - shift) > grid[1] - grid[0]))
    if not valleys.size:
        return float("nan")
    lowest = valleys[np.argmin(heights[valleys])]
    height = reader.profile(np.array([shift]), reader.rows_at).heights[0]
    return float(grid[lowest]) if heights[lowest] < height + _EQUAL_LOG_VARIANCE else float("nan")


def _undetermined_reason(
    half_interval: float, at_limit: bool, other: float
) -> UndeterminedDelay | None:
    if not np.isfinite(half_interval):
        return UndeterminedDelay.INSEPARABLE
    if half_interval > MAX_HALF_INTERVAL:
        return UndeterminedDelay.WIDE_INTERVAL
    if at_limit:
        return UndeterminedDelay.AT_LIMIT
    if np.isfinite(other):
        return UndeterminedDelay.OTHER_MINIMUM
    return None


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Weighted normal equations by B blocks of time.

    Columns: p parameters, a delay step of each joint, r of what resembles a delay, and the torque.
    """

    by_joint: Array  # (B, p + n + r + 1, p + n + r + 1)
    delay: int  # index p of the first delay
    joints: int  # n
    weights: Array  # (n,)
    rows: int
    beside: Nuisances  # what resembles a delay

    @cached_property
    def gram(self) -> Array:
        """The same with one delay of all joints (B, p + r + 2, p + r + 2)."""
        delays = slice(self.delay, self.delay + self.joints)
        gram = self.by_joint
        for axis in (1, 2):
            gram = gram.swapaxes(1, axis)
            together = gram[:, delays].sum(axis=1, keepdims=True)
            parts = gram[:, : self.delay], together, gram[:, delays.stop :]
            gram = np.concatenate(parts, axis=1).swapaxes(1, axis)
        return gram

    def solution(self) -> Solution:
        """Solve by least squares."""
        return _solved(self.gram.sum(axis=0), self.delay + 1)

    def delay_std(self, solution: Solution) -> tuple[float, int]:
        """Return the standard deviation of the delay, infinite if undetermined, and the blocks.

        Errors of the model may make the delays of single joints differ by more than the scatter
        over time shows. Then they are a random sample (DerSimonian and Laird 1986).
        """
        moved, count = _moved(self.gram, solution)
        if not solution.determined[self.delay]:
            return np.inf, count
        variance = float((moved[:, self.delay] ** 2).sum())
        places = np.arange(self.delay, self.delay + self.joints)
        alone = _solved(self.by_joint.sum(axis=0), places[-1] + 1)
        known = places[alone.determined[places]]
        moved, blocks = _moved(self.by_joint, alone)
        variances = (moved[:, known] ** 2).sum(axis=0)
        variance += _between_joints(alone.values[known], variances, blocks - 1)
        return float(np.sqrt(variance)), count

    def predicted(self, *, with_delay: bool = True) -> float:
        """Return the mean weighted squared error of every fifth block predicted from the others.

        They are spread over the recording, as friction that changes is not known beyond an end.
        """
        gram = self.gram.copy()
        if not with_delay:
            gram[:, self.delay] = 0.0
            gram[:, :, self.delay] = 0.0
        folds = np.array([gram[k::FOLDS].sum(axis=0) for k in range(FOLDS)])
        error = 0.0
        for fold in folds:
            values = _solved(folds.sum(axis=0) - fold, self.delay + 1).values
            augmented = np.append(-values, 1.0)
            error += float(augmented @ fold @ augmented)
        return error / self.rows


def _solved(gram: Array, first: int) -> Solution:
    """Solve normal equations; the coefficients from `first` on have unit variance."""
    information = gram[:-1, :-1].copy()
    others = np.arange(len(information)) >= first
    information[others, others] += 1.0
    return solve(NormalEquations(information, gram[:-1, -1]))


def _moved(gram: Array, solution: Solution) -> tuple[Array, int]:
    """Return rows (R, k) whose outer products sum to the covariance, and the number of blocks."""
    gram = gram[gram[:, -1, -1] > 0.0]
    augmented = np.append(-solution.values, 1.0)
    gram = merged(gram, block_length(gram[:, :-1] @ augmented))
    # A delay that is not there costs more than one whose interval is wide.
    moved = spread(gram[:, :-1, :-1], gram[:, :-1] @ augmented, solution.root, left_out=True)
    return moved, max(2, len(gram))


def _between_joints(delays: Array, variances: Array, freedom: int) -> float:
    """Return the variance of the mean of delays (k,) by what they differ beyond their variances.

    Zero unless they differ significantly, by variances of so many degrees of freedom.
    """
    others = len(delays) - 1
    if others < 1 or not np.all(variances > 0.0):
        return 0.0
    weights = 1.0 / variances
    whole = float(weights.sum())
    squares = float(weights @ (delays - weights @ delays / whole) ** 2)
    if squares <= others * fisher_limit(2.0 * _FALSE_DELAY_PROBABILITY, others, freedom):
        return 0.0
    share = float((weights**2).sum()) / whole**2
    return share * (squares - others) / (whole * (1.0 - share))


class _ShiftedRows(NamedTuple):
    """Rows of the model with the motion of an earlier time, and what was measured at them."""

    blocks: Sequence[Array]  # columns of each joint (m, c_j)
    torque: Array  # without that of known payloads (m, n)
    usable: Rows  # (m, n)

    def of(self, rows: slice) -> _ShiftedRows:
        """Return some of the rows."""
        blocks = [block[rows] for block in self.blocks]
        return _ShiftedRows(blocks, self.torque[rows], self.usable[rows])


class _Profile(NamedTuple):
    """Fits at K common shifts."""

    shifts: Array  # (K,) [s]
    heights: Array  # mean log residual variance (K,)
    values: Array  # parameters (p,) of the lowest


@dataclass(frozen=True, eq=False)
class _Reader:
    """Recording with torque averaged over short bins, and motion at any time shift."""

    model: RobotModel
    samples: Samples  # as prepared
    binned: Samples  # torque in bins, with that of known payloads; no motion
    parts: tuple[tuple[slice, slice], ...]  # per segment its rows of `samples` and of `binned`
    clear: Rows  # bins away from standstill and reversals (m, n)
    cycle: float  # usual step of the clock [s]
    summed: slice  # bins that the sums need

    @classmethod
    def of(cls, model: RobotModel, samples: Samples, bandwidth: Array | None) -> _Reader:
        """Prepare the samples of a recording, whose torque may have a bandwidth (n,) [Hz]."""
        motion = samples.motion
        # Around the step of dry friction arm and servo answer faster than the low-pass, and later
        # than it: with half of this reach a UR at a third of its speed had 2 ms less than it has.
        reach = REVERSAL_PERIODS / np.minimum(samples.position_bandwidth, DELAY_BANDWIDTH)
        clear = model.moving(motion.velocity) & ~near_any_reversal(model, motion, reach)
        cycle = float(np.median(np.diff(motion.time)))
        size = max(1, round(_BIN_SECONDS / cycle))
        parts = []
        start = 0
        for segment in samples.segments:
            count = (segment.stop - segment.start) // size
            if count > 1:
                parts.append((segment, slice(start, start + count)))
                start += count

        def bins(array: NDArray[Any]) -> NDArray[Any]:
            """Cut an array (m, ...) into (bins, size, ...)."""
            cut = [array[raw][: (b.stop - b.start) * size] for raw, b in parts]
            return np.concatenate([array[:0], *cut]).reshape(-1, size, *array.shape[1:])

        def every(rows: Rows) -> Rows:
            """Return bins whose rows (m, n) are all true."""
            return np.asarray(bins(rows).all(axis=1))

        still = np.zeros((start, model.n_joints))
        binned = replace(
            samples,
            motion=Motion(bins(motion.time).mean(axis=1), still, still, still),
            torque=bins(samples.torque + samples.known_torque(model)).mean(axis=1),
            usable=every(samples.usable),
            segments=tuple(b for _, b in parts),
            mask=None,
            parent=None,
        )
        step = 1
        if bandwidth is not None:
            rate = _ROWS_PER_PERIOD * float(bandwidth.max())
            step = max(1, int(1.0 / (rate * size * cycle)))
        summed = slice(step // 2, None, step)
        return cls(model, samples, binned, tuple(parts), every(clear), cycle, summed)

    def at(self, shift: float) -> Samples:
        """Return the bins with the motion of an earlier time, by a shift."""
        time = self.binned.motion.time
        usable = self.binned.usable.copy()
        fields = self.samples.motion.columns()
        del fields["time"]
        moved = {name: np.zeros((len(time), field.shape[1])) for name, field in fields.items()}
        for raw, b in self.parts:
            inside = self.samples.motion.time[raw]
            at = time[b] - shift
            for name, field in fields.items():
                moved[name][b] = read_at(inside, field[raw], at)
            index = np.interp(at, time[b], np.arange(len(at)))
            clear = self.clear[b]
            near = clear[np.floor(index).astype(int)] & clear[np.ceil(index).astype(int)]
            usable[b] &= near & ((at >= inside[0]) & (at <= inside[-1]))[:, None]
        result = replace(self.binned, motion=Motion(time, **moved), usable=usable)
        return replace(result, torque=result.torque - result.known_torque(self.model))

    def rows_at(self, shift: float) -> _ShiftedRows:
        """Return the rows at a shift that the sums need."""
        return self._every_row_at(shift).of(self.summed)

    def _every_row_at(self, shift: float) -> _ShiftedRows:
        samples = self.at(shift)
        return _ShiftedRows(samples.regressor(self.model).blocks, samples.torque, samples.usable)

    def rows_behind(self, shift: float) -> _ShiftedRows:
        """Return the rows that the sums need, at a shift by whole bins.

        These are unshifted rows, earlier by that many bins. The low-pass of the torque, which both
        have, does not depend on time.
        """
        count = round(shift / self.bin)
        start, torque, _ = self._unshifted
        source = np.arange(len(torque))
        there = np.zeros(len(torque), dtype=np.bool_)
        for _, b in self.parts:
            source[b] = np.clip(source[b] - count, b.start, b.stop - 1)
            there[b] = np.arange(b.start, b.stop) == source[b] + count
        source, there = source[self.summed], there[self.summed]
        usable = self.binned.usable[self.summed] & self.clear[source] & there[:, None]
        load = (self.binned.torque - torque)[source]
        blocks = [block[source] for block in start]
        return _ShiftedRows(blocks, self.binned.torque[self.summed] - load, usable)

    @cached_property
    def _unshifted(self) -> _ShiftedRows:
        return self._every_row_at(0.0)

    @property
    def bin(self) -> float:
        """Usual step of the bins [s]."""
        return float(np.median(np.diff(self.binned.motion.time)))

    def whole_profile(self, ends: tuple[float, float]) -> _Profile:
        """Fit the parameters at shifts between two, a profile step apart.

        By whole bins, with one regressor for all, unless a bin is longer than a step.
        """
        if not self.parts or self.bin > _PROFILE_STEP:
            steps = 1 + 2 * math.ceil(MAX_ESTIMATED_DELAY / _PROFILE_STEP)
            return self.profile(np.linspace(*ends, steps), self.rows_at)
        step = self.bin * round(_PROFILE_STEP / self.bin)
        first, last = math.ceil(ends[0] / step), math.floor(ends[1] / step)
        return self.profile(np.asarray(step * np.arange(first, last + 1)), self.rows_behind)

    def profile(self, shifts: Array, rows_at: Callable[[float], _ShiftedRows]) -> _Profile:
        """Fit the parameters at common shifts (K,)."""
        heights = np.full(len(shifts), np.inf)
        best = np.zeros(self.model.n_parameters)
        for k, shift in enumerate(shifts.tolist()):
            factor = self._factor(rows_at(shift))
            moving = factor.samples > 0
            if moving.any():
                fit = estimate(self.model, factor)
                height = 2.0 * np.log(fit.noise_std[moving])
                heights[k] = np.average(height, weights=factor.samples[moving])
                best = fit.values if heights[k] <= heights.min() else best
        if not np.isfinite(heights).any():
            raise IdentificationError(no_rows_message(self.model))
        return _Profile(shifts, heights, best)

    def _factor(self, rows: _ShiftedRows) -> Factor:
        """Reduce rows to one block."""
        index = np.zeros(len(rows.torque), dtype=np.intp)
        tables = [
            np.where(usable, np.column_stack([block, torque]).T, 0.0)
            for block, torque, usable in zip(rows.blocks, rows.torque.T, rows.usable.T, strict=True)
        ]
        counts = count_by_block(index, rows.usable)
        model = self.model
        return Factor.of_rows([(index, tables)], counts, model.plan.columns, model.parameter_names)

    def linearised(
        self,
        shift: float,
        values: Array,
        weights: Array | None = None,
        beside: Nuisances | None = None,
    ) -> _Blocks:
        """Return normal equations at a shift, linear near parameters.

        `values` are these (p,), or these and the coefficients of what resembles a delay (p + r,),
        whose columns may be given, of parameters and a shift nearby.
        """
        model = self.model
        p = model.n_parameters
        n = model.n_joints
        samples = self.at(shift)
        blocks, columns = samples.regressor(model)
        load = samples.known_torque(model)
        beside = beside or nuisances(model, samples, values[:p])
        usable = samples.usable[self.summed]
        tables = []
        for j, (block, used) in enumerate(zip(blocks, columns, strict=True)):
            torque = load[:, j] + block @ values[used]
            rate = predicted_rate(samples, torque)
            parts = block, -rate, beside.columns[j], samples.torque[:, j]
            table = np.column_stack([part[self.summed] for part in parts])
            tables.append(np.where(usable[:, j], table.T, 0.0))
        index = np.arange(len(usable)) * _TIME_BLOCKS // max(1, len(usable))
        places = tuple(
            np.concatenate([used, [p + joint], p + n + others])
            for joint, (used, others) in enumerate(zip(columns, beside.places, strict=True))
        )
        delays = tuple(f"delay {name}" for name in model.joint_names)
        names = (*model.parameter_names, *delays, *beside.names)
        counts = count_by_block(index, usable)
        factor = Factor.of_rows([(index, tables)], counts, places, names)
        if weights is None:
            unmoved = np.zeros(len(names))
            unmoved[:p] = values[:p]
            unmoved[p + n :][: len(values) - p] = values[p:]
            nothing = np.zeros((len(unmoved), 0))
            variance = residual_variance(factor, unmoved, nothing, np.ones(n))
            weights = inverse_variance(variance)
        rows = max(1, int(factor.samples.sum()))
        return _Blocks(factor.by_block(weights), p, n, weights, rows, beside)
