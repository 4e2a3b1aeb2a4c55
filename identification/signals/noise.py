"""Noise floor of a recording: at standstill, in motion, and whether there is any."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.signals.recording import RecordingError
from identification.signals.spectrum import HARRIS, power_density

STANDSTILL_WINDOW_SECONDS: Final = 0.1  # s
_MIN_WINDOW_SAMPLES: Final = 20  # samples
_MAX_DIFFERENCE_ORDER: Final = 8


def standstill_variance(time: Array, values: Array) -> Array:
    """Return the noise variance per channel (c,) of a recording at standstill (m, c).

    Median over windows of 0.1 s of the variance about a straight line, so that creep and single
    stick-slip moves do not count. Zero for a constant reading.

    Raises:
        RecordingError: fewer samples than one window.
    """
    if len(time) < _MIN_WINDOW_SAMPLES:
        raise RecordingError(
            f"a variance at standstill requires {_MIN_WINDOW_SAMPLES} samples, got {len(time)}"
        )
    width = max(
        _MIN_WINDOW_SAMPLES, round(STANDSTILL_WINDOW_SECONDS / float(np.median(np.diff(time))))
    )
    width = min(width, len(time))
    count = len(time) // width
    line = np.linspace(-1.0, 1.0, width)
    basis = np.column_stack([np.ones(width), line])
    basis /= np.linalg.norm(basis, axis=0)
    windows = values[: count * width].reshape(count, width, -1)
    windows = windows - windows.mean(axis=1, keepdims=True)
    residual = windows - np.einsum("wk,vk,nvc->nwc", basis, basis, windows)
    freedom = width - 2
    variance = (residual**2).sum(axis=1) / freedom
    # Median over mean of a chi-squared variable (Wilson and Hilferty).
    return np.asarray(np.median(variance, axis=0) / (1.0 - 2.0 / (9.0 * freedom)) ** 3)


def difference_variance(time: Array, values: Array) -> Array:
    """Return the white noise variance (c,) of smooth channels (m, c).

    By divided differences of rising order, scaled to unit noise gain (Gasser, Sroka and
    Jennen-Steinmetz 1986), up to the order at which the next changes the estimate by less than 5 %.

    Raises:
        RecordingError: fewer samples than the highest order needs.
    """
    if len(time) < 2 * _MAX_DIFFERENCE_ORDER:
        raise RecordingError(
            f"a noise variance requires {2 * _MAX_DIFFERENCE_ORDER} samples, got {len(time)}"
        )
    variances = [_difference_variance(time, values, 1)]
    settled = np.zeros((0, values.shape[1]), dtype=np.bool_)
    for order in range(2, _MAX_DIFFERENCE_ORDER + 1):
        variances.append(_difference_variance(time, values, order))
        settled = np.array(variances[1:]) > 0.95 * np.array(variances[:-1])
        if settled.any(axis=0).all():  # higher orders are not needed
            break
    estimates = np.array(variances)
    first = np.where(settled.any(axis=0), settled.argmax(axis=0), _MAX_DIFFERENCE_ORDER - 1)
    return np.asarray(np.take_along_axis(estimates, first[None, :], axis=0)[0])


def _difference_variance(time: Array, values: Array, order: int) -> Array:
    total = np.zeros(values.shape[1])
    count = len(time) - order
    for start in range(0, count, ROWS_AT_ONCE):
        rows = min(ROWS_AT_ONCE, count - start)
        channels = np.ascontiguousarray(values[start : start + rows + order].T)
        times = [time[start + k : start + k + rows] for k in range(order + 1)]
        scale = times[-1] - times[0]
        weights = np.ones((order + 1, rows))
        for k in range(order + 1):
            for earlier in range(k):
                apart = (times[k] - times[earlier]) / scale
                weights[k] *= apart
                weights[earlier] *= -apart
        np.divide(1.0, weights, out=weights)
        weights /= np.linalg.norm(weights, axis=0)
        difference = weights[0] * channels[:, :rows]
        for k in range(1, order + 1):
            difference += weights[k] * channels[:, k : k + rows]
        total += np.einsum("cm,cm->c", difference, difference)
    return np.asarray(total / count)


ROWS_AT_ONCE: Final = 8192  # of a long recording, whose intermediate arrays would be its largest
_SPECTRUM_SECONDS: Final = 4.0  # s; resolution 0.25 Hz
_MIN_SAMPLES: Final = 32  # samples
_SILENT_POWER_SHARE: Final = 1e-6  # share of a signal's power; noise of 0.1 % of the amplitude
# share of half the sampling rate; anti-alias filters cut at about 0.8
_MAX_EDGE_SHARE: Final = 0.75
_MIN_ROUNDING_STD_RATIO: Final = 2.0  # noise over that of rounding to the smallest step
_MIN_WHITE_SHARE: Final = 0.5  # of the power that white noise of the upper frequencies would have
_UPPER_SHARE: Final = 0.25  # of half the sampling rate, from which only noise is left of a motion
# Single precision rounds angles to a third of it, and no joint's encoder resolves it.
_MIN_SENSOR_NOISE: Final = 5e-7  # rad
_GRID_TOLERANCE: Final = 0.05  # of a step, from a whole number of steps
_DECIMAL_TOLERANCE: Final = 1e-3  # of a step, as a power of ten


def noiseless_above(time: Array, signals: Array, segments: Sequence[slice]) -> float | None:
    """Return the frequency [Hz] above which signals (m, c) have no power; None with noise."""
    frequency, power = _power(time, signals, segments)
    power = power[:, power.sum(axis=0) > 0.0]
    if not power.size:
        return None
    above = np.cumsum(power[::-1], axis=0)[::-1]
    silent = np.all(above < _SILENT_POWER_SHARE * above[0], axis=1)
    edge = float(frequency[np.argmax(silent)])
    return edge if silent.any() and edge < _MAX_EDGE_SHARE * frequency[-1] else None


def has_small_noise(time: Array, signals: Array, segments: Sequence[slice], above: float) -> bool:
    """Return whether angles (m, c) [rad] have small white noise of a sensor.

    It is larger than rounding to the digits of a log leaves, or the steps are an encoder's,
    no decimal number of degrees or radians; and there is as much of it at the highest frequencies
    as in all of the upper part of the spectrum, in which no motion is left.

    Args:
        time: of the samples (m,) [s].
        signals: that move.
        segments: without gaps.
        above: frequency [Hz] above which there is hardly any motion.
    """
    frequency, power = _power(time, signals, segments)
    longest = max(segments, key=lambda segment: int(segment.stop - segment.start))
    moving = power.sum(axis=0) > 0.0
    time, signals = time[longest], signals[longest][:, moving]
    variance = difference_variance(time, signals)
    step = smallest_steps(signals)
    rounding = step**2 / 12.0
    beyond = variance > _MIN_ROUNDING_STD_RATIO**2 * rounding
    of_encoder = (variance > rounding / _MIN_ROUNDING_STD_RATIO**2) & ~_is_decimal(step)
    # What little motion there is next to its edge is more than the noise of a fine encoder.
    lowest = max(above, _UPPER_SHARE * frequency[-1])
    of_band = power[frequency >= lowest][:, moving].mean(axis=0) * frequency[-1]
    white = variance >= np.maximum(_MIN_WHITE_SHARE * of_band, _MIN_SENSOR_NOISE**2)
    return bool(np.mean((beyond | of_encoder) & white) > 0.5)


def hidden_by_rounding(time: Array, signals: Array, segments: Sequence[slice]) -> float | None:
    """Return the step [rad] that angles (m, c) are rounded to, where it hides a sensor's noise.

    None where they are not rounded so coarsely, or have another noise than that of rounding.

    Args:
        time: of the samples (m,) [s].
        signals: that move.
        segments: without gaps.
    """
    longest = max(segments, key=lambda segment: int(segment.stop - segment.start))
    time, signals = time[longest], signals[longest]
    if len(time) < _MIN_SAMPLES or not signals.size:
        return None
    step = smallest_steps(signals)
    steps = np.diff(signals, axis=0) / np.where(step > 0.0, step, np.inf)
    on_grid = np.abs(steps - np.rint(steps)).max(axis=0) < _GRID_TOLERANCE
    rounding = step**2 / 12.0
    is_coarse = on_grid & (rounding > _MIN_SENSOR_NOISE**2)
    is_of_rounding = difference_variance(time, signals) < _MIN_ROUNDING_STD_RATIO**2 * rounding
    hidden = is_coarse & is_of_rounding
    return float(np.median(step[hidden])) if np.mean(hidden) > 0.5 else None


def smallest_steps(signals: Array) -> Array:
    """Return the smallest change of each signal between samples (c,), zero if it never moves."""
    steps = np.abs(np.diff(signals, axis=0))
    least = np.min(steps, axis=0, where=steps > 0.0, initial=np.inf)
    return np.where(np.isfinite(least), least, 0.0)


def _is_decimal(steps: Array) -> NDArray[np.bool_]:
    """Return which steps [rad] are a power of ten, in radians or in degrees (c,)."""
    exponents = np.log10(np.maximum([steps, np.degrees(steps)], np.finfo(np.float64).tiny))
    is_power = np.abs(exponents - np.rint(exponents)) < _DECIMAL_TOLERANCE
    return np.asarray(is_power.any(axis=0))


def _power(time: Array, signals: Array, segments: Sequence[slice]) -> tuple[Array, Array]:
    """Return frequencies (f,) above zero and power spectral densities (f, c)."""
    longest = max(
        segments, key=lambda segment: int(segment.stop - segment.start), default=slice(0, 0)
    )
    time = time[longest]
    signals = signals[longest]
    if time.size < _MIN_SAMPLES:
        return np.empty(0), np.empty((0, signals.shape[1]))
    interval = float(np.median(np.diff(time)))
    even = np.arange(time[0], time[-1], interval)
    resampled = np.column_stack([np.interp(even, time, column) for column in signals.T])
    length = min(len(even), max(_MIN_SAMPLES, round(_SPECTRUM_SECONDS / interval)))
    return power_density(resampled, 1.0 / interval, length, HARRIS)
