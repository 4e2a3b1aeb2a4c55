"""A planned motion: its trajectory, and how each target is passed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

from planner.arrays import Array
from planner.commands import FlyDistance, FlyPercent, Move, Overrides
from planner.corners import STOP, Corner, How, passing
from planner.limits import JointLimits
from planner.piecewise_cubic import PiecewiseCubic


@dataclass(frozen=True)
class TargetPassage:
    """How the target of one move is passed.

    Attributes:
        index: Of the move, from 0.
        time: When the path is nearest to the target, or reaches it, from the beginning [s].
        distance: Euclidean distance between path and target in joint space [rad].
        how: "flown" as asked, "reduced" (rounded less than asked), or "stopped".
        fly: Share of the ramps before and after the target that the corner takes, 0 for a stop.
    """

    index: int
    time: float
    distance: float
    how: How
    fly: float


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """A motion through the targets of moves, from rest to rest.

    Attributes:
        start: Where it begins (n,) [rad].
        moves: What was asked.
        limits: What it keeps at every instant.
        overrides: What applied when it was planned.
        trajectory: The motion.
        durations: Of each move by itself, from rest to rest [s].
        corners: How each target but the last is passed.
    """

    start: Array
    moves: tuple[Move, ...]
    limits: JointLimits
    overrides: Overrides
    trajectory: PiecewiseCubic
    durations: tuple[float, ...]
    corners: tuple[Corner, ...]

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        return self.trajectory.duration

    @property
    def duration_with_stops(self) -> float:
        """Length in time of the same moves with a stop at every target [s]; never shorter."""
        return sum(self.durations)

    @property
    def reduced_corners(self) -> int:
        """Number of targets flown by less widely than asked."""
        return sum(corner.how == "reduced" for corner in self.corners)

    @property
    def stopped_corners(self) -> int:
        """Number of targets to be flown by between two real moves at which the motion stops."""
        return sum(
            corner.how == "stopped" and _asked(move) and min(durations) > 0.0
            for corner, move, durations in zip(
                self.corners, self.moves, pairwise(self.durations), strict=False
            )
        )

    @cached_property
    def targets(self) -> tuple[TargetPassage, ...]:
        """How the target of each move is passed."""
        return tuple(self._passages())

    def _passages(self) -> Iterator[TargetPassage]:
        time, entered = 0.0, 0.0
        for index, (move, duration, corner) in enumerate(
            zip(self.moves, self.durations, (*self.corners, STOP), strict=True)
        ):
            time += max(duration - entered - corner.leave, 0.0)
            yield passage(index, move.target, corner, time)
            time += 0.0 if corner.join is None else corner.join.duration
            entered = corner.enter


def passage(index: int, target: Array, corner: Corner, time: float) -> TargetPassage:
    """Return how a target (n,) [rad] is passed by a corner that begins at `time` [s]."""
    if corner.join is None:
        return TargetPassage(index, time, 0.0, "stopped", 0.0)
    passed = passing(corner.join, target)
    return TargetPassage(index, time + passed.time, passed.distance, corner.how, corner.share)


def _asked(move: Move) -> bool:
    if isinstance(move.fly, FlyPercent):
        return move.fly.percent > 0.0
    return isinstance(move.fly, FlyDistance) and move.fly.distance > 0.0
