"""The motions of a campaign in order, with the moves between them, checked before they are sent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.archive.header import motion_name
from hil.cell import AngleFrame, Cell
from hil.motion_checks import MotionChecks
from planner import (
    FourierSeries,
    JointLimits,
    Move,
    PiecewiseCubic,
    PlanFile,
    TrajectoryPlayer,
    in_child,
    plan_moves,
)

from .errors import MotionRefusedError
from .plan import CampaignPlan

Array = NDArray[np.float64]

_ROUNDED: Final = 9e-7
"""Share of half a joint's range by which the wire rounds an arm at its limit out of it; the guard
of every cycle and the player allow as much."""


def at_limit(posture: Array, limits: JointLimits) -> Array:
    """A posture (n,) [rad], brought back to a limit that only rounding took it across."""
    within = np.clip(posture, limits.lower, limits.upper)
    rounding = 0.5 * _ROUNDED * (limits.upper - limits.lower)
    return np.where(np.abs(posture - within) <= rounding, within, posture)


def beyond(cell: Cell, posture: Array, verb: str = "stands at") -> str | None:
    """Which joint of a posture (n,) [rad] is outside its limits, in words and degrees.

    Args:
        cell: its limits.
        posture: (n,) rad.
        verb: what the joint does there.
    """
    limits, frame = cell.joint_limits, AngleFrame.of(cell)
    posture = at_limit(posture, limits)
    outside = np.flatnonzero((posture < limits.lower) | (posture > limits.upper))
    if not len(outside):
        return None
    joint = int(outside[0])
    ends = np.sort([frame.shown(limits.lower)[joint], frame.shown(limits.upper)[joint]])
    return (
        f"{cell.joint_names[joint]} {verb} {frame.shown(posture)[joint]:.6g}°, its limits are "
        f"{ends[0]:.6g}° and {ends[1]:.6g}° ({frame.whose})"
    )


AT_REST_TOLERANCE = 1e-6
"""rad; a move shorter than this is not worth an interval."""
START_TOLERANCE = 1e-3
"""rad by which a motion may begin elsewhere than where the arm is."""


@dataclass(frozen=True, eq=False)
class Interval:
    """One interval of motion: what kind it is, the trajectory to run, and the moves behind it.

    Attributes:
        kind: "standstill", "excitation", "validation" or "move".
        index: which of its kind, from 0.
        trajectory: the motion.
        moves: those that it was planned from, where there are any.
        from_arm: whether it is a way from or to where the arm happens to stand.
    """

    kind: str
    index: int
    trajectory: PiecewiseCubic | FourierSeries
    moves: PlanFile | None = None
    from_arm: bool = False

    def __str__(self) -> str:
        return motion_name(self.kind, self.index)


def wanted(cell: Cell, plan: CampaignPlan, repetitions: int | None = None) -> list[Interval]:
    """All motions of a plan, without the moves between them.

    Args:
        cell: says how many repetitions there are.
        plan: the motions.
        repetitions: of the excitation, and no validation motion; None for all of both.
    """
    settings = cell.campaign
    validation = plan.validation if repetitions is None else ()
    repetitions = settings.repetitions if repetitions is None else repetitions
    excitation = plan.excitation.trajectory
    return [
        Interval("standstill", 0, hold(cell.home, settings.standstill_s)),
        *(Interval("excitation", i, excitation, plan.moves) for i in range(repetitions)),
        *(
            Interval("validation", i, motion.trajectory, motion.moves)
            for i, motion in enumerate(validation)
        ),
    ]


def with_moves(cell: Cell, intervals: Sequence[Interval], where: Array) -> list[Interval]:
    """Put moves between: from `where` (n,) to home, from home to an excitation, and back.

    An excitation, and sines of any kind, may begin and end elsewhere than at home; whatever else
    does is not met.
    """
    home, at = cell.home, where
    joined: list[Interval] = []
    planned: dict[bytes, Interval] = {}

    def go(target: Array) -> None:
        nonlocal at
        from_arm = at is where or target is where
        if np.max(np.abs(target - at)) > AT_REST_TOLERANCE:
            key = at.tobytes() + target.tobytes()
            if key not in planned:
                planned[key] = way(cell, at, target)
            index = sum(interval.kind == "move" for interval in joined)
            joined.append(replace(planned[key], index=index, from_arm=from_arm))
        at = target

    for interval in intervals:
        elsewhere = interval.kind == "excitation" or isinstance(interval.trajectory, FourierSeries)
        start, end = ends(interval) if elsewhere else (home, home)
        go(start)
        joined.append(interval)
        at = end
    go(home)
    go(where)
    return joined


def require_sound(intervals: Sequence[Interval], checks: MotionChecks) -> None:
    """Refuse motions that must not be sent; each is looked at once.

    Raises:
        MotionRefusedError: names the motion, what is wrong with it and what to do.
    """
    checked: set[int] = set()
    for interval in intervals:
        if id(interval.trajectory) not in checked:
            _require(interval, checks.refusal(interval.trajectory))
            checked.add(id(interval.trajectory))


def require_joined(intervals: Sequence[Interval]) -> None:
    """Refuse motions that do not begin where the one before ends.

    Raises:
        MotionRefusedError: names the motion and the joint.
    """
    for before, after in pairwise(intervals):
        _require(after, _jump(before, after))


def require_runnable(cell: Cell, plan: CampaignPlan, checks: MotionChecks | None = None) -> None:
    """Refuse a plan that can never run on a cell, wherever its arm stands.

    Args:
        cell: the cell.
        plan: excitation and validation motions.
        checks: those of the cell, where they are at hand.

    Raises:
        MotionRefusedError: names the motion, what is wrong with it and what to do.
    """
    checks = checks or MotionChecks.of(cell)
    intervals = wanted(cell, plan)
    require_sound(intervals, checks)  # before ways are planned to where they lead
    joined = with_moves(cell, intervals, cell.home)
    require_sound([interval for interval in joined if interval.kind == "move"], checks)
    require_joined(joined)


def ends(interval: Interval) -> tuple[Array, Array]:
    """Where a motion begins and where it ends, (n,) [rad] each."""
    start, end = interval.trajectory.sample(np.array([0.0, interval.trajectory.duration]))[0]
    return start, end


def player_of(cell: Cell, trajectory: PiecewiseCubic | FourierSeries) -> TrajectoryPlayer:
    """Plays a motion within the three sets of bounds of a cell."""
    bounds = cell.file.bounds
    return TrajectoryPlayer(
        trajectory,
        cell.period,
        cell.joint_limits,
        override_acceleration=bounds.override.acceleration,
        override_jerk=bounds.override.jerk,
        stop_acceleration=bounds.stop.acceleration,
        stop_jerk=bounds.stop.jerk,
        start_tolerance=START_TOLERANCE,
    )


def hold(position: Array, duration: float) -> PiecewiseCubic:
    """Rest at `position` (n,) [rad] for `duration` [s]."""
    return PiecewiseCubic(
        knots=tuple(np.array([0.0, duration]) for _ in position),
        coefficients=tuple(np.array([[q, 0.0, 0.0, 0.0]]) for q in position),
    )


def way(cell: Cell, start: Array, end: Array) -> Interval:
    """The straight way between two postures (n,) [rad]; planned where a crash does not end us.

    Raises:
        MotionRefusedError: the arm stands outside its limits.
    """
    limits = cell.joint_limits
    for posture in (start, end):
        if (problem := beyond(cell, posture)) is not None:
            raise MotionRefusedError("the way", problem, "jog the arm to within [limits]")
    move = Move(at_limit(end, limits), speed=cell.campaign.approach_speed)
    motion = in_child(plan_moves, at_limit(start, limits), (move,), limits)
    return Interval("move", 0, motion.trajectory, PlanFile.of(motion, cell.joint_names))


def _require(interval: Interval, problem: str | None) -> None:
    if problem is None:
        return
    remedy = "design another motion"
    if interval.from_arm:
        remedy = "jog the arm to where the straight way to the motion is free"
    elif interval.kind == "standstill":
        remedy = "correct home_deg or standstill_s in [campaign], or [workspace], of the cell file"
    raise MotionRefusedError(str(interval), problem, remedy)


def _jump(before: Interval, after: Interval) -> str | None:
    """Why `after` cannot follow `before`, or None if it begins where that ends."""
    (_, end), (start, _) = ends(before), ends(after)
    distance = np.abs(start - end)
    if np.max(distance) <= START_TOLERANCE:
        return None
    joint = int(np.argmax(distance))
    return (
        f"it begins with joint {joint + 1} at {start[joint]:.6g} rad, but {before} ends at "
        f"{end[joint]:.6g} rad"
    )
