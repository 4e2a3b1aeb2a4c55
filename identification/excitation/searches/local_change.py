"""Change of a motion through via points with one of its points.

A via point belongs to two moves and three corners. The motion before them stays as it is, and that
after them is the same, only earlier or later. Hence these alone are planned, from rest to rest
between the points two before and two after. In the middle of the first and of the last of these
moves, which no corner reaches, they meet the whole motion.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.excitation.genomes import Genome, ViaPointGenome
from planner import FourierSeries, PiecewiseCubic, PlannerError

_CHANGED_NEIGHBOURS: Final = 2  # points before and after one that the motion changes with it
_DURATION_ROUNDING: Final = 1e-9  # of the duration, relative


@dataclass(frozen=True, eq=False)
class PlannedMoves:
    """A motion through via points, with the times of its moves."""

    motion: PiecewiseCubic
    points: Array  #: via points (m, n) [rad], both ends included
    speed: Array  #: fraction of each joint's velocity limit (n,)
    lengths: Array  #: of the moves from rest to rest (m - 1,) [s]
    middles: Array  #: when half of each of these is over (m - 1,) [s]

    @classmethod
    def of(
        cls, genome: Genome, genes: Array, motion: PiecewiseCubic | FourierSeries
    ) -> Self | None:
        """Return the moves of the motion of genes (n_genes,).

        None if it has no via points, a move without length, or moves that do not add up to its
        duration.
        """
        if not isinstance(genome, ViaPointGenome) or not isinstance(motion, PiecewiseCubic):
            return None
        (points,), (speed,) = genome.decode(genes)
        moves = [points[k : k + 2] for k in range(len(points) - 1)]
        pairs = [points[k : k + 3] for k in range(len(points) - 2)]
        planned = genome.planned([*moves, *pairs], np.tile(speed, (len(moves) + len(pairs), 1)))
        if any(isinstance(each, PlannerError) for each in planned):
            return None
        durations = np.array(
            [each.duration for each in planned if isinstance(each, PiecewiseCubic)]
        )
        lengths = durations[: len(moves)]
        if not np.all(lengths > 0.0):
            return None
        apart = durations[len(moves) :] - 0.5 * (lengths[:-1] + lengths[1:])
        middles = 0.5 * lengths[0] + np.concatenate(([0.0], np.cumsum(apart)))
        duration = motion.duration
        if abs(middles[-1] + 0.5 * lengths[-1] - duration) > _DURATION_ROUNDING * duration:
            return None
        return cls(motion, points, speed, lengths, middles)

    def changed(
        self, genome: ViaPointGenome, genes: Array, which: NDArray[np.intp]
    ) -> Iterator[LocalChange | None]:
        """Yield the change of the motion with each row of genes (k, n_genes).

        In each row one gene of `which` (k,), a coordinate of a via point, differs from those of the
        motion. None for what cannot be planned.
        """
        points, _ = genome.decode(genes)
        moved = genome.point_of(which)
        first = np.maximum(moved - _CHANGED_NEIGHBOURS, 0)
        last = np.minimum(moved + _CHANGED_NEIGHBOURS, len(self.points) - 1)
        parts = genome.planned(
            [row[a : b + 1] for row, a, b in zip(points, first, last, strict=True)],
            np.tile(self.speed, (len(points), 1)),
        )
        for part, point, a, b in zip(
            parts, moved.tolist(), first.tolist(), last.tolist(), strict=True
        ):
            if isinstance(part, PlannerError):
                yield None
                continue
            begin = float(self.middles[a] - 0.5 * self.lengths[a])
            enter = float(self.middles[a]) if a == point - _CHANGED_NEIGHBOURS else 0.0
            end = begin + part.duration
            left = self.motion.duration
            if b == point + _CHANGED_NEIGHBOURS:
                end -= 0.5 * float(self.lengths[b - 1])
                left = float(self.middles[b - 1])
            yield LocalChange(part, begin, enter, left, end - left)


class LocalChange(NamedTuple):
    """Change of a motion in a part of it; what follows is only later."""

    motion: PiecewiseCubic | FourierSeries  #: planned instead of the part, and of some before it
    begin: float  #: when that begins [s]
    enter: float  #: when the part begins [s]
    left: float  #: when it ended before the change [s]
    later: float  #: how much longer it takes [s]

    @property
    def length(self) -> float:
        """Duration of the part before the change [s]."""
        return self.left - self.enter

    def states(self, time: Array) -> Array:
        """Return position, velocity and acceleration (3, k, n) for times in the part (k,) [s].

        Each belongs to the changed motion at the same fraction of the part.
        """
        stretched = self.enter + (time - self.enter) * (1.0 + self.later / self.length)
        return np.array(self.motion.sample(stretched - self.begin))
