"""What is asked of the interpolator: moves, how their ends are passed, and overrides."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite
from typing import Any, Final, Literal, TypeAlias, cast, get_args

import numpy as np
from numpy.typing import ArrayLike

from planner.arrays import Array, read_only
from planner.errors import InvalidSetting

Termination = Literal["fine", "coarse", "nosettle"]
"""How exactly the arm has to have arrived before a stop at the target counts as made.

It changes no set-point: the interpolated motion is at rest on the target in all three cases. It
is carried along for whoever executes the motion and decides how long to wait for the real arm.
"""


@dataclass(frozen=True)
class FlyPercent:
    """Fly by: the next move begins during the last `percent` of the deceleration (0..100).

    0 is a stop; at 100 the corner begins as soon as the deceleration does. The path is rounder
    at a higher speed.
    """

    percent: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.percent <= 100.0:
            raise InvalidSetting("fly percentage", self.percent, "a number from 0 to 100")

    @property
    def share(self) -> float:
        """Share of the deceleration that is overlapped, in [0, 1]."""
        return self.percent / 100.0


@dataclass(frozen=True)
class FlyDistance:
    """Fly by as widely as the path stays within `distance` [rad] of the target.

    The distance is Euclidean in joint space, between the target and the point of the path that
    is nearest to it.
    """

    distance: float

    def __post_init__(self) -> None:
        if not (isfinite(self.distance) and self.distance >= 0.0):
            raise InvalidSetting("fly distance", self.distance, "a finite number >= 0 rad")


@dataclass(frozen=True)
class Stop:
    """Come to rest on the target."""


Fly: TypeAlias = FlyPercent | FlyDistance | Stop
STOP: Final = Stop()


@dataclass(frozen=True, eq=False)
class Move:
    """One straight joint-space move to a target, all joints in phase.

    Shares multiply, with each other and with the overrides; what they limit is one joint's
    velocity, acceleration or jerk, and the joint that needs longest rules the others.

    Attributes:
        target: Where it leads (n,) [rad].
        speed: Share of all velocity limits, in (0, 1].
        acceleration: Share of all acceleration limits, in (0, 1], for both ramps.
        joint_speed: Share of each velocity limit (n,), or None for all.
        joint_acceleration: Share of each acceleration limit (n,), or None for all.
        fly: How the target is passed; the last target of a motion is always a stop.
        termination: See `Termination`.
        joint_jerk: Share of each jerk limit (n,), or None for all.

    Raises:
        InvalidSetting: a value is outside its range or of the wrong shape.
    """

    target: Array
    speed: float = 1.0
    acceleration: float = 1.0
    joint_speed: Array | None = None
    joint_acceleration: Array | None = None
    fly: Fly = STOP
    termination: Termination = "nosettle"
    joint_jerk: Array | None = None

    def __post_init__(self) -> None:
        target = _vector("target", self.target)
        object.__setattr__(self, "target", target)
        for name in ("speed", "acceleration"):
            object.__setattr__(self, name, checked_share(name, getattr(self, name)))
        for name in ("joint_speed", "joint_acceleration", "joint_jerk"):
            shares = getattr(self, name)
            if shares is not None:
                object.__setattr__(self, name, checked_shares(name, shares, target.size))
        if not isinstance(self.fly, FlyPercent | FlyDistance | Stop):
            raise InvalidSetting("fly", self.fly, "FlyPercent, FlyDistance or Stop")
        if self.termination not in get_args(Termination):
            raise InvalidSetting("termination", self.termination, "fine, coarse or nosettle")


@dataclass(frozen=True, eq=False)
class Overrides:
    """Overrides that change only their own quantity, so that a flown path may change with them.

    (The override that leaves the path unchanged acts while the motion is played.)

    Attributes:
        speed: Share of all velocity limits, in (0, 1].
        acceleration: Share of the acceleration limits while speeding up, in (0, 1].
        deceleration: Share of the acceleration limits while slowing down, in (0, 1].
        joint: Share of each joint's velocity limit, a number or (n,).

    Raises:
        InvalidSetting: a value is outside its range.
    """

    speed: float = 1.0
    acceleration: float = 1.0
    deceleration: float = 1.0
    joint: ArrayLike = field(default=1.0)

    def __post_init__(self) -> None:
        for name in ("speed", "acceleration", "deceleration"):
            value = checked_share(f"{name} override", getattr(self, name))
            object.__setattr__(self, name, value)
        joint = np.asarray(self.joint)
        size = joint.size if joint.ndim == 1 else 1
        object.__setattr__(self, "joint", checked_shares("joint override", self.joint, size))

    @property
    def joint_shares(self) -> Array:
        """The joints' shares as an array, () or (n,)."""
        return cast(Array, self.joint)


def checked_share(name: str, value: Any) -> float:
    """Return one share in (0, 1].

    Raises:
        InvalidSetting: it is none.
    """
    try:
        share = float(value)
    except (TypeError, ValueError):
        share = float("nan")
    if not 0.0 < share <= 1.0:
        raise InvalidSetting(name, value, "a share in (0, 1]")
    return share


def checked_shares(name: str, values: ArrayLike, n_joints: int) -> Array:
    """Return shares in (0, 1], () or (n,), read-only.

    Raises:
        InvalidSetting: a value is outside its range, or there are not as many as joints.
    """
    try:
        shares = read_only(values)
    except (TypeError, ValueError):
        shares = read_only(np.nan)
    if shares.shape not in ((), (n_joints,)) or not ((shares > 0.0) & (shares <= 1.0)).all():
        raise InvalidSetting(name, values, f"a share in (0, 1], one or {n_joints} of them")
    return shares


def _vector(name: str, values: ArrayLike) -> Array:
    try:
        vector = read_only(values)
    except (TypeError, ValueError):
        vector = read_only(np.nan)
    if vector.ndim != 1 or vector.size == 0:
        raise InvalidSetting(name, values, "one position per joint [rad]")
    return vector
