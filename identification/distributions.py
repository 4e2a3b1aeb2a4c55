"""Quantiles and tails of distributions, without the slow import of `scipy.stats`."""

from __future__ import annotations

from typing import Any

import scipy
from numpy.typing import ArrayLike


def normal_limit(share: ArrayLike) -> Any:
    """Value that a standard normal variable exceeds with probability `share`."""
    return -scipy.special.ndtri(share)


def student_limit(share: ArrayLike, freedom: ArrayLike) -> Any:
    """Value that Student's t of so many degrees of freedom exceeds with probability `share`."""
    return -scipy.special.stdtrit(freedom, share)
