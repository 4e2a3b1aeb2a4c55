"""One motion from rest to rest, planned target by target while it may already run.

The plan is made of straight legs and of corners between neighbouring legs. A corner takes at most
the slowing down of the leg before it and the speeding up of the one after it, so corners never
meet, and a new target changes nothing but the end of what was the last leg: from a stop there to
a corner. That is possible until the arm has come to where the corner would begin.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from planner.arrays import Array, read_only
from planner.commands import Fly, Move, Overrides
from planner.corners import STOP, Corner
from planner.legs import Leg, between, leg
from planner.limits import JointLimits
from planner.motion_plan import passage
from planner.moves import assembled, check
from planner.path_reader import PathReader
from planner.piecewise_cubic import PiecewiseCubic


class _Stretch(NamedTuple):
    """A part of the motion: its motion times [s] and how it is read."""

    begin: float
    end: float
    path: PathReader


class Timeline:
    """Parts of a motion in a row, of which the last may still be cut short.

    Args:
        position: Where the motion begins (n,) [rad]; the arm rests there until a part is added.
    """

    def __init__(self, position: Array) -> None:
        self._stretches: list[_Stretch] = []
        self._reading = 0
        self._rest = read_only(position)

    @property
    def end(self) -> float:
        """Motion time at which the last part ends [s]."""
        return self._stretches[-1].end if self._stretches else 0.0

    def append(self, part: PiecewiseCubic, rest: Array) -> None:
        """Add a part at the end; `rest` (n,) [rad] is where the arm then comes to rest."""
        if part.duration > 0.0:
            begin = self.end
            self._stretches.append(_Stretch(begin, begin + part.duration, PathReader(part)))
        self._rest = read_only(rest)

    def cut(self, time: float) -> None:
        """End the last part at a motion time [s] within it that was not read past yet.

        The arm does not rest there; whatever is appended next goes on from its state.
        """
        last = self._stretches[-1]
        self._stretches[-1] = last._replace(end=time)

    def forget_read(self) -> None:
        """Drop the parts before the one read last."""
        del self._stretches[: self._reading]
        self._reading = 0

    def position(self, time: float) -> Array:
        """Return the position (n,) [rad] at a motion time [s], not before the one read last."""
        stretches = self._stretches
        if not stretches or time >= stretches[-1].end:
            return self._rest
        while time >= stretches[self._reading].end:
            self._reading += 1
        begin, _, path = stretches[self._reading]
        return path.read(time - begin)[0]


CornerPlanner = Callable[[Leg, Leg, Fly], Corner]
"""What plans a corner, `planner.legs.corner` or the same in another process."""


class Passage(NamedTuple):
    """A target that is still ahead, and the motion time at which it is passed or reached [s]."""

    target_id: int
    time: float


class MotionQueue:
    """Targets queued for one motion, and the motion through them.

    Args:
        start: Where the arm is at rest (n,) [rad].
        limits: Limits that the motion keeps.
        corner: What plans a corner.

    Attributes:
        ahead: Targets not passed yet, the next one first.
    """

    def __init__(self, start: Array, limits: JointLimits, corner: CornerPlanner) -> None:
        self._limits = limits
        self._corner = corner
        self._timeline = Timeline(start)
        self._point = start
        self._last: tuple[Leg, Move] | None = None
        self.ahead: deque[Passage] = deque()

    @property
    def end(self) -> float:
        """Motion time at which the arm rests at the last target [s]."""
        return self._timeline.end

    def position(self, time: float) -> Array:
        """Return the position (n,) [rad] at a motion time [s], not before the one read last."""
        return self._timeline.position(time)

    def leg_to(self, move: Move, overrides: Overrides) -> Leg:
        """Return the leg to a further target, as it would be from rest to rest.

        Raises:
            InvalidSetting: the move does not fit the arm.
        """
        return leg(self._point, move, self._limits, overrides)

    def append(self, target_id: int, move: Move, overrides: Overrides, now: float) -> None:
        """Go on to a further target; `now` is the motion time [s] read last.

        Raises:
            PlannerError: no motion to it was found; what was planned before stays.
        """
        new = self.leg_to(move, overrides)
        turn = self._turn(new, now)
        self._timeline.forget_read()
        if turn.join is not None:
            self._round(turn, turn.join)
        self._timeline.append(between(new.segment, turn, STOP), move.target)
        self._point, self._last = move.target, (new, move)
        self.ahead.append(Passage(target_id, self.end))

    def _turn(self, new: Leg, now: float) -> Corner:
        """Return the corner between the last leg and a new one, a stop if it comes too late.

        Raises:
            PlanningError: what was planned breaks a limit or jumps.
        """
        turn, legs = STOP, [new]
        if self._last is not None:
            before, move = self._last
            turn = self._corner(before, new, move.fly)
            if turn.join is None or self.end - turn.leave < now:
                turn = STOP
            else:
                legs = [before, new]
        # From rest to rest: what is new, and of what was there the leg that it joins.
        check(assembled(legs, [turn][: len(legs) - 1]), legs)
        return turn

    def _round(self, turn: Corner, join: PiecewiseCubic) -> None:
        """Replace the stop at the present end by a corner."""
        begin = self.end - turn.leave
        passed = passage(0, self._point, turn, begin)
        self._timeline.cut(begin)
        self._timeline.append(join, self._point)
        self.ahead[-1] = self.ahead[-1]._replace(time=passed.time)
