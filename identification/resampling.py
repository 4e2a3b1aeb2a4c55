"""The time base of a recording: what is wrong with it, and uniform samples where one needs them.

A smoothing spline takes any increasing time base as it is, and so does a fit. Uniform samples are
needed by filters that count samples instead of seconds, such as
:mod:`identification.butterworth`. Nothing is ever made up across a gap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator, make_interp_spline

from identification.recording import GAP_STEPS, Recording, RecordingError

Array = NDArray[np.float64]

# A filter that takes samples for uniform misplaces them by their jitter. One percent of a step
# moves a sine of a tenth of the sampling rate by less than one percent of its amplitude.
UNIFORM: Final = 0.01
_DROPPED: Final = 1.5  # steps
_CUBIC: Final = 4  # samples


@dataclass(frozen=True)
class TimeBase:
    """What the clock of a recording did.

    Attributes:
        samples: number of them.
        duration: from the first to the last [s].
        step: mean step of the clock; repeats, drops and gaps aside [s].
        jitter: standard deviation of the steps that are no drop and no gap, in such steps.
        largest_deviation: of one of them, in such steps.
        repeated: samples with the time stamp of the one before.
        backward: samples with an earlier time stamp than the one before.
        dropped: samples that are missing where the clock steps by more than 1.5 and at most
            `GAP_STEPS` usual ones.
        gaps: longer steps, and gaps that were reported.
    """

    samples: int
    duration: float
    step: float
    jitter: float
    largest_deviation: float
    repeated: int
    backward: int
    dropped: int
    gaps: int

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return 1.0 / self.step

    @property
    def uniform(self) -> bool:
        """Whether a filter may take each stretch between gaps for uniform as it is."""
        even = self.largest_deviation <= UNIFORM
        return even and self.repeated == self.backward == self.dropped == 0

    def describe(self) -> list[str]:
        """What there is to say about it, in words; the first line always."""
        lines = [f"{self.samples} samples in {self.duration:.6g} s, {self.rate:.6g} Hz"]
        if self.largest_deviation > UNIFORM:
            lines.append(
                f"uneven: steps scatter by {self.jitter:.1%} of the usual one, at most"
                f" {self.largest_deviation:.0%}"
            )
        if self.repeated:
            lines.append(f"{self.repeated} samples repeat the time stamp before them")
        if self.backward:
            lines.append(f"{self.backward} samples are older than the one before them")
        if self.dropped:
            lines.append(f"{self.dropped} samples are missing one by one")
        if self.gaps:
            lines.append(f"{self.gaps} gaps")
        if not self.uniform:
            lines.append("a filter that counts samples needs it resampled; the spline does not")
        return lines


def time_base(time: Array, gap_before: NDArray[np.bool_] | None = None) -> TimeBase:
    """Examine time stamps (m,) [s], legal or not.

    Args:
        time: as recorded; finite.
        gap_before: (m,) True at a sample before which samples are known to be missing.

    Raises:
        RecordingError: fewer than two different times.
    """
    steps = np.diff(time)
    forward = steps[steps > 0.0]
    if forward.size == 0:
        raise RecordingError("clock", f"the clock of all {len(time)} samples stands still")
    step = float(np.median(forward))
    reported = np.zeros(len(steps), dtype=np.bool_) if gap_before is None else gap_before[1:]
    gap = reported | (steps > GAP_STEPS * step)
    missing = np.rint(steps / step) - 1.0
    drop = ~gap & (steps > _DROPPED * step)
    usual = steps[~gap & ~drop & (steps > 0.0)]
    # The mean knows more digits than the median, which is one of the rounded steps.
    step = float(usual.mean()) if usual.size else step
    usual = usual / step
    return TimeBase(
        samples=len(time),
        duration=float(time[-1] - time[0]),
        step=step,
        jitter=float(usual.std()) if usual.size else 0.0,
        largest_deviation=float(np.abs(usual - 1.0).max(initial=0.0)),
        repeated=int(np.count_nonzero(steps == 0.0)),
        backward=int(np.count_nonzero(steps < 0.0)),
        dropped=int(np.maximum(missing[drop], 1.0).sum()),
        gaps=int(np.count_nonzero(gap)),
    )


def without_repeats(recording: Recording) -> Recording:
    """Return the recording with one sample per time stamp: the mean of those that share it.

    Raises:
        RecordingError: the clock falls back; which sample is right cannot be told.
    """
    steps = np.diff(recording.time)
    if np.any(steps < 0.0):
        sample = int(np.argmax(steps < 0.0)) + 1
        raise RecordingError(
            "clock", f"the clock falls back at sample {sample}; samples are not put in order here",
            sample=sample,
        )  # fmt: skip
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
        **_changed(recording, mean),
    )


def resample(recording: Recording, step: float | None = None) -> Recording:
    """Return the recording at uniform times within each stretch between gaps.

    Positions come from the interpolating cubic spline, torques and currents from monotone cubics,
    which do not overshoot where friction jumps, commands from straight lines, missing where one
    of the two samples beside them has none. Each stretch begins at its own first sample.

    Args:
        recording: checked.
        step: between samples [s], by default the recording's usual one.

    Raises:
        ValueError: a step that is not positive, or longer than 1.5 of the usual ones: that would
            be decimation, which needs a filter first.
        RecordingError: no stretch is long enough.
    """
    usual = float(np.median(np.diff(recording.time)))
    step = usual if step is None else step
    if not 0.0 < step <= _DROPPED * usual:
        raise ValueError(
            f"a step of {step} s is not between zero and {_DROPPED} times the usual {usual:.6g} s:"
            " fewer samples need a low-pass first"
        )
    pieces = []
    for segment in recording.segments():
        one = recording.between(segment.start, segment.stop)
        if one.n_samples >= _CUBIC:
            pieces.append(_uniform(one, step))
    if not pieces:
        raise RecordingError("shape", f"no stretch without a gap has {_CUBIC} samples")
    gap = np.concatenate([np.arange(piece.n_samples) == 0 for piece in pieces])
    gap[0] = False
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(piece, name) for piece in pieces])
        for name in _present(recording)
    }
    time = np.concatenate([piece.time for piece in pieces])
    return replace(recording, time=time, gap_before=gap, **joined)


def _uniform(one: Recording, step: float) -> Recording:
    """One stretch at uniform times."""
    time = one.time
    # Rounding of stamps must not cost the last sample.
    count = int(np.floor((time[-1] - time[0]) / step + 1e-6)) + 1
    at = time[0] + step * np.arange(count)
    inside = np.clip(at, time[0], time[-1])
    changed: dict[str, Any] = {"position": make_interp_spline(time, one.position, k=3)(inside)}
    for name in ("torque", "motor_current"):
        values = getattr(one, name)
        if values is not None:
            changed[name] = PchipInterpolator(time, values)(inside)
    if one.commanded_position is not None:
        command = one.commanded_position
        changed["commanded_position"] = np.column_stack(
            [np.interp(inside, time, column) for column in command.T]
        )
    return replace(one, time=at, gap_before=None, **changed)


_CHANNELS: Final = ("position", "torque", "motor_current", "commanded_position")


def _present(recording: Recording) -> tuple[str, ...]:
    return tuple(name for name in _CHANNELS if getattr(recording, name) is not None)


def _changed(recording: Recording, change: Callable[[Array], Array]) -> dict[str, Any]:
    return {name: change(getattr(recording, name)) for name in _present(recording)}
