"""A plan as plain data: the moves that were asked for, and the motion that came of them.

`PlanFile.to_dict` is what an archive carries (JSON, SI units); `to_toml` is the same for people,
with angles in degrees, and restores the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from planner import plan_text
from planner.arrays import Array, read_only
from planner.commands import STOP, Fly, FlyDistance, FlyPercent, Move, Overrides
from planner.errors import InvalidPlanFile, PlannerError
from planner.limits import JointLimits
from planner.moves import MotionPlan, plan_moves
from planner.piecewise_cubic import PiecewiseCubic
from planner.verify import check_limits, check_smooth

FORMAT = "joint motion plan"
VERSION = 1
# Planned again on another machine a motion may differ in its last digits [rad, s]; no more.
_SAME = 1e-9
_COMPARED_AT = 1000
_LIMITS = ("lower", "upper", "velocity", "acceleration", "jerk")
_SHARES = ("joint_speed", "joint_acceleration", "joint_jerk")
_FLY = ("fly_percent", "fly_distance")
_MOVE = ("target", "speed", "acceleration", *_SHARES, *_FLY, "termination")
_OVERRIDES = ("speed", "acceleration", "deceleration", "joint")


@dataclass(frozen=True, eq=False)
class PlanFile:
    """What a file of a plan says.

    Attributes:
        joint_names: Names of the joints, in their order.
        start: Where the motion begins (n,) [rad].
        moves: What follows, in order; percentages of fly and shares of speed as they were asked.
        overrides: Those in force when it was planned.
        limits: Those it was planned for; a file written by hand may leave them out.
        trajectory: The motion itself, to the bit; a file written by hand has none.
    """

    joint_names: tuple[str, ...]
    start: Array
    moves: tuple[Move, ...]
    overrides: Overrides = field(default_factory=Overrides)
    limits: JointLimits | None = None
    trajectory: PiecewiseCubic | None = None

    def __post_init__(self) -> None:
        n = len(self.joint_names)
        sizes = [self.start.size, *(move.target.size for move in self.moves)]
        if self.limits is not None:
            sizes.append(self.limits.n_joints)
        if self.trajectory is not None:
            sizes.append(self.trajectory.n_joints)
        if n == 0 or any(size != n for size in sizes):
            raise InvalidPlanFile(f"{n} joints are named, but positions or limits are for {sizes}")

    @classmethod
    def of(cls, plan: MotionPlan, joint_names: Sequence[str]) -> PlanFile:
        """Return a plan as a file, with its limits and its motion."""
        return cls(
            joint_names=tuple(joint_names),
            start=plan.start,
            moves=plan.moves,
            overrides=plan.overrides,
            limits=plan.limits,
            trajectory=plan.trajectory,
        )

    def plan(self, limits: JointLimits | None = None) -> MotionPlan:
        """Return the plan: the stored motion if there is one, checked, else a new one.

        Args:
            limits: Plan for these instead, whatever limits and motion are stored.

        Raises:
            InvalidPlanFile: no limits anywhere, or a stored motion that breaks its limits or is
                not what its moves plan to.
            PlannerError: the moves cannot be planned.
        """
        own = limits is None
        limits = limits or self.limits
        if limits is None:
            raise InvalidPlanFile("the plan has no limits; name some to plan it for")
        planned = plan_moves(self.start, self.moves, limits, self.overrides)
        if not own or self.trajectory is None:
            return planned
        self._check_motion(self.trajectory, planned)
        return replace(planned, trajectory=self.trajectory)

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists in SI units; `from_dict` restores every bit, through JSON too."""
        data: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "joints": list(self.joint_names),
            "start": self.start.tolist(),
        }
        shares = {name: np.asarray(getattr(self.overrides, name)).tolist() for name in _OVERRIDES}
        if any(np.any(np.asarray(share) != 1.0) for share in shares.values()):
            data["overrides"] = shares
        if self.limits is not None:
            data["limits"] = {name: getattr(self.limits, name).tolist() for name in _LIMITS}
        data["moves"] = [_move_to_dict(move) for move in self.moves]
        if self.trajectory is not None:
            data["motion"] = self.trajectory.to_dict()
        return data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PlanFile:
        """Restore a file from `to_dict`.

        Raises:
            InvalidPlanFile: a field is missing, unknown, or not what it should be.
        """
        if data.get("format") != FORMAT:
            raise InvalidPlanFile(f"format is {data.get('format')!r}; expected {FORMAT!r}")
        if data.get("version") != VERSION:
            raise InvalidPlanFile(f"version is {data.get('version')!r}; this reads {VERSION}")
        try:
            _only(
                data,
                ("format", "version", "joints", "start", "overrides", "limits", "moves", "motion"),
            )
            limits, motion = data.get("limits"), data.get("motion")
            return cls(
                joint_names=tuple(str(name) for name in data["joints"]),
                start=_vector(data["start"]),
                moves=tuple(_move_from_dict(move) for move in data["moves"]),
                overrides=Overrides(**_only(data.get("overrides", {}), _OVERRIDES)),
                limits=None if limits is None else JointLimits(**_only(limits, _LIMITS)),
                trajectory=None if motion is None else PiecewiseCubic.from_dict(motion),
            )
        except InvalidPlanFile:
            raise
        except KeyError as error:
            raise InvalidPlanFile(f"{error.args[0]!r} is missing") from error
        except (PlannerError, TypeError, ValueError, AttributeError) as error:
            raise InvalidPlanFile(f"not a plan: {error}") from error

    def to_toml(self) -> str:
        """Return the file as text for people, angles in degrees."""
        return plan_text.to_toml(self.to_dict())

    @classmethod
    def from_toml(cls, text: str) -> PlanFile:
        """Read the text of a file, written by `to_toml` or by hand.

        Raises:
            InvalidPlanFile: the text is not TOML, or not a plan.
        """
        return cls.from_dict(plan_text.from_toml(text))

    def _check_motion(self, stored: PiecewiseCubic, planned: MotionPlan) -> None:
        try:
            check_limits(stored, planned.limits)
            check_smooth(stored, planned.limits)
        except PlannerError as error:
            raise InvalidPlanFile(f"the stored motion: {error}") from error
        again = planned.trajectory
        t = np.linspace(0.0, stored.duration, _COMPARED_AT)
        apart = float(np.max(np.abs(stored.sample(t)[0] - again.sample(t)[0])))
        if not (apart <= _SAME and abs(stored.duration - again.duration) <= _SAME):
            raise InvalidPlanFile(
                f"the stored motion of {stored.duration:.6f} s is not what the moves plan to "
                f"({again.duration:.6f} s, up to {apart:.3g} rad away): they were edited, or "
                "planned by another version; take the motion out to plan them anew"
            )


def _move_to_dict(move: Move) -> dict[str, Any]:
    data: dict[str, Any] = {"target": move.target.tolist()}
    match move.fly:
        case FlyPercent(percent):
            data["fly_percent"] = float(percent)
        case FlyDistance(distance):
            data["fly_distance"] = float(distance)
    data |= {"speed": float(move.speed), "acceleration": float(move.acceleration)}
    for name in _SHARES:
        shares = getattr(move, name)
        if shares is not None:
            data[name] = np.asarray(shares).tolist()
    if move.termination != "nosettle":
        data["termination"] = move.termination
    return data


def _move_from_dict(data: Mapping[str, Any]) -> Move:
    fields = {name: value for name, value in _only(data, _MOVE).items() if name not in _FLY}
    fields["target"] = _vector(data["target"])
    return Move(fly=_fly(data), **fields)


def _fly(data: Mapping[str, Any]) -> Fly:
    if "fly_percent" in data and "fly_distance" in data:
        raise InvalidPlanFile("a move flies by percentage or by distance, not both")
    if "fly_percent" in data:
        return FlyPercent(float(data["fly_percent"]))
    if "fly_distance" in data:
        return FlyDistance(float(data["fly_distance"]))
    return STOP


def _only(data: Mapping[str, Any], known: Sequence[str]) -> dict[str, Any]:
    for name in data:
        if name not in known:
            raise InvalidPlanFile(f"{name!r} is unknown; known are {', '.join(known)}")
    return dict(data)


def _vector(values: Any) -> Array:
    array = read_only(values)
    if array.ndim != 1 or not np.all(np.isfinite(array)):
        raise InvalidPlanFile(f"{values} is not one finite position per joint")
    return array
