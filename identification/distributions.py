"""Limits and tails of the three distributions that intervals and tests are made of.

`scipy.special` has them to the last bit as `scipy.stats` does, which takes a third of a second to
import: every command of a person would wait for it.
"""

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


def fisher_tail(value: ArrayLike, freedom: ArrayLike, spare: ArrayLike) -> Any:
    """Probability that Fisher's F of (`freedom`, `spare`) degrees of freedom exceeds `value`."""
    return scipy.special.fdtrc(freedom, spare, value)
