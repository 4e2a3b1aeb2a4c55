"""Random search for an exciting motion, and random motions to validate on.

A motion leads from a home posture through random via points back to it, as the robot's own
interpolator runs it (eq. 6 of the paper: the genome is the via points and each joint's speed).
It is accepted if it keeps all constraints, and judged by eq. 7 on the planned motion. Friction
columns use sgn(qd) as it is: a planned velocity has no noise that would need a dead zone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision import CollisionChecker
from identification.excitation.constraints import (
    SAMPLE_PERIOD,
    CurrentModel,
    Violation,
    check_motion,
    clearance,
    sampled,
)
from identification.excitation.criteria import (
    coupling_index,
    fitness_eq7,
    information,
    log10_det,
)
from identification.excitation.drawn import DrawnMotion, moves_through
from identification.excitation.errors import DesignError, NoFeasibleMotionError
from identification.factor import Factor
from identification.model import RobotModel
from planner import (
    JointLimits,
    Move,
    PiecewiseCubic,
    PlannerCrashed,
    PlanningError,
    PlanningTimedOut,
    plan_in_child,
)

Array = NDArray[np.float64]
Progress = Callable[[str], None]

# Via points drawn at one place before a path is given up, and spacing [rad] of the postures at
# which the way between two of them is looked at.
_DRAWS_PER_POINT = 50
_LOOK_EVERY = 0.1
# Motions tried for each one that is wanted for validation.
_TRIES_PER_MOTION = 100
# Streams of random numbers that never meet, whatever the seeds.
_EXCITATION, _VALIDATION = 1, 2


@dataclass(frozen=True)
class Criteria:
    """How well a motion excites the parameters (paper, eqs. 5, 7 and 9).

    Attributes:
        log10_det: log10 of det(Phi^T Phi) / N^p; depends on units.
        coupling_index: I_c, the smaller the better.
        fitness: eq. 7.
        n_samples: N, time samples that they were computed from.
    """

    log10_det: float
    coupling_index: float
    fitness: float
    n_samples: int

    @classmethod
    def of(cls, model: RobotModel, trajectory: PiecewiseCubic) -> Self:
        """Judge a motion by the regressor of its samples, some 8 ms apart."""
        motion = sampled(trajectory, SAMPLE_PERIOD)
        unknown = np.zeros_like(motion.position)  # torque plays no part in the excitation
        gram = information(Factor.from_samples(model, motion, unknown))
        n = motion.n_samples
        return cls(log10_det(gram, n), coupling_index(gram), fitness_eq7(gram, n), n)


@dataclass(frozen=True, eq=False)
class Excitation:
    """The best motion of a search, and how it was found.

    Attributes:
        via_points: (n_points, n) [rad], home at both ends included.
        speed: (n,) share of each joint's velocity limit.
        fly: how far corners are rounded, 0 to 1.
        trajectory: the motion planned from these.
        criteria: how good it is.
        seed: of the search.
        tried: how many motions were drawn.
        rejected: how many of them were not feasible, by kind of constraint.
    """

    via_points: Array
    speed: Array
    fly: float
    trajectory: PiecewiseCubic
    criteria: Criteria
    seed: int
    tried: int
    rejected: Mapping[str, int]

    @property
    def moves(self) -> tuple[Move, ...]:
        """The moves from the first via point on; they plan to the trajectory, bit for bit."""
        return moves_through(self.via_points, self.speed, self.fly)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data; `from_dict` restores every bit, through JSON too."""
        return {
            "via_points": self.via_points.tolist(),
            "speed": self.speed.tolist(),
            "fly": self.fly,
            "trajectory": self.trajectory.to_dict(),
            "criteria": asdict(self.criteria),
            "seed": self.seed,
            "tried": self.tried,
            "rejected": dict(self.rejected),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Restore what `to_dict` returned.

        Raises:
            KeyError, TypeError, ValueError: the data are no excitation.
        """
        return cls(
            via_points=np.array(data["via_points"], dtype=np.float64),
            speed=np.array(data["speed"], dtype=np.float64),
            fly=float(data["fly"]),
            trajectory=PiecewiseCubic.from_dict(data["trajectory"]),
            criteria=Criteria(**data["criteria"]),
            seed=int(data["seed"]),
            tried=int(data["tried"]),
            rejected=dict(data["rejected"]),
        )


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


def random_search(
    model: RobotModel,
    limits: JointLimits,
    *,
    home: Array,
    seed: int,
    n_via: int = 6,
    fly: float = 0.5,
    candidates: int = 300,
    drawing: Drawing = Drawing(),
    checker: CollisionChecker | None = None,
    currents: CurrentModel | None = None,
    progress: Progress | None = None,
) -> Excitation:
    """Return the feasible motion with the best fitness by eq. 7 of so many random ones.

    Args:
        model: whose parameters are to be excited.
        limits: joint limits of the plan.
        home: posture (n,) [rad] where the motion begins and ends.
        seed: the same seed gives the same motion, to the last bit.
        n_via: via points between the two ends.
        fly: how far corners are rounded, 0 to 1.
        candidates: how many motions are drawn, feasible or not.
        drawing: what else they are drawn by.
        checker: clearance that every motion must keep.
        currents: torque and current limits that every motion must keep.
        progress: called with a short note after each motion.

    Raises:
        NoFeasibleMotionError: no motion keeps the constraints, or home itself does not.
        DesignError: a setting outside its range, or home outside the limits.
    """
    if candidates < 1:
        raise DesignError("candidates", candidates, "at least 1")
    draw = _Draw(limits, home, n_via, fly, drawing, checker, currents)
    best: tuple[DrawnMotion, Criteria] | None = None
    for k in range(candidates):
        drawn = draw(np.random.default_rng([_EXCITATION, seed, k]))
        if drawn is not None:
            criteria = Criteria.of(model, drawn.trajectory)
            if best is None or criteria.fitness > best[1].fitness:
                best = drawn, criteria
        if progress is not None:
            progress("none feasible yet" if best is None else f"fitness {best[1].fitness:.1f}")
    if best is None:
        raise draw.failure()
    drawn, criteria = best
    return Excitation(
        via_points=drawn.via_points,
        speed=drawn.speed,
        fly=drawn.fly,
        trajectory=drawn.trajectory,
        criteria=criteria,
        seed=seed,
        tried=candidates,
        rejected=dict(draw.rejected),
    )


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

    They run through the same interpolator under the same constraints as an excitation (see
    :func:`random_search` for the arguments), and come from other random numbers than any
    excitation, whatever the seeds.

    Raises:
        NoFeasibleMotionError: a hundred tries in a row did not give one feasible motion.
        DesignError: a setting outside its range, or home outside the limits.
    """
    draw = _Draw(limits, home, n_via, fly, drawing, checker, currents)
    motions = []
    for k in range(count):
        for attempt in range(_TRIES_PER_MOTION):
            drawn = draw(np.random.default_rng([_VALIDATION, seed, k, attempt]))
            if drawn is not None:
                motions.append(drawn)
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
        if self._home.shape != limits.lower.shape or not np.all(
            (self._home >= limits.lower) & (self._home <= limits.upper)
        ):
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
            way = _line(before, point)
            if last:
                way = np.concatenate((way, _line(point, self._home)))
            blocked = self._contact(way)
            if blocked is None:
                return point
            draws += 1
            if draws == _DRAWS_PER_POINT:
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


def _line(start: Array, end: Array) -> Array:
    """Return postures on the straight line between two, some 0.1 rad apart."""
    steps = int(np.ceil(np.max(np.abs(end - start)) / _LOOK_EVERY)) + 1
    return np.linspace(start, end, steps + 1)
