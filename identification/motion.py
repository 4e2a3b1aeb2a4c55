"""Joint motion, as the regressor reads it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Motion(NamedTuple):
    """Positions and their derivatives at m instants (rad or m, per s, per s²).

    Attributes:
        time: shape (m,), seconds.
        position: q, shape (m, n).
        velocity: qd, shape (m, n).
        acceleration: qdd, shape (m, n).
    """

    time: Array
    position: Array
    velocity: Array
    acceleration: Array

    @property
    def n_samples(self) -> int:
        """Number m of instants."""
        return int(self.position.shape[0])

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return int(self.position.shape[1])
