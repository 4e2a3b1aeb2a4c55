"""Joints that something else pushed: they move while their commands rest and the model stands."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array

_PUSH_SECONDS: Final = 1.0  # s in which a joint moves
_MEAN_SECONDS: Final = 0.2  # s over which positions are averaged, against their noise
_REST_SECONDS: Final = 0.5  # s before, from which on its command rests
_MAX_RESTING_RANGE: Final = 1e-3  # rad or m, range of a command that rests
_MIN_PUSH: Final = 0.01  # rad or m by which a joint that is pushed moves
_MAX_MODEL_SHARE: Final = 0.25  # of it, that the model moves at most


class Push(NamedTuple):
    """A joint that was pushed.

    Attributes:
        joint: index.
        time: at which it began to move [s].
        end: at which commands of the arm move again after it stood [s]: what pushed it may hold it
            until then.
        change: of its position [rad or m].
    """

    joint: int
    time: float
    end: float
    change: float


def pushes_of(step: float, command: Array, measured: Array, simulated: Array) -> list[Push]:
    """Return the largest push of each joint that was pushed, in the order of the joints.

    Args:
        step: between the instants [s].
        command: commanded positions (m, n).
        measured: positions (m, n).
        simulated: positions from the commands alone (m, n).
    """
    over, before = (max(1, round(duration / step)) for duration in (_PUSH_SECONDS, _REST_SECONDS))
    if len(measured) <= over + before:
        return []
    resting = _range(command, over + before + 1) <= _MAX_RESTING_RANGE
    moved, expected = (
        averaged[over + before :] - averaged[before:-over]
        for averaged in (_averaged(measured, step), _averaged(simulated, step))
    )
    size = np.abs(moved)
    pushed = resting & (size >= _MIN_PUSH) & (np.abs(expected) <= _MAX_MODEL_SHARE * size)
    moving = np.any(_range(command, before + 1) > _MAX_RESTING_RANGE, axis=1)
    pushes = []
    for joint in np.flatnonzero(pushed.any(axis=0)).tolist():
        row = int(np.argmax(np.where(pushed[:, joint], size[:, joint], 0.0))) + before
        end = _next_motion(moving, row + over)
        change = float(moved[row - before, joint])
        pushes.append(Push(joint, row * step, (end + before) * step, change))
    return pushes


def _range(positions: Array, count: int) -> Array:
    """Return the range of positions (m, n) in windows of samples (m - count + 1, n)."""
    windows = np.lib.stride_tricks.sliding_window_view(positions, count, axis=0)
    return np.asarray(np.ptp(windows, axis=-1))


def _averaged(positions: Array, step: float) -> Array:
    size = 1 + 2 * round(0.5 * _MEAN_SECONDS / step)
    return np.asarray(scipy.ndimage.uniform_filter1d(positions, size, axis=0, mode="nearest"))


def _next_motion(moving: NDArray[np.bool_], row: int) -> int:
    """Return the row from which on something moves, after a rest that begins at a row or later."""
    resting = np.flatnonzero(~moving[row:])
    if not len(resting):
        return len(moving)
    again = np.flatnonzero(moving[row + resting[0] :])
    return int(row + resting[0] + again[0]) if len(again) else len(moving)
