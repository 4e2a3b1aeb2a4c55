"""Stamps of a recording: their unit where nothing states it, counters that wrap, invalid clocks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.errors import SourceError
from hil.importers.conclusions import ClockRestarted, CounterContinued, Sample, SortedSamples
from hil.importers.units import TIMES
from identification.signals.recording import PAUSE_SECONDS
from identification.text import number

Stamps = NDArray[np.int64]

MIN_SAMPLING_RATE: Final = 20.0  # Hz; a robot's dynamics need faster sampling
MAX_SAMPLING_RATE: Final = 20_000.0  # Hz
_MAX_TIME_NS: Final = 10**40  # ns; more is no time in any unit
MIN_SECONDS: Final = 1.0
"""Of a recording [s]."""
_MIN_PLAUSIBLE_RATE: Final = 10.0  # Hz; 5 kHz in ms, read as s, are 5 Hz
_MAX_WRAP_STEPS: Final = 10  # median steps that a counter may pass where it wraps
_MIN_PART_NS: Final = 10**9  # ns of a motion that was recorded after another one
PAUSE_NS: Final = 10**9
"""Pause that separates two motions [ns]."""
# ns between motions whose clock began again, in which rows of one motion are not late
_RESTART_NS: Final = round(1.1e9 * PAUSE_SECONDS)
_MIN_ROWS: Final = 20  # rows
_MAX_SWAPPED_SHARE: Final = 0.02  # share of the samples of a recording that may have changed places
_MIN_USUAL_STEP_SHARE: Final = 0.9  # of the steps of a clock are usual ones
YEAR_NS: Final = 365 * 86_400 * 10**9
"""[ns]"""
_WRAPS: Final[dict[str, int]] = {
    **{
        f"a {bits}-bit counter of {unit}": 2**bits * 10 ** (9 - places)
        for unit, places in TIMES.items()
        for bits in (32, 31, 16)
    },
    "the time of day": 86_400 * 10**9,
}
"""Ranges [ns] after which clocks begin again."""


def concluded_unit(times: Sequence[int | None]) -> str:
    """Return the unit of times that nothing states, given as nanoseconds of seconds.

    It is the longest that gives a rate of sampling at which robots are recorded, of a second or
    more: seconds where none does, and for a column that only counts the samples. Of a few rows,
    which are no second in any unit, the rate decides alone, unless they are several in a second.
    """
    stamps = np.array(
        [time / 1e9 for time in times if time is not None and abs(time) < _MAX_TIME_NS]
    )
    steps = np.diff(stamps)
    steps = steps[steps > 0.0]
    if not steps.size or (bool(np.all(np.abs(steps - 1.0) < 1e-9)) and stamps[0] in (0.0, 1.0)):
        return "s"
    step = float(np.median(steps))
    possible = [
        unit
        for unit, places in TIMES.items()
        if _MIN_PLAUSIBLE_RATE <= 10.0**places / step <= MAX_SAMPLING_RATE
    ]
    lasting = [unit for unit in possible if steps.sum() >= MIN_SECONDS * 10.0 ** TIMES[unit]]
    if not lasting and step < 1.0:
        return "s"
    return next(iter((*lasting, *possible)), "s")


class Continued(NamedTuple):
    """Stamps of a counter without its wraps."""

    stamp: Stamps
    wrapped: CounterContinued | None  #: None if nothing did


def without_wraps(stamp: Stamps) -> Continued:
    """Return stamps (m,) [ns] that go on where a counter of limited range began again.

    Every backward step must then be an ordinary one, else the stamps are returned as they are.
    """
    steps = np.diff(stamp)
    backward = steps < 0
    forward = steps[steps > 0]
    if not backward.any() or not forward.size:
        return Continued(stamp, None)
    usual = int(np.median(forward))
    for name, wrap in _WRAPS.items():
        continued = steps[backward] + wrap
        # A counter with a range of a few samples looks like a clock that was set back.
        if wrap < 4 * _MAX_WRAP_STEPS * usual:
            continue
        if ((continued > 0) & (continued <= _MAX_WRAP_STEPS * usual)).all():
            passed = np.concatenate([[0], np.cumsum(np.where(backward, wrap, 0))])
            return Continued(stamp + passed, CounterContinued(name, int(backward.sum())))
    return Continued(stamp, None)


def leading_zeros(stamp: Stamps) -> int:
    """Return how many of the first stamps are 0, before a clock of the epoch was there."""
    zeros = int(np.argmax(stamp != 0)) if stamp.any() else 0
    return zeros if zeros and abs(int(stamp[zeros])) > YEAR_NS else 0


class Sorted(NamedTuple):
    """The order of samples by stamp."""

    order: NDArray[np.intp]
    swapped: SortedSamples | None  #: None if none had changed places


def sorted_neighbours(stamp: Stamps, sample: Sample) -> Sorted:
    """Return the order of samples by stamp (m,) [ns] where a few neighbours changed places.

    A clock that was set back stays as it is, to be refused: there a sample is older than many
    before it.
    """
    unchanged = np.arange(len(stamp))
    backward = int(np.count_nonzero(np.diff(stamp) < 0))
    if not backward:
        return Sorted(unchanged, None)
    order = np.argsort(stamp, kind="stable")
    farthest = int(np.abs(order - unchanged).max())
    if farthest > 2 or backward > max(1.0, _MAX_SWAPPED_SHARE * len(stamp)):
        return Sorted(unchanged, None)
    return Sorted(order, SortedSamples(backward, sample))


class Restarted(NamedTuple):
    """Stamps whose parts follow each other."""

    stamp: Stamps
    restarted: ClockRestarted | None  #: None if the clock never began again


def without_restarts(stamp: Stamps) -> Restarted:
    """Return stamps (m,) [ns] in which motions recorded one after the other have a pause between.

    Every part must be long, and run forward: else the clock runs backwards, which is refused.
    """
    edges = [0, *(np.flatnonzero(np.diff(stamp) < 0) + 1).tolist(), len(stamp)]
    parts = [stamp[a:b] for a, b in pairwise(edges)]
    shortest = min(int(part[-1] - part[0]) if len(part) else 0 for part in parts)
    if len(parts) == 1 or shortest < _MIN_PART_NS:
        return Restarted(stamp, None)
    joined = [parts[0]]
    for part in parts[1:]:
        joined.append(part - part[0] + joined[-1][-1] + _RESTART_NS)
    return Restarted(np.concatenate(joined), ClockRestarted(len(parts)))


def is_row_counter(times: Sequence[int | None]) -> bool:
    """Return whether times that are read as seconds [ns] count the rows, from 0 or 1."""
    known = [time for time in times if time is not None and abs(time) < _MAX_TIME_NS]
    if len(known) < _MIN_ROWS or known[0] not in (0, 10**9):
        return False
    return all(after - before == 10**9 for before, after in pairwise(known))


def is_clock(values: Array) -> bool:
    """Return whether numbers (m,) are times: they grow in every row, mostly by the same step."""
    steps = np.diff(values)
    if len(steps) < 2 or not np.all(steps > 0.0):
        return False
    usual = np.median(steps)
    return bool(np.mean(np.abs(steps - usual) <= 0.5 * usual) >= _MIN_USUAL_STEP_SHARE)


def check_clock(stamp: Stamps, path: Path, remedy: str | None = None) -> None:
    """Check that stamps (m,) [ns] of a file can be of a motion.

    `remedy` replaces the remedies of a log with a column map.

    Raises:
        SourceError: they run backwards, are all the same, or are too far apart.
    """
    steps = np.diff(stamp)
    backward = np.flatnonzero(steps < 0)
    if backward.size:
        first = int(backward[0]) + 1
        problem = (
            f"sample {first} is {number(-1e-9 * steps[first - 1])} s older than the previous one "
            f"({backward.size} such steps)"
        )
        cut = "cut the recording where its clock runs backwards"
        if backward.size == len(steps):
            cut = "write the rows in the order of their times"
        other = remedy or "choose another time column"
        raise SourceError(path, problem, field="time", remedy=f"{cut}, or {other}")
    if steps.size and not steps.any():
        problem = f"all {len(stamp)} samples have the same time"
        other = remedy or (
            "state the column of the time, --columns time=NAME, or the rate of the samples, "
            "--sample-rate HZ ([time] and sample_rate of a map)"
        )
        raise SourceError(path, problem, field="time", remedy=other)
    rate = 1e9 / float(np.median(steps[steps > 0])) if steps.size else np.inf
    if rate < _MIN_PLAUSIBLE_RATE:
        problem = f"has {number(rate, 2)} samples per second, too few for a motion"
        other = remedy or (
            "check its unit ([time] unit, or sample_rate in Hz): milliseconds read as seconds "
            f"would give {1e3 * rate:.0f} samples per second; at least {MIN_SAMPLING_RATE:g} are"
            " needed"
        )
        raise SourceError(path, problem, field="time", remedy=other)
