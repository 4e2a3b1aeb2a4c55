"""Low-passes that a controller may send its torques through before it logs them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.signals.smoothing import low_pass

Array = NDArray[np.float64]

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
