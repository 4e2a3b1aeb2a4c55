"""Moves to motion, as an industrial controller's joint interpolator runs them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

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
)
from planner.corners import STOP, Corner
from planner.errors import (
    InvalidViaPoints,
    NonFiniteViaPoint,
    TooFewViaPoints,
    ViaPointOutOfLimits,
    WrongShape,
)
from planner.legs import Leg, Shares, between, corners_between, leg_with, shares_of
from planner.limits import Allowance, Bounds, JointLimits
from planner.motion_plan import MotionPlan, TargetPassage
from planner.piecewise_cubic import PiecewiseCubic, concatenate
from planner.verify import check_limits, check_smooth


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


__all__ = [
    "plan_moves",
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
