"""Power spectral density, written here since importing `scipy.signal` takes longer than its use."""

from __future__ import annotations

from typing import Final

import numpy as np

from identification.arrays import Array

HANN: Final = (0.5, -0.5)
HARRIS: Final = (0.35875, -0.48829, 0.14128, -0.01168)
"""Cosine sums of windows; four terms leak least (Harris 1978)."""


def power_density(
    signals: Array, rate: float, length: int, window: tuple[float, ...] = HANN
) -> tuple[Array, Array]:
    """Return frequencies (f,) [Hz] and one-sided power densities (f, c) of signals [1/Hz].

    Welch (1967): mean over parts that overlap by half, without their mean, which has no frequency
    here.

    Args:
        signals: (m, c).
        rate: of the samples [Hz].
        length: of a part, in rows.
        window: that parts are multiplied by.
    """
    phase = 2.0 * np.pi * np.arange(length) / length
    weights = sum(share * np.cos(k * phase) for k, share in enumerate(window))
    weights = np.asarray(weights)[:, None]
    starts = range(0, len(signals) - length + 1, max(1, length // 2))
    power = np.zeros((length // 2 + 1, signals.shape[1]))
    for first in starts:
        part = signals[first : first + length]
        power += np.abs(np.fft.rfft(weights * (part - part.mean(axis=0)), axis=0)) ** 2
    density = 2.0 * power / (len(starts) * rate * float(np.sum(weights**2)))
    if length % 2 == 0:
        density[-1] *= 0.5  # the highest frequency is its own negative
    frequency = np.asarray(np.fft.rfftfreq(length, 1.0 / rate), dtype=np.float64)
    return frequency[1:], density[1:]
