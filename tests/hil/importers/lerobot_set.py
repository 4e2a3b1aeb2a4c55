"""A data set of LeRobot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
JOINTS = ("pan", "lift", "gripper")
FPS = 50.0


def motion(duration: float, phase: float) -> Array:
    """Return positions (m, 3) [rad]."""
    time = np.arange(0.0, duration, 1.0 / FPS)
    turns = [1.5 * np.sin(time + phase), 0.8 * np.cos(0.7 * time), 0.8 + 0.5 * np.sin(1.3 * time)]
    return np.column_stack(turns)
