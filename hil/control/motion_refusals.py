"""Why a motion must not be sent, as values; `hil.control.messages` words them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from identification.excitation import Violation
from planner import NotSmooth

Rate = Literal["velocity", "acceleration", "jerk"]
Limit = Literal["current_limit", "following_error"]
MAX_MOTION_SECONDS: Final = 600.0
"""Longest motion, s: checks take time and memory in proportion, and a failed motion is repeated."""
MAX_SINES: Final = 20
"""Most sines per joint, as in a design."""


@dataclass(frozen=True)
class OtherJointCount:
    """A motion of another number of joints than the arm has."""

    motion: int
    arm: int


@dataclass(frozen=True)
class TooLong:
    """A motion longer than `MAX_MOTION_SECONDS`, or of no finite duration."""

    duration: float  #: [s]


@dataclass(frozen=True)
class NoRamp:
    """Sines that begin and end at full speed."""


@dataclass(frozen=True)
class TooManySines:
    """More sines for each joint than `MAX_SINES`."""

    count: int


@dataclass(frozen=True)
class NotFinite:
    """A rate that is not finite."""

    quantity: Rate
    joint: int  #: index


@dataclass(frozen=True)
class FixedDistance:
    """A pair of bodies that is too close in any posture."""

    first: str
    second: str
    nearest: float  #: distance over the sampled postures [m]
    farthest: float
    required: float


@dataclass(frozen=True)
class NarrowerLimit:
    """A motor whose current limit differs between controller and cell file [A]."""

    controller: float
    cell: float


@dataclass(frozen=True)
class LowerLimit:
    """A limit of the controller that is below the one of the cell file."""

    joint: str
    limit: Limit
    controller: float  #: [A], or motor revolutions of the following error
    cell: float


@dataclass(frozen=True)
class BrokenConstraint:
    """A violated constraint."""

    violation: Violation
    fixed: FixedDistance | None = None  #: its bodies, if no posture parts them
    narrower: NarrowerLimit | None = None  #: its motor's limit, if the controller's counts


MotionRefusal = (
    OtherJointCount | TooLong | NoRamp | TooManySines | NotFinite | NotSmooth | BrokenConstraint
)
