"""The nominal model with fitted friction: what a good description alone would predict."""

from __future__ import annotations

from typing import Final

import numpy as np

from identification.arrays import Array
from identification.factor.estimate import joint_weights
from identification.factor.factor import Factor
from identification.factor.normal_equations import solve_with_ridge
from identification.model.robot import RobotModel

# Of each column's information, for terms that the motion hardly tells apart or does not show.
_RIDGE: Final = 1e-6


def with_fitted_friction(model: RobotModel, nominal: Array, factor: Factor) -> Array:
    """Return nominal parameters (p,) with friction and offsets fitted to a factor.

    Drives are not described by a URDF: compared without them, an identified model would be better
    for its friction alone.
    """
    fitted = np.zeros(len(nominal), dtype=np.bool_)
    fitted[model.friction_part] = True
    given = np.where(fitted, 0.0, nominal)
    gram = np.tensordot(joint_weights(factor), factor.gram, axes=1)
    residual = gram[:-1, -1] - gram[:-1, :-1] @ given
    square = gram[:-1, :-1][np.ix_(fitted, fitted)]
    values = given.copy()
    values[fitted] = solve_with_ridge(square, residual[fitted], _RIDGE)
    return values
