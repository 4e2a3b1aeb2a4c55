"""Via points to motion, as an industrial controller's joint interpolator runs it."""

from __future__ import annotations

from numpy.typing import ArrayLike

from planner.commands import FlyPercent, Move, checked_shares
from planner.errors import InvalidSetting
from planner.limits import JointLimits
from planner.moves import checked_via_points, planned
from planner.piecewise_cubic import PiecewiseCubic

__all__ = ["plan", "checked_via_points"]


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
