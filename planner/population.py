"""Planning many motions in whole arrays: `planner.plan` for a population.

The steps and their rules are those of `planner.plan`, taken over all motions together; only the
solver is asked corner by corner. Motions do not depend on their company, to the last bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.arrays import Array
from planner.blocks import Block, LimitRows, Rows
from planner.commands import FlyPercent
from planner.corners import FIRST_SHARES, LAST_SHARES, LEAST_SHARE, ranked
from planner.joins import Join, Solutions, finish_many, solve_many
from planner.legs import SEGMENT_ACCELERATION, SEGMENT_JERK, SEGMENT_VELOCITY
from planner.piecewise_cubic import PiecewiseCubic
from planner.straight import StraightMoves

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
        motion if kept else None for motion, kept in zip(block.tables(), good.tolist(), strict=True)
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
