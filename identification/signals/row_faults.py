"""Rows that a log cannot have from one motion: frozen, written twice, displaced, of another motion.

Positions alone show them, so they are left out before anything is judged by torque.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, runs_of
from identification.signals.noise import smallest_steps
from identification.signals.position_steps import MAX_ACCELERATION, Excursion, excursions
from identification.signals.recording import GAP_STEPS, Recording

Rows = NDArray[np.bool_]

_NEIGHBOUR_ROWS: Final = 4  # rows to either side
_MIN_REPEATED_ROWS: Final = 10  # rows that are written twice
# share of the rows that may be displaced: of more, these may be where the joint was
_MAX_DISPLACED: Final = 0.5
_HELD_QUANTILE: Final = 0.9  # quantile of the rows for which a sample is held in a slower channel


class RowFaultKind(Enum):
    """What is wrong with rows of a log."""

    FROZEN = auto()  #: the logger repeated a row while the arm moved on
    WRITTEN_TWICE = auto()  #: the same rows again
    DISPLACED = auto()  #: a joint was not where they say, and is again after them
    JUMP = auto()  #: another motion begins, or rows are missing and the stamps do not show it


@dataclass(frozen=True)
class RowFault:
    """Rows of a log that are not of its motion.

    Attributes:
        kind: what is wrong.
        time: of the first of them, or of the first row after a jump [s].
        duration: of the rows [s].
        rows: how many were left out; 0 at a jump, which separates two motions.
        joints: whose positions jump, or are displaced.
        size: of the step into displaced rows, the largest [rad or m].
        unit: of the size.
    """

    kind: RowFaultKind
    time: float
    duration: float
    rows: int
    joints: tuple[str, ...] = ()
    size: float = 0.0
    unit: str = "rad"


@dataclass(frozen=True)
class RowFaults:
    """Rows of a log with the same fault, in one place or more.

    Attributes:
        kind: what is wrong.
        faults: in order of time.
    """

    kind: RowFaultKind
    faults: tuple[RowFault, ...]

    @property
    def rows(self) -> int:
        """How many rows were left out."""
        return sum(fault.rows for fault in self.faults)

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints whose positions jump, or are displaced."""
        return tuple(dict.fromkeys(joint for fault in self.faults for joint in fault.joints))


def by_kind(faults: Sequence[RowFault]) -> tuple[RowFaults, ...]:
    """Group faults by kind."""
    of_kind = {
        kind: tuple(sorted((f for f in faults if f.kind is kind), key=lambda fault: fault.time))
        for kind in RowFaultKind
    }
    return tuple(RowFaults(kind, found) for kind, found in of_kind.items() if found)


def without_faulty_rows(recording: Recording) -> tuple[Recording, tuple[RowFault, ...]]:
    """Return a recording without such rows, with gaps where they were, and what was found."""
    frozen = list(_frozen(recording))
    valid = np.ones(recording.n_samples, np.bool_)
    for start, stop in frozen:
        valid[start:stop] = False
    faults = [_fault(RowFaultKind.FROZEN, recording, *each) for each in frozen]
    gap = np.zeros(recording.n_samples, np.bool_)
    if recording.gap_before is not None:
        gap |= recording.gap_before
    gap[[stop for _, stop in frozen if stop < len(gap)]] = True
    displaced = _displaced(replace(recording, gap_before=gap), valid)
    ends = np.zeros_like(gap)
    for each in displaced:
        ends[[each.start, each.stop]] = True
    faults += _displacements(recording, displaced)
    starts: list[tuple[int, NDArray[np.intp] | None]] = [
        (part.start, None) for part in recording.segments()[1:]
    ]
    for row, joints in (*starts, *_jumps(recording, gap | ends)):
        if not valid[row]:
            continue
        stop = row + _written_before(recording, row)
        if stop > row:
            valid[row:stop] = False
            faults.append(_fault(RowFaultKind.WRITTEN_TWICE, recording, row, stop))
            gap[stop : stop + 1] = True
            continue
        if joints is None:
            continue
        gap[row] = True
        names = tuple(np.array(recording.joint_names)[joints].tolist())
        time = float(recording.time[row])
        faults.append(RowFault(RowFaultKind.JUMP, time, 0.0, 0, names))
    for each in displaced:
        valid[each.start : each.stop] = False
        # Few missing rows are no gap.
        gap[each.stop] |= each.stop - each.start >= GAP_STEPS
    if not faults:
        return recording, ()
    faults.sort(key=lambda fault: fault.time)
    return replace(recording, gap_before=gap).rows(valid), tuple(faults)


def _fault(kind: RowFaultKind, recording: Recording, start: int, stop: int) -> RowFault:
    time = recording.time
    duration = float(time[min(stop, len(time) - 1)] - time[start])
    return RowFault(kind, float(time[start]), duration, stop - start)


def _displaced(recording: Recording, valid: Rows) -> list[Excursion]:
    """Return valid rows in which joints are displaced; none where these are most of all."""
    if not recording.usual_step:
        return []
    if (np.diff(recording.time) <= 0.0).any():  # stamps that repeat are not the times of rows
        even = recording.usual_step * np.arange(recording.n_samples, dtype=np.float64)
        recording = replace(recording, time=np.asarray(even, dtype=np.float64))
    places = np.flatnonzero(valid)
    found = [
        each._replace(start=int(places[each.start]), stop=int(places[each.stop]))
        for each in excursions(recording.rows(valid))
    ]
    rows = np.zeros(recording.n_samples, np.bool_)
    for each in found:
        rows[each.start : each.stop] = True
    return found if np.count_nonzero(rows) < _MAX_DISPLACED * len(rows) else []


def _displacements(recording: Recording, found: Sequence[Excursion]) -> Iterator[RowFault]:
    """Yield the displaced rows of each joint."""
    time = recording.time
    for joint in sorted({each.joint for each in found}):
        own = [each for each in found if each.joint == joint]
        yield RowFault(
            RowFaultKind.DISPLACED,
            float(time[min(each.start for each in own)]),
            float(sum(time[each.stop] - time[each.start] for each in own)),
            sum(each.stop - each.start for each in own),
            (recording.joint_names[joint],),
            max(abs(each.size) for each in own),
            recording.unit_of(joint),
        )


def _frozen(recording: Recording) -> Iterator[tuple[int, int]]:
    """Yield start and stop of rows that repeat the previous row while the arm moves on.

    Many more than a slower channel is held for; before or after them a joint would stop or start
    faster than any robot.
    """
    position = recording.position
    equal = np.ones(recording.n_samples - 1, np.bool_)
    for values in (position, recording.torque, recording.velocity):
        if values is not None:
            equal &= (values[1:] == values[:-1]).all(axis=1)
    runs = runs_of(equal)
    lengths = np.array([stop - start for start, stop in runs])
    if not len(runs):
        return
    single = recording.n_samples - int(lengths.sum()) - len(runs)  # rows that nothing repeats
    held = np.quantile(np.concatenate([lengths + 1, np.ones(max(0, single))]), _HELD_QUANTILE)
    least = MAX_ACCELERATION * recording.usual_step**2
    for start, stop in runs:
        if stop - start <= GAP_STEPS * held:
            continue
        beside = []
        if start > 0:
            beside.append(np.abs(position[start] - position[start - 1]))
        if stop + 1 < len(position):
            beside.append(np.abs(position[stop + 1] - position[stop]))
        resolution = smallest_steps(position)
        if any((size > np.maximum(least, 3.0 * resolution)).any() for size in beside):
            yield start + 1, stop + 1


def _jumps(recording: Recording, gap: Rows) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield rows before which several joints jump together, and which do.

    No few missing rows explain such a step: it is larger than `GAP_STEPS` further steps at the
    speed beside it. The positions stay there, other than after a single wrong row.
    """
    changed = np.any(np.diff(recording.position, axis=0) != 0.0, axis=1)
    places = np.concatenate([[0], np.flatnonzero(changed) + 1])  # of a slower channel too
    position = recording.position[places]
    if len(position) < 2 * _NEIGHBOUR_ROWS + 2:
        return
    median = recording.usual_step
    if not median:
        return
    step = np.diff(position, axis=0)
    passed = np.maximum(np.diff(recording.time[places]) / median, 1.0)[:, None] + GAP_STEPS
    possible = MAX_ACCELERATION * (passed * median) ** 2 + 3.0 * smallest_steps(position)
    # Medians of a neighbourhood take their time, and few steps are beyond a joint that stands.
    beyond = np.abs(step) > possible
    some = np.flatnonzero(beyond.any(axis=1))
    usual = _usual_steps(step, some)
    beyond[some] = np.abs(step[some]) > passed[some] * usual + possible[some]
    moving = np.count_nonzero(np.ptp(position, axis=0) > 0.0)
    found = np.flatnonzero(np.count_nonzero(beyond, axis=1) >= max(2.0, 0.5 * moving))
    breaks = {part.start for part in recording.segments()}
    for place in (found + 1).tolist():
        row = int(places[place])
        if row in breaks or gap[row]:
            continue
        stays = np.median(position[place : place + _NEIGHBOUR_ROWS], axis=0)
        stays = stays - np.median(position[max(0, place - _NEIGHBOUR_ROWS) : place], axis=0)
        joints = np.flatnonzero(beyond[place - 1])
        if (np.abs(stays)[joints] > 0.5 * np.abs(step[place - 1])[joints]).all():
            yield row, joints


def _usual_steps(step: Array, places: NDArray[np.intp]) -> Array:
    """Return the usual size (k, n) of the steps (m, n) next to some of them (k,), on either side.

    The median of a few, on the side where they are larger.
    """
    padded = np.pad(np.abs(step), ((_NEIGHBOUR_ROWS, _NEIGHBOUR_ROWS), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEIGHBOUR_ROWS + 1, axis=0)
    windows = windows[places]
    before, after = windows[..., :_NEIGHBOUR_ROWS], windows[..., _NEIGHBOUR_ROWS + 1 :]
    return np.asarray(np.maximum(np.median(before, axis=-1), np.median(after, axis=-1)))


def _written_before(recording: Recording, row: int) -> int:
    """Return how many rows from this one on repeat earlier ones, bit for bit."""
    rows = np.hstack(
        [recording.position, *([] if recording.torque is None else [recording.torque])]
    )
    earlier = np.flatnonzero((rows[:row] == rows[row]).all(axis=1))
    longest = 0
    for place in {*earlier[:1].tolist(), *earlier[-1:].tolist()}:  # an arm at rest has many
        lag = row - place
        same = (rows[row:] == rows[place : len(rows) - lag]).all(axis=1)
        length = len(same) if same.all() else int(np.argmin(same))
        longest = max(longest, min(length, lag))
    if longest < _MIN_REPEATED_ROWS:
        return 0
    moves = np.ptp(recording.position[row : row + longest], axis=0).any()
    return longest if moves else 0
