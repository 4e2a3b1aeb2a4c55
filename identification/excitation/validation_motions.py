"""Random motions to validate on: wide ones, which the parameters are never fitted to.

A motion leads from a home posture through random via points back to it, as the robot's own
interpolator runs it, and keeps all constraints.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision.checker import CollisionChecker
from identification.excitation.constraints import (
    CurrentModel,
    check_motion,
    clearance,
)
from identification.excitation.excitation import DrawnMotion
from identification.excitation.genomes import straight_way
from identification.excitation.violation import NoFeasibleMotionError, Violation
from planner import (
    JointLimits,
    PlannerCrashed,
    PlanningError,
    PlanningTimedOut,
    plan_in_child,
)

Array = NDArray[np.float64]

# Via points drawn at one place before a path is given up.
_DRAWS_PER_POINT: Final = 50
# Motions tried for each one that is wanted.
_TRIES_PER_MOTION: Final = 100
# A stream of random numbers that no search draws from, whatever the seeds.
_VALIDATION: Final = 2


# Range that each joint's share of its velocity limit is drawn from, share of each joint's range,
# about its middle, that via points lie in, and the longest motion [s].
_SPEED: Final = (0.5, 1.0)
_RANGE_SHARE: Final = 0.98
_LONGEST: Final = 60.0


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
) -> tuple[DrawnMotion, ...]:
    """Return wide random motions to predict torques on, never to fit parameters to.

    They run through the same interpolator under the same constraints as an excitation, and come
    from other random numbers than any excitation, whatever the seeds.

    Args:
        limits: joint limits of the plan.
        home: posture (n,) [rad] within the limits where each motion begins and ends.
        seed: the same seed gives the same motions, to the last bit.
        count: how many; the first ones do not depend on it.
        n_via: via points between the two ends.
        fly: how far corners are rounded, 0 to 1.
        checker: clearance that every motion must keep.
        currents: torque and current limits that every motion must keep.

    Raises:
        NoFeasibleMotionError: a hundred tries in a row did not give one feasible motion.
    """
    rejected, nearest = Counter[str](), dict[str, Violation]()

    def reject(violations: Sequence[Violation]) -> None:
        """Count a motion once per kind of constraint it breaks, and note the mildest of each."""
        for kind in dict.fromkeys(violation.kind for violation in violations):
            rejected[kind] += 1
            worst = max((v for v in violations if v.kind == kind), key=lambda v: v.excess)
            nearest[kind] = min(nearest.get(kind, worst), worst, key=lambda v: v.excess)

    found = None if checker is None else clearance(checker, home[None])
    if found is not None:
        reject([replace(found, subject=f"{found.subject} at home")])
        raise NoFeasibleMotionError(rejected, nearest)
    half = (limits.upper - limits.lower) / 2.0 * _RANGE_SHARE
    middle = (limits.upper + limits.lower) / 2.0

    def next_point(random: np.random.Generator, before: Array, *, last: bool) -> Array | Violation:
        """Draw until the path is free; return what was in it when patience ends."""
        draws = 0
        while True:
            point = random.uniform(middle - half, middle + half)
            path = straight_way(before, point)
            if last:
                path = np.concatenate((path, straight_way(point, home)))
            if checker is None or checker.clear(path).all():
                return point
            draws += 1
            blocked = clearance(checker, path) if draws >= _DRAWS_PER_POINT else None
            if blocked is not None:
                return blocked

    def draw(random: np.random.Generator) -> DrawnMotion | Sequence[Violation]:
        """Return a feasible motion, or why there is none."""
        speed = random.uniform(*_SPEED, limits.n_joints)
        points = [home]
        while len(points) <= n_via:
            point = next_point(random, points[-1], last=len(points) == n_via)
            if isinstance(point, Violation):
                return [point]
            points.append(point)
        via_points = np.array([*points, home])
        try:
            # The solver can take its process with it; that individual is infeasible, no more.
            trajectory = plan_in_child(via_points, limits, speed=speed, fly=fly)
        except (PlannerCrashed, PlanningError, PlanningTimedOut) as error:
            return [Violation("planning", f"the motion ({error})", 1.0, 0.0, None)]
        if trajectory.duration > _LONGEST:
            return [Violation("duration", "the motion", trajectory.duration, _LONGEST, None)]
        check = check_motion(trajectory, limits, checker=checker, currents=currents)
        return check.violations or DrawnMotion(via_points, speed, fly, trajectory)

    motions = []
    for k in range(count):
        for attempt in range(_TRIES_PER_MOTION):
            motion = draw(np.random.default_rng([_VALIDATION, seed, k, attempt]))
            if isinstance(motion, DrawnMotion):
                motions.append(motion)
                break
            reject(motion)
        else:
            raise NoFeasibleMotionError(rejected, nearest)
    return tuple(motions)
