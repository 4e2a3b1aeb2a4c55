"""Random motions to validate on: wide ones, which the parameters are never fitted to.

A motion leads from a home posture through random via points back to it, as the robot's own
interpolator runs it, and keeps all constraints.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
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
from identification.excitation.errors import DesignError, NoFeasibleMotionError
from identification.excitation.random_motion import DrawnMotion
from identification.excitation.straight_paths import is_inside, straight_way
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


@dataclass(frozen=True)
class Drawing:
    """Which motions are drawn.

    Attributes:
        speed: range that each joint's share of its velocity limit is drawn from.
        range_share: share of each joint's range, about its middle, that via points lie in.
        min_duration, max_duration: of a motion [s].

    Raises:
        DesignError: a setting outside its range.
    """

    speed: tuple[float, float] = (0.5, 1.0)
    range_share: float = 0.98
    min_duration: float = 0.0
    max_duration: float = 60.0

    def __post_init__(self) -> None:
        slowest, fastest = self.speed
        for name, fine, valid in (
            ("speed", 0.0 < slowest <= fastest <= 1.0, "a range within (0, 1]"),
            ("range_share", 0.0 < self.range_share <= 1.0, "within (0, 1]"),
            ("min_duration", self.min_duration <= self.max_duration, "at most max_duration"),
            ("max_duration", self.max_duration > 0.0, "above 0 s"),
        ):
            if not fine:
                raise DesignError(name, getattr(self, name), valid)


def random_validation_motions(
    limits: JointLimits,
    *,
    home: Array,
    seed: int,
    count: int,
    n_via: int = 6,
    fly: float = 0.5,
    drawing: Drawing = Drawing(),
    checker: CollisionChecker | None = None,
    currents: CurrentModel | None = None,
) -> tuple[DrawnMotion, ...]:
    """Return wide random motions to predict torques on, never to fit parameters to.

    They run through the same interpolator under the same constraints as an excitation, and come
    from other random numbers than any excitation, whatever the seeds.

    Args:
        limits: joint limits of the plan.
        home: posture (n,) [rad] where each motion begins and ends.
        seed: the same seed gives the same motions, to the last bit.
        count: how many; the first ones do not depend on it.
        n_via: via points between the two ends.
        fly: how far corners are rounded, 0 to 1.
        drawing: what else they are drawn by.
        checker: clearance that every motion must keep.
        currents: torque and current limits that every motion must keep.

    Raises:
        NoFeasibleMotionError: a hundred tries in a row did not give one feasible motion.
        DesignError: a setting outside its range, or home outside the limits.
    """
    draw = _Draw(limits, home, n_via, fly, drawing, checker, currents)
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
        drawing: Drawing,
        checker: CollisionChecker | None,
        currents: CurrentModel | None,
    ) -> None:
        self._limits, self._drawing = limits, drawing
        self._home = np.asarray(home, dtype=np.float64)
        self._n_via, self._fly = n_via, fly
        self._checker, self._currents = checker, currents
        self.rejected: Counter[str] = Counter()
        self._nearest: dict[str, Violation] = {}
        if n_via < 1:
            raise DesignError("n_via", n_via, "at least 1")
        if not is_inside(self._home, limits):
            raise DesignError("home", self._home.tolist(), "a posture inside the joint limits")
        if (contact := self._contact(self._home[None])) is not None:
            self._reject([replace(contact, subject=f"{contact.subject} at home")])
            raise self.failure()

    def __call__(self, random: np.random.Generator) -> DrawnMotion | None:
        """Return a feasible motion, or None and count why there is none."""
        speed = random.uniform(*self._drawing.speed, self._limits.n_joints)
        via_points = self._via_points(random)
        if via_points is None:
            return None
        try:
            # The solver can take its process with it; that individual is infeasible, no more.
            trajectory = plan_in_child(via_points, self._limits, speed=speed, fly=self._fly)
        except (PlannerCrashed, PlanningError, PlanningTimedOut) as error:
            self._reject([Violation("planning", f"the motion ({error})", 1.0, 0.0, None)])
            return None
        violations = self._wrong_duration(trajectory.duration)
        if not violations:
            check = check_motion(
                trajectory, self._limits, checker=self._checker, currents=self._currents
            )
            violations = list(check.violations)
        if violations:
            self._reject(violations)
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
        half = (self._limits.upper - self._limits.lower) / 2.0 * self._drawing.range_share
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

    def _wrong_duration(self, duration: float) -> list[Violation]:
        shortest, longest = self._drawing.min_duration, self._drawing.max_duration
        bound = min(max(duration, shortest), longest)
        if bound == duration:
            return []
        return [Violation("duration", "the motion", duration, bound, None)]

    def _reject(self, violations: list[Violation]) -> None:
        """Count a motion once per kind of constraint it breaks; keep the mildest case of each."""
        for kind in dict.fromkeys(violation.kind for violation in violations):
            self.rejected[kind] += 1
            worst = max((v for v in violations if v.kind == kind), key=lambda v: v.excess)
            if kind not in self._nearest or worst.excess < self._nearest[kind].excess:
                self._nearest[kind] = worst
