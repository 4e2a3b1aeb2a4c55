"""The motions between which a choice is free: none of them is better in both measures.

Whoever wants a larger determinant has to pay in coupling, and the other way round. The front of
everything that was ever scored shows what is to be had, and its knee is the default choice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from identification.excitation.searches.scale import Scale

if TYPE_CHECKING:
    from identification.excitation.searches.problem import Scores

Array = NDArray[np.float64]

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

    def merge(self, other: Self) -> Self:
        """Return the front of the motions of both."""
        return type(self)(
            np.concatenate((self.genes, other.genes)),
            np.concatenate((self.log10_det, other.log10_det)),
            np.concatenate((self.coupling_index, other.coupling_index)),
            np.concatenate((self.duration, other.duration)),
        )._unbeaten()

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
        part = self._worthwhile(scale)
        height = _above_chord(self.coupling_index[part], self.log10_det[part])
        highest = part[height >= height.max() - _ALIKE]
        if scale is None or len(highest) == 1:
            return int(highest[0])
        balanced = scale.fitness(self.log10_det[highest], self.coupling_index[highest], (0.5, 0.5))
        return int(highest[np.argmax(balanced)])

    def _worthwhile(self, scale: Scale | None) -> NDArray[np.intp]:
        """Return indices of the motions that beat the median random one, of all if none does."""
        everything = np.arange(len(self))
        if scale is None:
            return everything
        size, decoupling = scale.gains(self.log10_det, self.coupling_index)
        better = np.flatnonzero((size > 0.0) & (decoupling > 0.0))
        return better if len(better) else everything

    def _selected(self, rows: NDArray[np.intp]) -> Self:
        return type(self)(
            self.genes[rows], self.log10_det[rows], self.coupling_index[rows], self.duration[rows]
        )

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
