"""Planning whole populations together, for searches.

A search draws motions by the thousand, and some cannot be planned: their points are outside the
limits, or their corners crash the solver and its process with it, so that it is to be a worker's
(`planner.children`). Here each comes back as a motion or as the error that made it infeasible.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cbrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from planner.arrays import Array
from planner.blocks import Block, LimitRows, Rows, after
from planner.commands import FlyPercent
from planner.corners import FIRST_SHARES, LAST_SHARES, LEAST_SHARE, ranked
from planner.errors import InvalidViaPoints, PlannerError, PlanningError
from planner.joins import Join, Solutions, finish_many, solve_many
from planner.legs import SEGMENT_ACCELERATION, SEGMENT_JERK, SEGMENT_VELOCITY
from planner.limits import JointLimits
from planner.piecewise_cubic import PiecewiseCubic
from planner.plan import checked_via_points, plan


class StraightMoves(NamedTuple):
    """Straight joint-space lines, each run by one scalar profile of seven pieces.

    Attributes:
        start: Where each begins (s, n) [rad].
        direction: Change of the joints per unit of path, largest entry 1, (s, n).
        knots: Times of the profile (s, 8) [s].
        pieces: Path, its rates at the start of each piece, and its constant jerk, (s, 7, 4).
        ramp: Time spent accelerating, equal to that spent decelerating (s,) [s].
    """

    start: Array
    direction: Array
    knots: Array
    pieces: Array
    ramp: Array

    @classmethod
    def between(
        cls, starts: Array, ends: Array, velocity: Array, acceleration: Array, jerk: Array
    ) -> StraightMoves:
        """Plan the fastest straight moves (s, n) under limits that are each (s, n)."""
        change = ends - starts
        length = np.max(np.abs(change), axis=1)
        moves = length > 0.0
        direction = change / np.where(moves, length, 1.0)[:, None]
        with np.errstate(divide="ignore", over="ignore"):
            along = [
                np.where(moves, np.min(bound / np.abs(direction), axis=1), 1.0)
                for bound in (velocity, acceleration, jerk)
            ]
        knots, pieces, ramp = _profiles(np.where(moves, length, 1.0), *along)
        knots *= moves[:, None]
        pieces *= moves[:, None, None]
        return cls(starts, direction, knots, pieces, ramp * moves)

    def take(self, rows: Rows) -> StraightMoves:
        """Return some of the moves, by index."""
        return StraightMoves(*(field[rows] for field in self))

    @property
    def durations(self) -> Array:
        """Length in time (s,) [s]."""
        last: Array = self.knots[:, -1]
        return last

    def states(self, t: Array) -> Array:
        """Return position, velocity, acceleration (s, n, 3) at one time `t` (s,) [s] in each."""
        along = self._along(t)
        states = self.direction[:, :, None] * along[:, None, :3]
        states[..., 0] += self.start
        return states

    def cut(self, begin: Array, end: Array) -> tuple[Array, Array]:
        """Return the parts between two times (s,) [s], with pieces outside them of no length.

        Those hold the state at the cut, so that the table stays continuous.

        Returns:
            Times from 0 (s, 8) [s] and pieces (s, n, 7, 4).
        """
        begin, end = begin[:, None], end[:, None]
        knots = np.clip(self.knots, begin, end)
        pieces = self.pieces.copy()
        moved = knots[:, :-1] - self.knots[:, :-1]
        p, v, a, j = np.moveaxis(self.pieces, -1, 0)
        pieces[..., :3] = np.stack(after(p, v, a, j, moved), axis=-1)
        for outside, at in (
            (self.knots[:, 1:] <= begin, begin[:, 0]),
            (self.knots[:, :-1] >= end, end[:, 0]),
        ):
            np.copyto(pieces, self._along(at)[:, None, :], where=outside[..., None])
        table = self.direction[:, :, None, None] * pieces[:, None]
        table[..., 0] += self.start[:, :, None]
        return knots - begin, table

    def _along(self, t: Array) -> Array:
        """Return path, its two rates and its jerk at a time in each move, (s, 4)."""
        index = np.sum(self.knots[:, 1:-1] <= t[:, None], axis=1)
        rows = np.arange(len(t))
        p, v, a, j = self.pieces[rows, index].T
        return np.stack((*after(p, v, a, j, t - self.knots[rows, index]), j), axis=-1)


def _profiles(
    distance: Array, velocity: Array, acceleration: Array, jerk: Array
) -> tuple[Array, Array, Array]:
    """Return knots (s, 8), pieces (s, 7, 4) and ramps (s,), as `scurve.rest_to_rest` does."""
    rise = np.minimum(acceleration / jerk, np.sqrt(velocity / jerk))
    flat = np.maximum(velocity / (jerk * rise) - rise, 0.0)
    cruises = distance > velocity * (2.0 * rise + flat)
    # Too short to reach full speed; the shortest do not even reach full acceleration.
    full = acceleration / jerk
    holds = distance >= 2.0 * acceleration * full * full
    held = (np.sqrt(full * full + 4.0 * distance / acceleration) - 3.0 * full) / 2.0
    short = full.copy()
    # As floats have it: that of arrays may differ in the last digit.
    least = (distance / (2.0 * jerk))[~holds].tolist()
    short[~holds] = [cbrt(cube) for cube in least]
    rise = np.where(cruises, rise, short)
    flat = np.where(cruises, flat, np.where(holds, np.maximum(held, 0.0), 0.0))

    a1 = jerk * rise
    v1 = a1 * rise / 2.0
    p1 = v1 * rise / 3.0
    v2, p2 = v1 + a1 * flat, p1 + flat * (v1 + a1 * flat / 2.0)
    v3, p3 = v2 + v1, p2 + rise * (v2 + a1 * rise / 3.0)
    cruise = np.where(cruises, (distance - p3 - p3) / v3, 0.0)
    zero = np.zeros_like(distance)
    pieces = np.array(
        [
            (zero, zero, zero, jerk),
            (p1, v1, a1, zero),
            (p2, v2, a1, -jerk),
            (p3, v3, zero, zero),
            (distance - p3, v3, zero, -jerk),
            (distance - p2, v2, -a1, zero),
            (distance - p1, v1, -a1, jerk),
        ]
    )
    lengths = np.stack((zero, rise, flat, rise, cruise, rise, flat, rise), axis=-1)
    return np.cumsum(lengths, axis=-1), np.moveaxis(pieces, -1, 0), 2.0 * rise + flat


_PIECES = 7  # of a straight move


class _Corners(NamedTuple):
    """How corners are rounded: times cut before and after (c,) [s], and the joins."""

    leave: Array
    enter: Array
    joins: list[Join | None]


def plan_population(points: Array, bounds: LimitRows, fly: float) -> list[PiecewiseCubic | None]:
    """Plan motions through via points, as many for each, that were checked.

    Args:
        points: Via points (m, k, n) [rad].
        bounds: Limits of each motion, its share of speed included, (m, n).
        fly: Share of each deceleration that the next acceleration overlaps, 0 to 1.

    Returns:
        The motions; None for one that does not keep what a plan promises.
    """
    count, n_points, n_joints = points.shape
    each = np.repeat(np.arange(count), n_points - 1)
    moves = StraightMoves.between(
        points[:, :-1].reshape(-1, n_joints),
        points[:, 1:].reshape(-1, n_joints),
        SEGMENT_VELOCITY * bounds.velocity[each],
        SEGMENT_ACCELERATION * bounds.acceleration[each],
        SEGMENT_JERK * bounds.jerk[each],
    )
    numbered = np.arange(len(each)).reshape(count, n_points - 1)
    before, after = numbered[:, :-1].ravel(), numbered[:, 1:].ravel()
    corners = _round(moves, before, after, bounds.take(each[before]), fly)
    block = _assembled(moves, corners, points.shape)
    good = block.keeps(bounds) & block.smooth(bounds)
    return [
        motion if ok else None for motion, ok in zip(block.tables(), good.tolist(), strict=True)
    ]


def _round(
    moves: StraightMoves, before: Rows, after: Rows, bounds: LimitRows, fly: float
) -> _Corners:
    """Choose the join of each corner between two moves; none where the arm stops."""
    count, fly = len(before), FlyPercent(100.0 * fly).share
    corners = _Corners(np.zeros(count), np.zeros(count), [None] * count)
    task = _Task(moves, before, after, bounds, fly)
    flown = (fly >= LEAST_SHARE) & (moves.ramp[before] > 0.0) & (moves.ramp[after] > 0.0)
    asked = np.flatnonzero(flown)
    if len(asked) == 0:  # the solver is not even asked whether it is there
        return corners
    shares = np.repeat(fly * np.array(FIRST_SHARES), len(asked))
    rows = np.tile(asked, len(FIRST_SHARES))
    candidates = task.solve(rows, shares)
    leave, enter = task.cuts(rows, shares)
    saving = leave + enter - candidates.durations
    saving = saving.reshape(len(FIRST_SHARES), -1)
    for place in ranked(saving):
        picked = np.flatnonzero(np.take_along_axis(saving, place[None], axis=0)[0] >= 0.0)
        picked = picked[[corners.joins[row] is None for row in asked[picked].tolist()]]
        chosen = place[picked] * len(asked) + picked
        task.finish(corners, rows[chosen], shares[chosen], candidates.take(chosen))
    for share in LAST_SHARES:
        rows = asked[[corners.joins[row] is None for row in asked.tolist()]]
        if len(rows) == 0:
            break
        shares = np.full(len(rows), fly * share)
        solutions = task.solve(rows, shares)
        leave, enter = task.cuts(rows, shares)
        found = np.flatnonzero(leave + enter >= solutions.durations)
        task.finish(corners, rows[found], shares[found], solutions.take(found))
    return corners


class _Task(NamedTuple):
    """Corners (c,) between moves, their limits (c, n), and the fly asked for."""

    moves: StraightMoves
    before: Rows
    after: Rows
    bounds: LimitRows
    fly: float

    def cuts(self, rows: Rows, shares: Array) -> tuple[Array, Array]:
        """Return the times cut before and after some corners for a share of each ramp."""
        ramp = self.moves.ramp
        return shares * ramp[self.before[rows]], shares * ramp[self.after[rows]]

    def solve(self, rows: Rows, shares: Array) -> Solutions:
        """Ask the solver to join what is cut."""
        leave, enter = self.cuts(rows, shares)
        before, after = self.moves.take(self.before[rows]), self.moves.take(self.after[rows])
        starts, ends = before.states(before.durations - leave), after.states(enter)
        full = self.fly * (self.moves.ramp[self.before[rows]] + self.moves.ramp[self.after[rows]])
        return solve_many(starts, ends, full, self.bounds.take(rows))

    def finish(self, corners: _Corners, rows: Rows, shares: Array, solutions: Solutions) -> None:
        """Enter the joins that keep their limits and are no slower than to stop."""
        leave, enter = self.cuts(rows, shares)
        joins = finish_many(solutions, self.bounds.take(rows))
        for row, out, into, join in zip(rows.tolist(), leave, enter, joins, strict=True):
            if join is not None and join.duration <= out + into:
                corners.leave[row], corners.enter[row] = out, into
                corners.joins[row] = join


def _assembled(moves: StraightMoves, corners: _Corners, shape: tuple[int, ...]) -> Block:
    """Cut the moves where the corners ask for it and put everything in a row."""
    count, n_points, n_joints = shape
    legs = n_points - 1
    none = np.zeros((count, 1))
    enter = np.hstack((none, corners.enter.reshape(count, legs - 1))).ravel()
    leave = np.hstack((corners.leave.reshape(count, legs - 1), none)).ravel()
    # Two full fly-bys may use up a move without cruise; nothing is left but rounding.
    times, pieces = moves.cut(enter, np.maximum(enter, moves.durations - leave))
    times = times.reshape(count, legs, 1, _PIECES + 1)
    pieces = pieces.reshape(count, legs, n_joints, _PIECES, 4)

    width = max([1, *(join.knots.shape[1] - 1 for join in corners.joins if join is not None)])
    # Where the arm stops, and behind the last piece of a join, pieces of no length hold the state
    # in which the next move is entered.
    rounds = np.repeat(pieces[:, 1:, :, :1], width, axis=3)
    rounds[..., 3] = 0.0
    knots = np.zeros((count, legs - 1, n_joints, width + 1))
    for index, join in enumerate(corners.joins):
        if join is not None:
            where, own = divmod(index, legs - 1), join.knots.shape[1]
            rounds[where][:, : own - 1] = join.coefficients
            knots[where][:, :own] = join.knots
            knots[where][:, own:] = join.duration
    return _in_a_row(
        np.broadcast_to(times, (*pieces.shape[:3], _PIECES + 1)), pieces, knots, rounds
    )


def _in_a_row(move_knots: Array, moves: Array, join_knots: Array, joins: Array) -> Block:
    """Put moves (m, k, n, ...) and the joins between them (m, k - 1, n, ...) in one row."""
    count, legs, n_joints = moves.shape[:3]
    spans = np.zeros((count, 2 * legs - 1))
    spans[:, ::2], spans[:, 1::2] = move_knots[:, :, 0, -1], join_knots[:, :, 0, -1]
    offset = np.cumsum(np.hstack((np.zeros((count, 1)), spans[:, :-1])), axis=1)[..., None, None]
    move_knots, join_knots = move_knots + offset[:, ::2], join_knots + offset[:, 1::2]
    knots, pieces = [np.zeros((count, n_joints, 1))], []
    for leg in range(legs):
        knots.append(move_knots[:, leg, :, 1:])
        pieces.append(moves[:, leg])
        if leg < legs - 1:
            knots.append(join_knots[:, leg, :, 1:])
            pieces.append(joins[:, leg])
    times, table = np.concatenate(knots, axis=-1), np.concatenate(pieces, axis=-2)
    return Block.of_pieces(times, table)


Planned = PiecewiseCubic | PlannerError


def plan_chunk(
    individuals: Sequence[ArrayLike], speed: Array, limits: JointLimits, fly: float
) -> list[Planned]:
    """Plan a motion through the via points of each individual, as `planner.plan` does.

    Args:
        individuals: Via points (n_points, n_joints) [rad] of each; their number may differ.
        speed: Share of each joint's velocity limit, in (0, 1], one row (n,) for each.
        limits: Limits that every motion keeps.
        fly: Share of each deceleration that the next acceleration overlaps, 0 to 1.

    Returns:
        For each individual, in their order, its motion or the error that `plan` would raise for it.
    """
    planned: list[Planned | None] = [None] * len(individuals)
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
        shape = (len(rows), limits.n_joints)
        bounds = LimitRows(
            np.broadcast_to(limits.lower, shape),
            np.broadcast_to(limits.upper, shape),
            limits.velocity * speed[rows],
            np.broadcast_to(limits.acceleration, shape),
            np.broadcast_to(limits.jerk, shape),
        )
        motions = plan_population(np.array([points for _, points in group]), bounds, fly)
        for (index, points), motion in zip(group, motions, strict=True):
            planned[index] = motion or _alone(points, speed[index], limits, fly)
    return [result for result in planned if result is not None]


def _alone(points: Array, speed: Array, limits: JointLimits, fly: float) -> Planned:
    """Plan what failed in company once more by itself; its error tells what is wrong."""
    try:
        return plan(points, limits, speed=speed, fly=fly)
    except PlanningError as error:
        return error
