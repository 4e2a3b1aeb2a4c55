"""One move planned by itself, and the corner between two: all that a plan is made of.

Each function looks at two neighbours at most, so that a motion can also be planned while it
runs, one move after the other, and comes out the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from planner.arrays import Array
from planner.commands import Fly, FlyDistance, FlyPercent, Move, Overrides
from planner.corners import Corner, fly_by_all, fly_within
from planner.errors import InvalidSetting
from planner.limits import Allowance, Bounds, JointLimits
from planner.piecewise_cubic import PiecewiseCubic
from planner.segments import StraightSegment

# Segments keep this distance from the limits, so that the states at which corners cut them lie
# clear of where the corner's solver is known to fail; corners then use the full limits.
SEGMENT_VELOCITY: Final = 0.99
SEGMENT_ACCELERATION: Final = 0.98
SEGMENT_JERK: Final = 0.98


class Leg(NamedTuple):
    """A move planned from rest to rest.

    Attributes:
        segment: The straight motion.
        bounds: What the move may use, its deceleration apart.
        deceleration: What it may use while slowing down (n,) [rad/s²].
    """

    segment: StraightSegment
    bounds: Bounds
    deceleration: Array


class Shares(NamedTuple):
    """Bounds of one or more moves: worked out once, used for all moves alike."""

    bounds: Bounds
    deceleration: Array
    cautious: Bounds
    cautious_deceleration: Array


def shares_of(move: Move, limits: JointLimits, overrides: Overrides) -> Shares:
    """Return what a move may use of the limits.

    Raises:
        InvalidSetting: the move, or the overrides, are those of another number of joints.
    """
    n = limits.n_joints
    if move.target.size != n:
        raise InvalidSetting("target", move.target.tolist(), f"one position for each of {n} joints")
    if overrides.joint_shares.shape not in ((), (n,)):
        raise InvalidSetting("joint override", overrides.joint, f"one share, or {n} of them")
    velocity = limits.velocity * (move.speed * overrides.speed * overrides.joint_shares)
    rate = limits.acceleration * move.acceleration
    jerk = limits.jerk
    if move.joint_speed is not None:
        velocity = velocity * move.joint_speed
    if move.joint_acceleration is not None:
        rate = rate * move.joint_acceleration
    if move.joint_jerk is not None:
        jerk = jerk * move.joint_jerk
    acceleration = rate * overrides.acceleration
    deceleration = rate * overrides.deceleration
    return Shares(
        Allowance(limits.lower, limits.upper, velocity, acceleration, jerk),
        deceleration,
        Allowance(
            limits.lower,
            limits.upper,
            SEGMENT_VELOCITY * velocity,
            SEGMENT_ACCELERATION * acceleration,
            SEGMENT_JERK * jerk,
        ),
        SEGMENT_ACCELERATION * deceleration,
    )


def leg_with(start: Array, target: Array, shares: Shares) -> Leg:
    """Plan a move between two positions (n,) [rad] from what it may use."""
    segment = StraightSegment.between(start, target, shares.cautious, shares.cautious_deceleration)
    return Leg(segment, shares.bounds, shares.deceleration)


def leg(start: Array, move: Move, limits: JointLimits, overrides: Overrides) -> Leg:
    """Plan a move from `start` (n,) [rad] to its target, from rest to rest."""
    return leg_with(start, move.target, shares_of(move, limits, overrides))


def corner(before: Leg, after: Leg, fly: Fly) -> Corner:
    """Plan how the target of `before` is passed on the way to that of `after`."""
    return corners_between([before, after], [fly])[0]


def corners_between(legs: Sequence[Leg], flies: Sequence[Fly]) -> list[Corner]:
    """Plan how the target of each leg but the last is passed on the way to that of the next.

    Within a corner each joint may use what the more generous of the two moves grants: the
    deceleration of the one before or the acceleration of the one after.
    """
    pairs = list(pairwise(legs))
    segments = [(before.segment, after.segment) for before, after in pairs]
    bounds = [
        before.bounds
        if after.bounds is before.bounds and before.deceleration is before.bounds.acceleration
        else wider(before.bounds, after.bounds, before.deceleration)
        for before, after in pairs
    ]
    shares = [fly.share if isinstance(fly, FlyPercent) else 0.0 for fly in flies]
    corners = fly_by_all(segments, bounds, shares)
    for index, fly in enumerate(flies):
        if isinstance(fly, FlyDistance):
            corners[index] = fly_within(*segments[index], bounds[index], fly.distance)
    return corners


def wider(before: Bounds, after: Bounds, deceleration: Array) -> Bounds:
    """Return, joint by joint, the larger rates of a move that ends and one that begins."""
    return Allowance(
        before.lower,
        before.upper,
        np.maximum(before.velocity, after.velocity),
        np.maximum(deceleration, after.acceleration),
        np.maximum(before.jerk, after.jerk),
    )


def between(segment: StraightSegment, before: Corner, after: Corner) -> PiecewiseCubic:
    """Return what two corners leave of the segment that leads from one to the other."""
    # Two full fly-bys may use up a segment without cruise; nothing is left but rounding.
    start, stop = before.enter, segment.duration - after.leave
    return segment.pieces(start, max(start, stop))
