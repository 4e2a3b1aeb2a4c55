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
        direction: of dry friction, shape (m, n + k), joints and then k coupled motors, from -1 to
            1; None for the sign of the velocity. See :meth:`JointFriction.direction`.
    """

    time: Array
    position: Array
    velocity: Array
    acceleration: Array
    direction: Array | None = None

    def rows(self, which: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Motion:
        """The motion at some of the instants."""
        return Motion(*(None if one is None else one[which] for one in self))  # type: ignore[arg-type]

    @property
    def n_samples(self) -> int:
        """Number m of instants."""
        return int(self.position.shape[0])

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return int(self.position.shape[1])
