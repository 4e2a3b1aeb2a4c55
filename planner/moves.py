"""Moves to motion, as an industrial controller's joint interpolator runs them.

A plan is made of legs, each a move by itself, and of the corners between two. Each looks at two
neighbours at most, so that a motion can also be planned while it runs, one move after the other,
and comes out the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from planner.arrays import Array, read_only
from planner.commands import (
    Fly,
    FlyDistance,
    FlyPercent,
    Move,
    Overrides,
    Stop,
    Termination,
    checked_shares,
)
from planner.corners import STOP, Corner, How, fly_by_all, fly_within, passing
from planner.errors import (
    InvalidSetting,
    InvalidViaPoints,
    NonFiniteViaPoint,
    TooFewViaPoints,
    ViaPointOutOfLimits,
    WrongShape,
)
from planner.limits import Allowance, Bounds, JointLimits
from planner.piecewise_cubic import PiecewiseCubic, concatenate
from planner.segments import StraightSegment
from planner.verify import check_limits, check_smooth

__all__ = [
    "plan",
    "plan_moves",
    "checked_via_points",
    "Move",
    "Fly",
    "FlyPercent",
    "FlyDistance",
    "Stop",
    "Termination",
    "Overrides",
    "MotionPlan",
    "TargetPassage",
]

# Segments keep this distance from the limits, so that the states at which corners cut them lie
# clear of where the corner's solver is known to fail; corners then use the full limits.
SEGMENT_VELOCITY: Final = 0.99
SEGMENT_ACCELERATION: Final = 0.98
SEGMENT_JERK: Final = 0.98


class Leg(NamedTuple):
    """A move planned from rest to rest.

    Attributes:
        segment: The straight motion.
        bounds: What the move may use, its deceleration apart.
        deceleration: What it may use while slowing down (n,) [rad/s²].
    """

    segment: StraightSegment
    bounds: Bounds
    deceleration: Array


class Shares(NamedTuple):
    """Bounds of one or more moves: worked out once, used for all moves alike."""

    bounds: Bounds
    deceleration: Array
    cautious: Bounds
    cautious_deceleration: Array


def shares_of(move: Move, limits: JointLimits, overrides: Overrides) -> Shares:
    """Return what a move may use of the limits.

    Raises:
        InvalidSetting: the move, or the overrides, are those of another number of joints.
    """
    n = limits.n_joints
    if move.target.size != n:
        raise InvalidSetting("target", move.target.tolist(), f"one position for each of {n} joints")
    if overrides.joint_shares.shape not in ((), (n,)):
        raise InvalidSetting("joint override", overrides.joint, f"one share, or {n} of them")
    velocity = limits.velocity * (move.speed * overrides.speed * overrides.joint_shares)
    rate = limits.acceleration * move.acceleration
    jerk = limits.jerk
    if move.joint_speed is not None:
        velocity = velocity * move.joint_speed
    if move.joint_acceleration is not None:
        rate = rate * move.joint_acceleration
    if move.joint_jerk is not None:
        jerk = jerk * move.joint_jerk
    acceleration = rate * overrides.acceleration
    deceleration = rate * overrides.deceleration
    return Shares(
        Allowance(limits.lower, limits.upper, velocity, acceleration, jerk),
        deceleration,
        Allowance(
            limits.lower,
            limits.upper,
            SEGMENT_VELOCITY * velocity,
            SEGMENT_ACCELERATION * acceleration,
            SEGMENT_JERK * jerk,
        ),
        SEGMENT_ACCELERATION * deceleration,
    )


def leg_with(start: Array, target: Array, shares: Shares) -> Leg:
    """Plan a move between two positions (n,) [rad] from what it may use."""
    segment = StraightSegment.between(start, target, shares.cautious, shares.cautious_deceleration)
    return Leg(segment, shares.bounds, shares.deceleration)


def leg(start: Array, move: Move, limits: JointLimits, overrides: Overrides) -> Leg:
    """Plan a move from `start` (n,) [rad] to its target, from rest to rest."""
    return leg_with(start, move.target, shares_of(move, limits, overrides))


def corner(before: Leg, after: Leg, fly: Fly) -> Corner:
    """Plan how the target of `before` is passed on the way to that of `after`."""
    return corners_between([before, after], [fly])[0]


def corners_between(legs: Sequence[Leg], flies: Sequence[Fly]) -> list[Corner]:
    """Plan how the target of each leg but the last is passed on the way to that of the next.

    Within a corner each joint may use what the more generous of the two moves grants: the
    deceleration of the one before or the acceleration of the one after.
    """
    pairs = list(pairwise(legs))
    segments = [(before.segment, after.segment) for before, after in pairs]
    bounds = [
        before.bounds
        if after.bounds is before.bounds and before.deceleration is before.bounds.acceleration
        else wider(before.bounds, after.bounds, before.deceleration)
        for before, after in pairs
    ]
    shares = [fly.share if isinstance(fly, FlyPercent) else 0.0 for fly in flies]
    corners = fly_by_all(segments, bounds, shares)
    for index, fly in enumerate(flies):
        if isinstance(fly, FlyDistance):
            corners[index] = fly_within(*segments[index], bounds[index], fly.distance)
    return corners


def wider(before: Bounds, after: Bounds, deceleration: Array) -> Bounds:
    """Return, joint by joint, the larger rates of a move that ends and one that begins."""
    return Allowance(
        before.lower,
        before.upper,
        np.maximum(before.velocity, after.velocity),
        np.maximum(deceleration, after.acceleration),
        np.maximum(before.jerk, after.jerk),
    )


def between(segment: StraightSegment, before: Corner, after: Corner) -> PiecewiseCubic:
    """Return what two corners leave of the segment that leads from one to the other."""
    # Two full fly-bys may use up a segment without cruise; nothing is left but rounding.
    start, stop = before.enter, segment.duration - after.leave
    return segment.pieces(start, max(start, stop))


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


def checked_via_points(via_points: ArrayLike, limits: JointLimits) -> Array:
    """Return via points (n_points, n_joints) [rad] that a motion can be planned through.

    Raises:
        InvalidViaPoints: wrong shape, fewer than two, not finite, or out of limits.
    """
    try:
        points = np.array(via_points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidViaPoints(f"via points are not a table of numbers: {error}") from error
    if points.ndim != 2 or points.shape[1] != limits.n_joints:
        raise WrongShape(points.shape, limits.n_joints)
    if len(points) < 2:
        raise TooFewViaPoints(len(points))
    for index, joint in np.argwhere(~np.isfinite(points)).tolist():
        raise NonFiniteViaPoint(index, joint, float(points[index, joint]))
    for index, joint in np.argwhere((points < limits.lower) | (points > limits.upper)).tolist():
        raise ViaPointOutOfLimits(
            index,
            joint,
            float(points[index, joint]),
            float(limits.lower[joint]),
            float(limits.upper[joint]),
        )
    return points


_NO_OVERRIDES = Overrides()


def plan_moves(
    start: Array,
    moves: Sequence[Move],
    limits: JointLimits,
    overrides: Overrides = _NO_OVERRIDES,
) -> MotionPlan:
    """Plan a motion through the targets of moves that starts and ends at rest.

    Between targets the arm moves on straight joint-space lines, all joints in phase. A target
    that repeats its predecessor is a stop. A corner that cannot be rounded as asked, or is
    faster if it is rounded less, is rounded less, in the end not at all; see
    `MotionPlan.targets`. The motion never takes longer than one with a stop at every target.

    Args:
        start: Where the arm rests (n,) [rad].
        moves: At least one, targets inside the limits.
        limits: Limits, respected exactly (but for rounding) at every instant.
        overrides: Shares that apply to all moves.

    Raises:
        InvalidViaPoints: start or a target is of the wrong shape, not finite, or out of limits;
            via point 0 is the start, via point i the target of the i-th move.
        InvalidSetting: overrides of another number of joints.
        PlanningError: the finished plan breaks a limit or jumps by more than rounding, and is not
            returned; seen only with limits that lie many powers of ten (1e8) apart.
        UnsupportedSolver: a corner is to be rounded, and the installed ruckig is not known.
    """
    points = checked_via_points([start, *(move.target for move in moves)], limits)
    return planned(points, moves, limits, overrides)


def planned(
    points: Array, moves: Sequence[Move], limits: JointLimits, overrides: Overrides = _NO_OVERRIDES
) -> MotionPlan:
    """Plan moves through points (n_moves + 1, n) [rad] that were checked; see `plan_moves`."""
    shares = _shares(moves, limits, overrides)
    legs = [leg_with(a, b, each) for (a, b), each in zip(pairwise(points), shares, strict=True)]
    corners = corners_between(legs, [move.fly for move in moves[:-1]])
    motion = assembled(legs, corners)
    check(motion, legs)
    return MotionPlan(
        start=read_only(points[0]),
        moves=tuple(moves),
        limits=limits,
        overrides=overrides,
        trajectory=motion,
        durations=tuple(each.segment.duration for each in legs),
        corners=tuple(corners),
    )


def assembled(legs: Sequence[Leg], corners: Sequence[Corner]) -> PiecewiseCubic:
    """Cut the legs where the corners ask for it and put everything in a row."""
    parts = []
    for each, before, after in zip(legs, (STOP, *corners), (*corners, STOP), strict=True):
        parts.append(between(each.segment, before, after))
        if after.join is not None:
            parts.append(after.join)
    return concatenate([part for part in parts if part.duration > 0.0] or parts[:1])


def check(motion: PiecewiseCubic, legs: Sequence[Leg]) -> None:
    """Refuse a motion that breaks what its legs may use, or is not smooth.

    Raises:
        PlanningError: naming quantity, joint, value and bound.
    """
    bounds = _widest(legs)
    check_limits(motion, bounds)
    check_smooth(motion, bounds)


def _shares(moves: Sequence[Move], limits: JointLimits, overrides: Overrides) -> list[Shares]:
    """Return what each move may use; the same object for neighbours that are alike."""
    shares: list[Shares] = []
    for index, move in enumerate(moves):
        alike = index > 0 and _alike(move, moves[index - 1])
        shares.append(shares[-1] if alike else shares_of(move, limits, overrides))
    return shares


def _alike(move: Move, other: Move) -> bool:
    return (
        move.speed == other.speed
        and move.acceleration == other.acceleration
        and _same(move.joint_speed, other.joint_speed)
        and _same(move.joint_acceleration, other.joint_acceleration)
        and _same(move.joint_jerk, other.joint_jerk)
    )


def _same(shares: Array | None, others: Array | None) -> bool:
    if shares is None or others is None:
        return shares is others
    return np.array_equal(shares, others)


def _widest(legs: Sequence[Leg]) -> Bounds:
    def largest(rates: list[Array]) -> Array:
        widest: Array = np.max(rates, axis=0)
        return widest

    return Allowance(
        legs[0].bounds.lower,
        legs[0].bounds.upper,
        largest([each.bounds.velocity for each in legs]),
        largest([np.maximum(each.bounds.acceleration, each.deceleration) for each in legs]),
        largest([each.bounds.jerk for each in legs]),
    )


def plan(
    via_points: ArrayLike, limits: JointLimits, *, speed: ArrayLike = 1.0, fly: float = 0.5
) -> PiecewiseCubic:
    """Plan a motion through via points that starts and ends at rest and keeps all limits.

    The same as `plan_moves` with moves that are all alike; see there.

    Args:
        via_points: Positions (n_points, n_joints) [rad], at least two, inside the limits.
        limits: Limits, respected exactly (but for rounding) at every instant.
        speed: Share of each joint's velocity limit to use, in (0, 1], a number or (n,).
        fly: Share of each deceleration that the next acceleration overlaps, from 0 (stop at
            every via point) to 1 (the corner begins where the deceleration would).

    Raises:
        InvalidViaPoints: wrong shape, fewer than two, not finite, or out of limits.
        InvalidSetting: speed or fly outside its range.
        PlanningError: the finished plan breaks a limit or jumps by more than rounding, and is not
            returned; seen only with limits that lie many powers of ten (1e8) apart.
        UnsupportedSolver: a corner is to be rounded, and the installed ruckig is not known.
    """
    points = checked_via_points(via_points, limits)
    shares = checked_shares("speed", speed, limits.n_joints)
    if not 0.0 <= fly <= 1.0:
        raise InvalidSetting("fly", fly, "a number from 0 to 1")
    passing = FlyPercent(100.0 * fly)
    moves = [Move(point, joint_speed=shares, fly=passing) for point in points[1:]]
    return planned(points, moves, limits).trajectory
