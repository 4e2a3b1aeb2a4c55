"""Which shapes are too close by the way an arm is built, so that no motion could part them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from planner import JointLimits

Array = NDArray[np.float64]

# Shapes that are closer than the margin, and than this [m], in all postures tried are built that
# way; a wider margin must not check less.
NEAR: Final = 0.05
# A foot's distance from what it stands in changes by this [m] at most.
STILL: Final = 0.002
# A link that never keeps the margin keeps the farthest distance that was tried, less this [m].
SLACK: Final = 0.005
_N_POSTURES = 200
_SEED = 20140901
# Ranges below this [rad, m] count as ranges that nobody gave.
_NO_RANGE = 1e-6


class BuiltIn(NamedTuple):
    """Two shapes that are not checked against each other, because they are always too close.

    Attributes:
        first, second: the shapes' names (of a link: those that pinocchio gives them, the link's
            with a number), or an obstacle's.
        nearest, farthest: their distance in the postures tried [m], negative where they overlap.
    """

    first: str
    second: str
    nearest: float
    farthest: float

    def __str__(self) -> str:
        return f"{self.first} and {self.second} ({self.nearest:.3f} to {self.farthest:.3f} m)"


class Pairs(Protocol):
    """What is asked about pairs of shapes."""

    def joints_between(self, pair: int) -> int:
        """Count the joints between the two."""
        ...

    def with_obstacle(self, pair: int) -> bool:
        """Whether the second is an obstacle."""
        ...

    def lower_bounds(self, pair: int) -> Array:
        """Return lower bounds of the distance in the postures tried (k,) [m]."""
        ...

    def distances(self, pair: int) -> Array:
        """Return the distances in the postures tried (k,) [m]."""
        ...


def always_close(pairs: Pairs, pair: int, margin: float) -> tuple[float, float] | None:
    """Return nearest and farthest distance [m] of a pair that is built in, else None.

    Two links: two joints apart at most, and too close in every posture. An obstacle and a shape of
    the first link, which can but turn in it: too close at the same distance in every posture; one
    that comes nearer and goes farther is checked along the motion.
    """
    near = min(margin, NEAR)
    if pairs.joints_between(pair) > (1 if pairs.with_obstacle(pair) else 2):
        return None
    if not np.all(pairs.lower_bounds(pair) < near):
        return None
    distances = pairs.distances(pair)
    nearest, farthest = float(distances.min()), float(distances.max())
    if not farthest < near or (pairs.with_obstacle(pair) and not farthest - nearest <= STILL):
        return None
    return nearest, farthest


def never_clear(pairs: Pairs, pair: int, margin: float) -> tuple[float, float] | None:
    """Return nearest and farthest distance [m] of a link that never keeps the margin of a plane.

    It is one of the two links next to the mounting, such as an upper arm whose shoulder turns
    close above the floor; in some postures it does not touch.
    """
    near = min(margin, NEAR)
    if pairs.joints_between(pair) > 2 or not np.all(pairs.lower_bounds(pair) < near):
        return None
    distances = pairs.distances(pair)
    nearest, farthest = float(distances.min()), float(distances.max())
    return (nearest, farthest) if SLACK < farthest < near else None


def random_postures(model: pin.Model, limits: JointLimits | None) -> Array:
    """Return postures within limits, half a turn to either side where there are none (k, n).

    Args:
        model: the arm.
        limits: in use; None for those of the description, where none given means 0 to 0.
    """
    lower, upper = _described(model) if limits is None else (limits.lower, limits.upper)
    range_ = upper - lower
    # Written so that what is no number or infinite counts as no limit.
    limited = (range_ > _NO_RANGE) & (range_ < 2.0 * np.pi)
    lower, upper = np.where(limited, lower, -np.pi), np.where(limited, upper, np.pi)
    shares = np.random.default_rng(_SEED).random((_N_POSTURES, model.nv))
    postures: Array = lower + shares * (upper - lower)
    return postures


def exceptions(built_in: Sequence[BuiltIn], narrowed: Sequence[BuiltIn]) -> str | None:
    """Return the sentence that says what is not checked, or with less than the margin."""
    sentences = []
    if built_in:
        pairs = "; ".join(map(str, built_in))
        sentences.append(
            f"not checked for collisions, always too close by the way the arm is built: {pairs}"
        )
    if narrowed:
        pairs = "; ".join(map(str, narrowed))
        sentences.append(
            f"checked with the largest distance that the mounting leaves instead of the margin:"
            f" {pairs}"
        )
    return "; ".join(sentences) or None


def _described(model: pin.Model) -> tuple[Array, Array]:
    """Return the limits of a description, (n,) each; 0 for joints that turn without end."""
    lower, upper = np.zeros((2, model.nv))
    for joint in range(1, model.njoints):
        if model.joints[joint].nq == 1:  # one without end counts as two numbers in pinocchio
            index, limit = model.joints[joint].idx_v, model.joints[joint].idx_q
            lower[index] = model.lowerPositionLimit[limit]
            upper[index] = model.upperPositionLimit[limit]
    return lower, upper
