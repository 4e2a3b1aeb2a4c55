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
    where rests were cut out of a motion or recorded one by one.
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
    is_rest = length[rests].sum() >= _MIN_REST_SHARE * len(position)
    return int(rests.sum()) if is_rest and rests.sum() >= _MIN_POSES else None
