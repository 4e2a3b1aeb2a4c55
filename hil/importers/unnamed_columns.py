"""Guesses about columns without names and several time columns, from their numbers alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.importers.stamps import is_clock

_MIN_UNNAMED_CORRELATION: Final = 0.9  # correlation of a velocity with the slope of its position
_MAX_SLOPE_DEVIATION: Final = 0.1  # relative deviation of a velocity from the slope
_MAX_ROWS: Final = 20_000
_MIN_ROWS: Final = 8  # rows


@dataclass(frozen=True)
class ColumnBlocks:
    """Columns of a table without names, from 0, as blocks of one for each joint.

    Attributes:
        time: that grows in every row, None without one.
        position, velocity, torque: None where the table has no such block.
    """

    time: int | None
    position: tuple[int, ...]
    velocity: tuple[int, ...] | None
    torque: tuple[int, ...] | None


def blocks_of(values: Array, counts: Sequence[int]) -> ColumnBlocks | None:
    """Return the blocks of a table (m, k) for the first number of joints that fits its width.

    Blocks are in the usual order: positions, velocities if they are the slopes of the positions,
    other quantities, torques last. `counts` are numbers of joints, the likeliest first.
    """
    values = values[:_MAX_ROWS]
    first = int(len(values) > _MIN_ROWS and is_clock(values[:, 0]))
    width = values.shape[1] - first
    count = next((n for n in counts if n and width % n == 0), None)
    if count is None or not width:
        return None
    starts = range(first, values.shape[1], count)
    blocks = [tuple(range(start, start + count)) for start in starts]
    velocity = None
    if len(blocks) > 1:
        ratio = _slope_ratio(values[:, blocks[0]], values[:, blocks[1]])
        step = float(np.median(np.diff(values[:, 0]))) if first else None
        # Of two blocks the second may be a torque that is like the velocity, as of friction.
        is_same = (
            step is not None
            and ratio is not None
            and abs(ratio / step - 1.0) < _MAX_SLOPE_DEVIATION
        )
        if ratio is not None and (len(blocks) > 2 or is_same):
            velocity = blocks[1]
    others = [block for block in blocks[1:] if block is not velocity]
    torque = others[-1] if others else None
    return ColumnBlocks(0 if first else None, blocks[0], velocity, torque)


def _slope_ratio(position: Array, other: Array) -> float | None:
    """Return the steps of positions (m, n) over other columns, by most of the moving ones.

    None where the others do not follow the slopes.
    """
    slopes = np.gradient(position, axis=0)
    moving = (np.ptp(position, axis=0) > 0.0) & (np.ptp(other, axis=0) > 0.0)
    if len(position) < _MIN_ROWS or not moving.any():
        return None
    pairs = [*zip(slopes[:, moving].T, other[:, moving].T, strict=True)]
    if np.median([np.corrcoef(*pair)[0, 1] for pair in pairs]) < _MIN_UNNAMED_CORRELATION:
        return None
    return float(np.median([np.std(slope) / np.std(column) for slope, column in pairs]))


def roughness(stamp: NDArray[np.float64], position: Array) -> float | None:
    """Return how much positions (m, n) deviate from lines between their neighbours at stamps (m,).

    In units of their usual step. Positions are smooth in the time at which they were measured, not
    in that at which they arrived. None where a stamp is not known, or stands still.
    """
    stamp = stamp[:_MAX_ROWS]
    position = position[:_MAX_ROWS]
    if len(stamp) < _MIN_ROWS or not np.isfinite(stamp).all() or not np.all(np.diff(stamp) > 0.0):
        return None
    share = ((stamp[1:-1] - stamp[:-2]) / (stamp[2:] - stamp[:-2]))[:, None]
    between = position[:-2] + share * (position[2:] - position[:-2])
    usual = float(np.sqrt(np.mean(np.diff(position, axis=0) ** 2)))
    if not usual > 0.0:
        return None
    return float(np.sqrt(np.mean((position[1:-1] - between) ** 2))) / usual
