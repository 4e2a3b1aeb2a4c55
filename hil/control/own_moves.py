"""Moves of a simulated controller's own program, as the controller's interpolator runs them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hil.base.arrays import Array
from planner import JointLimits
from planner.interpolator import Interpolator, Status
from sim_fixtures import SettingError


class InterpolatedMoves:
    """Moves from rest to rest by the services of RRS-1, one after the other.

    Args:
        limits: of the arm.
        period: cycle [s].
        speed: of the moves, as a share of the velocity limits.

    Raises:
        SettingError: the interpolator refuses a speed, a position or a posture.
    """

    def __init__(self, limits: JointLimits, period: float, speed: float) -> None:
        self._limits = limits
        self._period = period
        self._speed = speed

    def begin(self, position: Array) -> None:
        """Rest at a position, (n,) [rad]; from outside its range the arm moves back into it."""
        limits = replace(
            self._limits,
            lower=np.minimum(self._limits.lower, position),
            upper=np.maximum(self._limits.upper, position),
        )
        # Nothing of a move that was aborted is left. Moves that stop have no corner that could
        # crash, so that no child is needed.
        self._arm = Interpolator(limits, self._period, isolated=False)
        self._moved = 0
        self._accepted(self._arm.initialize())
        self._accepted(self._arm.set_joint_speeds(100.0 * self._speed))
        self._accepted(self._arm.set_initial_position(position))

    def move_to(self, posture: Array) -> None:
        """Begin a move to a posture, (n,) [rad]."""
        self._moved += 1
        self._accepted(self._arm.set_next_target(self._moved, posture))

    def advance(self) -> tuple[Array, bool]:
        """Return the set-point of the next cycle, (n,) [rad], and whether the move ends there."""
        step = self._arm.get_next_step()
        self._accepted(step.status)
        return step.position, step.status is Status.FINAL_STEP

    def _accepted(self, status: Status) -> None:
        if status < 0:
            raise SettingError("own_motion", self._arm.refusal, "within the limits of the arm")
