"""Whether an arm can have the masses of a description."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from identification.model.link_wrenches import MASS_INDEX
from identification.model.robot import RobotModel


class MassFault(StrEnum):
    """Why the masses of a description are not the arm's."""

    NONE = "none"
    EQUAL = "equal"
    UNRELATED = "unrelated"  #: to the torque


def mass_fault(model: RobotModel) -> MassFault | None:
    """Return why the bodies of the description cannot have the masses of an arm, by themselves."""
    masses = model.nominal[model.layout.links][:, MASS_INDEX]
    if not np.any(masses > 0.0):
        return MassFault.NONE
    if len(masses) > 1 and np.ptp(masses) <= 1e-6 * masses.max():
        return MassFault.EQUAL
    return None
