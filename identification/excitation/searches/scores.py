"""Scores of motions, their scale, and their Pareto front."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.excitation.criteria import CRITERIA, SENSE
from identification.excitation.errors import DesignError
from identification.excitation.violation import KINDS

Array = NDArray[np.float64]

_NAMES: Final = tuple(CRITERIA)
_MEASURES: Final = len(_NAMES)

ROW: Final = _MEASURES + 1 + len(KINDS)
"""Length of a row of scores: `CRITERIA`, duration, one excess for each of `KINDS`."""


class Scores(NamedTuple):
    """Scores of m motions."""

    measures: Array  #: (m, d) `CRITERIA`; the worst values if unplannable or not exciting
    duration: Array  #: (m,) [s]; nan if unplannable
    #: (m, n_kinds) largest excess of each of `KINDS`, 0 if satisfied; inf for "planning" if
    #: unplannable
    excess: Array

    def measure(self, name: str) -> Array:
        """Return one of `CRITERIA` (m,)."""
        return self.measures[:, _NAMES.index(name)]

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """Which motions satisfy all constraints, (m,)."""
        return np.asarray(np.all(self.excess == 0.0, axis=1))

    @property
    def exciting(self) -> NDArray[np.bool_]:
        """Which motions excite every parameter, (m,)."""
        return _finite(self.measures)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which motions satisfy all constraints and excite every parameter, (m,)."""
        return self.feasible & self.exciting

    def take(self, index: int) -> Self:
        """Return the scores of one motion, m = 1."""
        return type(self)(*(values[index : index + 1] for values in self))

    @property
    def rows(self) -> Array:
        """The scores as one array, (m, ROW)."""
        return np.column_stack(self)

    @classmethod
    def of_rows(cls, rows: Array) -> Self:
        """Return the scores in an array (m, ROW)."""
        return cls(rows[:, :_MEASURES], rows[:, _MEASURES], rows[:, _MEASURES + 1 :])


def _finite(measures: Array) -> NDArray[np.bool_]:
    return np.asarray(np.all(np.isfinite(measures), axis=-1))


def unplanned() -> Array:
    """Return the row (ROW,) of an unplannable motion."""
    excess = np.where(np.array(KINDS) == "planning", np.inf, 0.0)
    return np.concatenate((-SENSE * np.inf, [np.nan], excess))


SAMPLE_COUNT: Final = 200
"""Number of random motions for a scale."""

# With fewer feasible motions than this the scale is that of all motions.
_FEWEST_FEASIBLE: Final = 20
_FEWEST: Final = 2


class Scale(NamedTuple):
    """Centre and spread of each of `CRITERIA` over random motions.

    The two terms of eq. 7 differ in size (about 75 and 5 on a six-axis arm), so that its weights
    have little effect. Here each measure counts from its median over random motions of the same
    genome, in units of their interquartile range.
    """

    centre: tuple[float, ...]  #: medians (d,)
    spread: tuple[float, ...]  #: interquartile ranges (d,)

    @classmethod
    def of(cls, scores: Scores) -> Self:
        """Return the scale of random motions, `SAMPLE_COUNT` of them.

        Raises:
            DesignError: fewer than two different motions excite all parameters.
        """
        chosen = scores.usable
        if np.count_nonzero(chosen) < _FEWEST_FEASIBLE:
            chosen = scores.exciting
        if np.count_nonzero(chosen) >= _FEWEST:
            lower, median, upper = np.quantile(scores.measures[chosen], (0.25, 0.5, 0.75), axis=0)
            if np.all(upper > lower):
                return cls(tuple(median.tolist()), tuple((upper - lower).tolist()))
        raise DesignError(
            "random motions that excite all parameters",
            int(np.count_nonzero(chosen)),
            f"at least {_FEWEST} different ones",
        )

    def gains(self, measures: ArrayLike) -> Array:
        """Return the improvement of measures (..., d) over the median, in spreads."""
        return np.asarray(SENSE * (np.asarray(measures) - self.centre) / self.spread)

    def fitness(self, measures: ArrayLike, weights: tuple[float, ...]) -> Array:
        """Return the balanced fitness (...) of measures (..., d) with weights (d,).

        To be maximised; -inf for a motion that leaves a parameter without excitation.
        """
        values = np.asarray(measures, dtype=np.float64)
        finite = _finite(values)
        gains = self.gains(np.where(finite[..., None], values, 0.0))
        total = sum(weight * gains[..., k] for k, weight in enumerate(weights))
        return np.where(finite, total, -np.inf)


# Distances from the chord, between -1 and 1, that differ by less are equal.
_EQUAL: Final = 1e-12


@dataclass(frozen=True, eq=False)
class Front:
    """Pareto front: the k motions not dominated in `CRITERIA`, by rising last measure (I_c).

    Of motions with equal measures it has one: the shortest, then the one whose genes come first.
    So it does not depend on the order in which motions are added.
    """

    genes: Array  #: (k, n_genes), within [0, 1]
    measures: Array  #: (k, d)
    duration: Array  #: (k,) [s]

    @classmethod
    def empty(cls, n_genes: int) -> Self:
        """Return the front of no motions."""
        return cls(np.empty((0, n_genes)), np.empty((0, _MEASURES)), np.empty(0))

    @classmethod
    def of(cls, genes: Array, scores: Scores) -> Self:
        """Return the front of the usable motions among genes (m, n_genes)."""
        usable = scores.usable
        return cls(genes[usable], scores.measures[usable], scores.duration[usable])._nondominated()

    def __len__(self) -> int:
        return len(self.measures)

    def measure(self, name: str) -> Array:
        """Return one of `CRITERIA` (k,)."""
        return self.measures[:, _NAMES.index(name)]

    def scores(self, index: int) -> Scores:
        """Return the scores of one motion, m = 1."""
        one = slice(index, index + 1)
        return Scores(self.measures[one], self.duration[one], np.zeros((1, len(KINDS))))

    def merge(self, other: Self) -> Self:
        """Return the front of the motions of both."""
        columns = zip(vars(self).values(), vars(other).values(), strict=True)
        return type(self)(*map(np.concatenate, columns))._nondominated()

    def knee(self, scale: Scale | None = None) -> int:
        """Return the index of the knee of a non-empty front, farthest beyond the chord of its ends.

        Das 1999, "On characterizing the knee of the Pareto curve based on normal-boundary
        intersection"; measures relative to the ranges of the front. With `scale` only motions
        better than the median random motion in all measures count, if any. Of several the knee has
        the largest balanced fitness; without `scale` it is the first.
        """
        part = np.arange(len(self))
        if scale is not None:
            better = np.flatnonzero(np.all(scale.gains(self.measures) > 0.0, axis=1))
            part = better if len(better) else part
        values = self.measures[part]
        span = np.ptp(values, axis=0)
        height = (values - values.min(axis=0)) / np.where(span > 0.0, span, 1.0) @ SENSE
        highest = part[height >= height.max() - _EQUAL]
        if scale is None or len(highest) == 1:
            return int(highest[0])
        balanced = scale.fitness(self.measures[highest], (1.0 / _MEASURES,) * _MEASURES)
        return int(highest[np.argmax(balanced)])

    def _nondominated(self) -> Self:
        cost = -SENSE * self.measures
        left = np.lexsort((*self.genes.T[::-1], self.duration, *cost.T))
        found = []
        while len(left):  # no other one dominates the first in this order
            found.append(left[0])
            left = left[np.any(cost[left] < cost[left[0]], axis=1)]
        rows = np.array(found, dtype=np.intp)
        return type(self)(*(column[rows] for column in vars(self).values()))
