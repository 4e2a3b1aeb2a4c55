"""What a search turns its numbers into: motions through via points, and sums of sines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.excitation.collision.checker import CollisionChecker
from identification.excitation.errors import DesignError
from planner import (
    FourierSeries,
    InvalidSetting,
    JointLimits,
    PiecewiseCubic,
    PlannerError,
    harmonic_bounds,
    plan_chunk,
)
from planner.arrays import read_only

Array = NDArray[np.float64]
Motion: TypeAlias = PiecewiseCubic | FourierSeries

# Spacing [rad] of the postures at which a way is looked at.
_LOOK_EVERY: Final = 0.1
# Draws of one via point before the last one is used as it is.
_DRAWS: Final = 50


class Genome(Protocol):
    """A family of motions, each given by `n_genes` numbers from 0 to 1."""

    @property
    def n_genes(self) -> int:
        """How many numbers tell a motion."""
        ...

    def motions(self, genes: Array) -> Sequence[Motion | PlannerError]:
        """Return the motion of each row of genes (m, n_genes), or why there is none.

        A motion does not depend on its company, to the last bit.
        """
        ...

    def sample(self, random: np.random.Generator, count: int) -> Array:
        """Draw a first population (count, n_genes)."""
        ...

    def recorded(self, genes: Array) -> dict[str, Any]:
        """Return what the motion of genes (n_genes,) was planned from: fields of `Excitation`."""
        ...


def between(lower: ArrayLike, upper: ArrayLike, genes: Array) -> Array:
    """Return what genes mean: exactly `lower` at 0, exactly `upper` at 1, never beyond either."""
    low, high = np.asarray(lower), np.asarray(upper)
    return np.asarray(np.clip((1.0 - genes) * low + genes * high, low, high))


def straight_way(start: Array, end: Array) -> Array:
    """Return postures (m, n) [rad] on the straight line between two, some 0.1 rad apart."""
    steps = int(np.ceil(np.max(np.abs(end - start)) / _LOOK_EVERY)) + 1
    return np.linspace(start, end, steps + 1)


@dataclass(frozen=True, eq=False)
class ViaPointGenome:
    """Motions through K via points, as the robot's own interpolator runs them (section 3.3, eq. 6).

    Genes are the via points' coordinates, point by point, then one speed for each joint: K n + n
    numbers.
    """

    #: joint limits of the plan; via points reach from one end of a range to the other
    limits: JointLimits
    n_via: int  #: K, without home
    fly: float = 0.5  #: how far corners are rounded, 0 to 1
    #: share of a joint's velocity limit, above 0, that gene 0 means; gene 1 means 1
    slowest: float = 0.3
    #: share of each joint's range, about its middle, that via points lie in
    range_share: float = 1.0
    #: posture (n,) [rad] within the limits where the motion begins and ends; None: it leads from
    #: the first via point to the last
    home: Array | None = None
    #: clearance that the straight ways between the points of a first population keep; None: its
    #: points are uniform in the range, as the paper's
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

    def motions(self, genes: Array) -> Sequence[Motion | PlannerError]:
        """Plan each row of genes (m, n_genes), all together and in this process.

        The solver can take its process with it: what must not die calls this in a child.
        """
        points, speed = self.decode(genes)
        return plan_chunk(list(points), speed, self.limits, self.fly)

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

    def recorded(self, genes: Array) -> dict[str, Any]:
        """Return via points and speeds of genes (n_genes,), for the record."""
        points, speed = (each[0] for each in self.decode(genes))
        return {"via_points": points, "speed": speed, "fly": self.fly}

    def _redraw(
        self,
        random: np.random.Generator,
        checker: CollisionChecker,
        coordinates: Array,
        before: Array | None,
        after: Array | None,
    ) -> Array:
        """Draw points anew, in place (m, n), until the ways before and after them are free."""
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
            starts = np.cumsum([0, *(len(way) for way in segments[:-1])])
            free = np.logical_and.reduceat(checker.clear(np.concatenate(segments)), starts)
            blocked = blocked[~free]
            if len(blocked) == 0:
                break
        return self._points(coordinates)

    def _points(self, coordinates: Array) -> Array:
        """Return the via points [rad] that coordinates (..., n) from 0 to 1 mean."""
        lower, upper = self.limits.lower, self.limits.upper
        margin = 0.5 * (1.0 - self.range_share) * (upper - lower)
        return between(lower + margin, upper - margin, coordinates)


@dataclass(frozen=True, eq=False)
class SineGenome:
    """Sums of W sines for each joint, eq. 8, with a ramp at both ends or, as in the paper, without.

    Genes are the amplitudes, joint by joint, then the frequencies: 2 n W numbers. Amplitudes
    reach from -q_max / W to q_max / W, so that the sines stay inside the range together; q_max is
    the room about the offset on its narrower side. A negative one turns its sine's phase by 180
    degrees. Velocity and jerk, and with a ramp acceleration too, are not bounded by the genes and
    have to be checked (appendix; Calafiore et al., 2001).

    Raises:
        DesignError: an offset outside the limits, or a slowest frequency above the fastest.
    """

    limits: JointLimits  #: joint limits
    length: float  #: of the whole motion [s]
    harmonics: int = 3  #: W
    #: time over which the sines grow and fade [s]; with 0 the motion starts at full speed, and no
    #: controller can execute it
    ramp: float = 0.0
    #: posture (n,) [rad] about which the joints swing, and where a motion with a ramp begins and
    #: ends; None: the middle of each range
    offset: Array | None = None
    #: frequencies that gene 0 means (n,) [rad/s]; None: one period in `length`
    slowest: Array | None = None
    #: frequencies that gene 1 means (n,) [rad/s]; None: the appendix's sqrt(qdd_max / q_max),
    #: which keeps the acceleration limit where there is no ramp
    fastest: Array | None = None

    def __post_init__(self) -> None:
        for name in ("offset", "slowest", "fastest"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, read_only(getattr(self, name)))
        try:
            harmonic_bounds(self.limits, self.centre, self.harmonics)
        except InvalidSetting as error:
            raise DesignError(error.name, error.value, error.valid) from error
        slowest, fastest = self.frequency_range
        if not np.all((slowest > 0.0) & (slowest <= fastest) & (fastest < np.inf)):
            raise DesignError(
                "slowest", slowest.tolist(), f"above 0 and at most fastest = {fastest.tolist()}"
            )

    @property
    def n_genes(self) -> int:
        """Number of amplitudes, n W, and as many frequencies."""
        return 2 * self.limits.n_joints * self.harmonics

    @property
    def centre(self) -> Array:
        """Posture (n,) [rad] about which the joints swing."""
        if self.offset is None:
            return (self.limits.lower + self.limits.upper) / 2.0
        return self.offset

    @property
    def frequency_range(self) -> tuple[Array, Array]:
        """Slowest and fastest frequencies, (n,) each [rad/s]."""
        slowest, fastest = self.slowest, self.fastest
        if slowest is None:
            slowest = np.full(self.limits.n_joints, 2.0 * np.pi / self.length)
        if fastest is None:
            fastest = harmonic_bounds(self.limits, self.centre, self.harmonics).frequency
        return slowest, fastest

    def decode(self, genes: ArrayLike) -> tuple[Array, Array]:
        """Return amplitudes [rad] and frequencies [rad/s], (m, n, W) each."""
        rows = np.atleast_2d(genes)
        shares = rows.reshape(len(rows), 2, self.limits.n_joints, self.harmonics)
        largest = harmonic_bounds(self.limits, self.centre, self.harmonics).amplitude[:, None]
        slowest, fastest = (rate[:, None] for rate in self.frequency_range)
        return between(-largest, largest, shares[:, 0]), between(slowest, fastest, shares[:, 1])

    def motions(self, genes: Array) -> Sequence[Motion | PlannerError]:
        """Return the series of each row of genes (m, n_genes)."""
        return [
            FourierSeries(self.centre, amplitude, frequency, self.length, self.ramp)
            for amplitude, frequency in zip(*self.decode(genes), strict=True)
        ]

    def sample(self, random: np.random.Generator, count: int) -> Array:
        """Draw a first population (count, n_genes), uniform."""
        return random.random((count, self.n_genes))

    def recorded(self, genes: Array) -> dict[str, Any]:  # noqa: ARG002  the series says it all
        """Return nothing: a sum of sines was planned from nothing else."""
        return {}
