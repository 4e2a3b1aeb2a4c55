"""Smoothing of positions, and the low-pass of torques.

Quintic splines f on uniform knots minimise, per channel on any increasing times,

    sum_i (y_i - f(t_i))^2 + penalty * integral f'''(t)^2 dt

with mean (y_i - f(t_i))^2 = tolerance (de Boor; Villagrossi et al. 2014, section 4.1), away from
the ends a zero-phase low-pass of gain 1 / (1 + (w / w_c)^6). The normal equations have five
off-diagonals; knots are refined to the tolerance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from math import comb, factorial
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array
from identification.signals.noise import ROWS_AT_ONCE
from identification.signals.sample_times import MAX_STEP_DEVIATION

Complex = NDArray[np.complex128]


SPLINE_DEGREE: Final = 5
SPLINE_ORDER: Final = SPLINE_DEGREE + 1  # non-zero basis functions per knot interval
# Limits of the penalty in knot units per sample: resolution of the knots, and rounding of the
# normal equations.
_MIN_PENALTY: Final = 1e-9
_MAX_PENALTY: Final = 1e11
_MAX_ACCURATE_PENALTY: Final = 1e4
"""Penalty, per samples of a knot, above which the normal equations lose digits: the solution is
then the one for the lightest penalty plus a correction."""
_LOG_PENALTY_TOLERANCE: Final = 1e-2  # of its logarithm; 0.2 % of the bandwidth
_MIN_SLOPE: Final = 1e-6  # slope of the residual over the penalty that is none
_RADIANS_PER_KNOT: Final = 0.5  # radians of the cutoff frequency per knot


@dataclass(frozen=True, eq=False)
class SmoothingSpline:
    """Quintic spline through c channels on uniform knots."""

    start: float  # time of the first knot [s]
    spacing: float  # knot spacing [s]
    coefficients: Array  # B-spline coefficients (intervals + 5, c)
    bandwidth: Array  # half-amplitude frequency per channel (c,) [Hz]

    def __call__(self, time: Array, derivative: int = 0) -> Array:
        """Return value or derivative at times (m,): (m, c), per second to its power."""
        intervals = len(self.coefficients) - SPLINE_DEGREE
        values = np.empty((len(time), self.coefficients.shape[1]))
        # The basis functions of a long recording take many times the memory of its values.
        for start in range(0, len(time), ROWS_AT_ONCE):
            some = slice(start, start + ROWS_AT_ONCE)
            rows = _rows(self.start, self.spacing, intervals, time[some], derivative)
            values[some] = rows @ self.coefficients
        return values


def fit_smoothing_spline(
    time: Array, values: Array, tolerance: Array, *, widest: float = np.inf
) -> SmoothingSpline:
    """Smooth channels to mean squared residuals equal to their tolerances.

    Limited by the closest spline with one knot per sample and by the smoothest one, nearly a
    parabola.

    Args:
        time: of the samples (m,) [s].
        values: channels (m, c).
        tolerance: of each channel (c,).
        widest: largest bandwidth [Hz].
    """
    for samples_per_knot in (4, 2, 1):
        problem = _Problem.of(time, values, samples_per_knot * float(np.median(np.diff(time))))
        fine = problem.design.spacing <= _RADIANS_PER_KNOT / (2.0 * np.pi * widest)
        # Without the squares of all samples, which are the largest array of a long recording.
        squares = np.einsum("mc,mc->c", problem.closest_residual, problem.closest_residual)
        if fine or np.all(squares / len(time) <= tolerance):
            break
    penalties = np.array(
        [problem.penalty_for(c, float(variance), widest) for c, variance in enumerate(tolerance)]
    )
    coefficients = problem.closest.copy()
    for channel, penalty in enumerate(penalties.tolist()):
        coefficients[:, channel] += problem.correction(channel, penalty)
    spacing = problem.design.spacing
    bandwidth = (problem.design.density / penalties) ** (1 / 6) / (2.0 * np.pi * spacing)
    return SmoothingSpline(float(time[0]), spacing, coefficients, bandwidth)


def low_pass(time: Array, values: Array, bandwidth: float) -> Array:
    """Filter values (m, c) by the same smoother with a fixed bandwidth [Hz]: linear, zero-phase."""
    step = float(np.median(np.diff(time)))
    times = time.tobytes()
    spacing = max(step, _RADIANS_PER_KNOT / (2.0 * np.pi * bandwidth))
    design = _design(times, spacing)
    penalty, factor = _low_pass_factor(times, spacing, bandwidth)
    if (
        penalty > _MAX_ACCURATE_PENALTY * design.density
    ):  # of few samples, as the knots follow the bandwidth
        problem = _Problem.of(time, values, spacing)
        coefficients = problem.closest + problem.correction(slice(None), penalty)
    else:
        coefficients = _banded_solution(factor, design.transposed @ values)
    return np.asarray(design.rows @ coefficients)


class _Design(NamedTuple):
    """Normal equations of a spline, which the times alone determine, in knot units."""

    spacing: float  # [s]
    density: float  # samples per knot interval
    rows: scipy.sparse.csr_array  # (m, k) values of the basis at the samples
    transposed: scipy.sparse.csc_array  # (k, m)
    gram: Array  # (6, k) lower band of rows' rows
    penalty: Array  # (6, k) lower band of the roughness

    def penalty_at(self, bandwidth: float) -> float:
        """Return the penalty of a bandwidth [Hz], within the limits of the knots."""
        cutoff = 2.0 * np.pi * bandwidth * self.spacing  # rad per knot
        share = np.clip(1.0 / max(cutoff, 1e-3) ** 6, _MIN_PENALTY, _MAX_PENALTY)
        return float(self.density * share)

    def factor(self, penalty: float) -> Array:
        """Return the factor (6, k) of the normal equations with a penalty."""
        return _banded_factor(self.gram + penalty * self.penalty)


@lru_cache(maxsize=2)  # torques and columns of one recording are filtered one after the other
def _design(times: bytes, spacing: float) -> _Design:
    """Return the design for times (m,) as float64, with about this knot spacing [s]."""
    time = np.frombuffer(times)
    span = float(time[-1] - time[0])
    intervals = max(1, round(span / spacing))
    spacing = span / intervals
    density = len(time) / intervals
    rows = _rows(float(time[0]), spacing, intervals, time)
    gram = _gram_band(rows)
    return _Design(spacing, density, rows, rows.T, gram, _penalty_band(intervals))


@lru_cache(maxsize=2)
def _low_pass_factor(times: bytes, spacing: float, bandwidth: float) -> tuple[float, Array]:
    """Return the penalty of a bandwidth [Hz], and the factor (6, k) with it, of a design."""
    design = _design(times, spacing)
    penalty = design.penalty_at(bandwidth)
    return penalty, design.factor(penalty)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Normal equations of samples in knot units, and their least smoothed solution."""

    design: _Design
    closest: Array  # (k, c) coefficients with the lightest penalty
    closest_residual: Array  # (m, c)
    roughness: Array  # (k, c) penalty matrix times closest

    @classmethod
    def of(cls, time: Array, values: Array, spacing: float) -> _Problem:
        """Set up the problem with about this knot spacing [s]."""
        design = _design(time.tobytes(), spacing)
        light = _MIN_PENALTY * design.density
        factor = design.factor(light)
        closest = _banded_solution(factor, design.transposed @ values)
        residual = design.rows @ closest
        np.subtract(values, residual, out=residual)
        refined = design.transposed @ residual - light * _roughness(closest)
        closest += _banded_solution(factor, refined)
        np.subtract(values, design.rows @ closest, out=residual)
        return cls(design, closest, residual, _roughness(closest))

    def correction(self, channel: int | slice, penalty: float) -> Array:
        """Return the change of coefficients from the least smoothed ones."""
        return self._corrected(penalty, self.roughness[:, channel])[1]

    def _corrected(self, penalty: float, roughness: Array) -> tuple[Array, Array]:
        """Return the factor (6, k) of the normal equations, and the change of coefficients."""
        design = self.design
        factor = design.factor(penalty)
        change = penalty - _MIN_PENALTY * design.density
        return factor, _banded_solution(factor, -change * roughness)

    def penalty_for(self, channel: int, tolerance: float, widest: float) -> float:
        """Return the penalty at which a channel's mean squared residual equals the tolerance.

        By Newton's method in logarithms, or bisection where a step would leave the bracket.
        """
        low, high = (float(np.log(self.design.penalty_at(width))) for width in (widest, 0.0))
        closest = np.ascontiguousarray(self.closest_residual[:, channel])
        roughness = np.ascontiguousarray(self.roughness[:, channel])
        point = low
        high_tried = False
        while high - low > _LOG_PENALTY_TOLERANCE:
            penalty = float(np.exp(point))
            variance, slope = self._residual_variance(penalty, closest, roughness)
            excess = float(np.log(variance / tolerance))
            if excess > 0.0:
                high = point
                high_tried = True
            else:
                low = point
            target = point - excess / max(slope, _MIN_SLOPE)
            if abs(target - point) < _LOG_PENALTY_TOLERANCE:
                return float(np.exp(np.clip(target, low, high)))
            if target >= high and not high_tried:
                target = high
                high_tried = True
            elif not low < target < high:
                target = 0.5 * (low + high)
            point = target
        return float(np.exp(low))

    def _residual_variance(
        self, penalty: float, closest: Array, roughness: Array
    ) -> tuple[float, float]:
        """Return the mean squared residual of a channel, and the slope of its logarithm.

        The slope is that over the logarithm of the penalty; `closest` (m,) is the closest residual,
        `roughness` (k,) the roughness of its coefficients.
        """
        factor, correction = self._corrected(penalty, roughness)
        residual = closest - self.design.rows @ correction
        variance = max(float(residual @ residual) / len(residual), np.finfo(np.float64).tiny)
        bending = roughness + _roughness(correction)
        # Half of the solution of b' A^-1 b, in a third of the time.
        half = scipy.linalg.lapack.dtbtrs(factor, bending[:, None], uplo="L")[0]
        sensitivity = float(np.vdot(half, half))
        return variance, 2.0 * penalty**2 * sensitivity / (len(residual) * variance)


def _banded_factor(band: Array) -> Array:
    """Return the lower Cholesky factor (6, k) of a positive definite matrix by its lower band.

    Without the checks of scipy's function, which take as long as the factorisation.
    """
    factor, failed = scipy.linalg.lapack.dpbtrf(band, lower=1, overwrite_ab=1)
    if failed:
        raise np.linalg.LinAlgError("the normal equations of the spline are singular")
    return np.asarray(factor)


def _banded_solution(factor: Array, right: Array) -> Array:
    """Solve for right-hand sides (k,) or (k, c) with a factor of `_banded_factor`."""
    return np.asarray(scipy.linalg.lapack.dpbtrs(factor, right, lower=1)[0])


@cache
def _pieces(degree: int, derivative: int = 0) -> Array:
    """Return the cardinal B-spline on a knot interval: powers of u by basis functions."""
    pieces = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        for j in range(degree + 1 - k):
            for power in range(degree + 1):
                whole = (-1) ** j * comb(degree + 1, j) * comb(degree, power)
                pieces[power, k] += whole * (degree - k - j) ** (degree - power) / factorial(degree)
    for _ in range(derivative):
        pieces = np.arange(1, len(pieces))[:, None] * pieces[1:]
    return pieces


def _rows(
    start: float, spacing: float, intervals: int, time: Array, derivative: int = 0
) -> scipy.sparse.csr_array:
    """Return the basis functions or derivatives at each time, sparse (m, intervals + 5)."""
    pieces = _pieces(SPLINE_DEGREE, derivative)
    m = len(time)
    weights = np.empty((m, SPLINE_ORDER))
    columns = np.empty((m, SPLINE_ORDER), dtype=np.int32)
    # Powers of all times of a long recording would be its largest arrays.
    for first in range(0, m, ROWS_AT_ONCE):
        part = slice(first, first + ROWS_AT_ONCE)
        x = (np.asarray(time[part], dtype=np.float64) - start) / spacing
        interval = np.clip(np.floor(x).astype(np.int32), 0, intervals - 1)
        x -= interval
        powers = np.ones((len(pieces), len(x)))  # `np.vander` takes three times as long
        for power in range(1, len(pieces)):
            np.multiply(powers[power - 1], x, out=powers[power])
        np.matmul(powers.T, pieces, out=weights[part])
        weights[part] /= spacing**derivative
        columns[part] = interval[:, None] + np.arange(SPLINE_ORDER, dtype=np.int32)
    ends = np.arange(0, SPLINE_ORDER * m + 1, SPLINE_ORDER, dtype=np.int32)
    return scipy.sparse.csr_array(
        (weights.ravel(), columns.ravel(), ends), shape=(m, intervals + SPLINE_DEGREE)
    )


def _gram_band(rows: scipy.sparse.csr_array) -> Array:
    """Return the lower band (6, k) of rows' rows, in the order of LAPACK."""
    first = rows.indices[::SPLINE_ORDER].astype(np.intp)
    weights = np.ascontiguousarray(rows.data.reshape(-1, SPLINE_ORDER).T)
    intervals = rows.shape[1] - SPLINE_DEGREE
    band = np.zeros((SPLINE_ORDER, rows.shape[1]), order="F")
    for k in range(SPLINE_ORDER):
        for offset in range(SPLINE_ORDER - k):
            products = weights[k] * weights[k + offset]
            band[offset, k : k + intervals] += np.bincount(first, products, minlength=intervals)
    return band


def _products(pieces: Array) -> Array:
    """Return integrals over a knot interval of products of two pieces, up to cubics."""
    points, weights = np.polynomial.legendre.leggauss(4)
    values = np.vander((points + 1.0) / 2.0, len(pieces), increasing=True) @ pieces
    return np.asarray(values.T @ (values * (weights / 2.0)[:, None]))


_THIRD_DERIVATIVES: Final = _products(_pieces(SPLINE_DEGREE, 3))
_QUADRATICS: Final = _products(_pieces(2))


def _penalty_band(intervals: int) -> Array:
    """Return the lower band (6, k) of integrals of third derivatives, in knot units."""
    band = np.zeros((SPLINE_ORDER, intervals + SPLINE_DEGREE), order="F")
    for k in range(SPLINE_ORDER):
        for offset in range(SPLINE_ORDER - k):
            band[offset, k : k + intervals] += _THIRD_DERIVATIVES[k, k + offset]
    return band


def _roughness(coefficients: Array) -> Array:
    """Return the penalty matrix times coefficients (k,) or (k, c).

    Accurate also with a heavy penalty.
    """
    third = _third_differences(coefficients)
    intervals = len(third) - 2
    padded = np.zeros((len(third) + 6, *third.shape[1:]))
    product = padded[3:-3]
    for k in range(3):
        for other in range(3):
            product[k : k + intervals] += _QUADRATICS[k, other] * third[other : other + intervals]
    return -_third_differences(padded)


def _third_differences(values: Array) -> Array:
    """Return ``np.diff(values, 3, axis=0)``, which takes longer."""
    for _ in range(3):
        values = values[1:] - values[:-1]
    return values


_MAX_CUTOFF_SHARE: Final = 0.45  # largest cut-off as a share of the sampling rate
_COLUMNS_AT_ONCE: Final = 8  # columns; more would leave the processor's cache
_NEGLIGIBLE_RESPONSE_SHARE: Final = 1e-6  # share of the impulse response that a reflection may lack


@dataclass(frozen=True)
class LowPassShape:
    """Order and direction of a low-pass."""

    order: int  # number of poles
    # forwards only, gain 1/sqrt(2) at the bandwidth; otherwise forwards and backwards, gain 1/2
    causal: bool = False

    def lag(self, bandwidth: float) -> float:
        """Return the delay [s] of slow signals by a causal low-pass [Hz]."""
        return 1.0 / (2.0 * math.pi * bandwidth * math.sin(math.pi / (2.0 * self.order)))

    def response(self, frequency: Array, bandwidth: float) -> tuple[Complex, Complex]:
        """Return gain H and lag ``i d(ln H)/dw`` [s] at frequencies [Hz], of the shape of these.

        The real part of the lag is the group delay.
        """
        # Poles of the prototype of 1 rad/s; backwards they are mirrored.
        angle = np.pi * (2.0 * np.arange(self.order) + 1.0 + self.order) / (2.0 * self.order)
        poles = np.exp(1j * angle)
        if not self.causal:
            poles = np.concatenate([poles, -poles])
        ratio = np.asarray(frequency, dtype=np.float64)[..., None] / bandwidth
        factors = 1.0 - 1j * ratio / poles
        lag = -(1.0 / (poles * factors)).sum(axis=-1) / (2.0 * np.pi * bandwidth)
        return np.asarray(1.0 / factors.prod(axis=-1)), np.asarray(lag)

    def __str__(self) -> str:
        poles = "one pole" if self.order == 1 else f"{self.order} poles"
        return f"{poles}, {'forwards only' if self.causal else 'without phase'}"


SMOOTHER: Final = LowPassShape(order=3)
"""That of the smoothing spline."""
WITHOUT_PHASE: Final = (SMOOTHER, *(LowPassShape(order) for order in (1, 2, 4)))
FORWARDS: Final = tuple(LowPassShape(order, causal=True) for order in (1, 2, 4))


def low_passed(
    time: Array, columns: Array, bandwidth: float, shape: LowPassShape = SMOOTHER
) -> Array:
    """Filter columns of a segment by a low-pass; Butterworth: at even times.

    Args:
        time: of the samples (m,) [s].
        columns: (m, c).
        bandwidth: of the low-pass [Hz].
        shape: its order and direction.
    """
    if shape == SMOOTHER:
        return low_pass(time, columns, bandwidth)
    step = float(np.median(np.diff(time)))
    if np.abs(np.diff(time) - step).max() <= MAX_STEP_DEVIATION * step:
        return _filtered(columns, bandwidth * step, shape)
    even = np.arange(time[0], time[-1] + step, step)
    filtered = _filtered(_interpolated(even, time, columns), bandwidth * step, shape)
    return _interpolated(time, even, filtered)


def _filtered(columns: Array, cycles: float, shape: LowPassShape) -> Array:
    """Filter columns (m, c) at even times; the cut-off in cycles per sample."""
    cycles = min(cycles, _MAX_CUTOFF_SHARE)
    if not shape.causal:
        return _filtered_without_phase(columns, cycles, shape.order)
    sections = scipy.signal.butter(shape.order, cycles, fs=1.0, output="sos")
    # Initially at rest with the first sample.
    state = scipy.signal.sosfilt_zi(sections)[:, :, None] * columns[0]
    return np.asarray(scipy.signal.sosfilt(sections, columns, axis=0, zi=state)[0])


def _filtered_without_phase(columns: Array, cycles: float, order: int) -> Array:
    """Filter columns (m, c), reflected about their end points, by a Butterworth filter twice.

    By its gain, of the bilinear transform. The line through the end points, which the filter leaves
    as it is, is apart: the reflected difference is periodic after two lengths, of which so
    much is transformed as reaches into the columns.
    """
    count = len(columns)
    if count < 3:
        return columns.copy()
    decay = 2.0 * np.pi * cycles * math.sin(math.pi / (2.0 * order))  # per sample
    reach = math.log(1.0 / _NEGLIGIBLE_RESPONSE_SHARE) / decay
    length = 2 * (count - 1)
    if count + 2 * reach < length:
        length = min(length, _quick_length(count + 2 * int(reach)))
    after = (length - count) // 2
    before = length - count - after
    ratio = np.tan(np.pi * np.arange(length // 2 + 1) / length) / math.tan(np.pi * cycles)
    gain = 1.0 / (1.0 + ratio ** (2 * order))
    share = np.linspace(0.0, 1.0, count)
    filtered = np.empty_like(columns)
    for first in range(0, columns.shape[1], _COLUMNS_AT_ONCE):
        # Transforms of rows take three quarters of the time.
        part = columns[:, first : first + _COLUMNS_AT_ONCE].T
        line = part[:, :1] + share * (part[:, -1:] - part[:, :1])
        extended = np.empty((len(part), length))
        extended[:, :count] = part - line
        extended[:, count : count + after] = -extended[:, count - 1 - after : count - 1][:, ::-1]
        extended[:, count + after :] = -extended[:, 1 : before + 1][:, ::-1]
        spectrum = np.fft.rfft(extended, axis=1)
        spectrum *= gain
        line += np.fft.irfft(spectrum, length, axis=1)[:, :count]
        filtered[:, first : first + _COLUMNS_AT_ONCE] = line.T
    return filtered


def _quick_length(least: int) -> int:
    """Return a length of few and small factors, which a transform takes least time for."""
    power = 1 << max(0, least - 1).bit_length()
    shares = (power * numerator // 16 for numerator in (9, 10, 12, 15, 16))
    return next(length for length in shares if length >= least)


def _interpolated(at: Array, time: Array, columns: Array) -> Array:
    return np.column_stack([np.interp(at, time, column) for column in columns.T])
