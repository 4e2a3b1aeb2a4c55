"""The motions of a campaign in order, with the ways between them, checked before they are sent."""

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
AT_REST_TOLERANCE: Final = 1e-6
"""rad; a move shorter than this is not worth an interval."""
START_TOLERANCE: Final = 1e-3
"""rad by which a motion may begin elsewhere than where the arm is."""
REPEATED: Final = ("excitation", "warmup")
"""Kinds that run the excitation as it was designed."""


@dataclass(frozen=True, eq=False)
class Interval:
    """One interval of motion: what kind it is, the trajectory to run, and the moves behind it.

    Attributes:
        kind: "standstill", "excitation", "validation", "move", "dryrun" or "warmup".
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

    @property
    def ends(self) -> tuple[Array, Array]:
        """Where it begins and where it ends, (n,) [rad] each."""
        start, end = self.trajectory.sample(np.array([0.0, self.trajectory.duration]))[0]
        return start, end

    def leads(self, start: Array, end: Array) -> bool:
        """Whether it leads from `start` to `end` (n,) [rad]."""
        first, last = self.ends
        apart = max(np.max(np.abs(first - start)), np.max(np.abs(last - end)))
        return bool(apart <= AT_REST_TOLERANCE)

    def places(self, home: Array) -> tuple[Array, Array]:
        """Where the arm is to be before and after it (n,) [rad]: at home, as a rule.

        An excitation, and sines of any kind, may begin and end elsewhere; whatever else does is
        not met.
        """
        own = self.kind in (*REPEATED, "dryrun") or isinstance(self.trajectory, FourierSeries)
        return self.ends if own else (home, home)


def at_limit(posture: Array, limits: JointLimits) -> Array:
    """A posture (n,) [rad], brought back to a limit that only rounding took it across."""
    within = np.clip(posture, limits.lower, limits.upper)
    rounding = 0.5 * _ROUNDED * (limits.upper - limits.lower)
    return np.where(np.abs(posture - within) <= rounding, within, posture)


def beyond(cell: Cell, posture: Array, verb: str = "stands at") -> str | None:
    """Which joint of a posture (n,) [rad] is outside its limits, in words and degrees."""
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


def planned_intervals(
    cell: Cell, plan: CampaignPlan, repetitions: int | None = None
) -> list[Interval]:
    """All motions of a plan, without the ways between them.

    Args:
        cell: says how many repetitions there are.
        plan: the motions.
        repetitions: of the excitation, and no validation motion; None for all of both.
    """
    validation = plan.validation if repetitions is None else ()
    repetitions = cell.campaign.repetitions if repetitions is None else repetitions
    excitation = plan.excitation.trajectory
    return [
        Interval("standstill", 0, hold(cell.home, cell.campaign.standstill_s)),
        *(Interval("excitation", k, excitation, plan.moves) for k in range(repetitions)),
        *(Interval("validation", k, m.trajectory, m.moves) for k, m in enumerate(validation)),
    ]


class StraightMoves:
    """Straight ways between postures, each planned and checked once."""

    def __init__(self, cell: Cell, checks: MotionChecks) -> None:
        self._cell, self._checks = cell, checks
        self._known: list[Interval] = []

    def between(
        self, start: Array, end: Array, index: int, *, from_arm: bool = False
    ) -> Interval | None:
        """The way from `start` to `end` (n,) [rad]; None where they are the same.

        Raises:
            MotionRefusedError: it is not free.
        """
        if np.max(np.abs(end - start)) <= AT_REST_TOLERANCE:
            return None
        found = next((one for one in self._known if one.leads(start, end)), None)
        if found is None:
            found = replace(way(self._cell, start, end), index=index, from_arm=from_arm)
            require_allowed([found], self._checks)
            self._known.append(found)
        return replace(found, index=index)

    def joining(self, intervals: Sequence[Interval], where: Array) -> list[Interval]:
        """These motions with the ways between them, from `where` (n,) [rad] to home, and back.

        Raises:
            MotionRefusedError: a way is not free, or a motion begins where no way leads.
        """
        at, home, joined = where, self._cell.home, list[Interval]()

        def go(target: Array) -> None:
            nonlocal at
            index = sum(one.kind == "move" for one in joined)
            from_arm = at is where or target is where
            if (move := self.between(at, target, index, from_arm=from_arm)) is not None:
                joined.append(move)
            at = target

        for interval in intervals:
            start, end = interval.places(home)
            go(start)
            joined.append(interval)
            at = end
        go(home)
        go(where)
        for before, after in pairwise(joined):
            _require(after, _jump(before, after))
        return joined


def require_allowed(intervals: Sequence[Interval], checks: MotionChecks) -> None:
    """Refuse motions that must not be sent; each is looked at once.

    Raises:
        MotionRefusedError: names the motion, what is wrong with it and what to do.
    """
    different: dict[int, Interval] = {}
    for one in intervals:
        different.setdefault(id(one.trajectory), one)
    for one in different.values():
        _require(one, checks.refusal(one.trajectory))


def require_runnable(cell: Cell, plan: CampaignPlan, checks: MotionChecks | None = None) -> None:
    """Refuse a plan that can never run on a cell, wherever its arm stands.

    Raises:
        MotionRefusedError: names the motion, what is wrong with it and what to do.
    """
    checks = checks or MotionChecks.of(cell)
    intervals = planned_intervals(cell, plan)
    require_allowed(intervals, checks)  # before ways are planned to where they lead
    StraightMoves(cell, checks).joining(intervals, cell.home)


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


def way(cell: Cell, start: Array, end: Array, speed: float | None = None) -> Interval:
    """The straight way between two postures (n,) [rad]; planned where a crash does not end us.

    Args:
        cell: its limits.
        start: where the arm stands.
        end: where it is to go.
        speed: fraction of the joints' speeds; the cell's `approach_speed` if left out.

    Raises:
        MotionRefusedError: one of them is outside the limits.
    """
    limits = cell.joint_limits
    if (problem := beyond(cell, start)) is not None:
        raise MotionRefusedError("the way", problem, "jog the arm to within [limits]")
    if (problem := beyond(cell, end, "would go to")) is not None:
        raise MotionRefusedError("the way", problem, "name a posture within [limits]")
    speed = cell.campaign.approach_speed if speed is None else speed
    move = Move(at_limit(end, limits), speed=speed)
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
    end, start = before.ends[1], after.ends[0]
    distance = np.abs(start - end)
    if np.max(distance) <= START_TOLERANCE:
        return None
    joint = int(np.argmax(distance))
    return (
        f"it begins with joint {joint + 1} at {start[joint]:.6g} rad, but {before} ends at "
        f"{end[joint]:.6g} rad"
    )
