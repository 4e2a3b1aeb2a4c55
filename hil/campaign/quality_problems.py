"""Why a completed motion is rejected, as values; `quality_messages` words them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from identification.signals.position_steps import PositionJump

MAX_MISSED_SHARE: Final = 0.01
"""Largest share of missed packets."""


@dataclass(frozen=True)
class MissedPackets:
    """Packets that were missed, more than are allowed."""

    missed: int
    cycles: int  #: of the motion


@dataclass(frozen=True)
class StuckJoint:
    """A position that does not change while the joint is commanded to move."""

    joint: str
    start: float  #: after the motion begins [s]
    commanded: float  #: travel since [rad]


@dataclass(frozen=True)
class SaturatedCurrent:
    """A motor current at its limit."""

    joint: str
    duration: float  #: [s]


@dataclass(frozen=True)
class IncompleteArchive:
    """Cycles that are not in the archive."""

    archived: int
    cycles: int  #: of the motion


@dataclass(frozen=True)
class HeldOrSlowed:
    """Set-points that are not at their times."""

    time: float  #: since the motion began [s]


@dataclass(frozen=True)
class MovedAtRest:
    """A joint that moved while the arm was to stand still."""

    joint: str
    speed: float  #: [rad/s]
    allowed: float


@dataclass(frozen=True)
class OtherRepetition:
    """A repetition that differs from those before it."""

    quantity: Literal["position", "current"]
    joint: str
    repetitions: int  #: that it was compared with
    difference: float  #: rms, as a share of following-error threshold or rms current
    allowed: float


@dataclass(frozen=True)
class ColdStart:
    """A repetition that began with cold joints."""

    rest: float | None  #: how long the arm had rested [s]; None: unknown


@dataclass(frozen=True)
class Slipped:
    """A measured position that slipped."""

    jump: PositionJump


@dataclass(frozen=True)
class OthersAgree:
    """An accepted repetition from which later attempts differ, while they agree with each other."""

    attempts: tuple[str, ...]  #: archives; the next repetition agrees with them as well
    only_missed: bool  #: whether packets were missed in it, and in none of the others


QualityProblem = (
    MissedPackets
    | StuckJoint
    | SaturatedCurrent
    | IncompleteArchive
    | HeldOrSlowed
    | MovedAtRest
    | OtherRepetition
    | ColdStart
    | Slipped
    | OthersAgree
)


@dataclass(frozen=True)
class ReplacedRepetitions:
    """All accepted repetitions, which were rejected for later ones that agree."""

    archives: tuple[str, ...]
    later: int  #: repetitions that agree with each other
