"""Steps of a measured position that an arm cannot make, such as lost encoder counts.

They depart from the steps beside them, and later steps do not reverse them. Departures common to
the other joints are errors of the clock and are subtracted first. Samples that the log repeats, or
has late, are recognised by their place on the path of the motion. Steps whose sum is zero enclose
an excursion: rows in which the joint was not where they say, before and after which it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import MAD_TO_STD
from identification.signals.noise import smallest_steps
from identification.signals.recording import GAP_STEPS, Recording

# Acceleration within one step of the clock; robots reach a fifth of it.
MAX_ACCELERATION: Final = 150.0
"""rad/s² or m/s²"""
_ROWS_AT_ONCE: Final = 50_000  # that are searched for steps
_JUMP_SIGMAS: Final = 15.0  # robust standard deviations of a jump
# The same relative to the frequent large departures (starts, stops, reversals).
_USUAL_DEPARTURES: Final = 20  # departures
_USUAL_DEPARTURE_FACTOR: Final = 3.0
_NEIGHBOUR_STEPS: Final = 4  # steps to either side
# Standard deviations by which other joints must move for a missing row to be visible.
_VISIBLE_SIGMAS: Final = 5.0
_MOVING_RATIO: Final = 3.0  # multiples of the usual departure of a joint that moves
# departures by a whole step that an encoder does not repeat by chance
_MIN_REPEATED_DEPARTURES: Final = 3
_PATH_TOLERANCE_SHARE: Final = 0.25  # distance from the extrapolated path, as a share of the step
# tolerance of departures by whole steps of the motion, as a share of a step
_WHOLE_STEP_TOLERANCE: Final = 0.15
# Resolutions by which rounding moves a step: one at its ends, half of one in the speed beside it.
_ROUNDING_RESOLUTIONS: Final = 1.5


@dataclass(frozen=True)
class PositionJump:
    """One impossible step of a position."""

    recording: str
    joint: str
    time: float  # of the sample after the step [s], since the recording began
    size: float  # [rad or m], without the motion
    unit: str = "rad"  # of `size`


class PositionSteps(NamedTuple):
    """Lasting steps of the measured positions of a recording that the motion does not have."""

    jumps: tuple[PositionJump, ...]  # of a position, by joint and time
    logged: tuple[PositionJump, ...]  # of the log: samples repeated or late, rows missing


class Excursion(NamedTuple):
    """Rows in which a joint was not where they say."""

    joint: int
    start: int
    stop: int
    size: float  # of the step into them [rad or m]


def position_jumps(recording: Recording, name: str = "the recording") -> list[PositionJump]:
    """Return lasting steps of the measured positions of a named recording, by joint and time."""
    return list(position_steps(recording, name).jumps)


def position_steps(recording: Recording, name: str = "the recording") -> PositionSteps:
    """Return lasting steps of the positions of a named recording that its log did not make."""
    jumps: list[PositionJump] = []
    logged: list[PositionJump] = []
    rounded = _rounding(recording)
    for parts in _pieces(recording):
        steps = _steps_of(recording, parts, name, rounded)
        jumps += steps.jumps
        logged += steps.logged
    return PositionSteps(tuple(jumps), tuple(logged))


def _pieces(recording: Recording) -> Iterator[list[slice]]:
    """Yield stretches without a gap, together some `_ROWS_AT_ONCE` rows, with the row before."""
    parts: list[slice] = []
    for segment in recording.segments():
        for start in range(segment.start, segment.stop, _ROWS_AT_ONCE):
            stop = min(start + _ROWS_AT_ONCE, segment.stop)
            first = max(segment.start, start - 1)
            if stop - first <= 2 * _NEIGHBOUR_STEPS + 2:
                continue
            parts.append(slice(first, stop))
            if sum(part.stop - part.start for part in parts) >= _ROWS_AT_ONCE:
                yield parts
                parts = []
    if parts:
        yield parts


@dataclass(frozen=True, eq=False)
class _Departures:
    """Steps within stretches of a recording, and how they differ from their neighbours."""

    after: NDArray[np.intp]  # row after each step (k,)
    size: Array  # without the motion and errors of the clock (k, n)
    least: Array  # that neither noise nor rounding make (k, n)
    motion: Array  # usual step of the motion (k, n)
    suspect: NDArray[np.bool_]  # (k, n)
    by_whole_steps: NDArray[np.bool_]  # of the motion (k, n)
    moving: NDArray[np.bool_]  # (k, n)

    @classmethod
    def of(cls, recording: Recording, parts: Sequence[slice], rounded: Array) -> _Departures:
        """Compare the steps of stretches; rounding changes the step of each joint by up to (n,)."""
        time = recording.time
        position = recording.position
        pieces = [_departures(time[part], position[part]) for part in parts]
        departure, speed, change = map(np.concatenate, zip(*pieces, strict=True))
        steps = np.concatenate([np.diff(time[part]) for part in parts])[:, None]
        after = np.concatenate([np.arange(part.start + 1, part.stop) for part in parts])
        departure, shown = _without_clock(departure, speed, steps)
        distance = np.abs(departure)
        spread = MAD_TO_STD * np.median(distance, axis=0)
        usual = (
            np.partition(distance, -_USUAL_DEPARTURES, axis=0)[-_USUAL_DEPARTURES]
            if len(distance) > 10 * _USUAL_DEPARTURES
            else 0.0
        )
        least = np.maximum(
            np.maximum(_JUMP_SIGMAS * spread, _USUAL_DEPARTURE_FACTOR * usual),
            MAX_ACCELERATION * steps**2,
        )
        least = np.maximum(least, rounded)
        # Missing or repeated rows cause departures by whole steps of the motion, also at a gap.
        motion = speed * np.median(steps)
        count = np.clip(
            np.rint(departure / np.where(motion == 0.0, np.inf, motion)), -1.0, GAP_STEPS
        )
        apart = np.abs(departure - count * motion)
        whole = apart < np.maximum(least, _WHOLE_STEP_TOLERANCE * np.abs(motion))
        suspect = (distance - 0.5 * change > least) & (shown | ~whole)
        by_whole_steps = (count != 0.0) & (apart < _WHOLE_STEP_TOLERANCE * np.abs(motion))
        moving = np.abs(motion) > _MOVING_RATIO * spread
        return cls(after, departure, least, motion, suspect, by_whole_steps, moving)


def _steps_of(
    recording: Recording, parts: Sequence[slice], name: str, rounded: Array
) -> PositionSteps:
    """Return the lasting steps within stretches of a recording, larger than by rounding (n,)."""
    time = recording.time
    position = recording.position
    found = _Departures.of(recording, parts, rounded)
    distance = np.abs(found.size)
    lasting = np.zeros_like(found.suspect)
    for joint, k in np.argwhere(found.suspect.T):
        around = found.size[max(0, k - _NEIGHBOUR_STEPS) : k + _NEIGHBOUR_STEPS + 1, joint]
        # Otherwise its neighbouring steps reverse it.
        lasting[k, joint] = np.abs(around.sum()) > 0.5 * distance[k, joint]
    by_whole_steps = found.by_whole_steps
    often = np.count_nonzero(lasting & by_whole_steps) >= _MIN_REPEATED_DEPARTURES
    together = np.count_nonzero(_nearby(lasting) & found.moving, axis=1)
    every = (together >= 2) & (together > 0.5 * np.count_nonzero(found.moving, axis=1))
    jumps: list[PositionJump] = []
    logged: list[PositionJump] = []
    for joint, k in np.argwhere(lasting.T):
        row = int(found.after[k])
        jump = float(found.size[k, joint])
        position_jump = PositionJump(
            name,
            recording.joint_names[joint],
            float(time[row] - time[0]),
            jump,
            recording.unit_of(joint),
        )
        by_log = every[k] or (by_whole_steps[k, joint] and often)
        tolerance = _PATH_TOLERANCE_SHARE * abs(jump) + float(rounded[joint])
        by_log |= _on_path(time, position[:, joint], row, tolerance)
        (logged if by_log else jumps).append(position_jump)
    return PositionSteps(tuple(jumps), tuple(logged))


def excursions(recording: Recording) -> list[Excursion]:
    """Return rows in which single joints were not where they say, by joint and row.

    The steps into and out of them add up to less than what is a step, or the motion goes on after
    them as before.
    """
    rounded = _rounding(recording)
    found: list[Excursion] = []
    for parts in _pieces(recording):
        departures = _Departures.of(recording, parts, rounded)
        for joint in np.flatnonzero(departures.suspect.any(axis=0)).tolist():
            found += _excursions_of(recording, departures, joint, float(rounded[joint]))
    return found


def _excursions_of(
    recording: Recording, departures: _Departures, joint: int, rounded: float
) -> Iterator[Excursion]:
    """Yield the excursions of a joint: the fewest steps in a row after which it goes on."""
    position = recording.position[:, joint]
    steps: list[_Step] = []  # into an excursion, or lasting
    for k in np.flatnonzero(departures.suspect[:, joint]).tolist():
        row = int(departures.after[k])
        size = float(departures.size[k, joint])
        tolerance = _PATH_TOLERANCE_SHARE * abs(size) + rounded
        if _on_path(recording.time, position, row, tolerance):
            continue
        steps.append(_Step(row, size, float(departures.least[k, joint])))
        for first in range(len(steps) - 2, -1, -1):
            total = sum(step.size for step in steps[first:])
            returns = abs(total) < steps[first].least + steps[-1].least
            if returns or _continues(recording.time, position, steps[first], steps[-1]):
                into = steps[first].row
                yield Excursion(joint, into, row, float(position[into] - position[into - 1]))
                del steps[first:]
                break


def _continues(time: Array, position: Array, into: _Step, out: _Step) -> bool:
    """Return whether positions (m,) after a step go on where those before another one led to.

    Between them they need not follow the motion, as zeros do not.
    """
    start, stop = into.row - 1, out.row
    first, last = max(start - _NEIGHBOUR_STEPS, 0), min(stop + _NEIGHBOUR_STEPS, len(time) - 1)
    if first == start or last == stop or into.size * out.size > 0.0:
        return False
    before = (position[start] - position[first]) / (time[start] - time[first])
    after = (position[last] - position[stop]) / (time[last] - time[stop])
    passed = time[stop] - time[start]
    expected = position[start] + 0.5 * (before + after) * passed
    doubt = abs(position[stop] - expected) + 0.5 * abs(after - before) * passed
    return bool(doubt < _PATH_TOLERANCE_SHARE * min(abs(into.size), abs(out.size)))


class _Step(NamedTuple):
    """A step of a position."""

    row: int  # after it
    size: float
    least: float  # that is one


def _rounding(recording: Recording) -> Array:
    """Return by how much rounding may move a step of each joint (n,)."""
    return _ROUNDING_RESOLUTIONS * smallest_steps(recording.position)


def _nearby(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where a row or a neighbour is marked (m, n)."""
    padded = np.pad(marked, ((1, 1), (0, 0)))
    return np.asarray(padded[:-2] | padded[1:-1] | padded[2:])


def _on_path(time: Array, position: Array, row: int, tolerance: float) -> bool:
    """Return whether a step to a row of a position (m,) begins or ends a frozen value, on its path.

    A sample that exactly repeats the one before it while the joint moves is no new measurement.
    """
    if position[row] == position[row - 1]:
        return True
    first = row - 1
    while first > 0 and position[first - 1] == position[first]:
        first -= 1
    if first == row - 1 or first < _NEIGHBOUR_STEPS or row + _NEIGHBOUR_STEPS >= len(time):
        return False
    before = (position[first] - position[first - _NEIGHBOUR_STEPS]) / (
        time[first] - time[first - _NEIGHBOUR_STEPS]
    )
    behind = (position[row + _NEIGHBOUR_STEPS] - position[row]) / (
        time[row + _NEIGHBOUR_STEPS] - time[row]
    )
    expected = position[first] + 0.5 * (before + behind) * (time[row] - time[first])
    return bool(abs(position[row] - expected) < tolerance)


def _departures(time: Array, position: Array) -> tuple[Array, Array, Array]:
    """Return how much each step departs from the neighbouring speed (m - 1, n), and this speed."""
    steps = np.diff(time)[:, None]
    speed = np.diff(position, axis=0) / steps
    padded = np.pad(speed, ((_NEIGHBOUR_STEPS, _NEIGHBOUR_STEPS), (0, 0)), mode="edge")
    medians = _medians_of_four(padded)
    before, after = medians[: len(speed)], medians[_NEIGHBOUR_STEPS + 1 :]
    # The mean of both sides' medians follows a steady acceleration and ignores single jumps.
    usual = 0.5 * (before + after)
    return (speed - usual) * steps, usual, np.abs(after - before) * steps


def _medians_of_four(values: Array) -> Array:
    """Return the medians of `_NEIGHBOUR_STEPS` successive rows (m - 3, n) of values (m, n)."""
    low = np.minimum(values[:-1], values[1:])
    high = np.maximum(values[:-1], values[1:])
    return 0.5 * (np.maximum(low[:-2], low[2:]) + np.minimum(high[:-2], high[2:]))


def _without_clock(departure: Array, speed: Array, steps: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Subtract the time error shown by the other joints from departures (m, n)."""
    # Departures of zero, at rest, do not measure noise.
    distance = np.abs(departure)
    noise = np.array(
        [
            MAD_TO_STD * np.median(some) if (some := column[column > 0.0]).size else np.inf
            for column in distance.T
        ]
    )
    off = departure / noise
    rate = speed / noise
    weight = (rate**2).sum(axis=1, keepdims=True) - rate**2
    # Time error of the other joints, regularised by one step.
    error = ((rate * off).sum(axis=1, keepdims=True) - rate * off) / (weight + steps**-2)
    without = departure - speed * error
    less = np.where(np.abs(without) < distance, without, departure)
    return less, weight * steps**2 > _VISIBLE_SIGMAS**2
