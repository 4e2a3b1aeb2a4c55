"""Smoothing spline whose mean squared residual equals a given tolerance (the paper's SPAPS).

Minimises, per channel and on any increasing time base,

    sum_i (y_i - f(t_i))^2 + penalty * integral f'''(t)^2 dt

over quintic splines f, and chooses the penalty so that mean (y_i - f(t_i))^2 = tolerance, which
is the measured variance of the channel (de Boor's rule, MATLAB's ``spaps``; Villagrossi et al.
2014, section 4.1). On uniform time and away from the ends this is a zero-phase low-pass with
gain 1 / (1 + (w / w_c)^6): three poles each way, like a third-order Butterworth filter run
forwards and backwards, whose derivatives are exact.

The knots are uniform and a few samples apart instead of one at each sample: every basis function
is then the same cardinal B-spline, the normal equations have five off-diagonals whatever the
time base, and a channel costs a few banded factorisations. The knots are refined where the
tolerance asks for more detail than they can follow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from math import comb
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]


ORDER: Final = 6  # quintic: six basis functions are non-zero on each knot interval
SAMPLES_PER_KNOT: Final = 4
# The penalty is limited, in knot units and per sample, to where it still smooths something the
# knots can show (lower end) and where the normal equations still have digits left (upper end).
_LIGHTEST: Final = 1e-9
_HEAVIEST: Final = 1e11
# Radians of a cutoff frequency per knot: the knots then follow far more than the smoother passes.
_KNOT_OF_CUTOFF: Final = 0.5


@dataclass(frozen=True, eq=False)
class SmoothingSpline:
    """Quintic spline through c channels on uniform knots.

    Attributes:
        start: time of the first knot [s].
        spacing: knot spacing [s].
        coefficients: B-spline coefficients (intervals + 5, c).
        bandwidth: frequency at which the smoothing halves a sine, per channel (c,) [Hz].
    """

    start: float
    spacing: float
    coefficients: Array
    bandwidth: Array

    def __call__(self, time: Array, derivative: int = 0) -> Array:
        """Value or derivative at ``time`` (m,): (m, c), per second to the power ``derivative``.

        Times outside the knots extrapolate the first or last piece.
        """
        intervals = len(self.coefficients) - ORDER + 1
        rows = _rows(self.start, self.spacing, intervals, time, derivative)
        return np.asarray(rows @ self.coefficients)


def fit_smoothing_spline(
    time: Array,
    values: Array,
    tolerance: Array,
    *,
    widest: float = np.inf,
    samples_per_knot: int = SAMPLES_PER_KNOT,
) -> SmoothingSpline:
    """Smooth each channel until its mean squared residual equals its tolerance.

    A tolerance below what one knot per sample can follow gives the closest such spline, one
    above the residual of the smoothest representable spline gives that spline (a parabola in
    all but name).

    Args:
        time: strictly increasing (m,) [s], uniform or not.
        values: (m, c).
        tolerance: wanted mean squared residual (c,), positive.
        widest: bandwidth [Hz] that is never exceeded, whatever the tolerance.
        samples_per_knot: knot spacing in median sampling intervals, to begin with.

    Raises:
        ValueError: fewer than 6 samples, or a tolerance that is not positive.
    """
    if len(time) < ORDER:
        raise ValueError(f"a quintic smoothing spline needs {ORDER} samples, got {len(time)}")
    tolerance = np.broadcast_to(np.asarray(tolerance, dtype=np.float64), values.shape[1:])
    if not np.all(tolerance > 0.0):
        raise ValueError(f"the tolerance must be positive in every channel, got {tolerance}")
    while True:
        problem = _Problem.build(time, values, samples_per_knot * _median_step(time))
        fine = problem.spacing <= _KNOT_OF_CUTOFF / (2.0 * np.pi * widest)
        close = bool(np.all(np.mean(problem.closest_residual**2, axis=0) <= tolerance))
        if fine or close or samples_per_knot == 1:
            break
        samples_per_knot = max(1, samples_per_knot // 2)
    channels = range(values.shape[1])
    return problem.solve(
        np.array([problem.penalty_for(c, float(tolerance[c]), widest) for c in channels])
    )


def low_pass(time: Array, values: Array, bandwidth: float) -> Array:
    """Values (m, c) after the same smoother with a fixed bandwidth [Hz]: linear, zero-phase.

    What is applied to a measured torque and to every column of its regressor alike leaves their
    linear relation as it is.
    """
    spacing = max(_median_step(time), _KNOT_OF_CUTOFF / (2.0 * np.pi * bandwidth))
    problem = _Problem.build(time, values, spacing)
    correction = problem.correction(slice(None), problem.penalty_at(bandwidth))
    return np.asarray(problem.rows @ (problem.closest + correction))


@dataclass(frozen=True, eq=False)
class _Problem:
    """Normal equations of one set of samples, in knot units, and their least smoothed solution.

    Every other solution is computed as a difference from that one. The difference has the size
    of the noise, so nothing is lost to cancellation against positions of many radians.
    """

    start: float
    spacing: float
    density: float  # samples per knot interval
    rows: scipy.sparse.csr_array  # (m, k) values of the basis at the samples
    gram: Array  # (6, k) lower band of rows' rows
    penalty: Array  # (6, k) lower band of the roughness
    closest: Array  # (k, c) coefficients with the lightest penalty
    closest_residual: Array  # (m, c)
    roughness: Array  # (k, c) penalty matrix times closest

    @classmethod
    def build(cls, time: Array, values: Array, spacing: float) -> _Problem:
        span = float(time[-1] - time[0])
        intervals = max(1, round(span / spacing))
        spacing = span / intervals
        density = len(time) / intervals
        start = float(time[0])
        rows = _rows(start, spacing, intervals, time, 0)
        gram, penalty = _gram_band(rows), _penalty_band(intervals)
        lightest = gram + _LIGHTEST * density * penalty
        factor = (scipy.linalg.cholesky_banded(lightest, lower=True), True)
        closest = scipy.linalg.cho_solve_banded(factor, rows.T @ values)
        closest += scipy.linalg.cho_solve_banded(
            factor,
            rows.T @ (values - rows @ closest) - _LIGHTEST * density * _roughness(closest),
        )
        residual = values - rows @ closest
        return cls(
            start, spacing, density, rows, gram, penalty, closest, residual, _roughness(closest)
        )

    def correction(self, channel: int | slice, penalty: float) -> Array:
        """How the coefficients of a channel, or all, differ from the least smoothed ones."""
        factor = scipy.linalg.cholesky_banded(self.gram + penalty * self.penalty, lower=True)
        excess = penalty - _LIGHTEST * self.density
        return np.asarray(
            scipy.linalg.cho_solve_banded((factor, True), -excess * self.roughness[:, channel])
        )

    def penalty_at(self, bandwidth: float) -> float:
        """Penalty that gives a bandwidth [Hz], within what the knots can show."""
        cutoff = 2.0 * np.pi * bandwidth * self.spacing  # rad per knot
        share = np.clip(1.0 / max(cutoff, 1e-3) ** 6, _LIGHTEST, _HEAVIEST)
        return float(self.density * share)

    def penalty_for(self, channel: int, tolerance: float, widest: float) -> float:
        """Penalty at which the channel's mean squared residual equals the tolerance.

        Never less than gives the widest bandwidth [Hz].
        """

        def excess(log_penalty: float) -> float:
            residual = self.closest_residual[:, channel] - self.rows @ self.correction(
                channel, float(np.exp(log_penalty))
            )
            variance = float(np.mean(residual**2))
            return float(np.log(max(variance / tolerance, np.finfo(np.float64).tiny)))

        lightest = np.log(self.penalty_at(widest))
        heaviest = np.log(self.penalty_at(0.0))
        if excess(lightest) >= 0.0:
            return float(np.exp(lightest))
        if excess(heaviest) <= 0.0:
            return float(np.exp(heaviest))
        return float(np.exp(scipy.optimize.brentq(excess, lightest, heaviest, xtol=1e-4)))

    def solve(self, penalties: Array) -> SmoothingSpline:
        coefficients = self.closest.copy()
        for channel, penalty in enumerate(penalties):
            coefficients[:, channel] += self.correction(channel, float(penalty))
        return SmoothingSpline(
            start=self.start,
            spacing=self.spacing,
            coefficients=coefficients,
            bandwidth=(self.density / penalties) ** (1 / 6) / (2.0 * np.pi * self.spacing),
        )


def _median_step(time: Array) -> float:
    return float(np.median(np.diff(time)))


def _pieces() -> Array:
    """Cardinal quintic B-spline on one knot interval: (6 powers of u, 6 basis functions).

    From B(x) = sum_j (-1)^j C(6, j) (x - j)_+^5 / 5!; basis function k sees x = u + 5 - k.
    """
    pieces = np.zeros((ORDER, ORDER))
    for k in range(ORDER):
        for j in range(ORDER - k):
            shift = 5 - k - j
            for power in range(ORDER):
                pieces[power, k] += (
                    (-1) ** j * comb(6, j) * comb(5, power) * shift ** (5 - power) / 120
                )
    return pieces


_PIECES: Final = _pieces()
# Quadratic B-spline likewise: (3 powers of u, 3 basis functions).
_QUADRATIC_PIECES: Final = np.array([[0.5, 0.5, 0.0], [-1.0, 1.0, 0.0], [0.5, -1.0, 0.5]])


def _piece_derivative(order: int) -> Array:
    pieces = _PIECES
    for _ in range(order):
        pieces = np.arange(1, len(pieces))[:, None] * pieces[1:]
    return pieces


def _rows(
    start: float, spacing: float, intervals: int, time: Array, derivative: int
) -> scipy.sparse.csr_array:
    """Basis functions, or their derivatives, at each time: sparse (m, intervals + 5)."""
    x = (np.asarray(time, dtype=np.float64) - start) / spacing
    interval = np.clip(np.floor(x).astype(np.int64), 0, intervals - 1)
    pieces = _piece_derivative(derivative)
    weights = np.vander(x - interval, len(pieces), increasing=True) @ pieces
    columns = interval[:, None] + np.arange(ORDER)
    return scipy.sparse.csr_array(
        (
            (weights / spacing**derivative).ravel(),
            columns.ravel(),
            np.arange(0, ORDER * len(x) + 1, ORDER),
        ),
        shape=(len(x), intervals + ORDER - 1),
    )


def _gram_band(rows: scipy.sparse.csr_array) -> Array:
    """Lower band (6, k) of rows' rows."""
    columns = rows.indices.reshape(-1, ORDER)
    weights = rows.data.reshape(-1, ORDER)
    band = np.zeros((ORDER, rows.shape[1]))
    for k in range(ORDER):
        for offset in range(ORDER - k):
            band[offset] += np.bincount(
                columns[:, k], weights[:, k] * weights[:, k + offset], minlength=rows.shape[1]
            )
    return band


def _gauss_products(pieces: Array) -> Array:
    """Integrals over one knot interval of the products of two pieces, up to cubics."""
    points, weights = np.polynomial.legendre.leggauss(4)
    values = np.vander((points + 1.0) / 2.0, len(pieces), increasing=True) @ pieces
    return np.asarray(values.T @ (values * (weights / 2.0)[:, None]))


def _penalty_band(intervals: int) -> Array:
    """Lower band (6, k) of the integrals of products of third derivatives, in knot units."""
    local = _gauss_products(_piece_derivative(3))
    band = np.zeros((ORDER, intervals + ORDER - 1))
    for k in range(ORDER):
        for offset in range(ORDER - k):
            band[offset, k : k + intervals] += local[k, k + offset]
    return band


def _roughness(coefficients: Array) -> Array:
    """Penalty matrix times coefficients (k, c), by way of third differences.

    The third derivative is a quadratic spline whose coefficients are the third differences.
    Computed this way the rounding has no part that a parabola could take up, however heavy the
    penalty; the band times the coefficients would lose eleven digits there.
    """
    third = np.diff(coefficients, 3, axis=0)
    intervals = len(third) - 2
    local = _gauss_products(_QUADRATIC_PIECES)
    product = np.zeros_like(third)
    for k in range(3):
        for other in range(3):
            product[k : k + intervals] += local[k, other] * third[other : other + intervals]
    return -np.diff(np.pad(product, ((3, 3), (0, 0))), 3, axis=0)


# Of the sampling rate: higher, the filter is none and the bilinear transform bends it.
_HIGHEST: Final = 0.45
# A zero-phase filter starts from the signal's point reflection at its end, for so many periods.
_PADDING_PERIODS: Final = 1.0
_UNEVEN: Final = 0.01  # of a step


@dataclass(frozen=True)
class LowPassShape:
    """How a low-pass falls off above its bandwidth.

    Attributes:
        order: number of poles, one way.
        causal: run forwards only, as a controller does it, so that it lags; it then has
            1/sqrt(2) of a sine at its bandwidth. Otherwise forwards and backwards, without phase:
            one half.
    """

    order: int
    causal: bool = False

    def lag(self, bandwidth: float) -> float:
        """Return the time [s] by which a causal low-pass [Hz] delays slow signals."""
        return 1.0 / (2.0 * math.pi * bandwidth * math.sin(math.pi / (2.0 * self.order)))

    def __str__(self) -> str:
        poles = "one pole" if self.order == 1 else f"{self.order} poles"
        return f"{poles}, {'forwards only' if self.causal else 'without phase'}"


SMOOTHER: Final = LowPassShape(order=3)
"""That of the smoothing spline, which takes any time base."""
WITHOUT_PHASE: Final = (SMOOTHER, *(LowPassShape(order) for order in (1, 2, 4)))
FORWARDS: Final = tuple(LowPassShape(order, causal=True) for order in (1, 2, 4))


def low_passed(
    time: Array, columns: Array, bandwidth: float, shape: LowPassShape = SMOOTHER
) -> Array:
    """Columns (m, c) of one stretch without a gap through a low-pass [Hz].

    Butterworth filters need even samples: columns at uneven times (m,) [s] are interpolated for
    them, and read again at their own times.
    """
    if shape == SMOOTHER:
        return low_pass(time, columns, bandwidth)
    step = float(np.median(np.diff(time)))
    if np.abs(np.diff(time) - step).max() <= _UNEVEN * step:
        return _filtered(columns, bandwidth * step, shape)
    even = np.arange(time[0], time[-1] + step, step)
    filtered = _filtered(_read(even, time, columns), bandwidth * step, shape)
    return _read(time, even, filtered)


def _filtered(columns: Array, cycles: float, shape: LowPassShape) -> Array:
    """Columns (m, c) at even times; the cut-off in cycles per sample."""
    cycles = min(cycles, _HIGHEST)
    sections = scipy.signal.butter(shape.order, cycles, fs=1.0, output="sos")
    if shape.causal:
        # As if it had been at rest with the first sample for ever.
        state = scipy.signal.sosfilt_zi(sections)[:, :, None] * columns[0]
        return np.asarray(scipy.signal.sosfilt(sections, columns, axis=0, zi=state)[0])
    padding = min(len(columns) - 1, int(np.ceil(_PADDING_PERIODS / cycles)))
    return np.asarray(scipy.signal.sosfiltfilt(sections, columns, axis=0, padlen=padding))


def _read(at: Array, time: Array, columns: Array) -> Array:
    return np.column_stack([np.interp(at, time, column) for column in columns.T])
