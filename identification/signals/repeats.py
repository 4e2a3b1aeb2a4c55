"""Whether recordings show one motion again, and how their clocks are offset, from the positions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.signals.recording import Recording

Array = NDArray[np.float64]

_STEP: Final = 0.01  # s
# A repetition follows the first within this share of each joint's own scatter, ...
_ALIKE: Final = 0.02
# ... over this share of the longer one.
_OVERLAP: Final = 0.8
_REFINED: Final = 21  # offsets that are tried within a step


def offsets_of_repetitions(recordings: Sequence[Recording]) -> Array | None:
    """Offset of each clock against the first one's (R,) [s] where all show one motion.

    Returns:
        None where some recording shows another motion, or where there is only one.
    """
    if len(recordings) < 2:
        return None
    offsets = [0.0]
    for one in recordings[1:]:
        offset = _offset(recordings[0], one)
        if offset is None:
            return None
        offsets.append(offset)
    return np.array(offsets)


def _offset(first: Recording, other: Recording) -> float | None:
    """Time of the other recording less that of the first at equal postures [s]."""
    time, position = _even(first)
    other_time, other_position = _even(other)
    scatter = position.std(axis=0)
    if position.shape[1] != other_position.shape[1] or not scatter.any():
        return None
    moving = scatter > 1e-3 * scatter.max()
    scale = scatter[moving]
    a = (position - position.mean(axis=0))[:, moving] / scale
    b = (other_position - position.mean(axis=0))[:, moving] / scale
    lag = _lag(a, b)
    if lag is None:
        return None
    coarse = other_time[0] - time[0] + lag * _STEP
    fine = coarse + _STEP * np.linspace(-1.0, 1.0, _REFINED)
    differences = [_difference(time, a, other_time - offset, b) for offset in fine]
    best = int(np.argmin(differences))
    return float(fine[best]) if differences[best] < _ALIKE else None


def _lag(a: Array, b: Array) -> int | None:
    """Rows by which b (k, n) lags a (l, n) where their mean square difference is least."""
    lags = np.arange(1 - len(a), len(b))
    first, last = np.maximum(0, -lags), np.minimum(len(a), len(b) - lags)
    rows = last - first
    enough = rows >= _OVERLAP * max(len(a), len(b))
    if not enough.any():
        return None
    common = np.zeros(len(lags))
    for x, y in zip(a.T, b.T, strict=True):
        common += scipy.signal.correlate(y, x, method="fft")
    power_a, power_b = (np.append(0.0, np.cumsum((one**2).sum(axis=1))) for one in (a, b))
    own = power_a[last] - power_a[first] + power_b[last + lags] - power_b[first + lags]
    squares = np.where(enough, (own - 2.0 * common) / np.maximum(rows, 1), np.inf)
    return int(lags[np.argmin(squares)])


def _difference(time: Array, a: Array, other_time: Array, b: Array) -> float:
    """Largest RMS difference of a joint where both run; infinite where that is too short."""
    inside = (time >= other_time[0]) & (time <= other_time[-1])
    if np.count_nonzero(inside) < _OVERLAP * max(len(a), len(b)):
        return np.inf
    at = np.column_stack([np.interp(time[inside], other_time, column) for column in b.T])
    return float(np.sqrt(np.mean((a[inside] - at) ** 2, axis=0)).max())


def _even(recording: Recording) -> tuple[Array, Array]:
    """Times and positions (k, n) at even steps."""
    time = np.arange(recording.time[0], recording.time[-1], _STEP)
    columns = [np.interp(time, recording.time, column) for column in recording.position.T]
    return time, np.column_stack(columns)
