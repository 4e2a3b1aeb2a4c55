r"""Constant delay of the torque or current channel relative to the positions.

The torque of axis j is recorded with delay d_j:

.. math:: \tau_j(t) = W_j\bigl(q, \dot q, \ddot q\bigr)(t - d_j)\,\pi + e_j(t)

One logger records all torques, so a common delay is estimated first: the minimum of a residual
profile is refined by Gauss-Newton steps on parameters and delay together, with the column
:math:`-d\tau/dt`. An axis gets its own deviation only where that is significant and predicts
left-out blocks of time better.

The motion is interpolated at other times, not the torque, whose noise that would smooth. Rows near
a velocity reversal are left out: presliding friction is similar to a delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.distributions import student_limit
from identification.errors import IdentificationError
from identification.estimators.covariance import block_length, spread
from identification.factor.factor import (
    Estimate,
    Factor,
    NormalEquations,
    Solution,
    estimate,
    inverse_variance,
    no_rows_message,
    residual_variance,
    solve,
)
from identification.factor.phases import PhaseFactor, merged
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.masks import near_any_reversal
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, Samples, prepare

Array = NDArray[np.float64]


def compensate(recording: Recording, delays: Sequence[float] | Array) -> Recording:
    """Return the checked recording with torque and current shifted by delays (n,) [s].

    Channels are interpolated by cubics, not across gaps; samples without data at the ends of
    segments are dropped. For a common delay, :attr:`Preprocessing.torque_delay` leaves the torque
    unchanged.

    Raises:
        IdentificationError: no sample is left.
    """
    shift, time = np.asarray(delays, dtype=np.float64), recording.time
    keep, gap = np.zeros((2, recording.n_samples), dtype=np.bool_)
    channels = {"torque": recording.torque, "motor_current": recording.motor_current}
    moved = {name: array.copy() for name, array in channels.items() if array is not None}
    for segment in recording.segments():
        inside = time[segment]
        covered = (inside + shift.min() >= inside[0]) & (inside + shift.max() <= inside[-1])
        if not covered.any() or len(inside) < 2:
            continue
        keep[segment] = covered
        gap[segment.start + int(np.argmax(covered))] = True
        for array in moved.values():
            for joint in np.flatnonzero(shift):
                at = inside + shift[joint]
                array[segment, joint] = read_at(inside, array[segment, joint], at)
    if not keep.any():
        raise IdentificationError("every segment of the recording is shorter than the delay")
    changes: dict[str, Any] = {**moved, "gap_before": gap}
    return replace(recording, **changes).rows(keep)


def read_at(time: Array, values: Array, at: Array) -> Array:
    """Interpolate values (m, ...) of one segment at times (k,), constant outside."""
    # Local, since a global spline oscillates at Coulomb friction steps.
    source = scipy.interpolate.CubicHermiteSpline(time, values, np.gradient(values, time, axis=0))
    return np.asarray(source(np.clip(at, time[0], time[-1])))


def predicted_rate(samples: Samples, torque: Array) -> Array:
    """Return the time derivative of torques (m, ...), zero in segments of one sample."""
    rate = np.zeros_like(torque)
    for segment in samples.segments:
        if segment.stop - segment.start > 1:
            rate[segment] = np.gradient(torque[segment], samples.motion.time[segment], axis=0)
    return rate


def rate_products(model: RobotModel, samples: Samples) -> Array:
    """Return sums ``W' d[W | t]/dt`` per joint (n, p, p + 1); t is of the known payload."""
    products = np.zeros((model.n_joints, model.n_parameters, model.n_parameters + 1))
    load = samples.known_torque(model)
    for joint, (block, columns) in enumerate(zip(*samples.regressor(model), strict=True)):
        rows = samples.usable[:, joint]
        rate = predicted_rate(samples, np.column_stack([block, load[:, joint]]))
        places = np.ix_(columns, np.append(columns, model.n_parameters))
        products[joint][places] = block[rows].T @ rate[rows]
    return products


def with_uncertain_delay(
    estimate: Estimate, factor: Factor, products: Array, variance: float
) -> Estimate:
    """Return the estimate with the variance [s²] of its given delay in the covariance.

    The parameters change by the fit of the torque's rate; `products` are the `rate_products` of the
    factor's samples (n, p, p + 1).
    """
    weights = inverse_variance(estimate.noise_std**2)
    rate = np.tensordot(weights, products, axes=1) @ np.append(estimate.values, 1.0)
    moved = solve(factor.weighted(weights)._replace(b=rate)).values
    known = np.where(np.isfinite(np.diag(estimate.covariance)), moved, 0.0)
    return replace(estimate, covariance=estimate.covariance + variance * np.outer(known, known))


Rows = NDArray[np.bool_]

LONGEST_DELAY: Final = 0.05  # s, either way
# Encoder noise correlates with the torque through the servo loop. Simulated NS 16, delay 0.2 ms,
# four seeds: mean 0.18 ms at 10 Hz, 0.155 at 15 and 0.16 at 40 Hz, where wrist axes deviate by 0.3
# ms.
DELAY_BANDWIDTH: Final = 10.0  # Hz
# Half a 95 % interval of a determined delay.
WIDEST_INTERVAL: Final = 1e-3  # s
# Averaging interval of torques, symmetric in time; 2 % loss at 10 Hz.
_BIN: Final = 0.01  # s
# Minima of the profile are wider.
_PROFILE_STEP: Final = 0.01  # s
_ITERATIONS: Final = 12
_CONVERGED, _OF_STD = 1e-6, 0.02  # s, and share of the standard deviation
_MODEL_ERROR: Final = 0.05  # difference of log variance up to which two minima are equally good
_REVERSAL_PERIODS: Final = 0.5  # periods of the smoothing's bandwidth beside a velocity reversal
_FOLDS: Final = 5
_BLOCKS: Final = 80  # blocks of time
_WORTHWHILE: Final = 0.02  # required reduction of the squared error by a deviation
_CHANCE: Final = 0.005  # one-sided probability of a false delay


@dataclass(frozen=True, eq=False)
class DelayEstimate:
    """Delay of the torque of n axes relative to the position."""

    joint_names: tuple[str, ...]  # (n,)
    common: float  # delay of all axes without own deviation [s]
    common_std: float  # cluster-robust standard deviation [s]; infinite if undetermined
    # of each axis from the common delay (n,) [s]; zero if prediction does not improve
    deviations: Array
    deviation_std: Array  # standard deviations (n,) [s]
    assumed: float  # delay with which the samples were prepared [s]
    cycle: float  # usual step of the clock [s]
    interval_factor: float  # standard deviations in half a 95 % interval
    reason: str | None  # why the common delay is undetermined, or None
    # whether the delays differ from `assumed` at 99 % and predict left-out blocks better
    significant: bool

    @property
    def determined(self) -> bool:
        """Whether the delays of the axes are determined."""
        return self.reason is None

    @property
    def delays(self) -> Array:
        """Delays of the axes (n,) [s], NaN if undetermined."""
        return np.where(self.determined, self.common + self.deviations, np.nan)

    @property
    def std(self) -> Array:
        """Standard deviations of `delays` (n,) [s], infinite if undetermined."""
        own = np.where(self.deviations != 0.0, self.deviation_std, self.common_std)
        return np.where(self.determined, own, np.inf)

    @property
    def agree(self) -> bool:
        """Whether all axes have the common delay."""
        return not self.deviations.any()

    @property
    def applied(self) -> Array:
        """Delays to compensate (n,) [s]: those assumed unless significant."""
        n = len(self.joint_names)
        return self.common + self.deviations if self.significant else np.full(n, self.assumed)

    @property
    def variance(self) -> float:
        """Variance of the common delay [s²], at most that of a uniform one in `LONGEST_DELAY`.

        Also the error variance of an assumed delay inside the interval.
        """
        return float(np.fmin(self.common_std**2, LONGEST_DELAY**2 / 3.0))

    def describe(self) -> list[str]:
        """Return lines on the common delay and each axis that deviates."""
        axes = "all axes" if self.agree else "all other axes"
        against = f"the {self.assumed * 1e3:.3g} ms assumed"
        if self.reason is None or self.significant:
            line = f"{self._text(self.common, self.common_std)},"
            line += f" {'' if self.significant else 'not '}significantly different from {against}"
        else:
            line = f"not determined; {self.reason}"
        lines = [f"{axes}: {line}"]
        lines += [
            f"{name}: {self._text(self.common + deviation, std)}, which predicts better than the"
            " common delay"
            for name, deviation, std in zip(
                self.joint_names, self.deviations, self.deviation_std, strict=True
            )
            if deviation != 0.0
        ]
        return lines

    def _text(self, delay: float, std: float) -> str:
        half = self.interval_factor * std
        return (
            f"{delay * 1e3:.3f} ms ± {half * 1e3:.3f} ms"
            f" ({delay / self.cycle:.2f} ± {half / self.cycle:.2f} cycles)"
        )


def estimate_delays(
    recording: Recording,
    model: RobotModel,
    *,
    noise_variance: Array | None = None,
    options: Preprocessing = Preprocessing(),  # noqa: B008 - frozen
) -> DelayEstimate:
    """Estimate the delay of a recording's torque relative to its position.

    `noise_variance` (n,) as for :func:`identification.signals.samples.smooth`; the options are of
    the smoothing and the torque's low-pass, with the assumed delay.

    Raises:
        RecordingError: see :func:`identification.signals.samples.prepare`.
        IdentificationError: no usable row.
    """
    n, p, assumed = model.n_joints, model.n_parameters, options.torque_delay
    narrow = min(options.rigid_bandwidth, DELAY_BANDWIDTH)
    options = replace(options, smooth_torque=False, rigid_bandwidth=narrow)
    samples = prepare(recording, model, noise_variance=noise_variance, options=options)
    reader = _Reader.of(model, samples)
    ends = (-LONGEST_DELAY - assumed, LONGEST_DELAY - assumed)
    grid = np.linspace(*ends, 1 + 2 * int(np.ceil(LONGEST_DELAY / _PROFILE_STEP)))
    heights, values = reader.profile(grid)
    shift = np.full(n, grid[np.argmin(heights)])
    shift, blocks = _descend(reader, shift, values, _basis(p, n), ends)
    other = _other_minimum(grid, heights, float(shift[0]), reader.profile(shift[:1])[0][0])
    axes = _deviating(blocks, p, n)
    basis = _basis(p, n, axes)
    if axes:
        shift, blocks = _descend(reader, shift, values, basis, ends)
    solution = blocks.solution(basis)
    covariance, factor = blocks.covariance(basis, solution)
    _, by_chance = blocks.covariance(basis, solution, _CHANCE)
    std = np.sqrt(np.einsum("jk,kl,jl->j", basis[p:, p:], covariance[p:, p:], basis[p:, p:]))
    own = np.isin(np.arange(n), axes)
    first = int(np.argmin(own))  # first axis with the common delay
    common = float(shift[first])
    common_std = float(std[first]) if solution.determined[p] else np.inf
    at_limit = bool(np.any((shift <= ends[0]) | (shift >= ends[1])))
    before = reader.linearised(np.zeros(n), solution.values[:p], blocks.weights)
    return DelayEstimate(
        joint_names=model.joint_names,
        common=common + assumed,
        common_std=common_std,
        deviations=np.where(own, shift - common, 0.0),
        deviation_std=np.where(own, std, 0.0),
        assumed=assumed,
        cycle=reader.cycle,
        interval_factor=factor,
        reason=_undetermined_reason(factor * common_std, at_limit, other + assumed),
        significant=bool(
            not at_limit
            and np.isnan(other)
            and (axes or abs(common) > by_chance * common_std)
            and blocks.predicted(basis) < before.predicted(basis[:, :p])
        ),
    )


def _basis(p: int, n: int, axes: Sequence[int] = ()) -> Array:
    """Return parameters and delays (p + n, k) by p parameters, common delay, deviations."""
    return np.column_stack(
        [np.eye(p + n, p), np.repeat([0.0, 1.0], [p, n]), np.eye(p + n)[:, p + np.array(axes, int)]]
    )


def _descend(
    reader: _Reader, shift: Array, values: Array, basis: Array, ends: tuple[float, float]
) -> tuple[Array, _Blocks]:
    """Refine shifts (n,) by Gauss-Newton; returns the linear problem there, too."""
    p = reader.model.n_parameters
    for _ in range(_ITERATIONS):
        blocks = reader.linearised(shift, values)
        solution = blocks.solution(basis)
        values = solution.values[:p]
        step = np.clip(basis[p:, p:] @ solution.values[p:], -_PROFILE_STEP, _PROFILE_STEP)
        before, shift = shift, np.clip(shift + step, *ends)
        small = max(_CONVERGED, _OF_STD * float(np.sqrt(solution.inverse[p, p])))
        if np.all(np.abs(shift - before) <= small):
            break
    return shift, blocks


def _deviating(blocks: _Blocks, p: int, n: int) -> list[int]:
    """Return axes with a significant own delay that predicts better; never all."""
    axes: list[int] = []
    left = [axis for axis in range(n) if blocks.gram[:, p + axis, p + axis].any()]
    error = blocks.predicted(_basis(p, n))
    while len(left) > 1:
        errors = {axis: blocks.predicted(_basis(p, n, [*axes, axis])) for axis in left}
        axis = min(left, key=lambda one: errors[one])
        basis = _basis(p, n, [*axes, axis])
        solution = blocks.solution(basis)
        covariance, limit = blocks.covariance(basis, solution, _CHANCE / n)
        far = abs(solution.values[-1]) > limit * np.sqrt(covariance[-1, -1])
        if errors[axis] >= (1.0 - _WORTHWHILE) * error or not far:
            break
        axes.append(axis)
        left.remove(axis)
        error = errors[axis]
    return axes


def _other_minimum(grid: Array, heights: Array, shift: float, height: float) -> float:
    """Return another minimum of the profile that is as deep, NaN without one."""
    padded = np.concatenate([[np.inf], heights, [np.inf]])
    valley = (heights <= padded[:-2]) & (heights <= padded[2:])
    other = np.abs(grid - shift) > grid[1] - grid[0]
    found = np.flatnonzero(valley & other & (heights < height + _MODEL_ERROR))
    return float(grid[found[np.argmin(heights[found])]]) if found.size else float("nan")


def _undetermined_reason(half_interval: float, at_limit: bool, other: float) -> str | None:
    if not np.isfinite(half_interval):
        return "the motion does not separate a delay from the other parameters"
    if at_limit:
        return "the residual decreases up to the longest delay tested"
    if half_interval > WIDEST_INTERVAL:
        return (
            f"95 % interval of ± {half_interval * 1e3:.2g} ms: the torques change too slowly, or"
            " are too noisy"
        )
    if np.isfinite(other):
        return f"a delay of {other * 1e3:.0f} ms explains the torques as well"
    return None


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Weighted normal equations of p parameters and n delay steps, by B blocks of time."""

    gram: Array  # (B, p + n + 1, p + n + 1)
    weights: Array  # (n,)
    rows: int

    def solution(self, basis: Array) -> Solution:
        """Solve by least squares in the coordinates of a basis (p + n, k)."""
        return _solved(_reduced(self.gram.sum(axis=0), basis))

    def covariance(
        self, basis: Array, solution: Solution, share: float = 0.025
    ) -> tuple[Array, float]:
        """Return the cluster-robust covariance (k, k), and the quantile of `share`."""
        gram = _reduced(self.gram[self.gram[:, -1, -1] > 0.0], basis)
        augmented = np.append(-solution.values, 1.0)
        gram = merged(gram, block_length(gram[:, :-1] @ augmented))
        moved = spread(gram[:, :-1, :-1], gram[:, :-1] @ augmented, solution.root)
        return np.asarray(moved.T @ moved), float(student_limit(share, max(1, len(gram) - 1)))

    def predicted(self, basis: Array) -> float:
        """Return the mean weighted squared error of each fifth predicted from the others."""
        parts = np.array_split(_reduced(self.gram, basis), _FOLDS)
        folds = np.array([part.sum(axis=0) for part in parts])
        error = 0.0
        for own in folds:
            augmented = np.append(-_solved(folds.sum(axis=0) - own).values, 1.0)
            error += float(augmented @ own @ augmented)
        return error / self.rows


def _reduced(gram: Array, basis: Array) -> Array:
    """Transform Grams (..., q + 1, q + 1) of [W | y] to a basis (q, k) of W."""
    wide = scipy.linalg.block_diag(basis, 1.0)
    return np.asarray(wide.T @ (gram @ wide))


def _solved(gram: Array) -> Solution:
    return solve(NormalEquations(gram[:-1, :-1], gram[:-1, -1]))


@dataclass(frozen=True, eq=False)
class _Reader:
    """Recording with torque averaged over short bins, and motion at any time shift."""

    model: RobotModel
    samples: Samples  # as prepared
    binned: Samples  # torque in bins, with that of known payloads; no motion
    parts: tuple[tuple[slice, slice], ...]  # per segment its rows of `samples` and of `binned`
    clear: Rows  # bins away from standstill and reversals (m, n)
    cycle: float  # usual step of the clock [s]

    @classmethod
    def of(cls, model: RobotModel, samples: Samples) -> _Reader:
        """Prepare the samples of a recording."""
        motion = samples.motion
        reach = _REVERSAL_PERIODS / samples.position_bandwidth
        clear = model.moving(motion.velocity) & ~near_any_reversal(model, motion, reach)
        cycle = float(np.median(np.diff(motion.time)))
        size = max(1, round(_BIN / cycle))
        parts, start = [], 0
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
        return cls(model, samples, binned, tuple(parts), every(clear), cycle)

    def at(self, shift: float) -> Samples:
        """Return the bins with the motion of an earlier time, by a shift."""
        time, usable = self.binned.motion.time, self.binned.usable.copy()
        fields = [field for field in self.samples.motion[1:] if field is not None]
        moved = [np.zeros((len(time), field.shape[1])) for field in fields]
        for raw, b in self.parts:
            inside, at = self.samples.motion.time[raw], time[b] - shift
            for field, target in zip(fields, moved, strict=True):
                target[b] = read_at(inside, field[raw], at)
            place, clear = np.interp(at, time[b], np.arange(len(at))), self.clear[b]
            near = clear[np.floor(place).astype(int)] & clear[np.ceil(place).astype(int)]
            usable[b] &= near & ((at >= inside[0]) & (at <= inside[-1]))[:, None]
        result = replace(self.binned, motion=Motion(time, *moved), usable=usable)
        return replace(result, torque=result.torque - result.known_torque(self.model))

    def profile(self, shifts: Array) -> tuple[Array, Array]:
        """Return mean log residual variance at common shifts (K,), and the best parameters."""
        heights, best = np.full(len(shifts), np.inf), np.zeros(self.model.n_parameters)
        for k, shift in enumerate(shifts.tolist()):
            factor = Factor.of(self.model, self.at(shift))
            moving = factor.samples > 0
            if moving.any():
                found = estimate(self.model, factor)
                height = 2.0 * np.log(found.noise_std[moving])
                heights[k] = np.average(height, weights=factor.samples[moving])
                best = found.values if heights[k] <= heights.min() else best
        if not np.isfinite(heights).any():
            raise IdentificationError(no_rows_message(self.model))
        return heights, best

    def linearised(self, shift: Array, values: Array, weights: Array | None = None) -> _Blocks:
        """Return normal equations of p parameters and n delay steps at shifts (n,), by blocks."""
        n, p, model = self.model.n_joints, self.model.n_parameters, self.model
        rows, tables = np.zeros_like(self.clear), [np.empty((0, 0))] * n
        for value in np.unique(shift).tolist():
            samples = self.at(value)
            blocks, columns = samples.regressor(model)
            load = samples.known_torque(model)
            for j in np.flatnonzero(shift == value):
                rate = predicted_rate(samples, load[:, j] + blocks[j] @ values[columns[j]])
                table = np.column_stack([blocks[j], -rate, samples.torque[:, j]])
                rows[:, j] = samples.usable[:, j]
                tables[j] = np.where(rows[:, j], table.T, 0.0)
        index = np.arange(len(rows)) * _BLOCKS // max(1, len(rows))
        own = tuple(np.append(used, p + j) for j, used in enumerate(model.plan.columns))
        names = model.parameter_names + tuple(f"delay of {name}" for name in model.joint_names)
        phase = PhaseFactor.of_rows(index, rows, own, names, [(slice(None), tables)])
        if weights is None:
            here, nothing = np.append(values, np.zeros(n)), np.zeros((p + n, 0))
            variance = residual_variance(phase.total, here, nothing, np.ones(n))
            weights = inverse_variance(variance)
        return _Blocks(phase.weighted(weights), weights, max(1, int(phase.samples.sum())))
