"""Scores of motions, what a step in them is worth, and the best compromises between them."""

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
"""Numbers in a row of scores: `CRITERIA`, a duration, one excess for each of `KINDS`."""


class Scores(NamedTuple):
    """Scores of m motions. `len` is that of a tuple: there are `len(scores.duration)` motions."""

    measures: Array  #: (m, d) each of `CRITERIA`; the worst without excitation or without a motion
    duration: Array  #: (m,) [s]; nan where there is no motion
    #: (m, n_kinds) largest excess of each of `KINDS`, 0 where it is satisfied; inf of the first
    #: one, "planning", without a motion: anything that moves is nearer to feasible
    excess: Array

    def measure(self, name: str) -> Array:
        """Return one of `CRITERIA` (m,)."""
        return self.measures[:, _NAMES.index(name)]

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """Which motions keep every constraint, (m,)."""
        met: NDArray[np.bool_] = np.all(self.excess == 0.0, axis=1)
        return met

    @property
    def exciting(self) -> NDArray[np.bool_]:
        """Which motions excite every parameter, (m,)."""
        return _finite(self.measures)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which motions keep every constraint and excite every parameter, (m,)."""
        return self.feasible & self.exciting

    def take(self, index: int) -> Self:
        """Return the scores of one motion, m = 1."""
        return type(self)(*(values[index : index + 1] for values in self))

    @property
    def rows(self) -> Array:
        """Return the same as one array, (m, ROW)."""
        return np.column_stack(self)

    @classmethod
    def of_rows(cls, rows: Array) -> Self:
        """Return scores of what `rows` gave, (m, ROW)."""
        return cls(rows[:, :_MEASURES], rows[:, _MEASURES], rows[:, _MEASURES + 1 :])


def _finite(measures: Array) -> NDArray[np.bool_]:
    finite: NDArray[np.bool_] = np.all(np.isfinite(measures), axis=-1)
    return finite


def unplanned() -> Array:
    """Return the row (ROW,) of genes for which there is no motion."""
    excess = np.where(np.array(KINDS) == "planning", np.inf, 0.0)
    return np.concatenate((-SENSE * np.inf, [np.nan], excess))


SAMPLE_COUNT: Final = 200
"""How many random motions to draw for a scale."""

# Fewer feasible motions than this tell little of a spread; all motions are used then, feasible
# or not: what a step is worth is a matter of the arm rather than of its surroundings.
_FEWEST_FEASIBLE: Final = 20
_FEWEST: Final = 2


class Scale(NamedTuple):
    """What a step in each of `CRITERIA` is worth: its spread over random motions.

    Eq. 7 adds two terms of different size (0.7 of the first is about 75 on a six-axis arm, 0.3 of
    the second about 5), so that its weights decide nothing. Here each measure is counted from its
    median over random motions of the same genome, in units of their interquartile range: with
    equal weights all matter alike. Other units of the parameters, or another normalisation by N,
    add a constant to log10 det, which drops out.
    """

    centre: tuple[float, ...]  #: medians (d,)
    spread: tuple[float, ...]  #: interquartile ranges (d,)

    @classmethod
    def of(cls, scores: Scores) -> Self:
        """Measure the scale on scores of random motions, some `SAMPLE_COUNT` of them.

        Raises:
            DesignError: fewer than two different motions that excite all parameters.
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
        """Return measures (..., d) above those of the median random motion, in spreads."""
        gains: Array = SENSE * (np.asarray(measures) - self.centre) / self.spread
        return gains

    def fitness(self, measures: ArrayLike, weights: tuple[float, ...]) -> Array:
        """Return the balanced fitness (...) of measures (..., d), with weights (d,).

        The larger the better; -inf for a motion that leaves a parameter without excitation.
        """
        given = np.asarray(measures, dtype=np.float64)
        judged = _finite(given)
        gains = self.gains(np.where(judged[..., None], given, 0.0))
        total = sum(weight * gains[..., k] for k, weight in enumerate(weights))
        return np.where(judged, total, -np.inf)


# Heights of a knee that differ by less are alike (they lie between -1 and 1).
_ALIKE: Final = 1e-12


@dataclass(frozen=True, eq=False)
class Front:
    """The k motions that no other one beats in all of `CRITERIA`, by rising last measure (I_c).

    Motions that are alike in every measure are one: the shortest, then the one whose genes come
    first. It is therefore a function of the set of motions alone: neither their order nor their
    way into it, all at once or by parts that are merged, changes anything.
    """

    genes: Array  #: (k, n_genes), within [0, 1]
    measures: Array  #: (k, d)
    duration: Array  #: (k,) [s]

    @classmethod
    def empty(cls, n_genes: int) -> Self:
        """Return the front of nothing."""
        return cls(np.empty((0, n_genes)), np.empty((0, _MEASURES)), np.empty(0))

    @classmethod
    def of(cls, genes: Array, scores: Scores) -> Self:
        """Return the front of motions with `genes` (m, n_genes).

        Left out are those that break a constraint or leave a parameter without excitation.
        """
        good = scores.usable
        return cls(genes[good], scores.measures[good], scores.duration[good])._unbeaten()

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
        return type(self)(*map(np.concatenate, columns))._unbeaten()

    def knee(self, scale: Scale | None = None) -> int:
        """Return the index of the motion where each measure begins to cost much of the others.

        It is the one farthest beyond the plane through the ends (Das 1999, "On characterizing the
        knee of the Pareto curve based on normal-boundary intersection"; the chord, of two
        measures), all measured from end to end. An end that nobody would choose, such as a motion
        that hardly excites anything and is a trifle less coupled for it, must not decide: with
        `scale` only the part of the front counts that beats the median random motion in all
        measures, provided any does. Where no motion lies beyond (one or two of them, or a hollow
        front) it is the end with the better balanced fitness; without `scale`, the least coupled.

        Raises:
            ValueError: the front is empty.
        """
        if len(self) == 0:
            raise ValueError("an empty front has no knee")
        part = np.arange(len(self))
        if scale is not None:
            better = np.flatnonzero(np.all(scale.gains(self.measures) > 0.0, axis=1))
            part = better if len(better) else part
        values = self.measures[part]
        span = np.ptp(values, axis=0)
        height = (values - values.min(axis=0)) / np.where(span > 0.0, span, 1.0) @ SENSE
        highest = part[height >= height.max() - _ALIKE]
        if scale is None or len(highest) == 1:
            return int(highest[0])
        balanced = scale.fitness(self.measures[highest], (1.0 / _MEASURES,) * _MEASURES)
        return int(highest[np.argmax(balanced)])

    def _unbeaten(self) -> Self:
        cost = -SENSE * self.measures
        left = np.lexsort((*self.genes.T[::-1], self.duration, *cost.T))
        found = []
        while len(left):  # the first in this order is beaten by none of the others
            found.append(left[0])
            left = left[np.any(cost[left] < cost[left[0]], axis=1)]
        rows = np.array(found, dtype=np.intp)
        return type(self)(*(column[rows] for column in vars(self).values()))
