"""Motions, and the straight moves between them, checked before they are sent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from hil.archive.header import motion_name
from hil.base.arrays import Array
from hil.cell import AngleFrame, Cell
from hil.control.errors import MotionRefusedError
from hil.control.messages import refusal_words
from hil.control.motion_checks import MotionChecks
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
from planner.player import FLOAT32_RANGE_ROUNDING

MIN_MOVE: Final = 1e-6  # rad; a shorter move is left out
START_TOLERANCE: Final = 1e-3  # Largest distance of the arm from the start of a motion, rad
REPEATED: Final = ("excitation", "warmup")  # Kinds of motion that run the excitation


@dataclass(frozen=True, eq=False)
class CampaignMotion:
    """One motion of a campaign, or a move between two of them.

    Attributes:
        kind: "standstill", "excitation", "validation", "move", "dryrun" or "warmup".
        index: which of its kind, from 0.
        from_arm: whether it is a move from or to the first position of the arm.
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
        """First and last position, (n,) [rad] each."""
        start, end = self.trajectory.sample(np.array([0.0, self.trajectory.duration]))[0]
        return start, end

    def connects(self, start: Array, end: Array) -> bool:
        """Return whether it leads from `start` to `end` (n,) [rad]."""
        first, last = self.ends
        apart = max(np.max(np.abs(first - start)), np.max(np.abs(last - end)))
        return bool(apart <= MIN_MOVE)

    def endpoints(self, home: Array) -> tuple[Array, Array]:
        """Return the position of the arm before and after it (n,) [rad]: home, or its own ends."""
        at_own_ends = self.kind in (*REPEATED, "dryrun") or isinstance(
            self.trajectory, FourierSeries
        )
        return self.ends if at_own_ends else (home, home)


def at_limit(posture: Array, limits: JointLimits) -> Array:
    """Return a posture (n,) [rad], moved back to limits that are exceeded by rounding only."""
    within = np.clip(posture, limits.lower, limits.upper)
    rounding = 0.5 * FLOAT32_RANGE_ROUNDING * (limits.upper - limits.lower)
    return np.where(np.abs(posture - within) <= rounding, within, posture)


def limit_violation(cell: Cell, posture: Array, verb: str = "stands at") -> str | None:
    """Return which joint of a posture (n,) [rad] is outside its limits, in degrees, or None."""
    limits = cell.joint_limits
    frame = AngleFrame.of(cell)
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


class CheckedMoves:
    """Straight moves between postures, each planned and checked once."""

    def __init__(self, cell: Cell, checks: MotionChecks) -> None:
        self._cell = cell
        self._checks = checks
        self._known: list[CampaignMotion] = []

    def between(
        self, start: Array, end: Array, index: int, *, from_arm: bool = False
    ) -> CampaignMotion | None:
        """Return the checked motion between two postures; None if they are the same.

        Args:
            start: posture (n,) [rad].
            end: posture (n,) [rad].
            index: of the move.
            from_arm: whether it begins where the arm is.
        """
        if np.max(np.abs(end - start)) <= MIN_MOVE:
            return None
        motion = next((earlier for earlier in self._known if earlier.connects(start, end)), None)
        if motion is None:
            motion = replace(straight_move(self._cell, start, end), index=index, from_arm=from_arm)
            require_allowed([motion], self._checks)
            self._known.append(motion)
        return replace(motion, index=index)

    def with_moves(self, motions: Sequence[CampaignMotion], where: Array) -> list[CampaignMotion]:
        """Return these motions with the moves between them, from `where` (n,) [rad] and back.

        Raises:
            MotionRefusedError: a move failed its check, or a motion does not begin where one ends.
        """
        at = where
        home = self._cell.home
        joined = list[CampaignMotion]()

        def go(target: Array) -> None:
            nonlocal at
            index = sum(motion.kind == "move" for motion in joined)
            from_arm = at is where or target is where
            if (move := self.between(at, target, index, from_arm=from_arm)) is not None:
                joined.append(move)
            at = target

        for motion in motions:
            start, end = motion.endpoints(home)
            go(start)
            joined.append(motion)
            at = end
        go(home)
        go(where)
        for previous, after in pairwise(joined):
            _require_joined(previous, after)
        return joined


def require_allowed(motions: Sequence[CampaignMotion], checks: MotionChecks) -> None:
    """Check motions, each once; raise MotionRefusedError for one that must not be sent."""
    different: dict[int, CampaignMotion] = {}
    for motion in motions:
        different.setdefault(id(motion.trajectory), motion)
    for motion in different.values():
        if (refusal := checks.refusal(motion.trajectory)) is not None:
            raise _refused(motion, refusal_words(refusal, checks.frame))


def player_of(cell: Cell, trajectory: PiecewiseCubic | FourierSeries) -> TrajectoryPlayer:
    """Return a player of a motion within the bounds of a cell."""
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


def rest(position: Array, duration: float) -> PiecewiseCubic:
    """Return a rest at `position` (n,) [rad] of `duration` s."""
    return PiecewiseCubic(
        knots=tuple(np.array([0.0, duration]) for _ in position),
        coefficients=tuple(np.array([[q, 0.0, 0.0, 0.0]]) for q in position),
    )


def straight_move(
    cell: Cell, start: Array, end: Array, speed: float | None = None
) -> CampaignMotion:
    """Return the straight motion between two postures, planned in a child process.

    Args:
        cell: of the arm.
        start: posture (n,) [rad].
        end: posture (n,) [rad].
        speed: fraction of the joints' speeds, by default the cell's `approach_speed`.

    Raises:
        MotionRefusedError: a posture is outside the limits.
    """
    limits = cell.joint_limits
    for posture, verb, remedy in (
        (start, "stands at", "jog the arm to within [limits]"),
        (end, "would go to", "use a posture within [limits]"),
    ):
        if (problem := limit_violation(cell, posture, verb)) is not None:
            raise MotionRefusedError("the motion", problem, remedy)
    speed = cell.campaign.approach_speed if speed is None else speed
    move = Move(at_limit(end, limits), speed=speed)
    motion = in_child(plan_moves, at_limit(start, limits), (move,), limits)
    return CampaignMotion("move", 0, motion.trajectory, PlanFile.of(motion, cell.joint_names))


def _refused(motion: CampaignMotion, problem: str) -> MotionRefusedError:
    remedy = "design another motion"
    if motion.from_arm:
        remedy = "jog the arm to a posture from which the straight path to the motion is free"
    elif motion.kind == "standstill":
        remedy = "correct home_deg or standstill_s in [campaign], or [workspace], of the cell file"
    return MotionRefusedError(str(motion), problem, remedy)


def _require_joined(previous: CampaignMotion, after: CampaignMotion) -> None:
    """Require that a motion begins where the one before it ends (MotionRefusedError)."""
    end = previous.ends[1]
    start = after.ends[0]
    distance = np.abs(start - end)
    if np.max(distance) <= START_TOLERANCE:
        return
    joint = int(np.argmax(distance))
    problem = (
        f"it begins with joint {joint + 1} at {start[joint]:.6g} rad, but {previous} ends at "
        f"{end[joint]:.6g} rad"
    )
    raise _refused(after, problem)


def moves_to_dict(moves: PlanFile | None) -> dict[str, Any]:
    """Return the entry `moves` of data, a plan file without its motion; {} without moves."""
    return {} if moves is None else {"moves": replace(moves, trajectory=None).to_dict()}


def moves_from_dict(data: Mapping[str, Any]) -> PlanFile | None:
    """Return the entry `moves` of data, or None."""
    return PlanFile.from_dict(data["moves"]) if "moves" in data else None
