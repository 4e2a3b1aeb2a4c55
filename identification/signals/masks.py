"""Usable rows of a recording, and the reasons against the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, runs_of
from identification.distributions import MAD_TO_STD
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.recording import MIN_MOVEMENT, Recording

Rows = NDArray[np.bool_]

# Smoothed signals are inaccurate near the ends of a segment. On noisy sines the error of the
# acceleration is normal two periods of the bandwidth from the end. Limited, since a joint that
# hardly moves has a low bandwidth.
END_PERIODS: Final = 2.0
MAX_END_SECONDS: Final = 0.25  # s
# Coulomb friction and acceleration change faster at a reversal than the smoother, whose kernel is a
# period of its bandwidth wide. On the simulated NS 16 at 40 Hz
# (``benchmarks.identification_study``) the rms bias over standard deviation of the parameters is
# 0.38 with half a period on either side (worst 1.1), 0.20 with one (worst 0.6) or two.
REVERSAL_PERIODS: Final = 1.0
# Twice the minimum of the smoother.
MIN_STRETCH_SAMPLES: Final = 24  # samples
SATURATION_SHARE: Final = 0.995  # share of the limit, for the resolution of drives
MIN_TOP_SAMPLES: Final = 5  # samples
# A rounded smooth peak has a flat top as well. One top length further a parabola has fallen by at
# most 8 resolutions, 12 with the worst rounding.
_MIN_FALL_RESOLUTIONS: Final = 16.0

# The torque at rest depends on the servo. Shorter halts are reversals, which show dry friction. On
# an arm with a balancer fitting long rests doubles the prediction error.
MAX_HALT_SECONDS: Final = 0.25  # s

# The time around a reversal in which no row shows dry friction: two rows at the rate to which
# recordings are averaged for the choice of rows (`questions.SELECTION_RATE`), so that the fit of a
# faster recording leaves out as much as was judged.
REVERSAL_SECONDS: Final = 0.016  # s

# Torque that stands out alone, as damaged packets leave it: from its neighbours by so many robust
# standard deviations, and by so much of its range.
_SPIKE_SIGMAS: Final = 15.0
_SPIKE_RANGE_SHARE: Final = 0.5
_MAX_NEIGHBOUR_SHARE: Final = 0.1  # of it, by which its neighbours differ
_TAIL_QUANTILE: Final = 0.01  # of the samples at either end, which are no range
_MAX_SPIKE_SAMPLES: Final = 2  # samples

ExcludedRows = Literal["rests", "halts", "slow", "none"]


class RowReason(Enum):
    """Why a row is not used; `identification.signals.messages` words it."""

    EDGE = auto()  #: next to a gap or an end of the recording
    UNMEASURED = auto()  #: torque of the joint zero throughout, or constant although it moves
    SATURATED = auto()  #: torque or current
    REST = auto()
    STANDSTILL = auto()  #: slower than it
    REVERSAL = auto()  #: of the velocity
    SPIKE = auto()  #: torque or current stands out alone


@dataclass(frozen=True, eq=False)
class RowMask:
    """Usable rows, and reasons against the others."""

    reasons: Mapping[RowReason, Rows]  # excluded rows (m, n) by reason; a row may have several
    shape: tuple[int, int]  # (m, n)
    moving: Rows  # rows (m, n) without reason against them in sliding motion

    @property
    def usable(self) -> Rows:
        """Rows without a reason against them (m, n)."""
        usable = np.ones(self.shape, dtype=np.bool_)
        for rows in self.reasons.values():
            usable &= ~rows
        return usable

    def rows(self, part: slice) -> RowMask:
        """Return the mask of some rows."""
        reasons = {reason: rows[part] for reason, rows in self.reasons.items()}
        length = len(range(*part.indices(self.shape[0])))
        return RowMask(reasons, (length, self.shape[1]), self.moving[part])

    @property
    def counts(self) -> dict[RowReason, NDArray[np.intp]]:
        """Excluded rows per joint (n,), by the first matching reason."""
        usable = np.ones(self.shape, dtype=np.bool_)
        counts = {}
        for reason, rows in self.reasons.items():
            counts[reason] = np.count_nonzero(rows & usable, axis=0)
            usable &= ~rows
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
    exclude_rows: ExcludedRows = "slow",
) -> RowMask:
    """Return reasons against rows of a checked recording, with its smoothed motion.

    Args:
        recording: that was checked.
        model: of the arm.
        motion: of the recording, smoothed.
        bandwidth: of the smoothing (n,) [Hz].
        current_limit: of the motors (n,) [A].
        torque_bandwidth: of a low-pass of torque and regressor (n,) [Hz].
        delay: of the torque [s].
        exclude_rows: slow rows that are excluded:

            - "rests": rows in which no joint moves for more than `MAX_HALT_SECONDS` (a joint that
                stands while another moves holds its load), and the two rows at each reversal of a
                joint, or more in `REVERSAL_SECONDS`;
            - "halts": rows of a joint slower than standstill for more than `MAX_HALT_SECONDS`, and
                the same rows at each change of its velocity's sign;
            - "slow": all rows slower than standstill, or near a velocity reversal;
            - "none": no slow rows.
    """
    shape = recording.position.shape
    still = ~model.moving(motion.velocity)
    saturated, spikes = np.zeros((2, *shape), dtype=np.bool_)
    for values in (recording.torque, recording.motor_current):
        if values is not None:
            saturated |= flat_topped(values, ~still)
            spikes |= spiking(values, recording.segments())
    if current_limit is not None and recording.motor_current is not None:
        saturated |= np.abs(recording.motor_current) >= SATURATION_SHARE * current_limit
    slowest = float(bandwidth[np.ptp(recording.position, axis=0) > 0.0].min(initial=np.inf))
    edge = edge_rows(recording, min(MAX_END_SECONDS, END_PERIODS / slowest), delay)
    if torque_bandwidth is not None:
        edge |= edge_rows(
            recording, min(MAX_END_SECONDS, END_PERIODS / float(torque_bandwidth.min()))
        )
    reversal = near_any_reversal(model, motion, REVERSAL_PERIODS / bandwidth)
    reasons = {RowReason.EDGE: np.broadcast_to(edge[:, None], shape)}
    # Errors of velocity and delay turn dry friction there, always to less of it at low speed.
    # Half a period less, so that it ends between two rows.
    reach = max(0.0, 0.5 * (REVERSAL_SECONDS - float(np.median(np.diff(recording.time)))))
    turning = near_any_reversal(model, motion, np.full(shape[1], reach))
    halts = long_rests(motion.time, still)
    if exclude_rows == "rests":
        resting = long_rests(motion.time, np.all(still, axis=1)[:, None])
        reasons |= {
            RowReason.REST: np.broadcast_to(resting, shape),
            RowReason.REVERSAL: turning & ~halts,
        }
    elif exclude_rows == "halts":
        reasons |= {RowReason.REST: halts, RowReason.REVERSAL: turning}
    elif exclude_rows == "slow":
        reasons |= {RowReason.STANDSTILL: still, RowReason.REVERSAL: reversal}
    unmeasured = np.broadcast_to(_unmeasured(recording), shape)
    reasons[RowReason.UNMEASURED] = unmeasured
    reasons[RowReason.SATURATED] = saturated
    reasons[RowReason.SPIKE] = spikes
    moving = ~(reasons[RowReason.EDGE] | unmeasured | saturated | spikes | still | reversal)
    return RowMask(reasons, (shape[0], shape[1]), moving)


def _unmeasured(recording: Recording) -> NDArray[np.bool_]:
    """Return the joints whose torque is not measured while that of others is (n,).

    It is zero throughout, or constant although the joint moves, as of a channel that is stuck.
    """
    if recording.torque is None:
        return np.zeros(recording.position.shape[1], dtype=np.bool_)
    stuck = (np.ptp(recording.torque, axis=0) == 0.0) & (
        np.ptp(recording.position, axis=0) > MIN_MOVEMENT
    )
    silent = stuck | ~recording.torque.any(axis=0)
    return np.asarray(silent & ~silent.all())


def long_rests(time: Array, still: Rows) -> Rows:
    """Return rows (m, n) in runs of resting rows (m, n) longer than `MAX_HALT_SECONDS`."""
    resting = np.zeros_like(still)
    for joint, column in enumerate(still.T):
        for start, stop in runs_of(column):
            resting[start:stop, joint] = time[stop - 1] - time[start] > MAX_HALT_SECONDS
    return resting


def flat_topped(values: Array, moving: Rows) -> Rows:
    """Return rows (m, n) that are clipped: a moving channel constant at its extreme value.

    At least `MIN_TOP_SAMPLES` equal values, left faster than the peak of a smooth signal would be.
    """
    clipped = np.zeros(values.shape, dtype=np.bool_)
    for j, channel in enumerate(np.ascontiguousarray(values.T)):
        tops = [channel == extreme for extreme in (channel.max(), channel.min())]
        if max(map(np.count_nonzero, tops)) < MIN_TOP_SAMPLES:
            continue
        steps = np.abs(np.diff(channel))
        if not steps.any():
            continue
        resolution = float(steps[steps > 0.0].min())
        for top in tops:
            for start, stop in runs_of(top):
                if stop - start >= MIN_TOP_SAMPLES and _leaves_peak(
                    channel, start, stop, resolution
                ):
                    clipped[start:stop, j] = True
    return clipped & moving


def spiking(values: Array, segments: Sequence[slice]) -> Rows:
    """Return samples (m, n) of channels that stand out alone: one or two, and then as before.

    By half of what the channel ranges over, and beyond that range, between samples that know
    nothing of it: no motor does that. What lasts is a step, as of dry friction or of another load,
    and a pulse of the arm begins and ends in more than one sample.
    """
    found = np.zeros(values.shape, dtype=np.bool_)
    side = _MAX_SPIKE_SAMPLES + 1
    for segment in segments:
        part = values[segment]
        if len(part) < MIN_STRETCH_SAMPLES:
            continue
        low, high = np.quantile(part, [_TAIL_QUANTILE, 1.0 - _TAIL_QUANTILE], axis=0)
        beyond = np.maximum(part - high, low - part) > 0.5 * _SPIKE_RANGE_SHARE * (high - low)
        for joint in np.flatnonzero(beyond.any(axis=0)).tolist():  # none in most recordings
            column = part[:, joint]
            apart = np.abs(column - _running_median(column, side))
            spread = MAD_TO_STD * np.median(apart)
            least = max(_SPIKE_SIGMAS * spread, _SPIKE_RANGE_SHARE * (high - low)[joint])
            for start, stop in runs_of((apart > least) & beyond[:, joint]):
                if stop - start > _MAX_SPIKE_SAMPLES:
                    continue
                others = np.delete(column, slice(start, stop))
                around = others[max(0, start - 2) : start + 2]
                if np.ptp(around) < _MAX_NEIGHBOUR_SHARE * apart[start:stop].min():
                    found[segment.start + start : segment.start + stop, joint] = True
    return found


def _running_median(values: Array, side: int) -> Array:
    """Return the median of each sample (m,) and of `side` samples on both sides of it.

    `scipy.ndimage` takes longer to import.
    """
    extended = np.concatenate([np.full(side, values[0]), values, np.full(side, values[-1])])
    windows = np.lib.stride_tricks.sliding_window_view(extended, 2 * side + 1)
    return np.asarray(np.partition(windows, side, axis=1)[:, side])


def near_reversal(time: Array, speed: Array, reach: Array) -> Rows:
    """Return rows (m, k) within a time (k,) [s] of a reversal of each of k speeds (m, k)."""
    near = np.zeros(speed.shape, dtype=np.bool_)
    for column, velocity in enumerate(speed.T):
        before = min(MAX_END_SECONDS, float(reach[column]))
        last = np.flatnonzero(velocity[1:] * velocity[:-1] < 0.0)
        starts = np.searchsorted(time, time[last] - before)
        stops = np.searchsorted(time, time[last + 1] + before, side="right")
        for start, stop in zip(starts, stops, strict=True):
            near[start:stop, column] = True
    return near


def near_any_reversal(model: RobotModel, motion: Motion, reach: Array) -> Rows:
    """Return rows (m, n) within times (n,) [s] of a reversal of the joint or a coupled motor."""
    near = near_reversal(motion.time, motion.velocity, reach)
    shares = model.friction.motor_speeds()
    if len(shares):
        slowest = np.array([reach[share != 0.0].max() for share in shares])
        turning = near_reversal(motion.time, motion.velocity @ shares.T, slowest)
        for share, rows in zip(shares, turning.T, strict=True):
            near[:, share != 0.0] |= rows[:, None]
    return near


def edge_rows(recording: Recording, end: float, delay: float = 0.0) -> NDArray[np.bool_]:
    """Return rows (m,), read a delay [s] earlier, within `end` [s] of the ends of their segment."""
    edge = np.ones(recording.n_samples, dtype=np.bool_)
    for segment in recording.segments():
        inside = recording.time[segment]
        if len(inside) >= MIN_STRETCH_SAMPLES:
            at = inside - delay
            edge[segment] = (at < inside[0] + end) | (at > inside[-1] - end)
    return edge


def _leaves_peak(channel: Array, start: int, stop: int, resolution: float) -> bool:
    """Return whether a channel leaves a flat top faster than a parabola."""
    length = stop - start
    top = channel[start]
    outside = [channel[max(0, start - length) : start], channel[stop : stop + length]]
    falls = [float(np.abs(side - top).max(initial=0.0)) for side in outside]
    return max(falls) > _MIN_FALL_RESOLUTIONS * resolution
