"""Two estimates on the same motions: every motion is compared with itself.

This is over motions, for two estimates taken as they are; `drawn` says what other repetitions
would have done to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Paired:
    """What becomes of errors under a second method, over motions that both predicted.

    Attributes:
        motions: how many.
        ratio: geometric mean of error with the second over error with the first.
        wins: motions with a smaller error under the second.
        p_value: Wilcoxon's signed-rank test of log ratios, two-sided; 1 where all are equal.
    """

    motions: int
    ratio: float
    wins: int
    p_value: float


def compare(first: Array, second: Array) -> Paired:
    """Compare positive errors (m,) of two methods on the same m motions, in this order.

    Errors are compared by their ratio: motions differ in size, and a motion of large torques is
    to count as much as any other.

    Raises:
        ValueError: lengths differ, there is no motion, or an error is not above zero.
    """
    if first.shape != second.shape or first.ndim != 1 or not first.size:
        raise ValueError(f"errors of shapes {first.shape} and {second.shape} are no pairs")
    if not (np.all(first > 0.0) and np.all(second > 0.0)):
        raise ValueError("errors must be above zero to be compared by their ratio")
    logs = np.log(second / first)
    return Paired(
        motions=logs.size,
        ratio=float(np.exp(logs.mean())),
        wins=int(np.count_nonzero(logs < 0.0)),
        p_value=float(stats.wilcoxon(logs).pvalue) if np.any(logs) else 1.0,
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p values corrected for their number after Holm (1979), in the order given.

    The chance that any of them falls below alpha though nothing differs is then at most alpha.
    """
    order = np.argsort(p_values, kind="stable")
    corrected, largest = [0.0] * len(p_values), 0.0
    for rank, index in enumerate(order.tolist()):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[index]))
        corrected[index] = largest
    return corrected
