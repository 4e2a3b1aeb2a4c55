"""A controller's inertia over the identified one.

A torque constant or gear ratio wrong by a factor fits equally well: only independent knowledge
shows it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.model.mass_matrix import mass_matrices
from identification.model.robot import RobotModel


class InertiaRatio(NamedTuple):
    """Ratio of the controller's to the identified inertia per joint, with rotors, joint side."""

    # median over postures (n,); NaN where the controller sends zero or the inertia is undetermined
    ratio: Array
    spread: Array  # standard deviation over postures (n,), NaN likewise


def inertia_ratio(
    model: RobotModel, values: Array, position: Array, theirs: Array
) -> InertiaRatio | None:
    """Compare a controller's diagonal inertia with an estimate's.

    None if there is nothing to compare.

    Args:
        model: of the arm.
        values: parameters (p,).
        position: of the joints (m, n) [rad or m].
        theirs: the controller's inertia, joint side (m, n); zero where not sent.
    """
    if not np.any(theirs):
        return None
    ours = np.diagonal(mass_matrices(model, values, position), axis1=1, axis2=2)
    comparable = (ours > 0.0) & (theirs > 0.0)
    ratio = np.where(comparable, theirs, np.nan) / np.where(comparable, ours, 1.0)
    whole = comparable.mean(axis=0) > 0.9
    median, spread = np.full((2, model.n_joints), np.nan)
    median[whole] = np.nanmedian(ratio[:, whole], axis=0)
    spread[whole] = np.nanstd(ratio[:, whole], axis=0)
    return InertiaRatio(median, spread)
