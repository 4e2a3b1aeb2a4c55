"""Genomes: motions through via points and sums of sines, encoded as numbers from 0 to 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arrays import Array
from identification.excitation.collision import CollisionChecker
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

Motion: TypeAlias = PiecewiseCubic | FourierSeries

_POINTS_PER_CHECK: Final = 48
"""Motions planned together: the arrays of more do not fit the processor's caches (294 motions of 50
legs at once took twice the time)."""
# Spacing [rad] of the checked postures of a straight path.
_PATH_SPACING: Final = 0.1
# Draws of one via point before the last one is used even if it collides.
_MAX_DRAWS: Final = 50
# Of the postures of a path every so many are looked at for contacts, in turn.
_POSTURE_STRIDES: Final = (16, 4, 1)


def _interpolated(lower: ArrayLike, upper: ArrayLike, genes: Array) -> Array:
    """Return values from exactly `lower` for gene 0 to exactly `upper` for gene 1."""
    low = np.asarray(lower)
    high = np.asarray(upper)
    return np.asarray(np.clip((1.0 - genes) * low + genes * high, low, high))


def straight_path(start: Array, end: Array) -> Array:
    """Return postures (m, n) [rad] on the straight line between two, at most 0.1 rad apart."""
    steps = int(np.ceil(np.max(np.abs(end - start)) / _PATH_SPACING)) + 1
    return np.linspace(start, end, steps + 1)


def _are_clear(checker: CollisionChecker, paths: Sequence[Array]) -> NDArray[np.bool_]:
    """Return which paths (m, n) are clear; most contacts show in a few of their postures."""
    clear = np.ones(len(paths), dtype=np.bool_)
    for stride in _POSTURE_STRIDES:
        unchecked = np.flatnonzero(clear)
        some = [paths[k][::stride] for k in unchecked.tolist()]
        if some:
            numbers = np.repeat(np.arange(len(some)), [len(path) for path in some])
            clear[unchecked] = checker.clear(np.concatenate(some), numbers)
    return clear


@dataclass(frozen=True, eq=False)
class ViaPointGenome:
    """Motions through K via points as the robot's interpolator runs them (section 3.3, eq. 6).

    Genes: coordinates of the via points, point by point, then one speed per joint; K n + n in all.
    """

    limits: JointLimits  #: joint limits of the plan
    n_via: int  #: K, without home
    fly: float = 0.5  #: corner rounding, 0 to 1
    slowest: float = 0.3  #: speed of gene 0, fraction of a joint's velocity limit; gene 1 means 1
    range_share: float = 1.0  #: central fraction of each joint's range that via points lie in
    #: posture (n,) [rad] where the motion begins and ends; None: from first to last via point
    home: Array | None = None
    #: clearance of the straight paths between the points of a first population; None: uniform
    #: points as in the paper
    checker: CollisionChecker | None = None

    @property
    def n_genes(self) -> int:
        """Number of genes, K n + n."""
        return (self.n_via + 1) * self.limits.n_joints

    @property
    def n_point_genes(self) -> int:
        """Number of the first genes, coordinates of via points, K n."""
        return self.n_via * self.limits.n_joints

    def point_of(self, genes: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the indices of the via points, home included, of genes that are coordinates."""
        return genes // self.limits.n_joints + (self.home is not None)

    def decode(self, genes: ArrayLike) -> tuple[Array, Array]:
        """Return via points (m, n_points, n) [rad], home included, and speeds (m, n)."""
        rows = np.atleast_2d(genes)
        coordinates, rates = np.split(rows, [self.n_point_genes], axis=1)
        points = self._points(coordinates.reshape(len(rows), self.n_via, self.limits.n_joints))
        if self.home is not None:
            home = np.broadcast_to(self.home, (len(rows), 1, self.limits.n_joints))
            points = np.concatenate((home, points, home), axis=1)
        return points, _interpolated(self.slowest, 1.0, rates)

    def motions(self, genes: Array) -> Sequence[Motion | PlannerError]:
        """Plan each row of genes (m, n_genes) in this process, which the solver can crash.

        Errors are in place of their motion. It does not depend on the other rows, to the last bit.
        """
        points, speed = self.decode(genes)
        return self.planned(list(points), speed)

    def planned(self, points: Sequence[Array], speed: Array) -> list[PiecewiseCubic | PlannerError]:
        """Plan motions through points (m_k, n) [rad] at speeds (k, n); see :meth:`motions`."""
        motions = list[PiecewiseCubic | PlannerError]()
        for first in range(0, len(points), _POINTS_PER_CHECK):
            chunk = slice(first, first + _POINTS_PER_CHECK)
            motions += plan_chunk(points[chunk], speed[chunk], self.limits, self.fly)
        return motions

    def sample(self, random: np.random.Generator, count: int) -> Array:
        """Draw a first population (count, n_genes), uniform or with collision-free paths."""
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

    def contracted(self, genes: Array, reach: Sequence[float]) -> Array:
        """Return genes (m, n_genes) with via points nearer to home, or the middle without one.

        The rows have the fractions `reach` of their distance from there in turn.
        """
        n = self.limits.n_joints
        share = np.resize(np.asarray(reach, dtype=np.float64), len(genes))[:, None, None]
        centre = np.full(n, 0.5)
        if self.home is not None:
            lower, upper = self._points(np.array([np.zeros(n), np.ones(n)]))
            centre = np.clip((self.home - lower) / (upper - lower), 0.0, 1.0)
        coordinates = genes[:, : self.n_via * n].reshape(len(genes), self.n_via, n)
        nearer = share * coordinates + (1.0 - share) * centre
        return np.column_stack((nearer.reshape(len(genes), -1), genes[:, self.n_via * n :]))

    def source(self, genes: Array) -> dict[str, Any]:
        """Return the fields of `Excitation` that genes (n_genes,) determine."""
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
        """Redraw points (m, n) in place until the paths before and after them are free."""
        blocked = np.arange(len(coordinates))
        for draw in range(_MAX_DRAWS):
            if draw > 0:
                coordinates[blocked] = random.random((len(blocked), self.limits.n_joints))
            points = self._points(coordinates[blocked])
            segments = [
                np.concatenate(
                    (
                        point[None] if before is None else straight_path(before[index], point),
                        point[None] if after is None else straight_path(point, after),
                    )
                )
                for index, point in zip(blocked.tolist(), points, strict=True)
            ]
            blocked = blocked[~_are_clear(checker, segments)]
            if len(blocked) == 0:
                break
        return self._points(coordinates)

    def _points(self, coordinates: Array) -> Array:
        """Return via points [rad] for coordinates (..., n) from 0 to 1."""
        lower = self.limits.lower
        upper = self.limits.upper
        margin = 0.5 * (1.0 - self.range_share) * (upper - lower)
        return _interpolated(lower + margin, upper - margin, coordinates)


@dataclass(frozen=True, eq=False)
class SineGenome:
    """Sums of W sines per joint (eq. 8), with a ramp at both ends or, as in the paper, without.

    Genes: amplitudes, joint by joint, then frequencies; 2 n W in all. Amplitudes are within
    ± q_max / W (q_max: distance from the offset to the nearer limit). Velocity and jerk, and with
    a ramp acceleration, are not bounded and must be checked (appendix; Calafiore et al., 2001).

    Raises:
        DesignError: an offset outside the limits, or a slowest frequency above the fastest.
    """

    limits: JointLimits  #: joint limits
    length: float  #: duration of the motion [s]
    harmonics: int = 3  #: W
    #: duration of fade-in and fade-out [s]; with 0 the motion starts at speed and cannot be run
    ramp: float = 0.0
    #: mean posture (n,) [rad], start and end of a motion with a ramp; None: middle of each range
    offset: Array | None = None
    slowest: Array | None = None  #: frequencies of gene 0 (n,) [rad/s]; None: 2 pi / length
    #: frequencies of gene 1 (n,) [rad/s]; None: the appendix's sqrt(qdd_max / q_max), which
    #: satisfies the acceleration limit without a ramp
    fastest: Array | None = None

    def __post_init__(self) -> None:
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
        """Number of genes, 2 n W."""
        return 2 * self.limits.n_joints * self.harmonics

    @property
    def centre(self) -> Array:
        """Mean posture (n,) [rad]."""
        if self.offset is None:
            return (self.limits.lower + self.limits.upper) / 2.0
        return self.offset

    @property
    def frequency_range(self) -> tuple[Array, Array]:
        """Lowest and highest frequencies, (n,) each [rad/s]."""
        slowest = self.slowest
        fastest = self.fastest
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
        amplitude = _interpolated(-largest, largest, shares[:, 0])
        return amplitude, _interpolated(slowest, fastest, shares[:, 1])

    def motions(self, genes: Array) -> Sequence[Motion | PlannerError]:
        """Return the series of each row of genes (m, n_genes)."""
        return [
            FourierSeries(self.centre, amplitude, frequency, self.length, self.ramp)
            for amplitude, frequency in zip(*self.decode(genes), strict=True)
        ]

    def sample(self, random: np.random.Generator, count: int) -> Array:
        """Draw a uniform first population (count, n_genes)."""
        return random.random((count, self.n_genes))

    def source(self, genes: Array) -> dict[str, Any]:  # noqa: ARG002
        """Return the fields of `Excitation` that genes determine: none, the series has all."""
        return {}


Genome: TypeAlias = ViaPointGenome | SineGenome
