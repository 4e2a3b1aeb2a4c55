"""A plan as data: the moves that were asked for, and the motion that came of them.

`PlanFile.to_dict` is what an archive carries (JSON, SI units); `to_toml` is the same for people,
with angles in degrees, and restores the same bits. `to_csv` is the motion alone, for others.
"""

from __future__ import annotations

import csv
import io
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Any, Final

import numpy as np

from planner.arrays import Array
from planner.checked_data import DAMAGED, number, numbers, one_or_more, rows, table, text
from planner.commands import STOP, Fly, FlyDistance, FlyPercent, Move, Overrides
from planner.errors import InvalidPlanFile, InvalidSetting, PlannerError
from planner.limits import JointLimits
from planner.moves import MotionPlan, plan_moves
from planner.piecewise_cubic import PiecewiseCubic, Trajectory
from planner.toml_text import Angles, Rows, from_text, to_text
from planner.verify import check_limits, check_smooth

_HEAD = """\
A motion of joint moves. Names that end in _deg hold degrees, degrees/s, degrees/s^2,
degrees/s^3; shares of speed and acceleration lie in (0, 1]; a move without fly_percent
(0 to 100) or fly_distance_deg stops at its target."""
_MOTION = """\
What the moves above were planned to, to the last bit: per joint the times of its knots [s] and
position, velocity, acceleration, jerk at each (rad, s). After a change above, delete this table."""
_ANGLES: Mapping[str, frozenset[str]] = {
    "": frozenset({"start"}),
    "limits": frozenset({"lower", "upper", "velocity", "acceleration", "jerk"}),
    "moves": frozenset({"target", "fly_distance"}),
}
"""Which fields of each table are angles or their rates."""


def to_toml(data: Mapping[str, Any]) -> str:
    """Return the data of a plan file as TOML."""
    marked = _with_angles("", data)
    if "limits" in data:
        marked["limits"] = _with_angles("limits", data["limits"])
    marked["moves"] = [_with_angles("moves", move) for move in data["moves"]]
    if "motion" in data:
        lists = {name: Rows(data["motion"][name]) for name in ("knots", "coefficients")}
        marked["motion"] = {**data["motion"], **lists}
    return to_text(marked, {"": _HEAD, "motion": _MOTION})


def _with_angles(table: str, fields: Mapping[str, Any]) -> dict[str, Any]:
    angles = _ANGLES[table]
    return {name: Angles(value) if name in angles else value for name, value in fields.items()}


def from_toml(text: str) -> dict[str, Any]:
    """Return the data of a plan file, in SI units, from TOML.

    Raises:
        InvalidPlanFile: the text is not TOML, or an angle is not a number.
    """
    try:
        return from_text(text, _ANGLES)
    except tomllib.TOMLDecodeError as error:
        raise InvalidPlanFile(f"not TOML: {error}") from error
    except DAMAGED as error:
        raise InvalidPlanFile(f"not a plan: {error!r:.200}") from error


FORMAT = "joint motion plan"
VERSION = 1
# Planned again on another machine a motion may differ in its last digits [rad, s], and in its
# rates by as small a share of their limits; no more, at any instant.
_SAME = 1e-9
_SAME_RATES = 1e-6
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
        if len(set(self.joint_names)) < n:
            raise InvalidPlanFile(f"a joint is named twice in {', '.join(self.joint_names)}")
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
        """Return lists in SI units; `from_dict` restores every bit, through JSON too."""
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
        try:
            return _from_dict(cls, table(data))
        except InvalidPlanFile:
            raise
        except KeyError as error:
            raise InvalidPlanFile(f"{error.args[0]!r} is missing") from error
        except (PlannerError, *DAMAGED) as error:
            raise InvalidPlanFile(f"not a plan: {error}") from error

    def to_toml(self) -> str:
        """Return the file as text for people, angles in degrees."""
        return to_toml(self.to_dict())

    @classmethod
    def from_toml(cls, text: str) -> PlanFile:
        """Read the text of a file, written by `to_toml` or by hand.

        Raises:
            InvalidPlanFile: the text is not TOML, or not a plan.
        """
        return cls.from_dict(from_toml(text))

    def _check_motion(self, stored: PiecewiseCubic, planned: MotionPlan) -> None:
        try:
            check_limits(stored, planned.limits)
            check_smooth(stored, planned.limits)
        except PlannerError as error:
            raise InvalidPlanFile(f"the stored motion: {error}") from error
        again, limits = planned.trajectory, planned.limits
        extrema = _apart(stored, again).extrema()
        apart = float(max(np.max(-extrema.lower), np.max(extrema.upper)))
        rates = max(
            float(np.max(extrema.velocity / limits.velocity)),
            float(np.max(extrema.acceleration / limits.acceleration)),
        )
        late = abs(stored.duration - again.duration)
        if not (apart <= _SAME and late <= _SAME and rates <= _SAME_RATES):
            raise InvalidPlanFile(
                f"the stored motion of {stored.duration:.6f} s is not what the moves plan to "
                f"({again.duration:.6f} s, up to {apart:.3g} rad away): they were edited, or "
                "planned by another version; take the motion out to plan them anew"
            )


def _from_dict(cls: type[PlanFile], data: Mapping[str, Any]) -> PlanFile:
    if data.get("format") != FORMAT:
        raise InvalidPlanFile(f"format is {data.get('format')!r:.80}; expected {FORMAT!r}")
    version = data.get("version")
    if type(version) is not int or version != VERSION:
        raise InvalidPlanFile(f"version is {version!r:.80}; this reads {VERSION}")
    _only(data, ("format", "version", "joints", "start", "overrides", "limits", "moves", "motion"))
    overrides = _only(table(data.get("overrides", {})), _OVERRIDES)
    joint = one_or_more(overrides.pop("joint", 1.0))
    limits, motion = data.get("limits"), data.get("motion")
    return cls(
        joint_names=tuple(text(name) for name in rows(data["joints"])),
        start=_vector(data["start"]),
        moves=tuple(_move_from_dict(table(move)) for move in rows(data["moves"])),
        overrides=Overrides(**{k: number(v) for k, v in overrides.items()}, joint=joint),
        limits=None if limits is None else _limits_from_dict(table(limits)),
        trajectory=None if motion is None else PiecewiseCubic.from_dict(table(motion)),
    )


def _limits_from_dict(data: Mapping[str, Any]) -> JointLimits:
    known = _only(data, _LIMITS)
    return JointLimits(**{name: numbers(known[name], 1) for name in _LIMITS})


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
    fields: dict[str, Any] = {}
    for name, value in _only(data, _MOVE).items():
        if name == "target":
            fields[name] = _vector(value)
        elif name == "termination":
            fields[name] = text(value)
        elif name in _SHARES:
            fields[name] = one_or_more(value)
        elif name not in _FLY:
            fields[name] = number(value)
    if "target" not in fields:
        raise InvalidPlanFile("'target' is missing")
    return Move(fly=_fly(data), **fields)


def _fly(data: Mapping[str, Any]) -> Fly:
    if "fly_percent" in data and "fly_distance" in data:
        raise InvalidPlanFile("a move flies by percentage or by distance, not both")
    if "fly_percent" in data:
        return FlyPercent(number(data["fly_percent"]))
    if "fly_distance" in data:
        return FlyDistance(number(data["fly_distance"]))
    return STOP


def _only(data: Mapping[str, Any], known: Sequence[str]) -> dict[str, Any]:
    for name in data:
        if name not in known:
            raise InvalidPlanFile(f"{name!r} is unknown; known are {', '.join(known)}")
    return dict(data)


def _vector(values: Any) -> Array:
    try:
        array = numbers(values, 1)
    except (TypeError, OverflowError) as error:
        reason = f"{values!r:.80} is not one finite position per joint: {error}"
        raise InvalidPlanFile(reason) from error
    if not np.all(np.isfinite(array)):
        raise InvalidPlanFile(f"{values!r:.80} is not one finite position per joint")
    return array


def _apart(one: PiecewiseCubic, other: PiecewiseCubic) -> PiecewiseCubic:
    """Return the difference of two motions: between the knots of both it is cubic as well.

    The longer one is compared up to where the other ends.
    """
    end = min(one.duration, other.duration)
    knots, coefficients = [], []
    for joint in range(one.n_joints):
        times = np.union1d(one.knots[joint], other.knots[joint])
        times = np.unique(np.minimum(times, end))
        times = times if len(times) > 1 else np.zeros(2)
        ours, theirs = (_pieces_from(motion, joint, times[:-1]) for motion in (one, other))
        knots.append(times)
        coefficients.append(ours - theirs)
    return PiecewiseCubic(tuple(knots), tuple(coefficients))


def _pieces_from(motion: PiecewiseCubic, joint: int, times: Array) -> Array:
    """Return what goes on from times (m,) [s], coefficients (m, 4), of one joint."""
    knots = motion.knots[joint]
    piece = np.searchsorted(knots[1:-1], times, side="right")
    p, v, a, j = motion.coefficients[joint][piece].T
    x = times - knots[piece]
    return np.stack(
        (p + x * (v + x * (a / 2.0 + x * j / 6.0)), v + x * (a + x * j / 2.0), a + x * j, j), axis=1
    )


_QUANTITIES: Final = ("position [rad]", "velocity [rad/s]", "acceleration [rad/s^2]")
# A last period this much shorter than the others is rounding, not motion.
_LAST_PERIOD: Final = 1e-9
# More rows a second than any controller has cycles.
_HIGHEST_RATE: Final = 1e5


def to_csv(trajectory: Trajectory, rate: float, joint_names: Sequence[str]) -> str:
    """Return a motion as comma-separated values, `rate` rows a second [Hz] and one for its end.

    The first row names the columns: ``time [s]``, then for each joint ``NAME.position [rad]``,
    ``NAME.velocity [rad/s]`` and ``NAME.acceleration [rad/s^2]``. Every bit of a number is written.

    Raises:
        InvalidSetting: a rate not above 0 or above 100 kHz, not one name per joint, each another,
            or a motion of no duration, which no rows can tell.
    """
    if not 0.0 < rate <= _HIGHEST_RATE:
        raise InvalidSetting("rate", rate, f"above 0 Hz, at most {_HIGHEST_RATE:g} Hz")
    if trajectory.duration <= 0.0:
        raise InvalidSetting("duration", trajectory.duration, "a motion of more than 0 s")
    if len({*joint_names}) != trajectory.n_joints or len(joint_names) != trajectory.n_joints:
        raise InvalidSetting(
            "joint_names", list(joint_names), f"{trajectory.n_joints} different names"
        )
    steps = max(1, ceil(trajectory.duration * rate - _LAST_PERIOD))
    time = np.minimum(np.arange(steps + 1) / rate, trajectory.duration)
    time[-1] = trajectory.duration
    columns = np.stack(trajectory.sample(time), axis=2).reshape(len(time), -1)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [
            "time [s]",
            *(f"{name}.{quantity}" for name in joint_names for quantity in _QUANTITIES),
        ]
    )
    writer.writerows(np.column_stack((time, columns)).tolist())
    return text.getvalue()
