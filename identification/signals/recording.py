"""What identification reads: one stretch of motion as it was measured, and what was commanded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError

Array = NDArray[np.float64]


# A joint is not held still to the last bit of its encoder while it is commanded to move this far.
STUCK_MOVEMENT: Final = 0.02  # rad or m
LONGEST_PAUSE: Final = 600.0
"""s without a sample. What is reckoned in stretches of time takes memory for empty ones, too."""
# A step of the clock this many times the usual one is a gap, whether it was reported or not.
GAP_STEPS: Final = 5.0


class RecordingError(IdentificationError, ValueError):
    """A recording that must not be identified from."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Measured joint motion and torque, m samples of n joints, joint side."""

    time: Array  #: (m,) [s], the controller's clock
    position: Array  #: measured (m, n) [rad or m]
    joint_names: tuple[str, ...]  #: n names, in the order of the columns
    #: joint torque or force (m, n) [N·m or N], None where only currents are known
    torque: Array | None = None
    velocity: Array | None = None  #: measured (m, n) [rad/s or m/s], None where it was not
    #: (m, n) [A]; no use is made of it here but to carry it along
    motor_current: Array | None = None
    commanded_position: Array | None = None  #: (m, n) [rad or m], NaN where nothing was commanded
    #: (m,) True at a sample before which samples are known to be missing
    gap_before: NDArray[np.bool_] | None = None
    #: joints that are known to be clamped or switched off, so that a constant position is no
    #: fault
    held_joints: tuple[str, ...] = ()
    #: where the recording comes from, in words
    provenance: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = (len(self.time), len(self.joint_names))
        if self.time.ndim != 1:
            raise ShapeError("time", self.time.shape, "(m,)")
        for name, array in self._channels():
            if array.shape != shape:
                raise ShapeError(name, array.shape, f"{shape} (samples, joints)")
        if self.gap_before is not None and self.gap_before.shape != self.time.shape:
            raise ShapeError("gap_before", self.gap_before.shape, f"{self.time.shape}")

    @property
    def n_samples(self) -> int:
        """Number of samples m."""
        return len(self.time)

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    def checked(self, joint_names: Sequence[str] | None = None) -> Recording:
        """Return the recording itself if it can be identified from.

        Args:
            joint_names: the model's joints; names and order have to be the recording's.

        Raises:
            RecordingError: too short, NaN or infinity, a repeated, falling or leaping clock,
                joints that are not the model's, or a stuck joint.
        """
        if self.n_samples < 2:
            raise RecordingError(f"the recording has {self.n_samples} samples")
        if joint_names is not None and self.joint_names != tuple(joint_names):
            raise RecordingError(
                f"the recorded joints are {', '.join(self.joint_names)}; the model's are"
                f" {', '.join(joint_names)}, in this order"
            )
        self.check_finite()
        self._check_clock()
        self._check_stuck()
        return self

    def between(self, start: int, stop: int) -> Recording:
        """Return samples start to stop (exclusive) as a recording of its own."""
        return self.rows(slice(start, stop))

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
        """Time at which the commanded position begins to move [s]; the first sample's without.

        The first sample commanded otherwise than the first command: the same instant of a plan
        in every repetition of it.
        """
        if self.commanded_position is None:
            return float(self.time[0])
        known = np.isfinite(self.commanded_position).all(axis=1)
        if not known.any():
            return float(self.time[0])
        first = self.commanded_position[int(np.argmax(known))]
        moved = known & (self.commanded_position != first).any(axis=1)
        return float(self.time[int(np.argmax(moved))])

    def segments(self) -> list[slice]:
        """Stretches without a gap, in order.

        A gap is where one was reported, and where the clock steps by more than `GAP_STEPS` of
        its usual (median) step. Derivatives across one are wrong.
        """
        steps = np.diff(self.time)
        breaks = steps > GAP_STEPS * np.median(steps)
        if self.gap_before is not None:
            breaks |= self.gap_before[1:]
        edges = [0, *(np.flatnonzero(breaks) + 1).tolist(), self.n_samples]
        return [slice(a, b) for a, b in pairwise(edges)]

    def _channels(self) -> list[tuple[str, Array]]:
        """Channels present, each (m, n), by attribute name."""
        channels = {
            "position": self.position,
            "velocity": self.velocity,
            "torque": self.torque,
            "motor_current": self.motor_current,
            "commanded_position": self.commanded_position,
        }
        return [(name, array) for name, array in channels.items() if array is not None]

    def each_channel(self, select: Callable[[Array], Array]) -> dict[str, Any]:
        """Return every channel present, changed alike, by attribute name."""
        return {name: select(array) for name, array in self._channels()}

    def check_finite(self) -> None:
        """Raise RecordingError where a number is NaN or infinite; commands may be NaN."""
        bad = np.flatnonzero(~np.isfinite(self.time))
        if bad.size:
            raise RecordingError(f"time is {self.time[bad[0]]} at sample {bad[0]}")
        for name, array in self._channels():
            # A packet without a set-point has no commanded position; that is legal.
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
        if steps[sample - 1] > LONGEST_PAUSE:
            raise RecordingError(
                f"the clock leaps by {steps[sample - 1]:.6g} s at sample {sample}; pauses of "
                f"{LONGEST_PAUSE:g} s are borne: cut the recording there"
            )

    def _check_stuck(self) -> None:
        """Refuse a position reading that stays the same to the last bit when it should not."""
        ranges = np.ptp(self.position, axis=0)
        for j, name in enumerate(self.joint_names):
            if name in self.held_joints:
                continue
            if self.commanded_position is not None:
                found = stuck(self.position[:, j], self.commanded_position[:, j])
                if found is not None:
                    raise RecordingError(
                        f"joint {name} is stuck: its position stays"
                        f" {self.position[found[0], j]:.6g} from sample {found[0]} on while its"
                        f" command moves by {found[1]:.3g}"
                    )
            elif ranges[j] == 0.0 and np.any(ranges > STUCK_MOVEMENT):
                raise RecordingError(
                    f"joint {name} is stuck: its position is {self.position[0, j]:.6g} in all"
                    f" {self.n_samples} samples while other joints move; declare it as held if"
                    " it was meant to stand still"
                )


def without_repeats(recording: Recording) -> Recording:
    """Return the recording with one sample per time stamp: the mean of those that share it.

    Raises:
        RecordingError: the clock falls back; which sample is right cannot be determined.
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
        # One sample stays what it is to the last bit.
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
    """Where positions (m,) stay the same to the last bit while commands (m,) move [rad or m].

    First sample of the stretch during which the command travels farthest, and how far; None where
    that is nowhere more than `STUCK_MOVEMENT`. Commands are NaN where there are none.
    """
    edges = np.flatnonzero(np.diff(position, prepend=np.nan, append=np.nan) != 0.0)
    starts = edges[:-1]
    highest = np.fmax.reduceat(command, starts)
    lowest = np.fmin.reduceat(command, starts)
    travel = np.nan_to_num(highest - lowest, nan=0.0)
    worst = int(np.argmax(travel))
    if travel[worst] <= STUCK_MOVEMENT:
        return None
    return int(starts[worst]), float(travel[worst])


_STEP: Final = 0.01  # s
# A repetition follows the first within this share of each joint's own scatter, ...
_ALIKE: Final = 0.02
# ... over this share of the longer one.
_OVERLAP: Final = 0.8
_REFINED: Final = 21  # offsets that are tried within a step


def offsets_of_repetitions(recordings: Sequence[Recording]) -> Array | None:
    """Offset of each clock against the first one's (R,) [s] where all show one motion.

    Returns:
        None where some recording shows another motion, or where there is only one.
    """
    offsets = [0.0]
    for one in recordings[1:]:
        offset = _offset(recordings[0], one)
        if offset is None:
            return None
        offsets.append(offset)
    return np.array(offsets) if len(offsets) > 1 else None


def _offset(first: Recording, other: Recording) -> float | None:
    """Time of the other recording less that of the first at equal postures [s]."""
    time, position = _even(first)
    other_time, other_position = _even(other)
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
    coarse = other_time[0] - time[0] + lag * _STEP
    fine = coarse + _STEP * np.linspace(-1.0, 1.0, _REFINED)
    differences = [_difference(time, a, other_time - offset, b) for offset in fine]
    best = int(np.argmin(differences))
    return float(fine[best]) if differences[best] < _ALIKE else None


def _lag(a: Array, b: Array) -> int | None:
    """Rows by which b (k, n) lags a (l, n) where their mean square difference is least."""
    lags = np.arange(1 - len(a), len(b))
    first, last = np.maximum(0, -lags), np.minimum(len(a), len(b) - lags)
    rows = last - first
    enough = rows >= _OVERLAP * max(len(a), len(b))
    if not enough.any():
        return None
    common = np.zeros(len(lags))
    for x, y in zip(a.T, b.T, strict=True):
        common += scipy.signal.correlate(y, x, method="fft")
    power_a, power_b = (np.append(0.0, np.cumsum((one**2).sum(axis=1))) for one in (a, b))
    own = power_a[last] - power_a[first] + power_b[last + lags] - power_b[first + lags]
    squares = np.where(enough, (own - 2.0 * common) / np.maximum(rows, 1), np.inf)
    return int(lags[np.argmin(squares)])


def _difference(time: Array, a: Array, other_time: Array, b: Array) -> float:
    """Largest RMS difference of a joint where both run; infinite where that is too short."""
    inside = (time >= other_time[0]) & (time <= other_time[-1])
    if np.count_nonzero(inside) < _OVERLAP * max(len(a), len(b)):
        return np.inf
    at = np.column_stack([np.interp(time[inside], other_time, column) for column in b.T])
    return float(np.sqrt(np.mean((a[inside] - at) ** 2, axis=0)).max())


def _even(recording: Recording) -> tuple[Array, Array]:
    """Times and positions (k, n) at even steps."""
    time = np.arange(recording.time[0], recording.time[-1], _STEP)
    columns = [np.interp(time, recording.time, column) for column in recording.position.T]
    return time, np.column_stack(columns)
