"""Sampled joint motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Motion(NamedTuple):
    """Positions and their derivatives at m instants (rad or m, per s, per s²)."""

    time: Array  #: shape (m,), seconds
    position: Array  #: q, shape (m, n)
    velocity: Array  #: qd, shape (m, n)
    acceleration: Array  #: qdd, shape (m, n)
    #: of dry friction (:meth:`JointFriction.direction`), shape (m, n + k); None: sign of velocity
    direction: Array | None = None
    #: torque that the gears transmit [N·m, N], shape (m, n), see :meth:`RobotModel.gear_torque`;
    #: None: unknown. Of load-dependent friction only
    load: Array | None = None

    def rows(self, which: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Motion:
        """Return the motion at some of the instants."""
        return Motion(*(None if column is None else column[which] for column in self))  # type: ignore[arg-type]

    @property
    def n_samples(self) -> int:
        """Number m of instants."""
        return int(self.position.shape[0])

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return int(self.position.shape[1])
