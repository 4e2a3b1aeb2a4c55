"""A measured latency: percentiles, cycles lost to it, a histogram."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

RESERVE: Final = 100e-6
"""s of a cycle kept for what a bare measurement leaves out: session and guard (20 µs, at most 40),
the packet on the wire both ways (25 µs each at 100 Mbit/s), the card's interrupt."""
EDGES: Final = np.array([0, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, np.inf]) * 1e-6
"""s, bounds of the histogram's bars."""


@dataclass(frozen=True, eq=False)
class Latency:
    """Latencies of one kind.

    Attributes:
        name: "wake-up" or "turnaround".
        samples: (m,) s, finite and not negative, m >= 1.
        seconds: how long was measured.
    """

    name: str
    samples: NDArray[np.float64]
    seconds: float

    def __post_init__(self) -> None:
        if self.samples.ndim != 1 or not len(self.samples) or not self.seconds > 0:
            raise ValueError(f"{self.name}: no samples")
        if not (np.isfinite(self.samples).all() and (self.samples >= 0).all()):
            raise ValueError(f"{self.name}: samples must be finite and not negative")

    def percentile(self, percent: float) -> float:
        """The smallest sample that `percent` of all do not exceed, s."""
        return float(np.percentile(self.samples, percent, method="inverted_cdf"))

    def late_cycles(self, period: float) -> int:
        """Cycles of `period` s that would have ended before their answer.

        A latency of several cycles costs each of them: a stall counts by its length.
        """
        return int(np.floor((self.samples + RESERVE) / period).sum())

    def histogram(self) -> list[tuple[str, int]]:
        """Bars: bounds in µs, and how many samples lie in them (lower bound included)."""
        counts, _ = np.histogram(self.samples, EDGES)
        finite = (1e6 * EDGES[:-1]).tolist()
        bounds = [f"{low:.0f}-{high:.0f}" for low, high in pairwise(finite)]
        return list(zip([*bounds, f"over {finite[-1]:.0f}"], counts.tolist(), strict=True))

    def summary(self) -> dict[str, float | int]:
        """Figures for scripts, µs."""
        figures: dict[str, float | int] = {
            f"p{str(p).replace('.', '')}_us": round(1e6 * self.percentile(p), 1)
            for p in (50, 99, 99.9)
        }
        figures["max_us"] = round(1e6 * float(self.samples.max()), 1)
        figures["samples"] = len(self.samples)
        for cycle_ms in (1, 2):
            figures[f"late_cycles_{cycle_ms}ms"] = self.late_cycles(cycle_ms / 1000)
        return figures
