"""Flying by a via point: leave one segment early, enter the next late, join the two states."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import ruckig

from planner.arrays import Array
from planner.errors import PlanningError
from planner.limits import JointLimits
from planner.piecewise_cubic import PiecewiseCubic
from planner.segments import StraightSegment
from planner.verify import check_limits, jump_rounding

# A join may take this much of the time it replaces; a longer one wanders off (facts: motion).
_LONGEST_JOIN = 1.05
# How often a corner's fly is halved before the arm stops there instead.
_HALVINGS = 4
# ruckig is never shown a state closer than this to its limits: it can crash the process there.
_NEAREST_STATE = 0.995
# Joins use the full limits but for a little room in which the last digits are closed.
_FULL = 0.999


class Corner(NamedTuple):
    """How a via point is passed.

    Attributes:
        leave: Time cut from the end of the segment before [s].
        enter: Time cut from the beginning of the segment after [s].
        join: What replaces them; None where the arm stops.
    """

    leave: float
    enter: float
    join: PiecewiseCubic | None


STOP = Corner(0.0, 0.0, None)


def fly_by(
    before: StraightSegment, after: StraightSegment, limits: JointLimits, fly: float
) -> Corner:
    """Round the corner between two segments as far as `fly` asks and the limits allow.

    The cut takes the share `fly` of the deceleration before and of the acceleration after the
    corner, so that at most half of a segment goes to each of its corners. A join that takes
    too long or leaves the limits is tried again with half the fly, and given up in the end.
    """
    if fly == 0.0 or before.ramp == 0.0 or after.ramp == 0.0:
        return STOP
    for _ in range(1 + _HALVINGS):
        leave, enter = fly * before.ramp, fly * after.ramp
        joined = join(before.state(before.duration - leave), after.state(enter), limits)
        if joined is not None and joined.duration <= _LONGEST_JOIN * (leave + enter):
            return Corner(leave, enter, joined)
        fly /= 2.0
    return STOP


def join(start: Array, end: Array, limits: JointLimits) -> PiecewiseCubic | None:
    """Plan the fastest motion between two states (n, 3) that keeps the limits, if there is one.

    Rows are position, velocity and acceleration of a joint; all joints arrive together.
    """
    for state in (start, end):
        if np.any(np.abs(state[:, 1]) >= _NEAREST_STATE * limits.velocity) or np.any(
            np.abs(state[:, 2]) >= _NEAREST_STATE * limits.acceleration
        ):
            return None
    problem = ruckig.InputParameter(len(start))
    problem.synchronization = ruckig.Synchronization.Time
    problem.current_position, problem.current_velocity, problem.current_acceleration = start.T
    problem.target_position, problem.target_velocity, problem.target_acceleration = end.T
    problem.max_velocity = _FULL * limits.velocity
    problem.max_acceleration = _FULL * limits.acceleration
    problem.max_jerk = _FULL * limits.jerk
    solution = ruckig.Trajectory(len(start))
    try:
        ruckig.Ruckig(len(start)).calculate(problem, solution)
    except ruckig.RuckigError:
        return None
    joined = _table(solution, start)
    if not _meets(joined, end, limits):
        joined = _closed(joined, start, end)
    try:
        check_limits(joined, limits)
    except PlanningError:
        return None
    return joined if _meets(joined, end, limits) else None


def _table(solution: ruckig.Trajectory, start: Array) -> PiecewiseCubic:
    """Turn a solution into cubic pieces."""
    profiles = solution.profiles[0]
    lengths = np.array([[*p.brake.t, *p.t] for p in profiles])
    jerks = np.array([[*p.brake.j, *p.j] for p in profiles])
    knots = np.zeros((len(start), lengths.shape[1] + 1))
    knots[:, 1:] = np.minimum(np.cumsum(lengths, axis=1), solution.duration)
    knots[:, -1] = solution.duration
    return PiecewiseCubic.from_jerks(start, knots, jerks)


def _closed(table: PiecewiseCubic, start: Array, end: Array) -> PiecewiseCubic:
    """Change the jerks of a table from `start` as little as it takes to end in `end`.

    The solver is content with 1e-8 rad. Sampled each millisecond, such a jump is a jerk of
    10 rad/s³ and more. Knots at the quarters keep the change small: the fastest way to shift
    a joint a little, all else equal, changes its jerk there.
    """
    duration = table.duration
    knots = np.array(table.knots)
    quarters = np.broadcast_to(duration * np.array([0.25, 0.5, 0.75]), (len(start), 3))
    finer = np.sort(np.concatenate((knots, quarters), axis=1), axis=1)
    piece = np.sum(finer[:, :-1, None] >= knots[:, None, 1:-1], axis=2)
    jerks = np.take_along_axis(np.array(table.coefficients)[:, :, 3], piece, axis=1)
    # What each jerk does to the end state, by the time that is left at its two knots.
    left = duration - finer
    effect = -np.diff(np.stack((left**3 / 6.0, left**2 / 2.0, left), axis=1), axis=2)
    scale = np.array([1.0, duration, duration**2])  # makes the three rows comparable
    closing = np.linalg.pinv(effect * scale[:, None])
    for _ in range(2):  # the second time for what rounding left of the first
        jerks = jerks + np.einsum("jik,jk->ji", closing, _gap(table, end) * scale)
        table = PiecewiseCubic.from_jerks(start, finer, jerks)
    return table


def _meets(table: PiecewiseCubic, end: Array, limits: JointLimits) -> bool:
    """Whether a table ends in the state `end` but for rounding (a fraction of what jumps may)."""
    rounding = 0.1 * jump_rounding(limits, table.duration)
    return bool(np.all(np.abs(_gap(table, end)) <= rounding))


def _gap(table: PiecewiseCubic, end: Array) -> Array:
    """Return what is missing at the end of a table to the state `end`, (n, 3)."""
    reached: Array = np.array([states[-1] for states in table.ends()])
    return end - reached
