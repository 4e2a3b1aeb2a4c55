"""Growing oscillation in the following error of a recorded motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMOOTHED: Final = 0.05  # Moving mean that is subtracted from the following error, s
WINDOW: Final = 0.1  # Windows whose rms is compared, s
SHORTEST: Final = 5  # Fewest windows of uninterrupted growth
GROWTH: Final = 10.0  # Least growth of the rms
SLOWEST: Final = 40.0
"""Lowest frequency, Hz: slower parts of the following error are those of the motion, which the
moving mean does not remove, and grow where it begins."""
NARROW: Final = 0.5  # Least share of the power within two bins of the dominant frequency


@dataclass(frozen=True)
class Oscillation:
    """A growing oscillation: its joint (from 0), frequency [Hz], growth and duration of it [s]."""

    joint: int
    frequency: float
    growth: float
    seconds: float

    def sentence(self, joint_names: tuple[str, ...]) -> str:
        """Return it in a clause."""
        return (
            f"{joint_names[self.joint]} oscillates at {self.frequency:.0f} Hz, with an amplitude "
            f"that grows {self.growth:.0f} times in {self.seconds:.1f} s"
        )


def growing_oscillation(error: Array, period: float) -> Oscillation | None:
    """Return the strongest growing oscillation in a following error; None without one.

    Args:
        error: commanded minus measured position (m, n) [rad], one row per cycle.
        period: cycle [s].
    """
    smoothed = max(1, round(SMOOTHED / period))
    length = max(2, round(WINDOW / period))
    windows = len(error) // length
    if windows < SHORTEST:
        return None
    candidates = []
    for joint, column in enumerate(error.T):
        fast = column - np.convolve(column, np.full(smoothed, 1.0 / smoothed), "same")
        cut = fast[: windows * length].reshape(windows, length)
        rms = np.sqrt(np.mean(cut**2, axis=1))
        start, end = _longest_growth(rms)
        growth = rms[end] / max(rms[start], np.finfo(np.float64).tiny)
        if end - start < SHORTEST or growth < GROWTH:
            continue
        frequency, share = _dominant(fast[(end - 1) * length : (end + 1) * length], period)
        if frequency >= SLOWEST and share >= NARROW:
            seconds = (end - start) * length * period
            candidates.append(Oscillation(joint, frequency, float(growth), seconds))
    return max(candidates, key=lambda each: each.growth, default=None)


def _longest_growth(rms: Array) -> tuple[int, int]:
    """Return first and last window of the longest uninterrupted growth."""
    best = (0, 0)
    start = 0
    for end in range(1, len(rms)):
        if rms[end] < rms[end - 1]:
            start = end
        elif end - start > best[1] - best[0]:
            best = (start, end)
    return best


def _dominant(values: Array, period: float) -> tuple[float, float]:
    """Return the dominant frequency [Hz] and the share of the power within two bins of it."""
    power = np.abs(np.fft.rfft(values * np.hanning(len(values)))) ** 2
    peak = int(np.argmax(power))
    share = float(power[max(0, peak - 2) : peak + 3].sum() / max(power.sum(), 1e-300))
    return peak / (len(values) * period), share
