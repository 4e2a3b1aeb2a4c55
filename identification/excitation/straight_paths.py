"""Straight ways between postures, for those who draw via points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision.checker import CollisionChecker

Array = NDArray[np.float64]

# Spacing [rad] of the postures at which a way is looked at.
_LOOK_EVERY: Final = 0.1


def straight_way(start: Array, end: Array) -> Array:
    """Return postures (m, n) [rad] on the straight line between two, some 0.1 rad apart."""
    steps = int(np.ceil(np.max(np.abs(end - start)) / _LOOK_EVERY)) + 1
    return np.linspace(start, end, steps + 1)


def free_segments(checker: CollisionChecker, segments: Sequence[Array]) -> NDArray[np.bool_]:
    """Return which ways (m_i, n) keep the clearance at every posture, (len(ways),)."""
    starts = np.cumsum([0, *(len(way) for way in segments[:-1])])
    return np.logical_and.reduceat(checker.clear(np.concatenate(segments)), starts)
