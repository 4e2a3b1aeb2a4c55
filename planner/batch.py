"""Planning whole populations in worker processes, for searches.

A search draws motions by the thousand, and some cannot be planned: their points are outside the
limits, or their corners crash the solver and its process with it. Here each comes back as a
motion or as the error that made it infeasible, in the order given, whatever the number of
workers; a worker that dies is started anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from planner.arrays import Array
from planner.blocks import LimitRows
from planner.children import chunks_of, map_in_children
from planner.errors import InvalidSetting, InvalidViaPoints, PlannerError, PlanningError
from planner.isolation import PlanningChild
from planner.limits import JointLimits
from planner.piecewise_cubic import PiecewiseCubic
from planner.plan import checked_via_points, plan
from planner.population import plan_population

# Motions per call to a worker: enough for whole arrays to pay, few enough to spread.
_CHUNK = 32

Planned = PiecewiseCubic | PlannerError


class PlanningPool:
    """Worker processes that plan populations; keep one for all generations of a search.

    Args:
        workers: Number of processes; 0 plans in this one, where a crash of the solver is fatal.
        timeout: Longest time [s] a worker may take for 32 motions, then for each of them alone.

    Attributes:
        children: The worker processes.
    """

    def __init__(self, workers: int = 1, *, timeout: float = 10.0) -> None:
        if workers < 0:
            raise InvalidSetting("workers", workers, "a number of processes, 0 or more")
        self.children = [PlanningChild(timeout=timeout) for _ in range(workers)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the workers."""
        for child in self.children:
            child.close()

    def plan_many(
        self,
        individuals: Sequence[ArrayLike] | Array,
        limits: JointLimits,
        *,
        speed: ArrayLike = 1.0,
        fly: float = 0.5,
    ) -> list[Planned]:
        """Plan each individual as `planner.plan` does; see `plan_many`."""
        shares = _one_each(speed, len(individuals), limits.n_joints)
        if not 0.0 <= fly <= 1.0:
            raise InvalidSetting("fly", fly, "a number from 0 to 1")
        chunks = chunks_of(len(individuals), _CHUNK)
        population = _Population(individuals, shares, limits, fly)
        if self.children:
            return list(map_in_children(self.children, plan_chunk, chunks, population.part))
        return [planned for chunk in chunks for planned in plan_chunk(*population.part(chunk))]


def plan_many(
    individuals: Sequence[ArrayLike] | Array,
    limits: JointLimits,
    *,
    speed: ArrayLike = 1.0,
    fly: float = 0.5,
    workers: int = 1,
    timeout: float = 10.0,
) -> list[Planned]:
    """Plan a motion through the via points of each individual, as `planner.plan` does.

    Args:
        individuals: Via points (n_points, n_joints) [rad] of each; their number may differ.
        limits: Limits that every motion keeps.
        speed: Share of each joint's velocity limit, in (0, 1]: a number, (n_joints,) for all, or
            one row for each individual.
        fly: Share of each deceleration that the next acceleration overlaps, 0 to 1.
        workers: Number of processes; the result does not depend on it. With 0 all is planned in
            this process, where a crash of the solver is fatal.
        timeout: Longest time [s] a worker may take for 32 motions, then for each of them alone.

    Returns:
        For each individual, in their order, its motion, or the error that `plan` would raise for
        it, or `PlannerCrashed` or `PlanningTimedOut` if planning it alone ended its process.

    Raises:
        InvalidSetting: speed or fly outside its range, or a negative number of workers.
        PlannerNotStarted: a worker died before it was given anything to do.
    """
    with PlanningPool(workers, timeout=timeout) as pool:
        return pool.plan_many(individuals, limits, speed=speed, fly=fly)


class _Population:
    """What is to be planned, and parts of it as a worker wants them."""

    def __init__(
        self,
        individuals: Sequence[ArrayLike] | Array,
        shares: Array,
        limits: JointLimits,
        fly: float,
    ) -> None:
        self._individuals = individuals
        self._shares = shares
        self._limits = limits
        self._fly = fly

    def part(self, chunk: Sequence[int]) -> tuple[list[ArrayLike], Array, JointLimits, float]:
        own = [self._individuals[index] for index in chunk]
        return own, self._shares[list(chunk)], self._limits, self._fly


def plan_chunk(
    individuals: Sequence[ArrayLike], speed: Array, limits: JointLimits, fly: float
) -> list[Planned]:
    """Plan some individuals together, in this process; `speed` has one row (n,) for each."""
    planned: list[Planned | None] = [None] * len(individuals)
    alike: dict[int, list[tuple[int, Array]]] = {}
    for index, via_points in enumerate(individuals):
        try:
            points = checked_via_points(via_points, limits)
        except InvalidViaPoints as error:
            planned[index] = error
        else:
            alike.setdefault(len(points), []).append((index, points))
    for group in alike.values():
        rows = [index for index, _ in group]
        shape = (len(rows), limits.n_joints)
        bounds = LimitRows(
            np.broadcast_to(limits.lower, shape),
            np.broadcast_to(limits.upper, shape),
            limits.velocity * speed[rows],
            np.broadcast_to(limits.acceleration, shape),
            np.broadcast_to(limits.jerk, shape),
        )
        motions = plan_population(np.array([points for _, points in group]), bounds, fly)
        for (index, points), motion in zip(group, motions, strict=True):
            planned[index] = motion or _alone(points, speed[index], limits, fly)
    return [result for result in planned if result is not None]


def _alone(points: Array, speed: Array, limits: JointLimits, fly: float) -> Planned:
    """Plan what failed in company once more by itself; its error tells what is wrong."""
    try:
        return plan(points, limits, speed=speed, fly=fly)
    except PlanningError as error:
        return error


def _one_each(speed: ArrayLike, count: int, n_joints: int) -> Array:
    """Return shares of speed, one row (n_joints,) for each individual."""
    shares = np.asarray(speed, dtype=np.float64)
    if shares.shape not in ((), (n_joints,), (count, n_joints)) or not np.all(
        (shares > 0.0) & (shares <= 1.0)
    ):
        raise InvalidSetting(
            "speed", speed, f"a share in (0, 1]: one, {n_joints}, or {n_joints} per individual"
        )
    return np.broadcast_to(shares, (count, n_joints))
