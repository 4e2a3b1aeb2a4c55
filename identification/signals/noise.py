"""Noise variances of measured channels: from a standstill, or from the channels themselves."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.signals.recording import RecordingError

Array = NDArray[np.float64]

STANDSTILL_WINDOW: Final = 0.1  # s
_SHORTEST_WINDOW: Final = 20  # samples
_HIGHEST_DIFFERENCE: Final = 8


def standstill_variance(time: Array, values: Array) -> Array:
    """Noise variance per channel (c,) of a recording at standstill (m, c).

    The variance about a straight line in windows of a tenth of a second, and of these the
    median: an arm at rest creeps, and now and then dry friction lets go of an axis whose servo
    has been winding up, which is motion and no noise. A reading that hardly ever changes gives
    zero; its resolution is then what is known about it.

    Raises:
        RecordingError: fewer samples than one window needs.
    """
    if len(time) < _SHORTEST_WINDOW:
        raise RecordingError(
            "shape",
            f"a variance at standstill needs {_SHORTEST_WINDOW} samples, the recording has"
            f" {len(time)}",
        )
    width = max(_SHORTEST_WINDOW, round(STANDSTILL_WINDOW / float(np.median(np.diff(time)))))
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
    # The median of a chi-squared variable lies a little below its mean (Wilson and Hilferty).
    return np.asarray(np.median(variance, axis=0) / (1.0 - 2.0 / (9.0 * freedom)) ** 3)


def difference_variance(time: Array, values: Array) -> Array:
    """Variance of the white noise on smooth channels (m, c), from the channels themselves.

    Divided differences of rising order, scaled to unit noise gain, remove ever more of the
    smooth part and keep the noise (Gasser, Sroka and Jennen-Steinmetz 1986). Used is the first
    order at which the next one changes the estimate by less than 5 %; a channel without white
    noise (filtered before it was logged) gives the highest order's, next to nothing.

    Raises:
        RecordingError: fewer samples than the highest order needs.
    """
    if len(time) < 2 * _HIGHEST_DIFFERENCE:
        raise RecordingError(
            "shape",
            f"a noise variance needs {2 * _HIGHEST_DIFFERENCE} samples, got {len(time)}",
        )
    found = [_difference_variance(time, values, 1)]
    settled = np.zeros((0, values.shape[1]), dtype=np.bool_)
    for order in range(2, _HIGHEST_DIFFERENCE + 1):
        found.append(_difference_variance(time, values, order))
        settled = np.array(found[1:]) > 0.95 * np.array(found[:-1])
        if settled.any(axis=0).all():  # higher orders would not be asked
            break
    estimates = np.array(found)
    first = np.where(settled.any(axis=0), settled.argmax(axis=0), _HIGHEST_DIFFERENCE - 1)
    return np.asarray(np.take_along_axis(estimates, first[None, :], axis=0)[0])


def _difference_variance(time: Array, values: Array, order: int) -> Array:
    windows = np.lib.stride_tricks.sliding_window_view(time, order + 1)
    scale = windows[:, -1:] - windows[:, :1]
    apart = (windows[:, :, None] - windows[:, None, :]) / scale[:, :, None]
    apart[:, np.arange(order + 1), np.arange(order + 1)] = 1.0
    weights = 1.0 / apart.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    stacked = np.lib.stride_tricks.sliding_window_view(values, order + 1, axis=0)
    return np.asarray(np.mean(np.einsum("mck,mk->mc", stacked, weights) ** 2, axis=0))
