"""Plan files: moves and the motion planned through them, as JSON (SI units) and CSV.

The JSON of `PlanFile.to_dict` is part of archives. `to_csv` writes the motion alone.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from planner.arrays import DAMAGED_DATA_ERRORS, Array, read_only
from planner.errors import InvalidPlanFile, InvalidSetting, PlannerError
from planner.limits import JointLimits
from planner.moves import (
    MotionPlan,
    Move,
    Overrides,
    plan_moves,
)
from planner.piecewise_cubic import PiecewiseCubic, Trajectory, check_limits, check_smooth

FORMAT: Final = "joint motion plan"
VERSION: Final = 1
PLAN_TOLERANCE: Final = 1e-9
"""Between a stored motion and the same one planned on another machine, of positions [rad] and
duration [s]."""
_RATE_TOLERANCE: Final = 1e-6  # likewise, of rates as a share of their limits


class _Data(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, defer_build=True)


class _MoveData(_Data):
    target: list[float]
    fly_percent: float = 0.0
    speed: float = 1.0
    acceleration: float = 1.0
    joint_speed: float | list[float] | None = None
    joint_acceleration: float | list[float] | None = None
    joint_jerk: float | list[float] | None = None

    @classmethod
    def of(cls, move: Move) -> _MoveData:
        given = {name: value for name, value in vars(move).items() if value is not None}
        return cls(**{name: np.asarray(value).tolist() for name, value in given.items()})

    def move(self) -> Move:
        return Move(**self.model_dump(exclude_none=True))


class _LimitsData(_Data):
    lower: list[float]
    upper: list[float]
    velocity: list[float]
    acceleration: list[float]
    jerk: list[float]


_Override = Literal["speed", "acceleration", "deceleration", "joint"]


class _FileData(_Data):
    format: Literal["joint motion plan"]
    version: Annotated[int, Field(ge=VERSION, le=VERSION)]
    joints: list[str]
    start: list[float]
    overrides: dict[_Override, float | list[float]] = {}
    limits: _LimitsData | None = None
    moves: list[_MoveData]
    motion: dict[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class PlanFile:
    """Content of a plan file; `limits` and `trajectory` may be None in files written by hand."""

    joint_names: tuple[str, ...]
    start: Array
    moves: tuple[Move, ...]
    overrides: Overrides = field(default_factory=Overrides)
    limits: JointLimits | None = None
    trajectory: PiecewiseCubic | None = None

    def __post_init__(self) -> None:
        n = len(self.joint_names)
        sizes = [self.start.size, *(move.target.size for move in self.moves)]
        sizes += [part.n_joints for part in (self.limits, self.trajectory) if part is not None]
        if len(set(self.joint_names)) < n:
            raise InvalidPlanFile(f"a joint is named twice in {', '.join(self.joint_names)}")
        if n == 0 or any(size != n for size in sizes):
            raise InvalidPlanFile(f"{n} joints are named; positions and limits have {sizes}")
        if not all(np.all(np.isfinite(q)) for q in (self.start, *(m.target for m in self.moves))):
            raise InvalidPlanFile("start and targets must be finite positions")

    @classmethod
    def of(cls, plan: MotionPlan, joint_names: Sequence[str]) -> PlanFile:
        """Return the file of a plan, with limits and motion."""
        return cls(
            joint_names=tuple(joint_names),
            start=plan.start,
            moves=plan.moves,
            overrides=plan.overrides,
            limits=plan.limits,
            trajectory=plan.trajectory,
        )

    def plan(self, limits: JointLimits | None = None) -> MotionPlan:
        """Return the plan with the checked stored motion; for given `limits` a new one.

        Raises:
            InvalidPlanFile: no limits are given or stored, or the stored motion breaks its limits
                or does not match its moves.
            PlannerError: the moves cannot be planned.
        """
        use_stored = limits is None
        limits = limits or self.limits
        if limits is None:
            raise InvalidPlanFile("the plan has no limits; give the limits to plan it for")
        planned = plan_moves(self.start, self.moves, limits, self.overrides)
        if not use_stored or self.trajectory is None:
            return planned
        _check_motion(self.trajectory, planned)
        return replace(planned, trajectory=self.trajectory)

    def to_dict(self) -> dict[str, Any]:
        """Return lists in SI units, from which `from_dict` restores the same bits."""
        overrides = {
            name: np.asarray(share).tolist() for name, share in vars(self.overrides).items()
        }
        data: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "joints": list(self.joint_names),
            "start": self.start.tolist(),
        }
        if any(np.any(np.asarray(share) != 1.0) for share in overrides.values()):
            data["overrides"] = overrides
        if self.limits is not None:
            data["limits"] = {name: bound.tolist() for name, bound in vars(self.limits).items()}
        data["moves"] = [_MoveData.of(move).model_dump(exclude_none=True) for move in self.moves]
        if self.trajectory is not None:
            data["motion"] = self.trajectory.to_dict()
        return data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PlanFile:
        """Restore a file from `to_dict`.

        Raises:
            InvalidPlanFile: a field is missing, unknown or invalid.
        """
        try:
            read = _FileData.model_validate(data)
            limits = read.limits
            return cls(
                joint_names=tuple(read.joints),
                start=read_only(read.start),
                moves=tuple(move.move() for move in read.moves),
                overrides=Overrides(**read.overrides),  # type: ignore[arg-type]
                limits=None if limits is None else JointLimits(**limits.model_dump()),
                trajectory=None if read.motion is None else PiecewiseCubic.from_dict(read.motion),
            )
        except InvalidPlanFile:
            raise
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            field = ".".join(map(str, first["loc"])) or "top level"
            raise InvalidPlanFile(f"not a plan: {field}: {first['msg']}") from error
        except (PlannerError, *DAMAGED_DATA_ERRORS) as error:
            raise InvalidPlanFile(f"not a plan: {error}") from error


def _check_motion(stored: PiecewiseCubic, planned: MotionPlan) -> None:
    other = planned.trajectory
    limits = planned.limits
    try:
        check_limits(stored, limits)
        check_smooth(stored, limits)
    except PlannerError as error:
        raise InvalidPlanFile(f"the stored motion: {error}") from error
    end = min(stored.duration, other.duration)
    knots = np.unique(np.minimum(np.concatenate((*stored.knots, *other.knots)), end))
    apart, fast, steep = (
        np.abs(stored_rows - other_rows).max(axis=0)
        for stored_rows, other_rows in zip(stored.sample(knots), other.sample(knots), strict=True)
    )
    apart = float(apart.max())
    rates = float(max(np.max(fast / limits.velocity), np.max(steep / limits.acceleration)))
    late = abs(stored.duration - other.duration)
    if not (apart <= PLAN_TOLERANCE and late <= PLAN_TOLERANCE and rates <= _RATE_TOLERANCE):
        raise InvalidPlanFile(
            f"the stored motion of {stored.duration:.6f} s differs from the one planned through "
            f"the moves ({other.duration:.6f} s) by up to {apart:.3g} rad: the moves were edited, "
            "or planned by another version; delete the motion to plan again"
        )


_QUANTITIES: Final = ("position [rad]", "velocity [rad/s]", "acceleration [rad/s^2]")
# Shortest last period, as a share of the others.
_MIN_LAST_PERIOD: Final = 1e-9
_MAX_RATE: Final = 1e5  # Hz


def to_csv(trajectory: Trajectory, rate: float, joint_names: Sequence[str]) -> str:
    """Return a motion as comma-separated values with `rate` rows per second [Hz] and its end.

    The columns are ``time [s]``, then for each joint ``NAME.position [rad]``,
    ``NAME.velocity [rad/s]`` and ``NAME.acceleration [rad/s^2]``. Numbers are exact.

    Raises:
        InvalidSetting: a rate outside (0, 100 kHz], or a motion of zero duration.
    """
    if not 0.0 < rate <= _MAX_RATE:
        raise InvalidSetting("rate", rate, f"above 0 Hz, at most {_MAX_RATE:g} Hz")
    if trajectory.duration <= 0.0:
        raise InvalidSetting("duration", trajectory.duration, "a motion of more than 0 s")
    steps = max(1, ceil(trajectory.duration * rate - _MIN_LAST_PERIOD))
    time = np.minimum(np.arange(steps + 1) / rate, trajectory.duration)
    time[-1] = trajectory.duration
    columns = np.stack(trajectory.sample(time), axis=2).reshape(len(time), -1)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heads = (f"{name}.{quantity}" for name in joint_names for quantity in _QUANTITIES)
    writer.writerow(["time [s]", *heads])
    writer.writerows(np.column_stack((time, columns)).tolist())
    return text.getvalue()
