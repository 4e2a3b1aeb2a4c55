"""Joints that something else pushed: they move while their commands rest and the model stands."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array

_PUSH_SECONDS: Final = 1.0  # s in which a joint moves
_REST_SECONDS: Final = 0.5  # s before, from which on its command rests
_MAX_RESTING_RANGE: Final = 1e-3  # rad or m, range of a command that rests
_MIN_PUSH: Final = 0.01  # rad or m by which a joint that is pushed moves
_MAX_MODEL_SHARE: Final = 0.25  # of it, that the model moves at most


class Push(NamedTuple):
    """A joint that was pushed.

    Attributes:
        joint: index.
        time: at which it began to move [s].
        change: of its position [rad or m].
    """

    joint: int
    time: float
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
    windows = np.lib.stride_tricks.sliding_window_view(command, over + before + 1, axis=0)
    resting = np.ptp(windows, axis=-1) <= _MAX_RESTING_RANGE
    moved, expected = (
        positions[over + before :] - positions[before:-over] for positions in (measured, simulated)
    )
    size = np.abs(moved)
    pushed = resting & (size >= _MIN_PUSH) & (np.abs(expected) <= _MAX_MODEL_SHARE * size)
    pushes = []
    for joint in np.flatnonzero(pushed.any(axis=0)).tolist():
        row = int(np.argmax(np.where(pushed[:, joint], size[:, joint], 0.0)))
        pushes.append(Push(joint, (row + before) * step, float(moved[row, joint])))
    return pushes
