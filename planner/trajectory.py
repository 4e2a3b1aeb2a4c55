"""What everything that can be played, designed or identified from looks like."""

from __future__ import annotations

from typing import Protocol

from planner.arrays import Array


class Trajectory(Protocol):
    """A motion of all joints as a function of time, at rest at both ends."""

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        ...

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        ...

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return q [rad], qd [rad/s], qdd [rad/s²] at the times `t` (m,), each (m, n).

        Outside [0, duration] the joints rest at the nearer end.
        """
        ...
