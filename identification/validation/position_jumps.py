"""Steps of a measured position that an arm cannot make, such as lost encoder counts.

A step is compared with those beside it; a jump is a departure that later steps do not reverse.
Departures common to the other joints are errors of the clock and are subtracted first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.signals.recording import GAP_STEPS, Recording

Array = NDArray[np.float64]

_STANDS_OUT: Final = 15.0  # robust standard deviations of a jump
# The same relative to the frequent large departures (starts, stops, reversals).
_USUAL: Final = 20  # departures
_BEYOND_USUAL: Final = 3.0
# Acceleration within one step of the clock; robots reach a fifth of it.
_FASTEST: Final = 150.0  # rad/s² or m/s²
_BESIDE: Final = 4  # steps to either side
# Standard deviations by which other joints must move for a missing row to be visible.
_SHOWS: Final = 5.0
_WHOLE: Final = 0.15  # tolerance of departures by whole steps of the motion, as a share of a step
_NORMAL: Final = 1.4826  # standard deviation over median absolute value


@dataclass(frozen=True)
class PositionJump:
    """One impossible step of a position."""

    recording: str
    joint: str
    time: float  # of the sample after the step [s], since the recording began
    size: float  # [rad or m], without the motion


def position_jumps(recording: Recording, name: str = "the recording") -> list[PositionJump]:
    """Return lasting steps of the measured positions of a named recording, by joint and time."""
    time, position = recording.time, recording.position
    parts = [part for part in recording.segments() if part.stop - part.start > 2 * _BESIDE + 2]
    if not parts:
        return []
    pieces = [_departures(time[part], position[part]) for part in parts]
    departure, speed, change = map(np.concatenate, zip(*pieces, strict=True))
    steps = np.concatenate([np.diff(time[part]) for part in parts])[:, None]
    after = np.concatenate([np.arange(part.start + 1, part.stop) for part in parts])
    departure, shown = _without_clock(departure, speed, steps)
    size = np.abs(departure)
    spread = _NORMAL * np.median(size, axis=0)
    usual = np.partition(size, -_USUAL, axis=0)[-_USUAL] if len(size) > 10 * _USUAL else 0.0
    least = np.maximum(np.maximum(_STANDS_OUT * spread, _BEYOND_USUAL * usual), _FASTEST * steps**2)
    # Missing or repeated rows cause departures by whole steps of the motion.
    one = speed * steps
    count = np.clip(np.rint(departure / np.where(one == 0.0, np.inf, one)), -1.0, GAP_STEPS)
    whole = np.abs(departure - count * one) < np.maximum(least, _WHOLE * np.abs(one))
    suspect = (size - 0.5 * change > least) & (shown | ~whole)
    found = []
    for joint, k in np.argwhere(suspect.T):
        around = departure[max(0, k - _BESIDE) : k + _BESIDE + 1, joint]
        if np.abs(around.sum()) > 0.5 * size[k, joint]:  # otherwise the steps beside it reverse it
            since = float(time[after[k]] - time[0])
            jump = float(departure[k, joint])
            found.append(PositionJump(name, recording.joint_names[joint], since, jump))
    return found


def _departures(time: Array, position: Array) -> tuple[Array, Array, Array]:
    """Return how much each step departs from the speed beside it (m - 1, n), and that speed."""
    steps = np.diff(time)[:, None]
    speed = np.diff(position, axis=0) / steps
    padded = np.pad(speed, ((_BESIDE, _BESIDE), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _BESIDE + 1, axis=0)
    before = np.median(windows[..., :_BESIDE], axis=-1)
    after = np.median(windows[..., _BESIDE + 1 :], axis=-1)
    # The mean of both sides' medians follows a steady acceleration and ignores single jumps.
    usual = 0.5 * (before + after)
    return (speed - usual) * steps, usual, np.abs(after - before) * steps


def _without_clock(departure: Array, speed: Array, steps: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Subtract the time error shown by the other joints from departures (m, n)."""
    # Departures of zero, at rest, do not measure noise.
    size = np.abs(departure)
    noise = np.array(
        [_NORMAL * np.median(some) if (some := one[one > 0.0]).size else np.inf for one in size.T]
    )
    off, rate = departure / noise, speed / noise
    weight = (rate**2).sum(axis=1, keepdims=True) - rate**2
    # Time error of the other joints, regularised by one step.
    error = ((rate * off).sum(axis=1, keepdims=True) - rate * off) / (weight + steps**-2)
    without = departure - speed * error
    less = np.where(np.abs(without) < size, without, departure)
    return less, weight * steps**2 > _SHOWS**2
