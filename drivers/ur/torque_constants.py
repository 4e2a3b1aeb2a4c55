"""Torque constants that an arm states itself, from its own model at rest.

The controller computes its target current from the torque of its rigid-body model and of its
friction model. At rest there is no friction in it, and the ratio of both is the torque constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from drivers.arrays import Array

RELATIVE_UNCERTAINTY: Final = 0.1
"""Relative standard deviation to state of them until a payload was weighed: other sources have
constants of the same joints that are 11 to 24 % larger."""
_MIN_CURRENT: Final = 0.02
"""Current that gravity needs in a joint, at least [A]; below, the joint has no constant."""
_MAX_RELATIVE_SPREAD: Final = 0.01
"""Largest relative spread of the ratio over the samples at rest."""


def stated_constants(target_moment: Array, target_current: Array, target_velocity: Array) -> Array:
    """Return torque per current of each joint (n,) [N·m/A], NaN where the samples do not say it.

    Args:
        target_moment: (k, n) [N·m], of the controller's model.
        target_current: (k, n) [A], of the controller's model.
        target_velocity: (k, n) [rad/s].
    """
    resting = (target_velocity == 0.0).all(axis=1)[:, None]
    loaded = resting & (np.abs(target_current) >= _MIN_CURRENT)
    ratio = np.where(loaded, target_moment / np.where(loaded, target_current, 1.0), np.nan)
    constants = np.full(ratio.shape[1], np.nan)
    for joint, column in enumerate(ratio.T):
        values = column[np.isfinite(column)]
        if not values.size:
            continue
        middle = float(np.median(values))
        if middle > 0.0 and np.ptp(values) <= _MAX_RELATIVE_SPREAD * middle:
            constants[joint] = middle
    return constants


def by_size(constants: Array, torques: Sequence[float]) -> Array:
    """Return constants, where NaN the ones of joints of the same size.

    Joints of one size have the same largest torque [N·m].
    """
    filled = constants.copy()
    for joint in np.flatnonzero(np.isnan(constants)).tolist():
        alike = [
            constant
            for constant, torque in zip(constants, torques, strict=True)
            if torque == torques[joint] and np.isfinite(constant)
        ]
        if alike:
            filled[joint] = np.mean(alike)
    return filled
