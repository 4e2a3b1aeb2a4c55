"""Change of a motion through via points with one of its points.

A via point belongs to two moves and three corners. The motion before them stays as it is, and that
after them is the same, only earlier or later. Hence these alone are planned, from rest to rest
between the points two before and two after. In the middle of the first and of the last of these
moves, which no corner reaches, they meet the whole motion.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from identification.excitation.genomes import Genome, ViaPointGenome
from planner import FourierSeries, PiecewiseCubic, PlannerError

Array = NDArray[np.float64]

_REACH: Final = 2  # points before and after one that the motion changes with it
_ROUNDING: Final = 1e-9  # of the duration, relative


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

        None if it has no via points, or its moves alone do not add up to its duration.
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
        apart = durations[len(moves) :] - 0.5 * (lengths[:-1] + lengths[1:])
        middles = 0.5 * lengths[0] + np.concatenate(([0.0], np.cumsum(apart)))
        duration = motion.duration
        if abs(middles[-1] + 0.5 * lengths[-1] - duration) > _ROUNDING * duration:
            return None
        return cls(motion, points, speed, lengths, middles)

    def changed(
        self, genome: ViaPointGenome, genes: Array, which: NDArray[np.intp], n_samples: int
    ) -> Iterator[Change | None]:
        """Yield the change of the motion with each row of genes (k, n_genes).

        In each row one gene of `which` (k,), a coordinate of a via point, differs from those of the
        motion. None for what cannot be planned.
        """
        points, _ = genome.decode(genes)
        moved = genome.point_of(which)
        first = np.maximum(moved - _REACH, 0)
        last = np.minimum(moved + _REACH, len(self.points) - 1)
        parts = genome.planned(
            [row[a : b + 1] for row, a, b in zip(points, first, last, strict=True)],
            np.tile(self.speed, (len(points), 1)),
        )
        planned = [
            None if isinstance(part, PlannerError) else self._part(part, point, a, b, n_samples)
            for part, point, a, b in zip(
                parts, moved.tolist(), first.tolist(), last.tolist(), strict=True
            )
        ]
        times = [part.time - part.later * (part.time >= part.leave) for part in planned if part]
        if not times:
            yield from (None for _ in planned)
            return
        around = np.array(self.motion.sample(np.concatenate(times)))
        begin = 0
        for part in planned:
            if part is None:
                yield None
                continue
            states = around[:, begin : begin + len(part.time)]
            begin += len(part.time)
            inside = slice(*np.searchsorted(part.time, (part.enter, part.leave)).tolist())
            states[:, inside] = part.motion.sample(part.time[inside] - part.begin)
            yield Change(part.samples, states, part.later)

    def _part(
        self, motion: PiecewiseCubic | FourierSeries, point: int, first: int, last: int, count: int
    ) -> _Part:
        """Return a part between two points, with one of them moved, of a motion of some samples."""
        begin = float(self.middles[first] - 0.5 * self.lengths[first])
        enter = float(self.middles[first]) if first == point - _REACH else 0.0
        leave = begin + motion.duration
        left = self.motion.duration
        if last == point + _REACH:
            leave -= 0.5 * float(self.lengths[last - 1])
            left = float(self.middles[last - 1])
        step = self.motion.duration / count
        samples = slice(math.floor(enter / step), min(math.ceil(left / step), count))
        cells = samples.stop - samples.start
        later = leave - left
        stretched = (cells * step + later) / cells
        time = samples.start * step + (np.arange(cells, dtype=np.float64) + 0.5) * stretched
        return _Part(motion, samples, time, begin, enter, leave, later)


class Change(NamedTuple):
    """Change of a sampled motion: each sample stays at its place between two via points."""

    samples: slice  #: that change; those after them are only later
    states: Array  #: of these (3, k, n)
    later: float  #: by how much the motion takes longer, all of it in these samples [s]


class _Part(NamedTuple):
    """Part of a changed motion, planned from rest to rest."""

    motion: PiecewiseCubic | FourierSeries
    samples: slice  # of the whole motion that change with it
    time: Array  # of these samples in the changed motion (k,) [s]
    begin: float  # of the part in it [s]
    enter: float  # from here on it is that of the part [s]
    leave: float  # to here [s]
    later: float  # by how much the rest of the motion is later [s]
