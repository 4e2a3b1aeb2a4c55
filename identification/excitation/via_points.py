"""The paper's genome: coordinates of via points and each joint's speed (section 3.3, eq. 6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.excitation.collision.checker import CollisionChecker
from identification.excitation.genome import between
from planner import (
    FourierSeries,
    JointLimits,
    PiecewiseCubic,
    PlannerError,
    plan_chunk,
    plan_in_child,
)
from planner.arrays import read_only

Array = NDArray[np.float64]

# Spacing [rad] of the postures at which a way is looked at.
_LOOK_EVERY: Final = 0.1


def straight_way(start: Array, end: Array) -> Array:
    """Return postures (m, n) [rad] on the straight line between two, some 0.1 rad apart."""
    steps = int(np.ceil(np.max(np.abs(end - start)) / _LOOK_EVERY)) + 1
    return np.linspace(start, end, steps + 1)


def free_segments(checker: CollisionChecker, segments: Sequence[Array]) -> NDArray[np.bool_]:
    """Return which ways (m_i, n) keep the clearance at every posture, (len(ways),)."""
    starts = np.cumsum([0, *(len(way) for way in segments[:-1])])
    return np.logical_and.reduceat(checker.clear(np.concatenate(segments)), starts)


# Draws of one via point before the last one is used as it is.
_DRAWS: Final = 50


@dataclass(frozen=True, eq=False)
class ViaPointGenome:
    """Motions through K via points, as the robot's own interpolator runs them.

    Genes are the via points' coordinates, point by point, then one speed for each joint: K n + n
    numbers.

    Attributes:
        limits: joint limits of the plan; via points reach from one end of a range to the other.
        n_via: K, without home.
        fly: how far corners are rounded, 0 to 1.
        slowest: share of a joint's velocity limit, above 0, that gene 0 means; gene 1 means 1.
        range_share: share of each joint's range, about its middle, that via points lie in.
        home: posture (n,) [rad] within the limits where the motion begins and ends; None: it leads
            from the first via point to the last.
        checker: clearance that the straight ways between the points of a first population keep;
            None: its points are uniform in the range, as the paper's.
    """

    limits: JointLimits
    n_via: int
    fly: float = 0.5
    slowest: float = 0.3
    range_share: float = 1.0
    home: Array | None = None
    checker: CollisionChecker | None = None

    def __post_init__(self) -> None:
        if self.home is not None:
            object.__setattr__(self, "home", read_only(self.home))

    @property
    def n_genes(self) -> int:
        """Number of coordinates, K n, and n speeds."""
        return (self.n_via + 1) * self.limits.n_joints

    def decode(self, genes: ArrayLike) -> tuple[Array, Array]:
        """Return via points (m, n_points, n) [rad], home included, and shares of speed (m, n)."""
        rows = np.atleast_2d(genes)
        coordinates, rates = np.split(rows, [self.n_via * self.limits.n_joints], axis=1)
        points = self._points(coordinates.reshape(len(rows), self.n_via, -1))
        if self.home is not None:
            home = np.broadcast_to(self.home, (len(rows), 1, self.limits.n_joints))
            points = np.concatenate((home, points, home), axis=1)
        return points, between(self.slowest, 1.0, rates)

    def motions(self, genes: Array) -> list[PiecewiseCubic | FourierSeries | PlannerError]:
        """Plan each row of genes (m, n_genes), all together and in this process.

        The solver can take its process with it: what must not die calls this in a child.
        """
        points, speed = self.decode(genes)
        planned = plan_chunk(list(points), speed, self.limits, self.fly)
        return cast(list[PiecewiseCubic | FourierSeries | PlannerError], planned)

    def sample(self, random: np.random.Generator, count: int) -> Array:
        """Draw a first population (count, n_genes), uniform where no checker says otherwise."""
        n = self.limits.n_joints
        genes = random.random((count, self.n_genes))
        if self.checker is None:
            return genes
        coordinates = genes[:, : self.n_via * n].reshape(count, self.n_via, n)  # a view
        before = None if self.home is None else np.tile(self.home, (count, 1))
        for k in range(self.n_via):
            after = self.home if k == self.n_via - 1 else None
            before = self._redraw(random, self.checker, coordinates[:, k], before, after)
        return genes

    def recorded(
        self,
        genes: Array,
        trajectory: PiecewiseCubic | FourierSeries,
    ) -> dict[str, Any]:
        """Return the motion of genes (n_genes,), and its via points, for the record.

        The motion is planned once more, move by move: the same to the last bit at every instant,
        but in the pieces that its moves plan to.
        """
        points, speed = (each[0] for each in self.decode(genes))
        trajectory = plan_in_child(points, self.limits, speed=speed, fly=self.fly)
        return {"trajectory": trajectory, "via_points": points, "speed": speed, "fly": self.fly}

    def _redraw(
        self,
        random: np.random.Generator,
        checker: CollisionChecker,
        coordinates: Array,
        before: Array | None,
        after: Array | None,
    ) -> Array:
        """Draw points anew, in place (m, n), until the ways before and after them are free.

        Returns the points [rad]. Where patience ends the last draw stays: that individual is
        infeasible, and the search will find out.
        """
        blocked = np.arange(len(coordinates))
        for draw in range(_DRAWS):
            if draw > 0:
                coordinates[blocked] = random.random((len(blocked), self.limits.n_joints))
            points = self._points(coordinates[blocked])
            segments = [
                np.concatenate(
                    (
                        point[None] if before is None else straight_way(before[index], point),
                        point[None] if after is None else straight_way(point, after),
                    )
                )
                for index, point in zip(blocked.tolist(), points, strict=True)
            ]
            blocked = blocked[~free_segments(checker, segments)]
            if len(blocked) == 0:
                break
        return self._points(coordinates)

    def _points(self, coordinates: Array) -> Array:
        """Return the via points [rad] that coordinates (..., n) from 0 to 1 mean."""
        return between(*self._range(), coordinates)

    def _range(self) -> tuple[Array, Array]:
        """Return the smallest and largest coordinates of via points, (n,) each [rad]."""
        lower, upper = self.limits.lower, self.limits.upper
        margin = 0.5 * (1.0 - self.range_share) * (upper - lower)
        return lower + margin, upper - margin
