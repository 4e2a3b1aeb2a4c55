"""Arrays that are close to another: what `pytest.approx` compares number by number, at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike


class Near:
    """An array (any shape), or one number for all: equal within a tolerance; NaN to nothing."""

    __array_ufunc__ = None  # an array on the left asks this class, not each of its numbers
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, expected: ArrayLike, tolerance: ArrayLike) -> None:
        self.expected = np.asarray(expected, np.float64)
        self.tolerance = tolerance
        self.remark = ""

    def __eq__(self, actual: Any) -> bool:
        found = np.asarray(actual, np.float64)
        if self.expected.ndim and found.shape != self.expected.shape:
            self.remark = f", shape {self.expected.shape} instead of {found.shape}"
            return False
        with np.errstate(invalid="ignore"):
            apart = np.where(found == self.expected, 0.0, np.abs(found - self.expected))
        wrong = ~((apart <= self.tolerance) & np.isfinite(apart))
        self.remark = f", {wrong.sum()} of {wrong.size} are not, by up to {apart.max(initial=0.0)}"
        return not wrong.any()

    def __repr__(self) -> str:
        return f"near {self.expected}{self.remark}"


def near(expected: ArrayLike, rel: float | None = None, abs: float | None = None) -> Near:  # noqa: A002
    """Return what an array compares equal to within the larger of two tolerances.

    As of `pytest.approx`: 1e-6 of each number and 1e-12 by default, `abs` alone if only that is
    given.
    """
    share = (1e-6 if abs is None else 0.0) if rel is None else rel
    size = np.abs(np.where(np.isfinite(expected), expected, 0.0))
    return Near(expected, np.maximum(share * size, 1e-12 if abs is None else abs))
