"""What is said of the ratio of two errors: judged here and nowhere else."""

from __future__ import annotations

from typing import Final, Literal

ALPHA: Final = 0.05
"""How often, at most, a table tells any difference where there is none."""
SMALL: Final = 0.02
"""A difference of errors below this share is there, and matters to nobody."""

Verdict = Literal["better", "slightly better", "none", "slightly worse", "worse", "too few"]


def verdict_of(ratio: float, low: float | None, high: float | None) -> Verdict:
    """Verdict on the second of two estimates, from the interval of its error over the first's.

    A difference is told where the interval leaves out 1. Without an interval, of too few
    repetitions or one motion, nothing can be told.
    """
    if low is None or high is None:
        return "too few"
    if low <= 1.0 <= high:
        return "none"
    small = abs(ratio - 1.0) < SMALL
    if ratio < 1.0:
        return "slightly better" if small else "better"
    return "slightly worse" if small else "worse"
