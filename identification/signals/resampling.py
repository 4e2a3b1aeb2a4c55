"""Uniform samples, where one needs them.

A smoothing spline takes any increasing time base as it is, and so does a fit. Uniform samples are
needed by filters that count samples instead of seconds, such as
:mod:`identification.signals.butterworth`. Nothing is ever made up across a gap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.signals.recording import Recording, RecordingError

Array = NDArray[np.float64]

_LONGEST: Final = 1.35  # usual steps; a longer one would be decimation
_CUBIC: Final = 4  # samples


def without_repeats(recording: Recording) -> Recording:
    """Return the recording with one sample per time stamp: the mean of those that share it.

    Raises:
        RecordingError: the clock falls back; which sample is right cannot be determined.
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
    if not 0.0 < step <= _LONGEST * usual:
        raise ValueError(
            f"a step of {step} s is not between zero and {_LONGEST} times the usual {usual:.6g} s:"
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
