"""Quantiles and tails of distributions, without the slow import of `scipy.stats`."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import ArrayLike

MAD_TO_STD: Final = 1.4826
"""Standard deviation of a normal variable over its median absolute value."""
NORMAL_95: Final = 1.96
"""Standard deviations in half a 95 % interval of known variance."""
SIGNIFICANT_SIGMAS: Final = 3.0
"""Standard deviations of a significant sign, change, correction, delay or scale."""


def normal_limit(share: ArrayLike) -> Any:
    """Value that a standard normal variable exceeds with probability `share`."""
    return -scipy.special.ndtri(share)


def student_limit(share: ArrayLike, freedom: ArrayLike) -> Any:
    """Value that Student's t with `freedom` degrees exceeds with probability `share`."""
    return -scipy.special.stdtrit(freedom, share)


def student_freedom(share: float, limit: float) -> float:
    """Degrees of freedom with which Student's t exceeds a limit with probability `share`.

    Infinite for a limit that the standard normal variable exceeds at least as often.
    """
    if limit <= normal_limit(share) * (1.0 + 1e-6):  # the inverse of fewer is rounding
        return float("inf")
    return float(scipy.special.stdtridf(1.0 - share, limit))


def chi_squared_limit(share: ArrayLike, freedom: ArrayLike) -> Any:
    """Value that chi-squared with `freedom` degrees exceeds with probability `share`."""
    return scipy.special.chdtri(freedom, share)


def fisher_limit(share: ArrayLike, freedom: ArrayLike, of_variance: ArrayLike) -> Any:
    """Value that Fisher's F exceeds with probability `share`.

    It is the mean of `freedom` squares over a variance of `of_variance` degrees of freedom.
    """
    return scipy.special.fdtri(freedom, of_variance, 1.0 - np.asarray(share))


def student_tail(value: ArrayLike, freedom: ArrayLike) -> Any:
    """Probability that Student's t with `freedom` degrees exceeds a value."""
    return scipy.special.stdtr(freedom, -np.asarray(value))


def fisher_tail(value: ArrayLike, freedom: ArrayLike, of_variance: ArrayLike) -> Any:
    """Probability that Fisher's F, see `fisher_limit`, exceeds a value."""
    return scipy.special.fdtrc(freedom, of_variance, value)
