"""Axes whose torque is too small to decide alone."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

Mask = NDArray[np.bool_]

LITTLE_TORQUE_SHARE: Final = 0.015
"""Torque of such an axis as a share of all axes' torque: an eighth of the error up to which a model
is good, so that losing it entirely adds 0.1 points to the error over all axes."""


def little_torque(torque: Array, slides: Mask, minor: float = LITTLE_TORQUE_SHARE) -> Mask:
    """Return the axes whose torque (n,) is too small against the others' to decide alone (n,).

    Axes that slide are compared with each other, and those that turn.
    """
    power = np.where(slides[:, None] == slides, torque**2, 0.0).sum(axis=1)
    return np.asarray(torque < minor * np.sqrt(power))
