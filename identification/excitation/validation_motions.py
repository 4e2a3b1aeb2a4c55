"""Random validation motions from home through random via points and back."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision import CollisionChecker
from identification.excitation.constraints import CurrentModel, check_motion, clearance
from identification.excitation.excitation import ViaPointMotion
from identification.excitation.genomes import straight_path
from identification.excitation.violation import NoFeasibleMotionError, Violation
from planner import (
    JointLimits,
    PlannerCrashed,
    PlanningError,
    PlanningTimedOut,
    plan_in_child,
)

Array = NDArray[np.float64]

_DRAWS_PER_POINT: Final = 50  # of one via point before the path is rejected
_TRIES_PER_MOTION: Final = 100
_VALIDATION: Final = 2  # first seed of a random stream that no search uses
_SPEED: Final = (0.5, 1.0)  # range of the speeds, fraction of the velocity limits
_RANGE_SHARE: Final = 0.98  # central fraction of each joint's range that via points lie in
_LONGEST: Final = 60.0  # s


def random_validation_motions(
    limits: JointLimits,
    *,
    home: Array,
    seed: int,
    count: int,
    n_via: int = 6,
    fly: float = 0.5,
    checker: CollisionChecker | None = None,
    currents: CurrentModel | None = None,
) -> tuple[ViaPointMotion, ...]:
    """Return random motions across the joint ranges to validate predictions on.

    They begin and end in `home` (n,) [rad], with `n_via` points between and corner rounding `fly`,
    and satisfy the same constraints as an excitation. Their random numbers are independent of those
    of any search. The same seed gives the same motions bit for bit, the first ones for any `count`.

    Raises:
        NoFeasibleMotionError: 100 attempts in a row without a feasible motion.
    """
    rejected = Counter[str]()
    nearest = dict[str, Violation]()

    def reject(violations: Sequence[Violation]) -> None:
        """Count a motion once per kind of constraint it breaks; update the smallest violations."""
        for kind in dict.fromkeys(violation.kind for violation in violations):
            rejected[kind] += 1
            worst = max((v for v in violations if v.kind == kind), key=lambda v: v.excess)
            nearest[kind] = min(nearest.get(kind, worst), worst, key=lambda v: v.excess)

    contact = None if checker is None else clearance(checker, home[None])
    if contact is not None:
        reject([replace(contact, subject=f"{contact.subject} at home")])
        raise NoFeasibleMotionError(rejected, nearest)
    half = (limits.upper - limits.lower) / 2.0 * _RANGE_SHARE
    middle = (limits.upper + limits.lower) / 2.0

    def next_point(random: np.random.Generator, before: Array, *, last: bool) -> Array | Violation:
        """Draw a point with a free path to it, or return a contact after too many draws."""
        draws = 0
        while True:
            point = random.uniform(middle - half, middle + half)
            path = straight_path(before, point)
            if last:
                path = np.concatenate((path, straight_path(point, home)))
            if checker is None or checker.clear(path).all():
                return point
            draws += 1
            blocked = clearance(checker, path) if draws >= _DRAWS_PER_POINT else None
            if blocked is not None:
                return blocked

    def draw(random: np.random.Generator) -> ViaPointMotion | Sequence[Violation]:
        """Return a feasible motion, or the violations of an infeasible one."""
        speed = random.uniform(*_SPEED, limits.n_joints)
        points = [home]
        while len(points) <= n_via:
            point = next_point(random, points[-1], last=len(points) == n_via)
            if isinstance(point, Violation):
                return [point]
            points.append(point)
        via_points = np.array([*points, home])
        try:
            # in a child, because the solver can crash its process
            trajectory = plan_in_child(via_points, limits, speed=speed, fly=fly)
        except (PlannerCrashed, PlanningError, PlanningTimedOut) as error:
            return [Violation("planning", f"the motion ({error})", 1.0, 0.0, None)]
        if trajectory.duration > _LONGEST:
            return [Violation("duration", "the motion", trajectory.duration, _LONGEST, None)]
        violations = check_motion(trajectory, limits, checker=checker, currents=currents)
        return violations or ViaPointMotion(via_points, speed, fly, trajectory)

    motions = []
    for k in range(count):
        for attempt in range(_TRIES_PER_MOTION):
            motion = draw(np.random.default_rng([_VALIDATION, seed, k, attempt]))
            if isinstance(motion, ViaPointMotion):
                motions.append(motion)
                break
            reject(motion)
        else:
            raise NoFeasibleMotionError(rejected, nearest)
    return tuple(motions)
