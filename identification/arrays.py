"""Array types of the package, and sums and runs over rows that several parts need."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


def root_mean_square(values: Array) -> Array:
    """Return the root mean square over rows (m, ...)."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def runs_of(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return start and stop of every run of True."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
