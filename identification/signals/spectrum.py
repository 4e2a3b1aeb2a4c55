"""Spectra of torques by Welch's method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STRETCH: Final = 4.0  # s; lines a quarter of a hertz apart
_FEWEST: Final = 32  # samples
_BINS: Final = 120
# Share of a signal's power: that of noise of a thousandth of its amplitude.
_NO_POWER: Final = 1e-6
# Share of half the sampling rate: filters against aliases usually cut at 0.8 of it.
_LOW_PASSED: Final = 0.75


class Spectrum(NamedTuple):
    """Amplitude spectral density.

    Attributes:
        frequency: (f,) [Hz], above zero and evenly spread on a logarithmic axis.
        density: (f, c) [unit of the signals per √Hz].
    """

    frequency: Array
    density: Array


def spectrum(time: Array, signals: Array, segments: Sequence[slice]) -> Spectrum:
    """Return the spectrum of signals (m, c) in the longest segment of time (m,) [s].

    As few points as a logarithmic figure shows. Uneven samples are interpolated at their median
    interval; f is 0 where there are too few.
    """
    frequency, power = _power(time, signals, segments, "hann")
    if not frequency.size:
        return Spectrum(frequency, power)
    edges = np.geomspace(frequency[0], frequency[-1], _BINS + 1)
    bins = np.clip(np.searchsorted(edges, frequency, side="right") - 1, 0, _BINS - 1)
    starts = np.flatnonzero(np.diff(bins, prepend=-1))
    counts = np.diff(starts, append=len(bins))
    mean_power = np.add.reduceat(power, starts, axis=0) / counts[:, None]
    return Spectrum(np.add.reduceat(frequency, starts) / counts, np.sqrt(mean_power))


def noiseless_above(time: Array, signals: Array, segments: Sequence[slice]) -> float | None:
    """Return the frequency [Hz] above which signals (m, c) have no power, not even that of noise.

    A measured signal has noise up to half its sampling rate, unless it came through a low-pass.
    None where any of the signals has some, or where there are too few samples.
    """
    frequency, power = _power(time, signals, segments, "blackmanharris")
    power = power[:, power.sum(axis=0) > 0.0]
    if not power.size:
        return None
    above = np.cumsum(power[::-1], axis=0)[::-1]
    silent = np.all(above < _NO_POWER * above[0], axis=1)
    found = float(frequency[np.argmax(silent)])
    return found if silent.any() and found < _LOW_PASSED * frequency[-1] else None


def _power(
    time: Array, signals: Array, segments: Sequence[slice], window: str
) -> tuple[Array, Array]:
    """Frequencies (f,) above zero, and the power spectral density at each (f, c)."""
    longest = max(segments, key=lambda one: int(one.stop - one.start), default=slice(0, 0))
    time, signals = time[longest], signals[longest]
    if time.size < _FEWEST:
        return np.empty(0), np.empty((0, signals.shape[1]))
    interval = float(np.median(np.diff(time)))
    even = np.arange(time[0], time[-1], interval)
    resampled = np.column_stack([np.interp(even, time, column) for column in signals.T])
    length = min(len(even), max(_FEWEST, round(_STRETCH / interval)))
    frequency, power = scipy.signal.welch(
        resampled, fs=1.0 / interval, window=window, nperseg=length, axis=0
    )
    # The mean is no part of it, and its line has what detrending left.
    return frequency[1:], power[1:]
