"""Whether an arm can have the masses of a description."""

from __future__ import annotations

import numpy as np

from identification.model.link_wrenches import MASS_INDEX
from identification.model.robot import RobotModel


def without_masses(model: RobotModel) -> str:
    """Return why the bodies of the description have no masses of an arm, or nothing."""
    masses = model.nominal[model.layout.links][:, MASS_INDEX]
    if not np.any(masses > 0.0):
        return "the description has no masses"
    if len(masses) > 1 and np.ptp(masses) <= 1e-6 * masses.max():
        return "all bodies of the description have the same mass"
    return ""
