"""What thousands of random plans keep, and what flying by gains in time and costs in way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from planner import JointLimits
from planner.arrays import Array
from planner.limits import position_rounding
from planner.moves import FlyPercent, MotionPlan, Move, plan_moves

FLYS = (0.1, 0.25, 0.5, 0.75, 1.0)
# Of the method's first trial: T / T with stops, and mean passing distance [deg].
FACTS = ((0.99, 0.03), (0.96, 0.4), (0.93, 2.6), (0.915, 8.0), (0.90, 16.0))
# The ranges of that trial: half width and centre of each joint [deg].
_TRIAL = np.deg2rad([[180, 92, 78, 200, 125, 200], [0, 33, -87, 0, 0, 0]])


class NarrowRow(NamedTuple):
    """One line of the table: a fly, what it gains, how far it passes, how often it is less."""

    fly: float
    time_ratio: float
    passing_deg: float
    corners: int
    reduced: int
    stopped: int


def random_points(limits: JointLimits, random: np.random.Generator, count: int) -> Array:
    """Return via points (count, n) anywhere within the limits [rad]."""
    return random.uniform(limits.lower, limits.upper, (count, limits.n_joints))


def limit_ratios(
    limits: JointLimits, plans: int, random: np.random.Generator
) -> dict[str, float | int]:
    """Return how far random motions go, 1 being the limit, and how their corners are passed.

    A fifth each: anywhere; on the ends of the ranges; near one another; one joint at a time; and
    out and back. Flies, and the joints' shares of speed, are random as well.
    """
    worst = np.zeros(4)
    corners = reduced = stopped = 0
    for index in range(plans):
        points = _points(limits, random, index % 5)
        speed = (
            random.uniform(0.05, 1.0, limits.n_joints) if index % 2 else np.ones(limits.n_joints)
        )
        planned = _planned(points, limits, float(random.uniform(0.01, 1.0)), speed)
        worst = np.maximum(worst, _reach(planned, limits.scaled(velocity=speed)))
        corners += len(planned.corners)
        reduced += planned.reduced_corners
        stopped += planned.stopped_corners
    return {
        "plans": plans,
        "worst_limit_ratio": float(worst.max()),
        **{
            f"worst_{name}_ratio": float(value)
            for name, value in zip(
                ("position", "velocity", "acceleration", "jerk"), worst, strict=True
            )
        },
        "corners": corners,
        "corners_reduced": reduced,
        "corners_stopped": stopped,
    }


def fly_table(limits: JointLimits, sets: int) -> list[NarrowRow]:
    """Return the table for random sets of 6 via points within the ranges of the first trial."""
    half, centre = _TRIAL
    narrow = replace(limits, lower=centre - half, upper=centre + half)
    random = np.random.default_rng(0)
    points = [random_points(narrow, random, 6) for _ in range(sets)]
    return [_row(narrow, points, fly) for fly in FLYS]


def _row(limits: JointLimits, sets: Sequence[Array], fly: float) -> NarrowRow:
    ones = np.ones(limits.n_joints)
    plans = [_planned(points, limits, fly, ones) for points in sets]
    stops = sum(planned.duration_with_stops for planned in plans)
    passing = [target.distance for planned in plans for target in planned.targets[:-1]]
    return NarrowRow(
        fly,
        sum(planned.duration for planned in plans) / stops,
        float(np.rad2deg(np.mean(passing))),
        sum(len(planned.corners) for planned in plans),
        sum(planned.reduced_corners for planned in plans),
        sum(planned.stopped_corners for planned in plans),
    )


def _planned(points: Array, limits: JointLimits, fly: float, speed: Array) -> MotionPlan:
    moves = [Move(point, joint_speed=speed, fly=FlyPercent(100.0 * fly)) for point in points[1:]]
    return plan_moves(points[0], moves, limits)


def _points(limits: JointLimits, random: np.random.Generator, kind: int) -> Array:
    points = random_points(limits, random, 6)
    if kind == 1:
        points = np.where(points > (limits.lower + limits.upper) / 2.0, limits.upper, limits.lower)
    elif kind == 2:
        points = points[0] + 10.0 ** random.uniform(-6.0, -1.0) * (points - points[0])
    elif kind == 3:
        for before, point in pairwise(points):
            resting = np.arange(limits.n_joints) != random.integers(limits.n_joints)
            point[resting] = before[resting]
    elif kind == 4:
        points[2::2] = points[0]
    return points


def _reach(planned: MotionPlan, limits: JointLimits) -> Array:
    """Return how far position, velocity, acceleration and jerk go, 1 being the limit."""
    extrema = planned.trajectory.extrema()
    half = (limits.upper - limits.lower) / 2.0
    beyond = np.maximum(extrema.upper - limits.upper, limits.lower - extrema.lower)
    beyond = beyond - position_rounding(limits)  # which is not reaching further
    rates = (
        extrema.velocity / limits.velocity,
        extrema.acceleration / limits.acceleration,
        extrema.jerk / limits.jerk,
    )
    return np.array([ratio.max() for ratio in (1.0 + beyond / half, *rates)])
