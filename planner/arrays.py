"""The one array type of this package, and how it is made read-only."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def read_only(values: ArrayLike) -> Array:
    """Return `values` as a read-only float64 array of its own (frozen dataclasses hold these)."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array
