"""Growing oscillation in the following error of a recorded motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from hil.base.arrays import Array

SMOOTHING_SECONDS: Final = 0.05
"""Moving mean that is subtracted from the following error, s. Oscillations within it remain;
slower parts belong to the motion."""
BLOCK_LENGTHS: Final = (1, 4, 16)
"""Half-waves whose rms is compared: noise hides slow growth from one half-wave to the next."""
MIN_GROWING_BLOCKS: Final = 8  # Fewest blocks of uninterrupted growth
MIN_RMS_GROWTH: Final = 10.0  # Least growth of the rms
# Largest deviation of the length of a half-wave from the median
MAX_HALF_WAVE_DEVIATION: Final = 0.25
MIN_REGULAR_SHARE: Final = 0.75  # Least share of half-waves of regular length


@dataclass(frozen=True)
class Oscillation:
    """A growing oscillation: its joint (from 0), frequency [Hz], growth and duration of it [s]."""

    joint: int
    frequency: float
    growth: float
    seconds: float


def growing_oscillation(error: Array, period: float, resolution: Array) -> Oscillation | None:
    """Return the strongest growing oscillation in a following error; None without one.

    Args:
        error: commanded minus measured position (m, n) [rad], one row per cycle.
        period: cycle [s].
        resolution: of the measured positions (n,) [rad]; growth below it is none.
    """
    width = max(1, round(SMOOTHING_SECONDS / period))
    if len(error) < width:
        return None
    window = np.ones(width)
    rows = np.convolve(np.ones(len(error)), window, "same")
    candidates = []
    for joint, column in enumerate(error.T):
        fast = column - np.convolve(column, window, "same") / rows
        lengths, amplitudes = _half_waves(fast)
        amplitudes = np.maximum(amplitudes, resolution[joint])
        for block in BLOCK_LENGTHS:
            growth, first, last = _strongest_growth(amplitudes, block)
            if growth < MIN_RMS_GROWTH:
                continue
            section = lengths[first:last]
            typical = float(np.median(section))
            regular = np.mean(np.abs(section / typical - 1.0) <= MAX_HALF_WAVE_DEVIATION)
            frequency = 0.5 / (typical * period)
            if regular >= MIN_REGULAR_SHARE and frequency >= 1.0 / SMOOTHING_SECONDS:
                seconds = float(section.sum()) * period
                candidates.append(Oscillation(joint, frequency, growth, seconds))
    return max(candidates, key=lambda each: each.growth, default=None)


def _half_waves(values: Array) -> tuple[Array, Array]:
    """Return lengths (samples) and amplitudes of the values between two changes of their sign."""
    before = np.flatnonzero(np.diff(np.signbit(values)))
    if len(before) < 2:
        return np.empty(0), np.empty(0)
    crossings = before + values[before] / (values[before] - values[before + 1])
    return np.diff(crossings), np.maximum.reduceat(np.abs(values), before + 1)[:-1]


def _strongest_growth(amplitudes: Array, block: int) -> tuple[float, int, int]:
    """Return growth, first and last half-wave (exclusive) of the strongest uninterrupted growth.

    The growth is that of the rms of blocks of positive amplitudes; 0 if no section has
    `MIN_GROWING_BLOCKS` of them.
    """
    n_blocks = len(amplitudes) // block
    offset = len(amplitudes) - n_blocks * block
    rms = np.sqrt(np.mean(amplitudes[offset:].reshape(n_blocks, block) ** 2, axis=1))
    falls = np.flatnonzero(np.diff(rms) < 0.0)
    best = (0.0, 0, 0)
    for start, end in zip([0, *(falls + 1)], [*falls, n_blocks - 1], strict=True):
        if end - start + 1 < MIN_GROWING_BLOCKS:
            continue
        growth = float(rms[end] / rms[start])
        best = max(best, (growth, offset + start * block, offset + (end + 1) * block))
    return best
