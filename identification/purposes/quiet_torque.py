"""Residual of motion without contact: how large it becomes once in a stated time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array, Indices
from identification.distributions import chi_squared_limit
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.block_mean import BLOCK_SECONDS
from identification.signals.masks import RowReason
from identification.signals.samples import Samples
from identification.signals.smoothing import low_pass
from identification.validation.prediction import SLOW_BANDWIDTH, driving_residual

FALSE_ALARM_PERIOD: Final = 60.0
"""A threshold is exceeded once in this time of motion without contact [s]."""
_MIN_BLOCK_SHARE: Final = 0.8  # of a block's time
_MIN_BLOCKS: Final = 10  # blocks that show how the largest residuals are distributed
_TAIL_SHARE: Final = 0.2  # of the blocks, from which larger ones are inferred
_MANY_BLOCKS: Final = 50  # blocks, of which a share would be more peaks than a tail needs
_TAIL_FACTOR: Final = 3.0  # times as many blocks as exceed the threshold, at most


class SlowResidual(NamedTuple):
    """Part of a recording without gap, and what a monitor of contact forces sees in it."""

    motion: Motion  # (m, n)
    torque: Array  # residual below `SLOW_BANDWIDTH` (m, n) [N·m or N]


def slow_residuals(
    model: RobotModel, values: Array, recordings: Sequence[Samples]
) -> list[SlowResidual]:
    """Return the residual of parameters (p,), as an observer of contact forces passes it.

    Reversals and rests are part of it; at the ends of recordings and in saturated rows it is zero.
    """
    parts = []
    for samples in recordings:
        error = driving_residual(model, samples, values)
        if samples.mask is not None:
            for reason in (RowReason.EDGE, RowReason.SATURATED, RowReason.UNMEASURED):
                error = np.where(samples.mask.reasons[reason], 0.0, error)
        for segment in samples.segments:
            motion = samples.motion.rows(segment)
            if motion.n_samples > _MIN_BLOCKS and np.ptp(motion.time) > BLOCK_SECONDS:
                slow = low_pass(motion.time, error[segment], SLOW_BANDWIDTH)
                parts.append(SlowResidual(motion, slow))
    return parts


def whole_blocks(time: Array) -> tuple[Indices, int]:
    """Return the first row of each whole block of times (m,) [s], and the row after the last."""
    index = np.floor((time - time[0]) / BLOCK_SECONDS + 1e-9).astype(np.intp)
    edges = np.flatnonzero(np.diff(index, prepend=-1))
    # A part of a block at the end would have a smaller peak than a whole one.
    if time[-1] - time[edges[-1]] > _MIN_BLOCK_SHARE * BLOCK_SECONDS:
        return edges, len(time)
    return edges[:-1], int(edges[-1])


class _Tail(NamedTuple):
    """The largest peaks, as of an exponential distribution."""

    beyond: int  # number k of peaks beyond the threshold
    threshold: Array  # (...)
    scale: Array  # mean excess over it (...)
    chance: float  # of exceeding a level once in the period, over that of the threshold

    @classmethod
    def of(cls, period: float, peaks: Array) -> _Tail:
        """Choose the tail of peaks of blocks (B, ...) for what is exceeded once in a time [s]."""
        count = len(peaks)
        share = min(1.0, BLOCK_SECONDS / period)
        beyond = int(
            np.clip(
                _TAIL_FACTOR * share * count, _TAIL_SHARE * min(count, _MANY_BLOCKS), 0.5 * count
            )
        )
        ordered = np.sort(peaks, axis=0)[::-1]
        threshold = ordered[beyond]
        scale = (ordered[:beyond] - threshold).mean(axis=0)
        return cls(beyond, threshold, scale, count * share / beyond)


def once_in(period: float, peaks: Array) -> Array | None:
    """Return what the peaks of blocks (B, ...) exceed once in a time [s]; None of too few.

    From the largest of them on, as of an exponential tail whose scale k peaks show: the chance of a
    further one beyond x is (1 + x / (k scale))^-k, so that few peaks give a larger threshold. Of
    normal residuals, whose tail is shorter, it errs to the larger side.
    """
    if len(peaks) < _MIN_BLOCKS:
        return None
    tail = _Tail.of(period, peaks)
    growth = tail.beyond * (tail.chance ** (-1.0 / tail.beyond) - 1.0)
    return np.asarray(tail.threshold + tail.scale * growth)


def once_in_interval(period: float, peaks: Array) -> tuple[Array, Array]:
    """Return the ends of the 95 % interval of the level that is exceeded once in a time [s].

    The mean of k excesses of an exponential distribution is distributed as chi-squared of 2 k
    degrees of freedom; peaks of blocks are (B, ...), at least ten.
    """
    tail = _Tail.of(period, peaks)
    freedom = 2.0 * tail.beyond
    longest, shortest = freedom / chi_squared_limit([0.975, 0.025], freedom)
    growth = -np.log(tail.chance)
    ends = [tail.threshold + tail.scale * growth * share for share in (shortest, longest)]
    return np.minimum(*ends), np.maximum(*ends)
