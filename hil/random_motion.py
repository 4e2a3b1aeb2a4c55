"""Via points drawn at random, to try a cell's limits with."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import AngleFrame, Cell

Array = NDArray[np.float64]

_STEP: Final = 0.1
"""deg; they are as round as those a person teaches."""


def random_via_points(cell: Cell, frame: AngleFrame, count: int, seed: int) -> Array:
    """The home posture, or the middle of the limits, and points within the limits (1 + m, n) [rad].

    Args:
        cell: whose limits.
        frame: angles in which they are round.
        count: points m.
        seed: the same gives the same points.
    """
    limits = cell.joint_limits
    ends = np.sort([frame.shown(limits.lower), frame.shown(limits.upper)], axis=0)
    shares = np.random.default_rng(seed).random((count, limits.n_joints))
    shown = ends[0] + shares * (ends[1] - ends[0])
    shown = np.clip(np.round(shown / _STEP) * _STEP, *ends)
    home = cell.home if cell.file.campaign is not None else (limits.lower + limits.upper) / 2.0
    return np.vstack((home, frame.urdf(shown)))
