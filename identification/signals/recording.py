"""Recording of one motion: measured and commanded signals, with checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, root_mean_square
from identification.errors import IdentificationError, ShapeError

# Command range beyond which a constant position is an error.
MIN_MOVEMENT: Final = 0.02  # rad or m
MAX_PAUSE_SECONDS: Final = 600.0
"""Longest time without sample, s; empty blocks of time take memory."""
PAUSE_SECONDS: Final = 10.0
"""Time without sample [s] at which an imported recording is cut."""
_PART_GAP_SECONDS: Final = 1.0  # s, left of a pause; a gap at every rate
RIGID_RATE: Final = 250.0
"""Rate [Hz] to which recordings are averaged where only the arm as rigid bodies is asked about:
positions and torques alike, without bias."""
GAP_STEPS: Final = 5.0  # clock steps of a gap, in usual steps


class RecordingError(IdentificationError, ValueError):
    """Recording that cannot be identified from."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Measured joint motion and torque, m samples of n joints, joint side."""

    time: Array  #: (m,) [s], the controller's clock
    position: Array  #: measured (m, n) [rad or m]
    joint_names: tuple[str, ...]  #: n names, in the order of the columns
    #: joint torque or force (m, n) [N·m or N], None where only currents are known
    torque: Array | None = None
    velocity: Array | None = None  #: measured (m, n) [rad/s or m/s], None where it was not
    motor_current: Array | None = None  #: (m, n) [A]
    commanded_position: Array | None = None  #: (m, n) [rad or m], NaN where nothing was commanded
    gap_before: NDArray[np.bool_] | None = None  #: (m,) whether samples are missing before
    held_joints: tuple[str, ...] = ()  #: joints that are clamped or switched off
    joint_units: tuple[str, ...] = ()  #: rad or m for each joint; empty if unknown
    provenance: Mapping[str, str] = field(default_factory=dict)  #: origin of the recording

    def __post_init__(self) -> None:
        shape = (len(self.time), len(self.joint_names))
        if self.time.ndim != 1:
            raise ShapeError("time", self.time.shape, "(m,)")
        for name, array in self.channels():
            if array.shape != shape:
                raise ShapeError(name, array.shape, f"{shape} (samples, joints)")
        if self.gap_before is not None and self.gap_before.shape != self.time.shape:
            raise ShapeError("gap_before", self.gap_before.shape, f"{self.time.shape}")

    def unit_of(self, joint: int) -> str:
        """Return the unit of a joint's position, as far as it is known."""
        return self.joint_units[joint] if self.joint_units else "rad or m"

    @property
    def n_samples(self) -> int:
        """Number of samples m."""
        return len(self.time)

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    def checked(self, joint_names: Sequence[str] | None = None) -> Recording:
        """Return the recording if it can be identified from, with joint names as given.

        Raises:
            RecordingError: too short, NaN or infinity, invalid time stamps, or other joints than
                those of the model.
        """
        if self.n_samples < 2:
            raise RecordingError(f"the recording has {self.n_samples} samples")
        if joint_names is not None and self.joint_names != tuple(joint_names):
            raise RecordingError(
                f"the recorded joints are {', '.join(self.joint_names)}; the model's are"
                f" {', '.join(joint_names)}, in this order"
            )
        if self._defect is not None:
            raise RecordingError(self._defect)
        return self

    @cached_property
    def _defect(self) -> str | None:
        """What makes the arrays useless, examined once; None if nothing does."""
        try:
            self.check_finite()
            self._check_clock()
        except RecordingError as error:
            return str(error)
        return None

    def between(self, start: int, stop: int) -> Recording:
        """Return samples start to stop (exclusive)."""
        return self.rows(slice(start, stop))

    def averaged(self, rate: float) -> Recording:
        """Return means of consecutive samples, at about a rate [Hz], unless it is lower already.

        All channels are averaged alike, which a model that is linear in them does not notice.
        """
        count = int(1.0 / (rate * float(np.median(np.diff(self.time)))) + 1e-6)
        if count < 2:
            return self
        parts = []
        for segment in self.segments():
            bins = (segment.stop - segment.start) // count
            parts.append(segment.start + np.arange(bins)[:, None] * count + np.arange(count))
        index = np.concatenate(parts)
        gap = np.zeros(len(index), dtype=np.bool_)
        edges = np.cumsum([len(part) for part in parts])[:-1]
        gap[edges[edges < len(index)]] = True
        return replace(
            self,
            time=self.time[index].mean(axis=1),
            gap_before=gap,
            **self.each_channel(lambda array: array[index].mean(axis=1)),
        )

    def rows(self, which: slice | NDArray[np.bool_]) -> Recording:
        """Return some of the samples."""
        return replace(
            self,
            time=self.time[which],
            gap_before=None if self.gap_before is None else self.gap_before[which],
            **self.each_channel(lambda array: array[which]),
        )

    @property
    def motion_start(self) -> float:
        """Time of the first commanded motion [s], of the first sample without command."""
        if self.commanded_position is None:
            return float(self.time[0])
        with_command = np.isfinite(self.commanded_position).all(axis=1)
        if not with_command.any():
            return float(self.time[0])
        first = self.commanded_position[int(np.argmax(with_command))]
        moved = with_command & (self.commanded_position != first).any(axis=1)
        return float(self.time[int(np.argmax(moved))])

    @property
    def usual_step(self) -> float:
        """Median step of the clock [s], without stamps that repeat; 0 where it stands still."""
        steps = np.diff(self.time)
        forward = steps[steps > 0.0]
        return float(np.median(forward)) if forward.size else 0.0

    def segments(self) -> list[slice]:
        """Segments between reported gaps, or steps above `GAP_STEPS` usual steps, in order."""
        steps = np.diff(self.time)
        breaks = steps > GAP_STEPS * self.usual_step
        if self.gap_before is not None:
            breaks |= self.gap_before[1:]
        edges = [0, *(np.flatnonzero(breaks) + 1).tolist(), self.n_samples]
        return [slice(a, b) for a, b in pairwise(edges)]

    def channels(self) -> list[tuple[str, Array]]:
        """Return the channels present, each (m, n), by attribute name."""
        channels = {
            "position": self.position,
            "velocity": self.velocity,
            "torque": self.torque,
            "motor_current": self.motor_current,
            "commanded_position": self.commanded_position,
        }
        return [(name, array) for name, array in channels.items() if array is not None]

    def each_channel(self, select: Callable[[Array], Array]) -> dict[str, Any]:
        """Apply a function to every channel present."""
        return {name: select(array) for name, array in self.channels()}

    def check_finite(self) -> None:
        """Raise RecordingError for NaN or infinity; commands may be NaN."""
        bad = np.flatnonzero(~np.isfinite(self.time))
        if bad.size:
            raise RecordingError(f"time is {self.time[bad[0]]} at sample {bad[0]}")
        for name, array in self.channels():
            # NaN: packet without set-point.
            wrong = np.isinf(array) if name == "commanded_position" else ~np.isfinite(array)
            for sample, joint in np.argwhere(wrong)[:1].tolist():
                raise RecordingError(
                    f"{name} of joint {self.joint_names[joint]} is {array[sample, joint]} at sample"
                    f" {sample} (t = {self.time[sample]:.6g} s)"
                )

    def _check_clock(self) -> None:
        steps = np.diff(self.time)
        bad = np.flatnonzero(steps <= 0.0)
        if bad.size:
            sample = int(bad[0]) + 1
            what = "repeats" if steps[bad[0]] == 0.0 else "falls back"
            raise RecordingError(
                f"the clock {what} at sample {sample}: {self.time[sample - 1]:.9g} s, then "
                f"{self.time[sample]:.9g} s ({bad.size} such samples)"
            )
        sample = int(np.argmax(steps)) + 1
        if steps[sample - 1] > MAX_PAUSE_SECONDS:
            raise RecordingError(
                f"the time step is {steps[sample - 1]:.6g} s at sample {sample}, limit "
                f"{MAX_PAUSE_SECONDS:g} s: cut the recording there"
            )


def cut_at_pauses(recording: Recording) -> Recording:
    """Return the recording with a second between parts that pauses above `PAUSE_SECONDS` separate.

    Blocks of time take memory, empty ones too.
    """
    steps = np.diff(recording.time)
    pauses = np.flatnonzero(steps > PAUSE_SECONDS) + 1
    if not pauses.size:
        return recording
    excess = np.zeros(recording.n_samples)
    excess[pauses] = steps[pauses - 1] - _PART_GAP_SECONDS
    gap = np.zeros(recording.n_samples, np.bool_)
    if recording.gap_before is not None:
        gap |= recording.gap_before
    gap[pauses] = True
    return replace(recording, time=recording.time - np.cumsum(excess), gap_before=gap)


def in_succession(recordings: Sequence[Recording]) -> Recording:
    """Return recordings of the same joints as segments of one, of the channels that all have."""
    if len(recordings) == 1:
        return recordings[0]
    first = recordings[0]
    times: list[Array] = []
    gaps = []
    for recording in recordings:
        steps = np.diff(recording.time)
        start = times[-1][-1] + float(np.median(steps)) if times else recording.time[0]
        times.append(recording.time - recording.time[0] + start)
        gap = np.zeros(len(recording.time), dtype=np.bool_)
        gap[[segment.start for segment in recording.segments()]] = True
        gaps.append(gap)
    parts = [dict(recording.channels()) for recording in recordings]
    channels: dict[str, Any] = {
        name: np.concatenate([part[name] for part in parts])
        if all(name in part for part in parts)
        else None
        for name in parts[0]
    }
    return replace(first, time=np.concatenate(times), gap_before=np.concatenate(gaps), **channels)


def without_repeats(recording: Recording) -> Recording:
    """Return the recording with one sample per time stamp, the mean of repeated ones.

    Raises:
        RecordingError: a time stamp is earlier than the one before.
    """
    steps = np.diff(recording.time)
    if np.any(steps < 0.0):
        sample = int(np.argmax(steps < 0.0)) + 1
        raise RecordingError(f"the clock falls back at sample {sample}; samples are not reordered")
    starts = np.flatnonzero(np.concatenate([[True], steps > 0.0]))
    if len(starts) == recording.n_samples:
        return recording
    count = np.diff(np.append(starts, recording.n_samples))[:, None]

    def mean(values: Array) -> Array:
        # Bit-identical for single samples.
        total = np.add.reduceat(values, starts, axis=0)
        return np.asarray(np.where(count == 1, values[starts], total / count))

    gap = recording.gap_before
    return replace(
        recording,
        time=recording.time[starts],
        gap_before=None if gap is None else np.logical_or.reduceat(gap, starts),
        **recording.each_channel(mean),
    )


def stuck(position: Array, command: Array) -> tuple[int, float] | None:
    """Return first sample and command range where positions (m,) rest and commands (m,) move."""
    edges = np.flatnonzero(np.diff(position, prepend=np.nan, append=np.nan) != 0.0)
    starts = edges[:-1]
    highest = np.fmax.reduceat(command, starts)
    lowest = np.fmin.reduceat(command, starts)
    travel = np.nan_to_num(highest - lowest, nan=0.0)
    worst = int(np.argmax(travel))
    if travel[worst] <= MIN_MOVEMENT:
        return None
    return int(starts[worst]), float(travel[worst])


_OFFSET_STEP: Final = 0.01  # s
# Largest difference of repetitions as a share of each joint's scatter.
_MAX_DIFFERENCE_SHARE: Final = 0.02
_MIN_OVERLAP_SHARE: Final = 0.8  # required overlap as a share of the longer recording
_REFINED_OFFSETS: Final = 21  # offsets tried within a step


def offsets_of_repetitions(recordings: Sequence[Recording]) -> Array | None:
    """Return the offsets of clocks from the first (R,) [s]; None without a common motion."""
    offsets = [0.0]
    for repetition in recordings[1:]:
        offset = _offset(recordings[0], repetition)
        if offset is None:
            return None
        offsets.append(offset)
    return np.array(offsets) if len(offsets) > 1 else None


def _offset(first: Recording, other: Recording) -> float | None:
    """Return the time of the other recording minus the first at equal positions [s]."""
    time, position = _resampled(first)
    other_time, other_position = _resampled(other)
    scatter = position.std(axis=0)
    if position.shape[1] != other_position.shape[1] or not scatter.any():
        return None
    moving = scatter > 1e-3 * scatter.max()
    scale = scatter[moving]
    a = (position - position.mean(axis=0))[:, moving] / scale
    b = (other_position - position.mean(axis=0))[:, moving] / scale
    lag = _lag(a, b)
    if lag is None:
        return None
    coarse = other_time[0] - time[0] + lag * _OFFSET_STEP
    fine = coarse + _OFFSET_STEP * np.linspace(-1.0, 1.0, _REFINED_OFFSETS)
    differences = [_difference(time, a, other_time - offset, b) for offset in fine]
    best = int(np.argmin(differences))
    return float(fine[best]) if differences[best] < _MAX_DIFFERENCE_SHARE else None


def _lag(a: Array, b: Array) -> int | None:
    """Return the rows by which b (k, n) lags a (l, n) at the least mean square difference."""
    lags = np.arange(1 - len(a), len(b))
    first = np.maximum(0, -lags)
    last = np.minimum(len(a), len(b) - lags)
    rows = last - first
    enough = rows >= _MIN_OVERLAP_SHARE * max(len(a), len(b))
    if not enough.any():
        return None
    # By transforms: `scipy.signal`, which has this, takes a second to import.
    length = 1 << (len(lags) - 1).bit_length()
    spectra = np.fft.rfft(b, length, axis=0) * np.fft.rfft(a, length, axis=0).conj()
    common = np.fft.irfft(spectra.sum(axis=1), length)[lags]
    power_a, power_b = (np.append(0.0, np.cumsum((signal**2).sum(axis=1))) for signal in (a, b))
    powers = power_a[last] - power_a[first] + power_b[last + lags] - power_b[first + lags]
    squares = np.where(enough, (powers - 2.0 * common) / np.maximum(rows, 1), np.inf)
    return int(lags[np.argmin(squares)])


def _difference(time: Array, a: Array, other_time: Array, b: Array) -> float:
    """Return the largest RMS difference of a joint; infinite if the overlap is short."""
    inside = (time >= other_time[0]) & (time <= other_time[-1])
    if np.count_nonzero(inside) < _MIN_OVERLAP_SHARE * max(len(a), len(b)):
        return np.inf
    at = np.column_stack([np.interp(time[inside], other_time, column) for column in b.T])
    return float(root_mean_square(a[inside] - at).max())


def _resampled(recording: Recording) -> tuple[Array, Array]:
    """Return times and positions (k, n) at even steps."""
    time = np.arange(recording.time[0], recording.time[-1], _OFFSET_STEP)
    columns = [np.interp(time, recording.time, column) for column in recording.position.T]
    return time, np.column_stack(columns)
