"""Steps of a measured position that no arm makes: an encoder that slipped, or lost its count.

A step that departs from the steps beside it and is not made up for is no motion. What the other
joints have in common with a departure is the clock's, and is subtracted before it is judged.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.signals.recording import GAP_STEPS, Recording

Array = NDArray[np.float64]

# Robust standard deviations that a step must depart by.
_STANDS_OUT: Final = 15.0
# The same against the largest departures that come in numbers (starts, stops, reversals).
_USUAL: Final = 20  # departures
_BEYOND_USUAL: Final = 3.0
# Acceleration that turns a joint's speed within one step of the clock; robots reach a fifth of it.
_FASTEST: Final = 150.0  # rad/s² or m/s²
_BESIDE: Final = 4  # steps to either side
# Standard deviations that other joints must move in a step to show that a row is missing.
_SHOWS: Final = 5.0
# Departures of whole steps of motion are sought to this share of one.
_WHOLE: Final = 0.15
_NORMAL: Final = 1.4826  # a standard deviation over the median of absolute ones


@dataclass(frozen=True)
class PositionJump:
    """One step."""

    recording: str  # its name
    joint: str  # name
    time: float  # of the sample after the step [s], since the recording began
    size: float  # of the step, apart from the motion [rad or m]


def position_jumps(recording: Recording, name: str = "the recording") -> list[PositionJump]:
    """Lasting steps of the measured positions, in the order of time for each joint.

    In stretches without gaps, at the times that :func:`identification.signals.clock.true_times`
    decided on; `name` is that of the recording.
    """
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
    # Missing or repeated rows make departures of whole steps of the motion.
    one = speed * steps
    count = np.clip(np.rint(departure / np.where(one == 0.0, np.inf, one)), -1.0, GAP_STEPS)
    whole = np.abs(departure - count * one) < np.maximum(least, _WHOLE * np.abs(one))
    suspect = (size - 0.5 * change > least) & (shown | ~whole)
    found = []
    for joint, k in np.argwhere(suspect.T):
        around = departure[max(0, k - _BESIDE) : k + _BESIDE + 1, joint]
        if np.abs(around.sum()) > 0.5 * size[k, joint]:  # or the steps beside it take it back
            since = float(time[after[k]] - time[0])
            jump = float(departure[k, joint])
            found.append(PositionJump(name, recording.joint_names[joint], since, jump))
    return found


def _departures(time: Array, position: Array) -> tuple[Array, Array, Array]:
    """By how much each step departs from the speed beside it (m - 1, n), and that speed."""
    steps = np.diff(time)[:, None]
    speed = np.diff(position, axis=0) / steps
    padded = np.pad(speed, ((_BESIDE, _BESIDE), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _BESIDE + 1, axis=0)
    before = np.median(windows[..., :_BESIDE], axis=-1)
    after = np.median(windows[..., _BESIDE + 1 :], axis=-1)
    # The mean of both sides' medians follows a steady acceleration; one more jump beside is none.
    usual = 0.5 * (before + after)
    return (speed - usual) * steps, usual, np.abs(after - before) * steps


def _without_clock(departure: Array, speed: Array, steps: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Departures (m, n) without the error of the time that the other joints show."""
    # A joint at rest shows nothing: what does not depart is no measure of its noise.
    size = np.abs(departure)
    noise = np.array(
        [_NORMAL * np.median(some) if (some := one[one > 0.0]).size else np.inf for one in size.T]
    )
    off, rate = departure / noise, speed / noise
    weight = (rate**2).sum(axis=1, keepdims=True) - rate**2
    # The others' error of the time, pulled to zero by as much as one step is likely.
    error = ((rate * off).sum(axis=1, keepdims=True) - rate * off) / (weight + steps**-2)
    without = departure - speed * error
    less = np.where(np.abs(without) < size, without, departure)
    return less, weight * steps**2 > _SHOWS**2
