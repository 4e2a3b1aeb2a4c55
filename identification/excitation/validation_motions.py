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
    Violation,
    check_motion,
    clearance,
)
from identification.excitation.errors import NoFeasibleMotionError
from identification.excitation.excitation import DrawnMotion
from identification.excitation.genomes import straight_way
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
    draw = _Draw(limits, home, n_via, fly, checker, currents)
    motions = []
    for k in range(count):
        for attempt in range(_TRIES_PER_MOTION):
            candidate = draw(np.random.default_rng([_VALIDATION, seed, k, attempt]))
            if candidate is not None:
                motions.append(candidate)
                break
        else:
            raise draw.failure()
    return tuple(motions)


class _Draw:
    """Draws motions one by one and keeps count of what stands in their way."""

    def __init__(
        self,
        limits: JointLimits,
        home: Array,
        n_via: int,
        fly: float,
        checker: CollisionChecker | None,
        currents: CurrentModel | None,
    ) -> None:
        self._limits, self._home = limits, home
        self._n_via, self._fly = n_via, fly
        self._checker, self._currents = checker, currents
        self.rejected: Counter[str] = Counter()
        self._nearest: dict[str, Violation] = {}
        if (contact := self._contact(self._home[None])) is not None:
            self._reject([replace(contact, subject=f"{contact.subject} at home")])
            raise self.failure()

    def __call__(self, random: np.random.Generator) -> DrawnMotion | None:
        """Return a feasible motion, or None and count why there is none."""
        speed = random.uniform(*_SPEED, self._limits.n_joints)
        via_points = self._via_points(random)
        if via_points is None:
            return None
        try:
            # The solver can take its process with it; that individual is infeasible, no more.
            trajectory = plan_in_child(via_points, self._limits, speed=speed, fly=self._fly)
        except (PlannerCrashed, PlanningError, PlanningTimedOut) as error:
            self._reject([Violation("planning", f"the motion ({error})", 1.0, 0.0, None)])
            return None
        found: Sequence[Violation] = [
            Violation("duration", "the motion", trajectory.duration, _LONGEST, None)
        ]
        if trajectory.duration <= _LONGEST:
            check = check_motion(
                trajectory, self._limits, checker=self._checker, currents=self._currents
            )
            found = check.violations
        if found:
            self._reject(found)
            return None
        return DrawnMotion(via_points, speed, self._fly, trajectory)

    def failure(self) -> NoFeasibleMotionError:
        """Return the error that tells what forbids every motion."""
        return NoFeasibleMotionError(self.rejected, self._nearest)

    def _via_points(self, random: np.random.Generator) -> Array | None:
        """Draw points one after the other, each within free straight reach of the one before.

        The last one must see home. Corners are rounded later: the whole motion is checked then.
        """
        points = [self._home]
        while len(points) <= self._n_via:
            found = self._next_point(random, points[-1], last=len(points) == self._n_via)
            if isinstance(found, Violation):
                self._reject([found])
                return None
            points.append(found)
        return np.array([*points, self._home])

    def _next_point(
        self, random: np.random.Generator, before: Array, *, last: bool
    ) -> Array | Violation:
        """Draw until the way is free; return what was in the way when patience ends."""
        middle = (self._limits.upper + self._limits.lower) / 2.0
        half = (self._limits.upper - self._limits.lower) / 2.0 * _RANGE_SHARE
        draws = 0
        while True:
            point = random.uniform(middle - half, middle + half)
            way = straight_way(before, point)
            if last:
                way = np.concatenate((way, straight_way(point, self._home)))
            if self._checker is None or self._checker.clear(way).all():
                return point
            draws += 1
            if draws >= _DRAWS_PER_POINT and (blocked := self._contact(way)) is not None:
                return blocked

    def _contact(self, q: Array) -> Violation | None:
        return None if self._checker is None else clearance(self._checker, q)

    def _reject(self, violations: Sequence[Violation]) -> None:
        """Count a motion once per kind of constraint it breaks; keep the mildest case of each."""
        for kind in dict.fromkeys(violation.kind for violation in violations):
            self.rejected[kind] += 1
            worst = max((v for v in violations if v.kind == kind), key=lambda v: v.excess)
            if kind not in self._nearest or worst.excess < self._nearest[kind].excess:
                self._nearest[kind] = worst
