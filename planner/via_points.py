"""What via points have to be before a motion is planned through them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from planner.arrays import Array
from planner.errors import (
    InvalidViaPoints,
    NonFiniteViaPoint,
    TooFewViaPoints,
    ViaPointOutOfLimits,
    WrongShape,
)
from planner.limits import JointLimits


def checked_via_points(via_points: ArrayLike, limits: JointLimits) -> Array:
    """Return via points (n_points, n_joints) [rad] that a motion can be planned through.

    Raises:
        InvalidViaPoints: wrong shape, fewer than two, not finite, or out of limits.
    """
    try:
        points = np.array(via_points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidViaPoints(f"via points are not a table of numbers: {error}") from error
    if points.ndim != 2 or points.shape[1] != limits.n_joints:
        raise WrongShape(points.shape, limits.n_joints)
    if len(points) < 2:
        raise TooFewViaPoints(len(points))
    for index, joint in np.argwhere(~np.isfinite(points)).tolist():
        raise NonFiniteViaPoint(index, joint, float(points[index, joint]))
    for index, joint in np.argwhere((points < limits.lower) | (points > limits.upper)).tolist():
        raise ViaPointOutOfLimits(
            index,
            joint,
            float(points[index, joint]),
            float(limits.lower[joint]),
            float(limits.upper[joint]),
        )
    return points
