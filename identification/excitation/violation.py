"""Violated constraints of a motion: where and by how much."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from identification.arrays import Array

Kind = Literal["planning", "joint limit", "duration", "collision", "torque", "current"]

KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
"""Kinds of constraints; "planning": the motion could not be planned."""


@dataclass(frozen=True)
class JointQuantity:
    """A position or rate of a joint that exceeds a limit."""

    quantity: str  #: position, velocity, acceleration or jerk, as of `planner.JointLimits`
    joint: int  #: index
    end: Literal["start", "end"] | None = None  #: of the motion, which must be at rest there


@dataclass(frozen=True)
class LoadedDrive:
    """A joint by its torque, or its motor by its current."""

    joint: int  #: index
    name: str  #: of the joint
    is_motor: bool


@dataclass(frozen=True)
class CloseBodies:
    """Two bodies that are too close to each other."""

    first: str
    second: str
    at_home: bool = False  #: before any motion


@dataclass(frozen=True)
class WholeMotion:
    """The motion as a whole: its duration, or that it could not be planned."""

    problem: str = ""  #: why it could not be planned


@dataclass(frozen=True)
class UsableShare:
    """A motion may use a share of a motor's current limit only."""

    share: float  #: 0 to 1


Remedy = Literal["set a ramp", "rest at both ends"] | UsableShare
"""What to do about a violation, or which bound applies."""

Subject = JointQuantity | LoadedDrive | CloseBodies | WholeMotion


@dataclass(frozen=True)
class Violation:
    """A violated constraint of a motion at its worst instant."""

    kind: Kind  #: of the constraint
    subject: Subject
    value: float  #: reached value (a distance for a collision), SI
    bound: float  #: largest allowed value (smallest for a collision or a short motion), SI
    time: float | None  #: of the worst instant [s], if there is one
    posture: tuple[float, ...] = ()  #: joint positions there [rad]; empty if irrelevant
    scale: float | None = None  #: deviation from the bound that means an excess of 1; None: bound
    remedy: Remedy | None = None  #: None if unknown

    @property
    def excess(self) -> float:
        """Deviation from the bound (> 0) relative to the scale, comparable between kinds.

        The scale is the limit of rates, torques, currents and durations, the joint's range for
        positions, the arm's length for collisions, 1 if zero. Infinite if not finite.
        """
        scale = abs(self.bound) if self.scale is None else self.scale
        excess = abs(self.value - self.bound) / (scale or 1.0)
        return excess if np.isfinite(excess) else np.inf


def excess_by_kind(violations: Iterable[Violation]) -> Array:
    """Return the largest excess by kind of constraint, (len(KINDS),); 0 if satisfied."""
    excess = np.zeros(len(KINDS))
    for violation in violations:
        kind = KINDS.index(violation.kind)
        excess[kind] = max(excess[kind], violation.excess)
    return excess
