"""Planning whole populations together, for searches.

A search draws motions by the thousand, and some cannot be planned: their points are outside the
limits, or their corners crash the solver and its process with it, so that it is to be a worker's
(`planner.worker`). Here each comes back as a motion or as the error that made it infeasible.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from planner.arrays import Array
from planner.blocks import Block
from planner.commands import FlyPercent
from planner.corners import Corners, round_corners
from planner.errors import InvalidViaPoints, PlannerError, PlanningError
from planner.limits import Allowance, JointLimits
from planner.moves import (
    SEGMENT_ACCELERATION,
    SEGMENT_JERK,
    SEGMENT_VELOCITY,
    checked_via_points,
    plan,
)
from planner.piecewise_cubic import PiecewiseCubic
from planner.segments import StraightMoves

_PIECES = 7  # of a straight move


def plan_population(points: Array, bounds: Allowance, fly: float) -> list[PiecewiseCubic | None]:
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
    shares = np.full(len(before), FlyPercent(100.0 * fly).share)
    corners = round_corners(moves, before, after, bounds.take(each[before]), shares)
    block = _assembled(moves, corners, points.shape)
    good = block.keeps(bounds) & block.smooth(bounds)
    return [
        motion if ok else None for motion, ok in zip(block.tables(), good.tolist(), strict=True)
    ]


def _assembled(moves: StraightMoves, corners: Corners, shape: tuple[int, ...]) -> Block:
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

    width = max([1, *(len(join.knots[0]) - 1 for join in corners.joins if join is not None)])
    # Where the arm stops, and behind the last piece of a join, pieces of no length hold the state
    # in which the next move is entered.
    rounds = np.repeat(pieces[:, 1:, :, :1], width, axis=3)
    rounds[..., 3] = 0.0
    knots = np.zeros((count, legs - 1, n_joints, width + 1))
    for index, join in enumerate(corners.joins):
        if join is not None:
            where, own = divmod(index, legs - 1), len(join.knots[0])
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
        bounds = Allowance(
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
