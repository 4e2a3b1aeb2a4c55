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
import scipy
from numpy.typing import NDArray

from identification.recording import GAP_STEPS, Recording, RecordingError

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

# A filter that takes samples for uniform misplaces them by their jitter. One percent of a step
# moves a sine of a tenth of the sampling rate by less than one percent of its amplitude.
UNIFORM: Final = 0.01
# Where a sample may be missing; whether one is, the phase of the clock around it says.
_DROPPED: Final = 1.35  # steps
_PHASE_STAMPS: Final = 7
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
        dropped: samples that are missing where the clock steps by at most
            `GAP_STEPS` usual steps.
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
    reported = np.zeros(len(steps), dtype=np.bool_) if gap_before is None else gap_before[1:]
    median = float(np.median(forward))
    gap = reported | (steps > GAP_STEPS * median)
    within = ~gap & (steps > 0.0)
    step = _usual_step(time, steps[within], median)
    suspects = np.flatnonzero(within & (steps > _DROPPED * step))
    missing = _missing(time, gap, suspects, step)
    if within.any() and within[~gap].all():  # nothing repeats: every sample stands for its time
        step = float(steps[within].sum() / (np.count_nonzero(within) + missing.sum()))
    relative = steps[within & (missing == 0.0)] / step
    return TimeBase(
        samples=len(time),
        duration=float(time[-1] - time[0]),
        step=step,
        jitter=float(relative.std()) if relative.size else 0.0,
        largest_deviation=float(np.abs(relative - 1.0).max(initial=0.0)),
        repeated=int(np.count_nonzero(steps == 0.0)),
        backward=int(np.count_nonzero(steps < 0.0)),
        dropped=int(missing.sum()),
        gaps=int(np.count_nonzero(gap)),
    )


def _usual_step(time: Array, steps: Array, median: float) -> float:
    """Step of the clock [s], to more digits than stamps that were rounded to a few.

    The median over a few steps is known better than that of one step, and the mean of the steps
    around it better still: as many are left out above it as below.
    """
    lag = min(_PHASE_STAMPS, len(time) - 1)
    usual = float(np.median(time[lag:] - time[:-lag])) / lag
    if not 0.5 * median < usual < 2.0 * median:
        return median
    near = steps[np.abs(steps - usual) <= 0.5 * usual]
    return float(near.mean()) if near.size else usual


def _missing(time: Array, gap: Rows, suspects: NDArray[np.intp], step: float) -> Array:
    """Samples missing at suspiciously long steps, by the clock's phase before and after them.

    A stamp that came late makes one step long and the next one short, and nothing is missing; the
    median phase of a few stamps on either side does not move with one of them. Steps too close
    together for that are judged as one, and what is missing is counted at the longest.
    """
    counts = np.zeros(len(time) - 1)
    edges = np.flatnonzero(gap)
    for group in np.split(suspects, np.flatnonzero(np.diff(suspects) > _PHASE_STAMPS) + 1):
        if not group.size:
            continue
        stop, start = group[0] + 1, group[-1] + 1
        first = max(0, stop - _PHASE_STAMPS, *(edges[edges < group[0]] + 1)[-1:])
        last = min(len(time), start + _PHASE_STAMPS, *(edges[edges > group[-1]] + 1)[:1])
        before = np.median(time[first:stop] - step * np.arange(first, stop))
        behind = np.median(time[start:last] - step * np.arange(start, last))
        lost = max(0.0, float(np.rint((behind - before) / step)))
        counts[group[np.argmax(time[group + 1] - time[group])]] = lost
    return counts


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
    changed: dict[str, Any] = {
        "position": scipy.interpolate.make_interp_spline(time, one.position, k=3)(inside)
    }
    for name in ("velocity", "torque", "motor_current"):
        values = getattr(one, name)
        if values is not None:
            changed[name] = scipy.interpolate.PchipInterpolator(time, values)(inside)
    if one.commanded_position is not None:
        command = one.commanded_position
        changed["commanded_position"] = np.column_stack(
            [np.interp(inside, time, column) for column in command.T]
        )
    return replace(one, time=at, gap_before=None, **changed)


_CHANNELS: Final = ("position", "velocity", "torque", "motor_current", "commanded_position")


def _present(recording: Recording) -> tuple[str, ...]:
    return tuple(name for name in _CHANNELS if getattr(recording, name) is not None)


def _changed(recording: Recording, change: Callable[[Array], Array]) -> dict[str, Any]:
    return {name: change(getattr(recording, name)) for name in _present(recording)}
