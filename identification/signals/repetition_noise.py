"""Measurement noise from repetitions of one motion, by what differs at equal times.

A standstill shows the noise of a sensor at rest: no quantisation steps, no ripple, no current
under load. The difference between repetitions of one motion shows all of that, and the motion
itself, whatever it is, drops out of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.signals.noise import difference_variance
from identification.signals.recording import Recording

Array = NDArray[np.float64]

_SHORTEST_RUN: Final = 64  # samples


@dataclass(frozen=True, eq=False)
class ChannelNoise:
    """Variance of one kind of channel, n joints.

    Attributes:
        white: of what differs from sample to sample (n,): measurement noise, the tolerance of a
            smoothing spline.
        unrepeatable: of all that differs between repetitions (n,): also friction that drifts, and
            motion that a servo makes from noise.
    """

    white: Array
    unrepeatable: Array


@dataclass(frozen=True, eq=False)
class RepetitionNoise:
    """Noise from R repetitions of one motion.

    Attributes:
        position: [rad² or m²].
        torque: [N²·m² or N²], None where no torque was recorded.
        motor_current: [A²], None where no current was recorded.
        rows: instants that all repetitions have in common.
        repetitions: R.
    """

    position: ChannelNoise
    torque: ChannelNoise | None
    motor_current: ChannelNoise | None
    rows: int
    repetitions: int


def repetition_noise(recordings: Sequence[Recording]) -> RepetitionNoise:
    """Variances from repetitions, aligned at the start of their commanded motion.

    Times are compared to the nearest sampling interval. What a shift of less than one leaves of
    the motion is smooth and counts as unrepeatable, not as white.

    Args:
        recordings: two or more of one motion, checked, with equal joints and sampling rate.

    Raises:
        IdentificationError: fewer than two, other joints or rates, or no stretch in common.
    """
    if len(recordings) < 2:
        raise IdentificationError(f"noise from repetitions takes two, got {len(recordings)}")
    first = recordings[0]
    step = float(np.median(np.diff(first.time)))
    for one in recordings[1:]:
        own = float(np.median(np.diff(one.time)))
        if one.joint_names != first.joint_names or abs(own - step) > 0.01 * step:
            raise IdentificationError("these are no repetitions: joints or sampling rates differ")
    indices = [np.rint((one.time - one.motion_start) / step).astype(np.int64) for one in recordings]
    common, runs = _common_runs(recordings, indices)
    # First of the samples that round to the same instant, if clocks jitter.
    rows = [np.searchsorted(index, common) for index in indices]
    time: Array = common.astype(np.float64) * step

    def noise(name: str) -> ChannelNoise | None:
        channels = [getattr(one, name) for one in recordings]
        if any(channel is None for channel in channels):
            return None
        return _channel_noise(
            time, [channel[row] for channel, row in zip(channels, rows, strict=True)], runs
        )

    position = noise("position")
    assert position is not None
    return RepetitionNoise(
        position=position,
        torque=noise("torque"),
        motor_current=noise("motor_current"),
        rows=int(sum(stop - start for start, stop in runs)),
        repetitions=len(recordings),
    )


def _common_runs(
    recordings: Sequence[Recording], indices: Sequence[NDArray[np.int64]]
) -> tuple[NDArray[np.int64], list[tuple[int, int]]]:
    """Instants in all repetitions, and which stretches of them no gap of any interrupts."""
    common = indices[0]
    for index in indices[1:]:
        common = np.intersect1d(common, index)
    common = np.unique(common)
    torn = np.diff(common) > 1
    for one, index in zip(recordings, indices, strict=True):
        for segment in one.segments()[1:]:
            torn[: len(torn)] |= (common[:-1] < index[segment.start]) & (
                common[1:] >= index[segment.start]
            )
    edges = [0, *(np.flatnonzero(torn) + 1).tolist(), len(common)]
    runs = [(a, b) for a, b in pairwise(edges) if b - a >= _SHORTEST_RUN]
    if not runs:
        raise IdentificationError(
            f"the repetitions have no {_SHORTEST_RUN} consecutive samples in common"
        )
    return common, runs


def _channel_noise(
    time: Array, channels: Sequence[Array], runs: Sequence[tuple[int, int]]
) -> ChannelNoise:
    stacked = np.stack(channels)
    # About the mean of R repetitions a share of 1/R of the variance is lost.
    apart = (stacked - stacked.mean(axis=0)) * np.sqrt(len(channels) / (len(channels) - 1.0))
    white, total, rows = np.zeros(stacked.shape[2]), np.zeros(stacked.shape[2]), 0
    for start, stop in runs:
        for one in apart[:, start:stop]:
            white += difference_variance(time[start:stop], one) * (stop - start)
            total += (one**2).sum(axis=0)
        rows += (stop - start) * len(channels)
    return ChannelNoise(white / rows, total / rows)
