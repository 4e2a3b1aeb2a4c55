"""A motion whose targets arrive while it runs, planned one target at a time."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from planner.arrays import Array
from planner.corners import STOP, Corner
from planner.limits import JointLimits
from planner.moves import Legs, Move, Overrides, legs_through, passage
from planner.piecewise_cubic import PiecewiseCubic
from planner.worker import in_child


class QueuedTarget(NamedTuple):
    """A target ahead, and the motion time at which it is passed or reached [s]."""

    target_id: int
    time: float


class MotionQueue:
    """Targets of one motion from rest to rest, with the result of `planner.plan_moves`.

    Corners use the deceleration before and the acceleration after a target, so they never overlap:
    a new target replaces the stop at the last one by a corner, unless the arm has reached its
    start. Nothing else of the motion changes.

    Args:
        start: Start position of the arm, at rest (n,) [rad].
        limits: Limits of the motion.
        isolated: Plan corners in a child process, as the solver behind them can crash.

    Attributes:
        end: Position at which the motion ends (n,) [rad].
        ahead: Targets not passed yet.
        duration: Motion time at which the motion ends [s].
    """

    def __init__(self, start: Array, limits: JointLimits, *, isolated: bool) -> None:
        self.end = start
        self.ahead: deque[QueuedTarget] = deque()
        self._limits = limits
        self._isolated = isolated
        self.duration = 0.0
        self._legs: Legs | None = None
        self._last: tuple[Legs, float] | None = None
        self._corners: list[Corner] = []

    def leg_to(self, move: Move, overrides: Overrides) -> Legs:
        """Return the leg to a further target, from rest to rest."""
        return legs_through(np.stack((self.end, move.target)), [move], self._limits, overrides)

    def append(
        self, target_id: int, move: Move, overrides: Overrides, now: float
    ) -> PiecewiseCubic:
        """Add a target; return the whole motion.

        Args:
            target_id: by which events name the target.
            move: to the target.
            overrides: of speed and acceleration.
            now: present motion time [s].

        Raises:
            PlannerError: no motion to it was found; the queue is unchanged.
        """
        leg = legs = self.leg_to(move, overrides)
        corners = self._corners
        turn = STOP
        if self._legs is not None and self._last is not None:
            last, fly = self._last
            legs = self._legs.followed_by(leg)
            both = last.followed_by(leg)
            turn = in_child(corner, both, fly) if self._isolated else corner(both, fly)
            if self.duration - turn.leave < now:
                turn = STOP
            corners = [*corners, turn]
        (motion,) = legs.motions(corners, 1)
        if turn.join is not None:
            passed = passage(0, self.end, turn, self.duration - turn.leave)
            self.ahead[-1] = self.ahead[-1]._replace(time=passed.time)
        self.ahead.append(QueuedTarget(target_id, motion.duration))
        self._legs = legs
        self._last = (leg, move.fly_percent / 100.0)
        self._corners = corners
        self.end = move.target
        self.duration = motion.duration
        return motion

    def pass_until(self, time: float) -> list[int]:
        """Remove the targets passed up to a motion time [s] from `ahead`, and return them."""
        passed = list[int]()
        while self.ahead and self.ahead[0].time <= time:
            passed.append(self.ahead.popleft().target_id)
        return passed


def corner(legs: Legs, fly: float) -> Corner:
    """Plan the corner between two legs, `fly` a share as of `Legs.corners`."""
    first, second = np.arange(2)[:, None]
    return legs.corners(first, second, np.array([fly]))[0]
