"""Which rows of a recording count in a fit, and in words why the others do not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.recording import Recording

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

# A smoothed signal is worse near the ends of its segment, where it is known from one side only.
# Measured on sines with noise: the error of the acceleration has come down to its usual size two
# periods of the smoother's bandwidth from the end. A joint that hardly moves is smoothed to
# almost nothing and must not take the whole segment with it, hence the limit.
END_PERIODS: Final = 2.0
LONGEST_END: Final = 0.25  # s
# When a joint turns round, Coulomb friction jumps, and until its servo has followed so does its
# acceleration. The smoother, whose kernel is a period of its bandwidth wide, cannot follow that.
# On the simulated NS 16 at 40 Hz (``benchmarks.identification_study``) the bias of
# the parameters, rms of its ratio to their standard deviation, is 0.38 if half a period is left out
# on either side (worst 1.1), 0.20 with one period (worst 0.6), and no smaller with two.
REVERSAL_PERIODS: Final = 1.0
# Twice what the least smoother takes; motion of a shorter stretch is not known at all.
SHORTEST_STRETCH: Final = 24  # samples
# Drives hold a limit to within their resolution.
AT_LIMIT: Final = 0.995
# A clipped top lasts; shorter ones are chance.
SHORTEST_TOP: Final = 5  # samples
# A smooth peak read with a resolution r has a flat top as well. One top's length further out a
# parabola has fallen by at most 8 r, and by 12 r with the worst rounding.
_FALL: Final = 16.0

# A joint that rests keeps whatever torque its servo was left with; shorter halts belong to a
# reversal, which says what dry friction is. On the recording of an arm with a balancer fitting
# such rests doubles the error of prediction.
LONGEST_HALT: Final = 0.25  # s

LeftOut = Literal["rests", "slow", "none"]

TORN: Final = "beside a gap or an end of the recording"
SATURATED: Final = "torque or current saturated"
REST: Final = "at rest"
STANDSTILL: Final = "slower than standstill"
REVERSAL: Final = "near a velocity reversal"


@dataclass(frozen=True, eq=False)
class RowMask:
    """Rows that count, and for those that do not every reason."""

    # by reason in words, the rows it excludes (m, n); a row may have several
    reasons: Mapping[str, Rows]
    shape: tuple[int, int]  # (m, n)
    # rows (m, n) without any reason against them in which the joint moves, away from its
    # reversals: what a model of sliding friction is judged on
    moving: Rows

    @property
    def usable(self) -> Rows:
        """Rows without any reason against them (m, n)."""
        usable = np.ones(self.shape, dtype=np.bool_)
        for rows in self.reasons.values():
            usable &= ~rows
        return usable

    def rows(self, part: slice) -> RowMask:
        """The mask of some of the rows."""
        reasons = {reason: rows[part] for reason, rows in self.reasons.items()}
        length = len(range(*part.indices(self.shape[0])))
        return RowMask(MappingProxyType(reasons), (length, self.shape[1]), self.moving[part])

    @property
    def counts(self) -> dict[str, NDArray[np.intp]]:
        """Rows excluded per joint (n,), by the first reason in the order of `reasons`."""
        left = np.ones(self.shape, dtype=np.bool_)
        counts = {}
        for reason, rows in self.reasons.items():
            counts[reason] = np.count_nonzero(rows & left, axis=0)
            left &= ~rows
        return counts


def mask_rows(
    recording: Recording,
    model: RobotModel,
    motion: Motion,
    bandwidth: Array,
    *,
    current_limit: Array | None = None,
    torque_bandwidth: Array | None = None,
    delay: float = 0.0,
    left_out: LeftOut = "slow",
) -> RowMask:
    """Reasons against each row of a checked recording, with its smoothed motion in the same rows.

    `bandwidth` (n,) [Hz] is of that smoothing, read `delay` [s] earlier; `torque_bandwidth` (n,)
    [Hz] of a low-pass of torque and regressor; `current_limit` (n,) [A] of motors. Slow rows:

    - "rests": out are those slower than standstill for longer than `LONGEST_HALT`, and the two
      between which a velocity changes its sign, where one of them has the wrong sign of friction;
    - "slow": all slower than standstill, and those near a velocity reversal; "none": none.
    """
    shape = recording.position.shape
    still = ~model.moving(motion.velocity)
    saturated = np.zeros(shape, dtype=np.bool_)
    for values in (recording.torque, recording.motor_current):
        if values is not None:
            saturated |= flat_topped(values, ~still)
    if current_limit is not None and recording.motor_current is not None:
        saturated |= np.abs(recording.motor_current) >= AT_LIMIT * current_limit
    slowest = float(bandwidth[np.ptp(recording.position, axis=0) > 0.0].min(initial=np.inf))
    torn = torn_rows(recording, min(LONGEST_END, END_PERIODS / slowest), delay)
    if torque_bandwidth is not None:
        torn |= torn_rows(recording, min(LONGEST_END, END_PERIODS / float(torque_bandwidth.min())))
    reversal = near_any_reversal(model, motion, REVERSAL_PERIODS / bandwidth)
    reasons = {TORN: np.broadcast_to(torn[:, None], shape)}
    if left_out == "rests":
        at_once = near_any_reversal(model, motion, np.zeros(shape[1]))
        reasons |= {REST: long_rests(motion.time, still), REVERSAL: at_once}
    elif left_out == "slow":
        reasons |= {STANDSTILL: still, REVERSAL: reversal}
    reasons[SATURATED] = saturated
    moving = ~(reasons[TORN] | saturated | still | reversal)
    return RowMask(MappingProxyType(reasons), (shape[0], shape[1]), moving)


def long_rests(time: Array, still: Rows) -> Rows:
    """Rows (m, n) within a run of resting rows (m, n) that lasts longer than `LONGEST_HALT`."""
    resting = np.zeros_like(still)
    for joint, column in enumerate(still.T):
        for start, stop in _runs(column):
            resting[start:stop, joint] = time[stop - 1] - time[start] > LONGEST_HALT
    return resting


def flat_topped(values: Array, moving: Rows) -> Rows:
    """Rows (m, n) that look clipped: a channel stays at its own extreme to the last bit.

    A run of `SHORTEST_TOP` equal values or more, at the largest or smallest value of the channel,
    from which it departs faster than a smooth peak read with the channel's resolution would; where
    it moves.
    """
    clipped = np.zeros(values.shape, dtype=np.bool_)
    for j, channel in enumerate(values.T):
        steps = np.abs(np.diff(channel))
        if not steps.any():
            continue
        resolution = float(steps[steps > 0.0].min())
        for extreme in (channel.max(), channel.min()):
            for start, stop in _runs(channel == extreme):
                if stop - start >= SHORTEST_TOP and _departs(channel, start, stop, resolution):
                    clipped[start:stop, j] = True
    return clipped & moving


def near_reversal(time: Array, speed: Array, reach: Array) -> Rows:
    """Rows (m, k) nearer to a reversal of each of k speeds (m, k) than its reach (k,) [s]."""
    near = np.zeros(speed.shape, dtype=np.bool_)
    for column, velocity in enumerate(speed.T):
        before = min(LONGEST_END, float(reach[column]))
        last = np.flatnonzero(velocity[1:] * velocity[:-1] < 0.0)
        starts = np.searchsorted(time, time[last] - before)
        stops = np.searchsorted(time, time[last + 1] + before, side="right")
        for start, stop in zip(starts, stops, strict=True):
            near[start:stop, column] = True
    return near


def near_any_reversal(model: RobotModel, motion: Motion, reach: Array) -> Rows:
    """Rows (m, n) within the reach (n,) [s] of a reversal of the joint or a coupled motor on it.

    The motor's speed is as slow to follow as that of the slowest joint in it.
    """
    near = near_reversal(motion.time, motion.velocity, reach)
    shares = model.friction.motor_speeds()
    if len(shares):
        slowest = np.array([reach[share != 0.0].max() for share in shares])
        turning = near_reversal(motion.time, motion.velocity @ shares.T, slowest)
        for share, rows in zip(shares, turning.T, strict=True):
            near[:, share != 0.0] |= rows[:, None]
    return near


def torn_rows(recording: Recording, end: float, delay: float = 0.0) -> NDArray[np.bool_]:
    """Rows (m,) within a time [s] of the ends of their stretch, or of a stretch without inside.

    Rows are read earlier than they stand by a delay [s].
    """
    torn = np.ones(recording.n_samples, dtype=np.bool_)
    for segment in recording.segments():
        inside = recording.time[segment]
        if len(inside) >= SHORTEST_STRETCH:
            at = inside - delay
            torn[segment] = (at < inside[0] + end) | (at > inside[-1] - end)
    return torn


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Start and stop of every run of True."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _departs(channel: Array, start: int, stop: int, resolution: float) -> bool:
    """Whether a channel leaves a flat top on some side faster than a parabola would."""
    length, top = stop - start, channel[start]
    outside = [channel[max(0, start - length) : start], channel[stop : stop + length]]
    falls = [float(np.abs(side - top).max(initial=0.0)) for side in outside]
    return max(falls) > _FALL * resolution
