"""Purposes of a model, each with its figure and limit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

PurposeName = Literal["gravity", "feed-forward", "contact", "payload", "simulation", "parameters"]
PURPOSES: Final[tuple[PurposeName, ...]] = get_args(PurposeName)

NoFigure = Literal[
    "",
    "nothing held out",
    "too short",
    "undetermined",
    "no gravity",
    "no dry friction",
    "not possible",
]
"""Why a purpose has no figure, or no limit that it can be held against."""


@dataclass(frozen=True)
class PurposeLimits:
    """What a user requires; None is reported and not judged."""

    contact: float | None = None  #: force at the flange that must be noticed [N]
    payload: float | None = None  #: mass at the flange that must be noticed [kg]
    #: error of the flange after `identification.purposes.simulation_error.HORIZON_SECONDS` [m]
    distance: float = 5e-3
    feed_forward: float = 0.2  #: share of the torque that may be left for feedback


NOTHING_REQUIRED: Final = PurposeLimits()


@dataclass(frozen=True)
class Purpose:
    """One purpose: its figure, the limit, and whether the model is good for it."""

    name: PurposeName
    good: bool | None  #: None: no limit is stated, or the figure is not known
    #: gravity: largest error over dry friction; feed-forward: share of the torque that is left;
    #: contact: force [N]; payload: mass [kg]; simulation: distance [m]; parameters: their number.
    #: Infinite where nothing is small enough; None where it could not be computed
    figure: float | None
    limit: float | None = None  #: that the figure is held against; None: none is stated
    unit: str = "1"
    joints: tuple[float, ...] = ()  #: torque of each joint (n,) [N·m or N]
    joint_limits: tuple[float, ...] = ()  #: what it is held against (n,)
    #: figures to compare with, by name
    references: Mapping[str, float] = field(default_factory=dict)
    missing: NoFigure = ""  #: why there is no figure or no judgement

    @classmethod
    def unknown(cls, name: PurposeName, missing: NoFigure, unit: str = "1") -> Purpose:
        """Return a purpose that could not be examined."""
        return cls(name, None, None, unit=unit, missing=missing)


def good_for(purposes: Sequence[Purpose], asked: Sequence[PurposeName]) -> bool:
    """Return whether a model is good for every requested purpose."""
    judged = {purpose.name: purpose.good for purpose in purposes}
    return all(judged.get(name) is True for name in asked)
