"""Moves with settings, and the motion planned through their targets.

A plan consists of legs (single moves) and of corners between two legs. A corner depends on its two
legs only, so a motion planned move by move while it runs is the same, and many motions can be
planned together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arrays import Array, read_only
from planner.corners import STOP, Corner, How, StraightMoves, passing, round_corners
from planner.errors import InvalidSetting, InvalidViaPoints, PlannerError, PlanningError
from planner.limits import Allowance, JointLimits
from planner.piecewise_cubic import Block, PiecewiseCubic, Rows, check_limits, check_smooth


@dataclass(frozen=True, eq=False)
class Move:
    """Straight joint-space move to a target (n,) [rad], all joints in phase.

    Shares of limits lie in (0, 1] and multiply, with each other and with the overrides; those named
    after a joint are (n,), None for 1. The slowest joint determines the time.

    The next move begins during the last `fly_percent` (0..100) of the deceleration: 0 is a stop, at
    100 the corner begins with the deceleration. The last target of a motion is a stop.

    Raises:
        InvalidSetting: a value is outside its range or of the wrong shape.
    """

    target: Array
    speed: float = 1.0
    acceleration: float = 1.0
    joint_speed: Array | None = None
    joint_acceleration: Array | None = None
    fly_percent: float = 0.0
    joint_jerk: Array | None = None

    def __post_init__(self) -> None:
        target = _array(self.target)
        if target.ndim != 1 or target.size == 0:
            raise InvalidSetting("target", self.target, "one position per joint [rad]")
        object.__setattr__(self, "target", target)
        for name in ("speed", "acceleration"):
            object.__setattr__(self, name, float(checked_shares(name, getattr(self, name))))
        for name in ("joint_speed", "joint_acceleration", "joint_jerk"):
            if (shares := getattr(self, name)) is not None:
                object.__setattr__(self, name, checked_shares(name, shares, target.size))
        if not 0.0 <= self.fly_percent <= 100.0:
            raise InvalidSetting("fly percentage", self.fly_percent, "a number from 0 to 100")


@dataclass(frozen=True, eq=False)
class Overrides:
    """Overrides at planning time, shares in (0, 1]; fly-by paths may change with them.

    `acceleration` scales the limits while speeding up, `deceleration` while slowing down, `joint`
    (a number or (n,)) the velocity limit of each joint. The override that does not change the path
    is `TrajectoryPlayer.override`.

    Raises:
        InvalidSetting: a value is outside its range.
    """

    speed: float = 1.0
    acceleration: float = 1.0
    deceleration: float = 1.0
    joint: ArrayLike = field(default=1.0)

    def __post_init__(self) -> None:
        for name in ("speed", "acceleration", "deceleration"):
            share = checked_shares(f"{name} override", getattr(self, name))
            object.__setattr__(self, name, float(share))
        size = np.size(self.joint)
        object.__setattr__(self, "joint", checked_shares("joint override", self.joint, size))


def checked_shares(name: str, values: ArrayLike, n_joints: int | None = None) -> Array:
    """Return shares in (0, 1], one or one per joint, read-only.

    Raises:
        InvalidSetting: a value is outside its range, or their number is wrong.
    """
    shares = _array(values)
    if shares.shape not in ((), (n_joints,)) or not np.all((shares > 0.0) & (shares <= 1.0)):
        count = "" if n_joints is None else f", one or {n_joints} of them"
        raise InvalidSetting(name, values, f"a share in (0, 1]{count}")
    return shares


def _array(values: ArrayLike) -> Array:
    """Return numbers as a read-only array; NaN if they are not numbers."""
    try:
        return read_only(values)
    except (TypeError, ValueError):
        return read_only(np.nan)


# Shares of the limits that legs use, so that the states at which corners cut them are far from
# those at which ruckig fails; corners use the full limits.
SEGMENT_VELOCITY: Final = 0.99
SEGMENT_ACCELERATION: Final = 0.98
SEGMENT_JERK: Final = 0.98


class Legs(NamedTuple):
    """Moves planned from rest to rest, with limits, also of deceleration (s, n) [rad/s²]."""

    moves: StraightMoves
    bounds: Allowance
    deceleration: Array

    @classmethod
    def between(cls, starts: Array, ends: Array, bounds: Allowance, deceleration: Array) -> Legs:
        """Plan moves between positions.

        Args:
            starts: positions (s, n) [rad].
            ends: positions (s, n) [rad].
            bounds: of velocity, acceleration and jerk (s, n).
            deceleration: bound of the slowing down (s, n) [rad/s²].
        """
        cautious = bounds._replace(
            velocity=SEGMENT_VELOCITY * bounds.velocity,
            acceleration=SEGMENT_ACCELERATION * bounds.acceleration,
            jerk=SEGMENT_JERK * bounds.jerk,
        )
        slowing = SEGMENT_ACCELERATION * deceleration
        return cls(StraightMoves.between(starts, ends, cautious, slowing), bounds, deceleration)

    def take(self, rows: Rows) -> Legs:
        """Return legs by index."""
        return Legs(self.moves.take(rows), self.bounds.take(rows), self.deceleration[rows])

    def followed_by(self, other: Legs) -> Legs:
        """Return these legs and others."""
        moves, bounds = (
            [np.concatenate(pair) for pair in zip(first, second, strict=True)]
            for first, second in zip(self[:2], other[:2], strict=True)
        )
        deceleration = np.concatenate((self.deceleration, other.deceleration))
        return Legs(StraightMoves(*moves), Allowance(*bounds), deceleration)

    def corners(self, before: Rows, after: Rows, fly: Array) -> list[Corner]:
        """Plan the corners at the targets of legs `before` (c,), towards the targets of `after`.

        `fly` (c,) is the share of the deceleration that the next acceleration overlaps.

        Limits within a corner are the larger ones of the two moves; limits of acceleration are the
        deceleration before and the acceleration after it.
        """
        first = self.bounds.take(before)
        second = self.bounds.take(after)
        bounds = first._replace(
            velocity=np.maximum(first.velocity, second.velocity),
            acceleration=np.maximum(self.deceleration[before], second.acceleration),
            jerk=np.maximum(first.jerk, second.jerk),
        )
        return round_corners(self.moves, before, after, bounds, fly)

    def motions(self, corners: Sequence[Corner], count: int) -> list[PiecewiseCubic]:
        """Assemble legs and corners to `count` motions.

        Raises:
            PlanningError: a motion breaks a limit of its legs, or is not smooth.
        """
        outcomes = self.checked_motions(corners, count)
        for motion in outcomes:
            if isinstance(motion, PlanningError):
                raise motion
        return [motion for motion in outcomes if isinstance(motion, PiecewiseCubic)]

    def checked_motions(
        self, corners: Sequence[Corner], count: int
    ) -> list[PiecewiseCubic | PlanningError]:
        """Return each motion, or the error for which it is refused."""
        block = _assembled(self.moves, corners, count)
        rates = self.bounds._replace(
            acceleration=np.maximum(self.bounds.acceleration, self.deceleration)
        )
        n = self.deceleration.shape[1]
        widest = Allowance(*(bound.reshape(count, -1, n).max(axis=1) for bound in rates))
        good = (block.satisfies(widest) & block.smooth(widest)).tolist()
        return [
            motion if ok else _checked(motion, Allowance(*(bound[row] for bound in widest)))
            for row, (motion, ok) in enumerate(zip(block.tables(), good, strict=True))
        ]


def _checked(motion: PiecewiseCubic, bounds: Allowance) -> PiecewiseCubic | PlanningError:
    try:
        check_limits(motion, bounds)
        check_smooth(motion, bounds)
    except PlanningError as error:
        return error
    return motion


def _assembled(moves: StraightMoves, corners: Sequence[Corner], count: int) -> Block:
    """Return `count` motions of equal numbers of legs, with corners between them."""
    legs = len(moves.start) // count
    n = moves.start.shape[1]
    leave, enter = np.zeros((2, count, legs))
    leave[:, :-1] = np.array([corner.leave for corner in corners]).reshape(count, -1)
    enter[:, 1:] = np.array([corner.enter for corner in corners]).reshape(count, -1)
    # Two full fly-bys may use up a move without cruise: then `end` is `begin` within rounding.
    begin = enter.ravel()
    end = moves.durations - leave.ravel()
    times, pieces = moves.cut(begin, np.maximum(begin, end))
    times = times.reshape(count, legs, 1, -1)
    pieces = pieces.reshape(count, legs, n, -1, 4)

    width = max([1, *(len(c.join.knots[0]) - 1 for c in corners if c.join is not None)])
    # At a stop, and after the last piece of a join, pieces of zero length have the state at which
    # the next move is entered.
    rounds = np.repeat(pieces[:, 1:, :, :1], width, axis=3)
    rounds[..., 3] = 0.0
    knots = np.zeros((count, legs - 1, n, width + 1))
    for index, (_, _, join, *_) in enumerate(corners):
        if join is not None:
            where = divmod(index, legs - 1)
            n_knots = len(join.knots[0])
            rounds[where][:, : n_knots - 1] = join.coefficients
            knots[where][:, :n_knots] = join.knots
            knots[where][:, n_knots:] = join.duration

    spans = np.zeros((count, 2 * legs))
    spans[:, 1::2], spans[:, 2::2] = times[:, :, 0, -1], knots[:, :, 0, -1]
    offset = np.cumsum(spans, axis=1)[..., None, None]
    row_knots = [np.zeros((count, n, 1))]
    row_pieces = []
    for part in range(2 * legs - 1):
        leg = part // 2
        local, table = (knots, rounds) if part % 2 else (times, pieces)
        shifted = local[:, leg, :, 1:] + offset[:, part]
        row_knots.append(np.broadcast_to(shifted, (count, n, shifted.shape[-1])))
        row_pieces.append(table[:, leg])
    return Block.of_pieces(np.concatenate(row_knots, -1), np.concatenate(row_pieces, -2))


def legs_through(
    points: Array, moves: Sequence[Move], limits: JointLimits, overrides: Overrides
) -> Legs:
    """Plan the moves from each point to the next, from rest to rest.

    Args:
        points: positions (s + 1, n) [rad].
        moves: to all of them but the first (s).
        limits: of the joints.
        overrides: of speed and acceleration.

    Raises:
        InvalidSetting: the overrides have another number of joints.
    """
    n = limits.n_joints
    joint = np.asarray(overrides.joint)
    if joint.shape not in ((), (n,)):
        raise InvalidSetting("joint override", overrides.joint, f"one share, or {n} of them")

    def share(values: Array | None) -> Any:
        return 1.0 if values is None else values

    rates = np.array(
        [
            (
                limits.velocity * (move.speed * overrides.speed * joint) * share(move.joint_speed),
                limits.acceleration * move.acceleration * share(move.joint_acceleration),
                limits.jerk * share(move.joint_jerk),
            )
            for move in moves
        ]
    )
    velocity, acceleration, jerk = rates.swapaxes(0, 1)
    lower, upper = (np.broadcast_to(end, velocity.shape) for end in (limits.lower, limits.upper))
    bounds = Allowance(lower, upper, velocity, acceleration * overrides.acceleration, jerk)
    return Legs.between(points[:-1], points[1:], bounds, acceleration * overrides.deceleration)


@dataclass(frozen=True)
class TargetPassage:
    """Passage of the target of move `index` [s, rad].

    `time` is when the path is nearest to the target, at a Euclidean `distance` in joint space;
    `fly` is the share of the ramps before and after the target that the corner takes, 0 for a stop.
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
        start: Start position (n,) [rad].
        durations: Duration of each move from rest to rest [s].
        corners: Corner at each target but the last.
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
        """Length in time with a stop at every target [s]; never shorter."""
        return sum(self.durations)

    @property
    def reduced_corners(self) -> int:
        """Number of targets with a smaller corner than requested."""
        return sum(corner.how == "reduced" for corner in self.corners)

    @property
    def stopped_corners(self) -> int:
        """Number of targets at which the motion stops although a fly-by was requested."""
        return sum(
            corner.how == "stopped" and move.fly_percent > 0.0 and min(durations) > 0.0
            for corner, move, durations in zip(
                self.corners, self.moves, pairwise(self.durations), strict=False
            )
        )

    @cached_property
    def targets(self) -> tuple[TargetPassage, ...]:
        """Passage of the target of each move."""
        time = 0.0
        entered = 0.0
        passages = []
        for index, (move, duration, corner) in enumerate(
            zip(self.moves, self.durations, (*self.corners, STOP), strict=True)
        ):
            time += max(duration - entered - corner.leave, 0.0)
            passages.append(passage(index, move.target, corner, time))
            time += 0.0 if corner.join is None else corner.join.duration
            entered = corner.enter
        return tuple(passages)


def passage(index: int, target: Array, corner: Corner, time: float) -> TargetPassage:
    """Return how a target is passed by a corner.

    Args:
        index: of the target.
        target: position (n,) [rad].
        corner: that rounds it.
        time: at which the corner begins [s].
    """
    if corner.join is None:
        return TargetPassage(index, time, 0.0, "stopped", 0.0)
    passed = passing(corner.join, target)
    return TargetPassage(index, time + passed.time, passed.distance, corner.how, corner.share)


def checked_via_points(via_points: ArrayLike, limits: JointLimits) -> Array:
    """Return checked via points (n_points, n_joints) [rad].

    Raises:
        InvalidViaPoints: wrong shape, fewer than two, not finite, or out of limits.
    """
    try:
        points = np.array(via_points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidViaPoints(f"via points are not a table of numbers: {error}") from error
    if points.ndim != 2 or points.shape[1] != limits.n_joints:
        expected = f"expected (n_points, {limits.n_joints})"
        raise InvalidViaPoints(f"via points have shape {points.shape}; {expected}")
    if len(points) < 2:
        raise InvalidViaPoints(f"{len(points)} via point(s) given; a motion needs at least 2")
    inside = (points >= limits.lower) & (points <= limits.upper)
    for index, joint in np.argwhere(~inside).tolist():  # the first; NaN is never inside
        value = points[index, joint]
        lower = limits.lower[joint]
        upper = limits.upper[joint]
        raise InvalidViaPoints(
            f"via point {index}, joint {joint}: {value:.6g} rad is outside "
            f"[{lower:.6g}, {upper:.6g}] rad"
            if np.isfinite(value)
            else f"via point {index}, joint {joint}: {value} is not a finite position"
        )
    return points


_NO_OVERRIDES = Overrides()


def plan_moves(
    start: Array,
    moves: Sequence[Move],
    limits: JointLimits,
    overrides: Overrides = _NO_OVERRIDES,
) -> MotionPlan:
    """Plan a motion through the targets of moves, from rest to rest.

    Between targets the arm moves on straight joint-space lines, all joints in phase. A target
    that repeats its predecessor is a stop. A corner that cannot be rounded as requested, or is
    faster if rounded less, is rounded less or becomes a stop; see `MotionPlan.targets`. The motion
    never takes longer than one with a stop at every target.

    Args:
        start: position (n,) [rad].
        moves: to the targets, in order.
        limits: of the joints.
        overrides: of speed and acceleration.

    Raises:
        InvalidViaPoints: start (via point 0) or a target (via point i of the i-th move) is of the
            wrong shape, not finite, or out of limits.
        InvalidSetting: overrides of another number of joints.
        PlanningError: the plan breaks a limit or is not smooth; seen only with limits that differ
            by 1e8.
        UnsupportedSolver: a corner is to be rounded with an untested version of ruckig.
    """
    points = checked_via_points([start, *(move.target for move in moves)], limits)
    legs = legs_through(points, moves, limits, overrides)
    rows = np.arange(len(moves))
    fly = np.array([move.fly_percent for move in moves[:-1]]) / 100.0
    corners = legs.corners(rows[:-1], rows[1:], fly)
    (motion,) = legs.motions(corners, 1)
    return MotionPlan(
        start=read_only(points[0]),
        moves=tuple(moves),
        limits=limits,
        overrides=overrides,
        trajectory=motion,
        durations=tuple(legs.moves.durations.tolist()),
        corners=tuple(corners),
    )


def plan(
    via_points: ArrayLike, limits: JointLimits, *, speed: ArrayLike = 1.0, fly: float = 0.5
) -> PiecewiseCubic:
    """Plan a motion through via points, from rest to rest.

    Args:
        via_points: positions (n_points, n_joints) [rad].
        limits: of the joints.
        speed: share of each joint's velocity limit, in (0, 1], a number or (n,).
        fly: share of each deceleration that the next acceleration overlaps, from 0 (stop at every
            via point) to 1 (the corner begins with the deceleration).

    Raises:
        InvalidSetting: speed or fly outside its range.
        InvalidViaPoints, PlanningError, UnsupportedSolver: as `plan_moves`.
    """
    n = limits.n_joints
    speeds = np.broadcast_to(checked_shares("speed", speed, n), (1, n))
    if not 0.0 <= fly <= 1.0:
        raise InvalidSetting("fly", fly, "a number from 0 to 1")
    (motion,) = plan_chunk([via_points], speeds, limits, fly)
    if isinstance(motion, PlannerError):
        raise motion
    return motion


def plan_chunk(
    individuals: Sequence[ArrayLike], speed: Array, limits: JointLimits, fly: float
) -> list[PiecewiseCubic | PlannerError]:
    """Plan the motions of many individuals of a search together.

    ruckig can crash the process, so searches call this in `planner.worker` processes.

    Args:
        individuals: via points of each, which may differ in number.
        speed: one row (n,) for each.
        limits: of the joints.
        fly: as of `plan`.

    Returns:
        The motion of each individual, or the error that `plan` would raise.
    """
    planned: dict[int, PiecewiseCubic | PlannerError] = {}
    alike: dict[int, list[tuple[int, Array]]] = {}
    for index, via_points in enumerate(individuals):
        try:
            points = checked_via_points(via_points, limits)
        except InvalidViaPoints as error:
            planned[index] = error
        else:
            alike.setdefault(len(points), []).append((index, points))
    for group in alike.values():
        rows = [index for index, _ in group]
        through = np.array([points for _, points in group])
        count, n_points, n = through.shape
        velocity = np.repeat(limits.velocity * speed[rows], n_points - 1, axis=0)
        lower, upper, acceleration, jerk = (
            np.broadcast_to(bound, velocity.shape)
            for bound in (limits.lower, limits.upper, limits.acceleration, limits.jerk)
        )
        legs, corners = _shared(
            through[:, :-1].reshape(-1, n),
            through[:, 1:].reshape(-1, n),
            Allowance(lower, upper, velocity, acceleration, jerk),
            fly,
            count,
        )
        planned |= dict(zip(rows, legs.checked_motions(corners, count), strict=True))
    return [planned[index] for index in range(len(individuals))]


def _shared(
    starts: Array, ends: Array, bounds: Allowance, fly: float, count: int
) -> tuple[Legs, list[Corner]]:
    """Plan the legs (s, n) of `count` motions and their corners, equal ones once.

    Neighbours of one motion in a search have most of them in common.
    """
    rows = np.concatenate((starts, ends, bounds.velocity), axis=1)
    first, leg = _distinct(rows)
    few = bounds.take(first)
    distinct = Legs.between(starts[first], ends[first], few, few.acceleration)
    each = leg.reshape(count, -1)
    pairs = np.stack((each[:, :-1].ravel(), each[:, 1:].ravel()), axis=1)
    first, corner = _distinct(pairs)
    before, after = pairs[first].T
    # in per cent and back, as a move has it
    shares = np.full(len(first), 100.0 * fly / 100.0)
    corners = distinct.corners(before, after, shares)
    return distinct.take(leg), [corners[index] for index in corner.tolist()]


def _distinct(rows: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first of each group of equal rows (s, k), and for each row its group (s,)."""
    numbers = np.ascontiguousarray(rows).view(np.int64)  # bit by bit: 0 is not -0
    _, first, group = np.unique(numbers, axis=0, return_index=True, return_inverse=True)
    return first, group.ravel()
