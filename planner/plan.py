"""Via points to motion, as an industrial controller's joint interpolator runs it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from planner.arrays import Array
from planner.corners import STOP, Corner, fly_by
from planner.errors import (
    InvalidSetting,
    InvalidViaPoints,
    NonFiniteViaPoint,
    TooFewViaPoints,
    ViaPointOutOfLimits,
    WrongShape,
)
from planner.limits import JointLimits
from planner.piecewise_cubic import PiecewiseCubic, concatenate
from planner.segments import StraightSegment
from planner.verify import check_limits, check_smooth

# Segments keep this distance from the limits, so that the states at which corners cut them lie
# clear of where the corner's solver is known to fail; corners then use the full limits.
_SEGMENT_VELOCITY = 0.99
_SEGMENT_ACCELERATION = 0.98
_SEGMENT_JERK = 0.98


def plan(
    via_points: ArrayLike, limits: JointLimits, *, speed: ArrayLike = 1.0, fly: float = 0.5
) -> PiecewiseCubic:
    """Plan a motion through via points that starts and ends at rest and keeps all limits.

    Between via points the arm moves on straight joint-space lines, all joints in phase. A via
    point that repeats its predecessor is a stop. A corner that cannot be rounded as asked is
    rounded less, in the end not at all; so the motion may stop where `fly` asks it not to.

    Args:
        via_points: Positions (n_points, n_joints) [rad], at least two, inside the limits.
        limits: Limits, kept exactly (but for rounding) at every instant.
        speed: Share of each joint's velocity limit to use, in (0, 1], a number or (n,).
        fly: Share of each deceleration that the next acceleration overlaps, from 0 (stop at
            every via point) to 1 (the corner begins where the deceleration would).

    Raises:
        InvalidViaPoints: wrong shape, fewer than two, not finite, or out of limits.
        InvalidSetting: speed or fly outside its range.
        PlanningError: no plan was found that keeps the limits (none such is known).
    """
    points = checked_via_points(via_points, limits)
    allowed = limits.scaled(velocity=_checked_speed(speed, limits.n_joints))
    if not 0.0 <= fly <= 1.0:
        raise InvalidSetting("fly", fly, "a number from 0 to 1")
    cautious = allowed.scaled(
        velocity=_SEGMENT_VELOCITY, acceleration=_SEGMENT_ACCELERATION, jerk=_SEGMENT_JERK
    )
    segments = [StraightSegment.between(a, b, cautious) for a, b in pairwise(points)]
    corners = [fly_by(a, b, allowed, fly) for a, b in pairwise(segments)]
    motion = _assemble(segments, corners)
    check_limits(motion, allowed)
    check_smooth(motion, allowed)
    return motion


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


def _checked_speed(speed: ArrayLike, n_joints: int) -> Array:
    shares = np.asarray(speed, dtype=np.float64)
    if shares.shape not in ((), (n_joints,)) or not np.all((shares > 0.0) & (shares <= 1.0)):
        raise InvalidSetting("speed", speed, f"a share in (0, 1], one or {n_joints} of them")
    return shares


def _assemble(segments: list[StraightSegment], corners: list[Corner]) -> PiecewiseCubic:
    """Cut the segments where the corners ask for it and put everything in a row."""
    parts = []
    for segment, before, after in zip(segments, [STOP, *corners], [*corners, STOP], strict=True):
        start, stop = before.enter, segment.duration - after.leave
        # Two full fly-bys may use up a segment without cruise; nothing is left but rounding.
        parts.append(segment.pieces(start, max(start, stop)))
        if after.join is not None:
            parts.append(after.join)
    return concatenate([part for part in parts if part.duration > 0.0] or parts[:1])
