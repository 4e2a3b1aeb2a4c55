"""What a search knows of the motions it tried: two measures, and what they break."""

from __future__ import annotations

from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

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
    def usable(self) -> NDArray[np.bool_]:
        """Which motions keep every constraint and excite every parameter, (m,)."""
        return self.feasible & np.isfinite(self.log10_det) & np.isfinite(self.coupling_index)

    def take(self, index: int) -> Self:
        """Return the scores of one motion, m = 1."""
        return type(self)(*(values[index : index + 1] for values in self))

    @property
    def rows(self) -> Array:
        """Return the same as one array, (m, ROW)."""
        return np.column_stack(self)

    @classmethod
    def feasible_ones(cls, log10_det: Array, coupling_index: Array, duration: Array) -> Self:
        """Return the scores of motions (m,) that keep every constraint."""
        return cls(log10_det, coupling_index, duration, np.zeros((len(duration), len(KINDS))))

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
