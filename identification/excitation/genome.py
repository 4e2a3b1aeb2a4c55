"""What a search turns its numbers into: motions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.errors import ShapeError
from identification.excitation.criteria import Criteria
from identification.excitation.errors import DesignError
from identification.excitation.excitation import Excitation
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

    def excitation(
        self,
        genes: Array,
        trajectory: PiecewiseCubic | FourierSeries,
        criteria: Criteria,
        *,
        method: str,
        seed: int,
        tried: int,
        rejected: Mapping[str, int],
    ) -> Excitation:
        """Return the record of a search that chose these genes (n_genes,) and their motion."""
        ...


def checked_genes(genes: ArrayLike, n_genes: int) -> Array:
    """Return genes as rows (m, n_genes); one (n_genes,) becomes a row.

    Raises:
        ShapeError: rows of another length.
        DesignError: a gene outside [0, 1].
    """
    rows = np.atleast_2d(np.asarray(genes, dtype=np.float64))
    if rows.ndim != 2 or rows.shape[1] != n_genes:
        raise ShapeError("genes", np.shape(genes), f"(m, {n_genes})")
    within = (rows >= 0.0) & (rows <= 1.0)
    if not np.all(within):
        raise DesignError("genes", float(rows[~within][0]), "numbers from 0 to 1")
    return rows


def between(lower: ArrayLike, upper: ArrayLike, genes: Array) -> Array:
    """Return what genes mean: exactly `lower` at 0, exactly `upper` at 1, never beyond either."""
    low, high = np.asarray(lower), np.asarray(upper)
    return np.asarray(np.clip((1.0 - genes) * low + genes * high, low, high))


def share_between(lower: ArrayLike, upper: ArrayLike, values: ArrayLike) -> Array:
    """Return the genes that mean these values, the inverse of `between` but for rounding."""
    low = np.asarray(lower)
    return np.asarray(np.clip((np.asarray(values) - low) / (np.asarray(upper) - low), 0.0, 1.0))
