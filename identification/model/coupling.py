r"""Motors coupled to several joints, as in the wrists of industrial arms.

With motor angles per joint angle K (n, n), rotor inertias J and friction in the motors act on the
joints as (Gautier 1997)

.. math:: \tau = K^T J K \ddot q + \sum_m c_m^T\, f_m(c_m \dot q), \qquad c_m = K_m / K_{mm}
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arrays import Array
from identification.errors import ModelError

_COUPLING_TOLERANCE = 1e-9  # relative to the largest entry of a row


@dataclass(frozen=True, eq=False)
class Coupling:
    """Coupling of motors and joints, and its identified parameters."""

    motor_from_joint: Array  #: motor angle per joint angle (n, n); only ratios within a row matter
    inertia: bool = True  #: identify a coupling inertia of each pair of coupled joints
    friction: bool = True  #: identify Coulomb and viscous friction of each coupled motor

    def __post_init__(self) -> None:
        matrix = np.array(self.motor_from_joint, dtype=np.float64)
        direct = np.abs(np.diag(matrix))
        most = np.abs(matrix).max(axis=1, initial=0.0)
        if np.any(direct <= _COUPLING_TOLERANCE * most):
            motor = int(np.argmax(direct <= _COUPLING_TOLERANCE * most)) + 1
            raise ModelError(
                f"motor {motor} of the coupling does not turn with joint {motor}; order the motors"
                " by the joints that they drive"
            )
        if np.linalg.matrix_rank(self._relative(matrix)) < len(matrix):
            raise ModelError("the coupling is singular: joints cannot be moved independently")
        matrix.setflags(write=False)
        object.__setattr__(self, "motor_from_joint", matrix)

    @property
    def speeds(self) -> Array:
        """Speed of each motor per joint speed (n, n), 1 for its own joint."""
        return self._relative(self.motor_from_joint)

    @property
    def coupled_motors(self) -> tuple[int, ...]:
        """Motors, from 0, that turn with several joints."""
        return tuple(np.flatnonzero(np.count_nonzero(self.speeds, axis=1) > 1).tolist())

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Joints (i, j), i < j from 0, that share a motor."""
        turns = self.speeds != 0.0
        together = turns.T.astype(np.intp) @ turns.astype(np.intp)
        return tuple((int(i), int(j)) for i, j in np.argwhere(np.triu(together, 1) > 0))

    @staticmethod
    def _relative(matrix: Array) -> Array:
        speeds = matrix / np.diag(matrix)[:, None]
        return np.where(np.abs(speeds) < _COUPLING_TOLERANCE, 0.0, speeds)
