"""Recordings of poses at rest, without the motion between them."""

from __future__ import annotations

from typing import Final

import numpy as np

from identification.arrays import Array
from identification.signals.recording import MIN_MOVEMENT

_MIN_POSES: Final = 3
_MIN_ROWS: Final = 3  # of a pose
_MIN_REST_SHARE: Final = 0.95  # of the rows


def poses_without_motion(position: Array) -> int | None:
    """Return the number of poses that positions (m, n) [rad or m] consist of; None with motion.

    Joints stand still in nearly all rows, and pass from one pose to the next in a single sample, as
    where rests were cut out of a motion or recorded one by one. The poses are unrelated: a motion
    whose samples are held for some rows passes through neighbouring ones.
    """
    moved = np.abs(np.diff(position, axis=0)).max(axis=1, initial=0.0) > MIN_MOVEMENT
    edges = np.concatenate([[0], np.flatnonzero(moved) + 1, [len(position)]])
    length = np.diff(edges)
    if len(length) < _MIN_POSES or not len(position):
        return None
    ranges = [
        float(np.ptp(position[start:stop], axis=0).max())
        for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    ]
    rests = (length >= _MIN_ROWS) & (np.array(ranges) <= MIN_MOVEMENT)
    if rests.sum() < _MIN_POSES or length[rests].sum() < _MIN_REST_SHARE * len(position):
        return None
    steps = np.diff(position[edges[:-1][rests]], axis=0)
    is_smooth = np.sum(np.diff(steps, axis=0) ** 2) < np.sum(steps**2)
    return None if is_smooth else int(rests.sum())
