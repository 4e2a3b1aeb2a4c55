"""How long answers take, counted in bins, so that other processes can tell percentiles.

Counting costs the exchange a logarithm and a store per packet, whatever the number of packets.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

BINS: Final = 48
PER_OCTAVE: Final = 4
SHORTEST: Final = 2e-6
"""s; the first bin holds everything up to it, each next one 2 ** (1 / `PER_OCTAVE`) times more.
The last holds all that took longer than 5.8 ms."""


def bin_of(seconds: float) -> int:
    """Index of the bin that a latency falls into."""
    if not seconds > SHORTEST:
        return 0
    if math.isinf(seconds):
        return BINS - 1
    return min(BINS - 1, math.ceil(PER_OCTAVE * math.log2(seconds / SHORTEST)))


def upper_edge(index: int) -> float:
    """Longest latency of a bin, s; that of the last is infinite."""
    return math.inf if index >= BINS - 1 else SHORTEST * 2.0 ** (index / PER_OCTAVE)


def quantile(counts: Sequence[int], share: float) -> float | None:
    """Latency not exceeded by this share of the answers, s; None without any.

    It is the upper edge of a bin: never too short, and at most 19 % too long.
    """
    total = sum(counts)
    if total <= 0:
        return None
    needed, seen = share * total, 0
    for index, count in enumerate(counts):
        seen += count
        if seen >= needed and seen > 0:
            return upper_edge(index)
    return upper_edge(BINS - 1)
