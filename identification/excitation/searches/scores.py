"""Scores of motions, what a step in them is worth, and the best compromises between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.excitation.errors import DesignError
from identification.excitation.violation import KINDS

Array = NDArray[np.float64]

_MEASURES: Final = 3

ROW: Final = _MEASURES + len(KINDS)
"""Numbers in a row of scores: two measures, a duration, one excess for each of `KINDS`."""


class Scores(NamedTuple):
    """Scores of m motions. `len` is that of a tuple: there are `len(scores.duration)` motions.

    Attributes:
        log10_det: (m,) log10 of det / N^p; -inf without excitation or without a motion.
        coupling_index: (m,) I_c; inf without excitation or without a motion.
        duration: (m,) [s]; nan where there is no motion.
        excess: (m, n_kinds) largest excess of each of `KINDS`, 0 where it is satisfied; inf of the
            first one, "planning", without a motion: anything that moves is nearer to feasible.
    """

    log10_det: Array
    coupling_index: Array
    duration: Array
    excess: Array

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """Which motions keep every constraint, (m,)."""
        met: NDArray[np.bool_] = np.all(self.excess == 0.0, axis=1)
        return met

    @property
    def exciting(self) -> NDArray[np.bool_]:
        """Which motions excite every parameter, (m,)."""
        excited: NDArray[np.bool_] = np.isfinite(self.log10_det) & np.isfinite(self.coupling_index)
        return excited

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
        return cls(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, _MEASURES:])


def unplanned() -> Array:
    """Return the row (ROW,) of genes for which there is no motion."""
    row = np.zeros(ROW)
    row[:_MEASURES] = -np.inf, np.inf, np.nan
    row[_MEASURES + KINDS.index("planning")] = np.inf
    return row


SAMPLE_COUNT: Final = 200
"""How many random motions to draw for a scale."""

# Fewer feasible motions than this tell little of a spread; all motions are used then, feasible
# or not: what a step is worth is a matter of the arm rather than of its surroundings.
_FEWEST_FEASIBLE: Final = 20
_FEWEST: Final = 2


class Scale(NamedTuple):
    """What a step in either measure is worth: its spread over random motions.

    Eq. 7 adds two terms of different size (0.7 of the first is about 75 on a six-axis arm, 0.3 of
    the second about 5), so that its weights decide nothing. Here either measure is counted from its
    median over random motions of the same genome, in units of their interquartile range: with
    equal weights both matter alike. Other units of the parameters, or another normalisation by N,
    add a constant to log10 det, which drops out.

    Attributes:
        log10_det_centre, log10_det_spread: of log10 det (eq. 9).
        coupling_index_centre, coupling_index_spread: of I_c (eq. 5).
    """

    log10_det_centre: float
    log10_det_spread: float
    coupling_index_centre: float
    coupling_index_spread: float

    @classmethod
    def of(cls, scores: Scores) -> Self:
        """Measure the scale on scores of random motions, some `SAMPLE_COUNT` of them.

        Raises:
            DesignError: fewer than two different motions that excite all parameters.
        """
        log10_det, coupling_index = scores.log10_det, scores.coupling_index
        judged = scores.exciting
        feasible = judged & scores.feasible
        chosen = feasible if np.count_nonzero(feasible) >= _FEWEST_FEASIBLE else judged
        if np.count_nonzero(chosen) >= _FEWEST:
            scale = cls(*_spread(log10_det[chosen]), *_spread(coupling_index[chosen]))
            if scale.log10_det_spread > 0.0 and scale.coupling_index_spread > 0.0:
                return scale
        raise DesignError(
            "random motions that excite all parameters",
            int(np.count_nonzero(chosen)),
            f"at least {_FEWEST} different ones",
        )

    def gains(self, log10_det: ArrayLike, coupling_index: ArrayLike) -> tuple[Array, Array]:
        """Return how much better than the median random motion either measure is, in spreads."""
        return (
            (np.asarray(log10_det) - self.log10_det_centre) / self.log10_det_spread,
            (self.coupling_index_centre - np.asarray(coupling_index)) / self.coupling_index_spread,
        )

    def fitness(
        self, log10_det: ArrayLike, coupling_index: ArrayLike, weights: tuple[float, float]
    ) -> Array:
        """Return the balanced fitness, the larger the better.

        Args:
            log10_det: of the motions, (m,).
            coupling_index: of the same motions, (m,).
            weights: lambda_1 of log10 det and lambda_2 of the coupling index.

        Returns:
            (m,); -inf for a motion that leaves a parameter without excitation.
        """
        judged = np.isfinite(log10_det) & np.isfinite(coupling_index)
        size, decoupling = self.gains(
            np.where(judged, log10_det, 0.0), np.where(judged, coupling_index, 0.0)
        )
        return np.where(judged, weights[0] * size + weights[1] * decoupling, -np.inf)


def _spread(values: Array) -> tuple[float, float]:
    """Return median and interquartile range."""
    lower, median, upper = np.quantile(values, (0.25, 0.5, 0.75))
    return float(median), float(upper - lower)


# Distances from the chord that differ by less are alike (they lie between -1 and 1).
_ALIKE = 1e-12


@dataclass(frozen=True, eq=False)
class Front:
    """Feasible motions, none better than another in both measures, by rising coupling index.

    log10 det rises with it, both strictly. Among motions alike in both measures it keeps the
    shortest, then the one whose genes come first. It is therefore a function of the set of
    motions alone: neither their order nor their way into it, all at once or by parts that are
    merged, changes anything.

    Attributes:
        genes: (k, n_genes), within [0, 1].
        log10_det: (k,), eq. 9, the larger the better.
        coupling_index: (k,), I_c of eq. 5, the smaller the better.
        duration: (k,) [s].
    """

    genes: Array
    log10_det: Array
    coupling_index: Array
    duration: Array

    @classmethod
    def empty(cls, n_genes: int) -> Self:
        """Return the front of nothing."""
        nothing = np.empty(0)
        return cls(np.empty((0, n_genes)), nothing, nothing, nothing)

    @classmethod
    def of(cls, genes: Array, scores: Scores) -> Self:
        """Return the front of motions with `genes` (m, n_genes).

        Left out are those that break a constraint or leave a parameter without excitation.
        """
        everything = cls(genes, scores.log10_det, scores.coupling_index, scores.duration)
        return everything._selected(np.flatnonzero(scores.usable))._unbeaten()

    def __len__(self) -> int:
        return len(self.log10_det)

    def scores(self, index: int) -> Scores:
        """Return the scores of one motion, m = 1."""
        one = slice(index, index + 1)
        excess = np.zeros((1, len(KINDS)))
        return Scores(self.log10_det[one], self.coupling_index[one], self.duration[one], excess)

    def merge(self, other: Self) -> Self:
        """Return the front of the motions of both."""
        columns = zip(vars(self).values(), vars(other).values(), strict=True)
        return type(self)(*map(np.concatenate, columns))._unbeaten()

    def knee(self, scale: Scale | None = None) -> int:
        """Return the index of the motion where either measure begins to cost much of the other.

        It is the one farthest above the chord between the two ends (Das 1999, "On characterizing
        the knee of the Pareto curve based on normal-boundary intersection"), both measures
        measured from end to end. An end that nobody would choose, such as a motion that hardly
        excites anything and is a trifle less coupled for it, must not decide: with `scale` only
        the part of the front counts that beats the median random motion in both measures,
        provided any does. Where no motion lies above the chord (one or two of them, or a hollow
        front) it is the end with the better balanced fitness; without `scale`, the least coupled.

        Raises:
            ValueError: the front is empty.
        """
        if len(self) == 0:
            raise ValueError("an empty front has no knee")
        part = np.arange(len(self))
        if scale is not None:
            size, decoupling = scale.gains(self.log10_det, self.coupling_index)
            better = np.flatnonzero((size > 0.0) & (decoupling > 0.0))
            part = better if len(better) else part
        height = _above_chord(self.coupling_index[part], self.log10_det[part])
        highest = part[height >= height.max() - _ALIKE]
        if scale is None or len(highest) == 1:
            return int(highest[0])
        balanced = scale.fitness(self.log10_det[highest], self.coupling_index[highest], (0.5, 0.5))
        return int(highest[np.argmax(balanced)])

    def _selected(self, rows: NDArray[np.intp]) -> Self:
        return type(self)(*(column[rows] for column in vars(self).values()))

    def _unbeaten(self) -> Self:
        """Leave out whatever is beaten, in O(k log k)."""
        order = np.lexsort((self.duration, -self.log10_det, self.coupling_index))
        best = np.maximum.accumulate(np.concatenate(([-np.inf], self.log10_det[order])))
        heads = np.flatnonzero(self.log10_det[order] > best[:-1])
        leader = order[np.repeat(heads, np.diff(heads, append=len(order)))]
        alike = np.all(
            [
                values[order] == values[leader]
                for values in (self.coupling_index, self.log10_det, self.duration)
            ],
            axis=0,
        )
        return self._selected(_first_of_each(leader[alike], order[alike], self.genes))


def _first_of_each(
    leader: NDArray[np.intp], rows: NDArray[np.intp], genes: Array
) -> NDArray[np.intp]:
    """Return of the rows that follow each leader the one whose genes come first, in their order."""
    group = np.cumsum(np.diff(leader, prepend=-1) != 0)
    order = np.lexsort((*genes[rows].T[::-1], group))
    _, first = np.unique(group[order], return_index=True)
    return rows[order][first]


def _above_chord(x: Array, y: Array) -> Array:
    """Return heights over the chord from first to last, x and y measured from end to end (k,).

    In these coordinates the distance from the chord is the height by a constant factor.
    """
    if len(x) < 2:
        return np.zeros(len(x))
    along = (x - x[0]) / (x[-1] - x[0])
    height: Array = (y - y[0]) / (y[-1] - y[0]) - along
    return height
