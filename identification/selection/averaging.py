"""The bandwidth of the motion, averaged with the usual one where the data do not decide."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

MIN_ODDS: Final = 0.05
"""Odds against a choice from which on it is averaged with what it replaced: at two and a half
standard deviations these are 0.05, and a share of 5 % moves nothing."""


@dataclass(frozen=True)
class AveragedBandwidth:
    """Usual bandwidth of the motion, in case another motion prefers it to the chosen one."""

    bandwidth: float  #: [Hz]
    weight: float  #: of its rows, relative to rows of the chosen bandwidth; at most 1

    @property
    def shares(self) -> tuple[float, float]:
        """Shares of the chosen bandwidth and of this one in sums over rows."""
        return 1.0 / (1.0 + self.weight), self.weight / (1.0 + self.weight)


def averaged_bandwidth(usual: float, odds: float) -> AveragedBandwidth | None:
    """Return the `usual` bandwidth [Hz], by its `odds` against the chosen one; None for a few."""
    return AveragedBandwidth(usual, odds) if odds > MIN_ODDS else None
