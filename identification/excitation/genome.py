"""What a search turns its numbers into: motions."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner import FourierSeries, PiecewiseCubic, PlannerError

Array = NDArray[np.float64]


class Genome(Protocol):
    """A family of motions, each given by `n_genes` numbers from 0 to 1."""

    @property
    def n_genes(self) -> int:
        """How many numbers tell a motion."""
        ...

    def motions(self, genes: Array) -> list[PiecewiseCubic | FourierSeries | PlannerError]:
        """Return the motion of each row of genes (m, n_genes), or why there is none.

        A motion does not depend on its company, to the last bit.
        """
        ...

    def sample(self, random: np.random.Generator, count: int) -> Array:
        """Draw a first population (count, n_genes)."""
        ...

    def recorded(self, genes: Array, trajectory: PiecewiseCubic | FourierSeries) -> dict[str, Any]:
        """Return the motion of genes (n_genes,), and what it was planned from, for the record.

        They are arguments of an `Excitation`.
        """
        ...


def between(lower: ArrayLike, upper: ArrayLike, genes: Array) -> Array:
    """Return what genes mean: exactly `lower` at 0, exactly `upper` at 1, never beyond either."""
    low, high = np.asarray(lower), np.asarray(upper)
    return np.asarray(np.clip((1.0 - genes) * low + genes * high, low, high))
