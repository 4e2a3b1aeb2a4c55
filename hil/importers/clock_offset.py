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
_LAG_NS: Final = 150_000_000
"""By how much positions are assumed to follow [ns]: speeds of servos follow by 40 to 160 ms, so
that a delay of commands remains to be found, which cannot be negative."""
_POSSIBLE_LAGS_NS: Final = (-2 * _GRID_STEP_NS, 300_000_000)
"""Least and largest lag [ns] at which speeds agree best on one clock: positions follow commands, by
the largest delay that is identified and what servo and friction add to it."""
_MIN_AGREEMENT: Final = (
    0.3  # correlation of speeds below which the commands do not belong to the motion
)


def clock_offset(position: Timed, command: Timed) -> int | None:
    """Return the offset to add to the stamps of commands [ns]; None if both share a clock.

    Both have one clock if they were recorded at the same time by their stamps, and positions follow
    commands as a servo does. Otherwise the speeds of all joints agree best at the offset; how late
    positions follow is then not known, and a usual lag is assumed.
    """
    lag, agreement = _best_lag(position, command)
    common = min(position.stamp[-1], command.stamp[-1]) - max(position.stamp[0], command.stamp[0])
    shorter = min(np.ptp(position.stamp), np.ptp(command.stamp))
    least, largest = _POSSIBLE_LAGS_NS
    possible = least <= lag <= largest or agreement < _MIN_AGREEMENT
    if common >= _MIN_OVERLAP_SHARE * shorter and possible:
        return None
    return lag - _LAG_NS


def _best_lag(position: Timed, command: Timed) -> tuple[int, float]:
    """Return by how much positions follow commands [ns] where speeds agree best, and how well.

    The agreement is their correlation, in the mean of the joints that were commanded.
    """
    followed, wanted = (_speeds(part) for part in (position, command))
    agreement = sum(
        scipy.signal.correlate(a, b, mode="full") for a, b in zip(followed.T, wanted.T, strict=True)
    )
    lags = scipy.signal.correlation_lags(len(followed), len(wanted), mode="full")
    best = int(np.argmax(agreement))
    lag = int(position.stamp[0] - command.stamp[0]) + int(lags[best]) * _GRID_STEP_NS
    joints = max(1, int(wanted.any(axis=0).sum()))
    return lag, float(agreement[best]) / (joints * min(len(followed), len(wanted)))


def _speeds(part: Timed) -> Array:
    """Return speeds on an even grid (g, n), each joint in its own scatter."""
    grid: Stamps = np.arange(part.stamp[0], part.stamp[-1], _GRID_STEP_NS)
    speeds = np.diff(at_stamps(grid, part.stamp, part.values, across_gaps=True), axis=0)
    speeds = np.nan_to_num(speeds)
    rms = np.sqrt((speeds**2).mean(axis=0))
    return np.asarray(speeds / np.where(rms > 0.0, rms, 1.0))
