"""Random validation motions from home through random via points and back."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.excitation.collision import CollisionChecker
from identification.excitation.constraints import CurrentModel, check_motion, clearance
from identification.excitation.errors import NoFeasibleMotionError
from identification.excitation.excitation import ViaPointMotion
from identification.excitation.genomes import straight_path
from identification.excitation.violation import CloseBodies, Violation, WholeMotion
from planner import (
    JointLimits,
    PlannerCrashed,
    PlanningError,
    PlanningTimedOut,
    plan_in_child,
)

_DRAWS_PER_POINT: Final = 50  # of one via point before the path is rejected
_TRIES_PER_MOTION: Final = 100
_VALIDATION_STREAM: Final = 2  # first seed of a random stream that no search uses
_SPEED_SHARES: Final = (0.5, 1.0)  # range of the speeds, fraction of the velocity limits
_RANGE_SHARE: Final = 0.98  # central fraction of each joint's range that via points lie in
_MAX_DURATION: Final = 60.0  # s


def random_validation_motions(
    limits: JointLimits,
    *,
    home: Array,
    seed: int,
    count: int,
    n_via: int = 6,
    fly: float = 0.5,
    range_share: float = 1.0,
    checker: CollisionChecker | None = None,
    currents: CurrentModel | None = None,
) -> tuple[ViaPointMotion, ...]:
    """Return random motions across the joint ranges to validate predictions on.

    They satisfy the same constraints as an excitation. Their random numbers are independent of
    every search. The same seed gives the same motions bit for bit, the first ones for any `count`.

    Args:
        limits: of the joints.
        home: position at both ends (n,) [rad].
        seed: of the random numbers.
        count: of the motions.
        n_via: points between the ends.
        fly: how far corners are rounded, from 0 to 1.
        range_share: central fraction of each joint's range that the points lie in.
        checker: of collisions.
        currents: of the motors.

    Raises:
        NoFeasibleMotionError: 100 attempts in a row without a feasible motion.
    """
    attempts = _Attempts(limits, home, n_via, fly, range_share, checker, currents)
    contact = None if checker is None else clearance(checker, home[None])
    if contact is not None and isinstance(pair := contact.subject, CloseBodies):
        attempts.reject([replace(contact, subject=replace(pair, at_home=True))])
        raise NoFeasibleMotionError(attempts.rejected, attempts.nearest)
    motions = []
    for k in range(count):
        for attempt in range(_TRIES_PER_MOTION):
            motion = attempts.motion(np.random.default_rng([_VALIDATION_STREAM, seed, k, attempt]))
            if isinstance(motion, ViaPointMotion):
                motions.append(motion)
                break
            attempts.reject(motion)
        else:
            raise NoFeasibleMotionError(attempts.rejected, attempts.nearest)
    return tuple(motions)


class _Attempts:
    """Random motions; some violate constraints.

    Attributes:
        rejected: motions by kind of constraint they break.
        nearest: the smallest violation of each kind.
    """

    def __init__(
        self,
        limits: JointLimits,
        home: Array,
        n_via: int,
        fly: float,
        range_share: float,
        checker: CollisionChecker | None,
        currents: CurrentModel | None,
    ) -> None:
        self._limits = limits
        self._home = home
        self._n_via = n_via
        self._fly = fly
        self._checker = checker
        self._currents = currents
        self._half = (limits.upper - limits.lower) / 2.0 * (_RANGE_SHARE * range_share)
        self._middle = (limits.upper + limits.lower) / 2.0
        self.rejected = Counter[str]()
        self.nearest = dict[str, Violation]()

    def reject(self, violations: Sequence[Violation]) -> None:
        """Count a motion once per kind of constraint it breaks; update the smallest violations."""
        for kind in dict.fromkeys(violation.kind for violation in violations):
            self.rejected[kind] += 1
            of_kind = [violation for violation in violations if violation.kind == kind]
            worst = max(of_kind, key=lambda violation: violation.excess)
            smallest = self.nearest.get(kind, worst)
            self.nearest[kind] = min(smallest, worst, key=lambda violation: violation.excess)

    def motion(self, random: np.random.Generator) -> ViaPointMotion | Sequence[Violation]:
        """Return a feasible motion, or the violations of an infeasible one."""
        speed = random.uniform(*_SPEED_SHARES, self._limits.n_joints)
        points = [self._home]
        while len(points) <= self._n_via:
            point = self._next_point(random, points[-1], last=len(points) == self._n_via)
            if isinstance(point, Violation):
                return [point]
            points.append(point)
        via_points = np.array([*points, self._home])
        try:
            # in a child, because the solver can crash its process
            trajectory = plan_in_child(via_points, self._limits, speed=speed, fly=self._fly)
        except (PlannerCrashed, PlanningError, PlanningTimedOut) as error:
            return [Violation("planning", WholeMotion(str(error)), 1.0, 0.0, None)]
        if trajectory.duration > _MAX_DURATION:
            return [Violation("duration", WholeMotion(), trajectory.duration, _MAX_DURATION, None)]
        violations = check_motion(
            trajectory, self._limits, checker=self._checker, currents=self._currents
        )
        return violations or ViaPointMotion(via_points, speed, self._fly, trajectory)

    def _next_point(
        self, random: np.random.Generator, before: Array, *, last: bool
    ) -> Array | Violation:
        """Draw a point with a free path to it, or return a contact after too many draws."""
        draws = 0
        while True:
            point = random.uniform(self._middle - self._half, self._middle + self._half)
            path = straight_path(before, point)
            if last:
                path = np.concatenate((path, straight_path(point, self._home)))
            if self._checker is None or self._checker.clear(path).all():
                return point
            draws += 1
            blocked = clearance(self._checker, path) if draws >= _DRAWS_PER_POINT else None
            if blocked is not None:
                return blocked
