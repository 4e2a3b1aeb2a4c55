"""Commands on another clock than the positions, moved onto theirs by the motion."""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy

from hil.base.arrays import Array
from hil.importers.resampling import Stamps, Timed, at_stamps

_GRID_STEP_NS: Final = 10_000_000  # ns of the grid on which both are compared
# of the shorter recording, that has to be common to both on one clock
_MIN_OVERLAP_SHARE: Final = 0.5
_USUAL_LAG_NS: Final = 50_000_000  # ns by which positions usually follow


def clock_offset(position: Timed, command: Timed) -> int | None:
    """Return what is added to the stamps of commands [ns]; None if both have one clock.

    Both have one clock if they were recorded at the same time by their stamps. Otherwise the speeds
    of all joints agree best at the offset; how late positions follow is then not known, and a usual
    lag is assumed.
    """
    common = min(position.stamp[-1], command.stamp[-1]) - max(position.stamp[0], command.stamp[0])
    shorter = min(np.ptp(position.stamp), np.ptp(command.stamp))
    if common >= _MIN_OVERLAP_SHARE * shorter:
        return None
    followed, wanted = (_speeds(part) for part in (position, command))
    agreement = sum(
        scipy.signal.correlate(a, b, mode="full") for a, b in zip(followed.T, wanted.T, strict=True)
    )
    lags = scipy.signal.correlation_lags(len(followed), len(wanted), mode="full")
    best = int(lags[int(np.argmax(agreement))]) * _GRID_STEP_NS
    return int(position.stamp[0] - command.stamp[0]) + best - _USUAL_LAG_NS


def _speeds(part: Timed) -> Array:
    """Return speeds on an even grid (g, n), each joint in its own scatter."""
    grid: Stamps = np.arange(part.stamp[0], part.stamp[-1], _GRID_STEP_NS)
    speeds = np.diff(at_stamps(grid, part.stamp, part.values, across_gaps=True), axis=0)
    speeds = np.nan_to_num(speeds)
    rms = np.sqrt((speeds**2).mean(axis=0))
    return np.asarray(speeds / np.where(rms > 0.0, rms, 1.0))
