"""Time stamps of a recording, and the times at which its samples were measured.

Uneven stamps are either correct or delayed by the logger. The positions decide: at a speed of v, a
stamp error e moves the sample of every joint off its smooth motion by v e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import MAD_TO_STD
from identification.signals.recording import GAP_STEPS, PAUSE_SECONDS, Recording, RecordingError

Rows = NDArray[np.bool_]

# Largest deviation from a uniform step: 1 % displaces a sine of a tenth of the sampling rate by
# less than 1 % of its amplitude.
MAX_STEP_DEVIATION: Final = 0.01
# largest deviation from a step between which no sample is missing
_REGULAR_STEP_TOLERANCE: Final = 0.25
_STEP_LAG: Final = 7  # steps for measuring the usual step
_PHASE_SAMPLES: Final = 51  # samples averaged for the phase; slower changes are drift
_REFINEMENTS: Final = 3  # iterations of step and count of steps
_DRIFT_SAMPLES: Final = 101
_DECISION_SIGMAS: Final = 3.0  # required significance of the decision, standard deviations
_OUTLIER_SIGMAS: Final = 6.0  # limit of the influence of a row, standard deviations
_ROWS_AT_ONCE: Final = 20_000
_MIN_SAMPLES: Final = 32  # samples; shorter segments keep their stamps
_NEIGHBOUR_STEPS: Final = 4  # steps to either side for the speed at one
_SPEED_TIME: Final = 0.025  # s to either side for the speed next to a residual
_MIN_BURST_SHARE: Final = 0.9  # of the pauses of stamps that are late, not of missing rows
_MIN_CLARITY: Final = 8.0  # steps are counted by positions that resolve an eighth of a clock step
_MOVING_NOISE_RATIO: Final = 3.0  # multiples of noise and resolution of a moving joint
# Rounding noise of the distance from the cubic: sqrt((1 + 17 / 18) / 12).
_CUBIC_ROUNDING: Final = 0.4  # steps of the encoder
_CUBIC_OFFSETS: Final = np.array([-2, -1, 1, 2])  # neighbouring samples


@dataclass(frozen=True)
class TimeBase:
    """Statistics of the time stamps of a recording."""

    samples: int
    duration: float  #: from the first to the last [s]
    step: float  #: mean step without repeats, drops and gaps [s]
    jitter: float  #: standard deviation of the other steps, in steps
    largest_deviation: float  #: of such a step, in steps
    repeated: int  #: samples with the time stamp of the one before
    backward: int  #: samples with an earlier time stamp than the one before
    dropped: int  #: missing samples in steps of up to `GAP_STEPS`
    gaps: int  #: longer steps and reported gaps
    pauses: int = 0  #: of those, steps at which a recording is cut
    longest_pause: float = 0.0  #: [s]

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return 1.0 / self.step

    @property
    def uniform(self) -> bool:
        """Whether segments between gaps are uniformly sampled."""
        even = self.largest_deviation <= MAX_STEP_DEVIATION
        return even and self.repeated == self.backward == self.dropped == 0


def time_base(time: Array, gap_before: NDArray[np.bool_] | None = None) -> TimeBase:
    """Analyse finite time stamps (m,) [s], and where samples are missing before.

    Raises:
        RecordingError: fewer than two different times.
    """
    steps = np.diff(time)
    forward = steps[steps > 0.0]
    if forward.size == 0:
        raise RecordingError(f"all {len(time)} samples have the same time stamp")
    reported = np.zeros(len(steps), dtype=np.bool_) if gap_before is None else gap_before[1:]
    median = float(np.median(forward))
    gap = reported | (steps > GAP_STEPS * median)
    within = ~gap & (steps > 0.0)
    step = _usual_step(time, steps[within], median)
    missing = np.zeros(len(steps))
    for _ in range(_REFINEMENTS):
        passed = 0.0
        for start, stop in pairwise([0, *(np.flatnonzero(gap) + 1).tolist(), len(time)]):
            new = start + np.flatnonzero(np.diff(time[start:stop], prepend=np.nan) != 0.0)
            counts = _steps_by_phase(time[new], step)
            # After a repeated stamp a double step is no gap.
            missing[new[1:] - 1] = np.maximum(counts - np.diff(new), 0.0)
            passed += float(counts.sum())
        step = float(steps[~gap].sum()) / passed if passed else step
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
        pauses=int(np.count_nonzero(steps > PAUSE_SECONDS)),
        longest_pause=float(steps.max(initial=0.0, where=steps > PAUSE_SECONDS)),
    )


def _usual_step(time: Array, steps: Array, median: float) -> float:
    """Return the step of the clock [s], with more digits than rounded stamps."""
    lag = min(_STEP_LAG, len(time) - 1)
    usual = float(np.median(time[lag:] - time[:-lag])) / lag
    if not 0.5 * median < usual < 2.0 * median:
        return median
    near = steps[np.abs(steps - usual) <= 0.5 * usual]
    return float(near.mean()) if near.size else usual


def _steps_by_phase(time: Array, step: float) -> Array:
    """Return steps of an even clock between stamps (m,) [s] with errors below half a step."""
    turns = (time - time[0]) / step
    if np.abs(np.diff(turns) - 1.0).max(initial=0.0) < _REGULAR_STEP_TOLERANCE:
        return np.ones(len(turns) - 1)
    phasor = scipy.ndimage.uniform_filter1d(
        np.exp(2j * np.pi * turns).view(np.float64).reshape(-1, 2),
        _PHASE_SAMPLES,
        axis=0,
        mode="nearest",
    )
    phase = np.unwrap(np.arctan2(phasor[:, 1], phasor[:, 0])) / (2.0 * np.pi)
    ahead = np.rint(turns - phase) - np.arange(len(time))
    # Single stamps may deviate more; a missing sample shifts all later ones.
    ahead = np.maximum.accumulate(scipy.ndimage.median_filter(ahead, 5, mode="nearest"))
    return np.asarray(np.diff(ahead) + 1.0)


@dataclass(frozen=True)
class SampleTimes:
    """Which times of the samples were used, and the evidence for them.

    Attributes:
        removed: rows that repeat the sample before them while the arm moves.
        even: whether even times are used instead of the stamps.
        missing: samples that are counted in them.
        rate: of the even times [Hz].
        scatter: standard deviation of the stamps about even times, in steps.
        share: of the lateness of the stamps that the positions show: 0 if times are even, 1 if the
            stamps are right, NaN if the stamps are even.
        deviation: standard deviation of the share.
        residuals: high-frequency residual in multiples of noise, with the stamps and evenly.
    """

    removed: int
    even: bool
    missing: int
    rate: float
    scatter: float
    share: float
    deviation: float
    residuals: tuple[float, float]

    @property
    def certain(self) -> bool:
        """Whether the positions decide: the share is not between the hypotheses."""
        return bool(abs(self.share - 0.5) > max(_DECISION_SIGMAS * self.deviation, 0.25))


def true_times(recording: Recording) -> tuple[Recording, SampleTimes]:
    """Return the recording at the times of its samples, and how they were decided.

    Two hypotheses are compared by positions, and velocities if given: the stamps, which may repeat
    or fall back, and even times that follow their slow drift, with missing samples counted. With
    even times, the distance of each sample from the cubic through its neighbours is noise; if the
    stamps are correct it also contains speed times stamp deviation, with a share near one instead
    of zero; otherwise the stamps are used. Rows that repeat the sample before them in motion are
    removed.

    Raises:
        RecordingError: NaN or infinity, or constant time stamps.
    """
    recording.check_finite()
    time = recording.time
    signals = recording.position
    if recording.velocity is not None:
        signals = np.hstack([signals, recording.velocity])
    base, clock = _clock_of(recording, signals)
    share = np.nan
    deviation = np.nan
    residuals = (1.0, 1.0)
    if np.abs(clock.late).max() > MAX_STEP_DEVIATION:
        parts = [_residuals(*part, base.step) for part in clock.evidence]
        share, deviation, residuals = _stamp_share(*map(np.concatenate, zip(*parts, strict=True)))
    rows = ~(clock.repeated | clock.idle)
    advances = bool(np.all(np.diff(clock.time[rows]) > 0.0))
    scatter = 0.0 if base.uniform else float(clock.late.std())
    times = SampleTimes(0, False, clock.missing, base.rate, scatter, share, deviation, residuals)
    is_even = times.certain and share < 0.5 and advances
    out = ~rows if is_even else clock.repeated
    shown = share if is_even or base.largest_deviation > MAX_STEP_DEVIATION else np.nan
    times = replace(times, removed=int(np.count_nonzero(out)), even=is_even, share=shown)
    if not out.any() and not is_even:
        return recording, times
    return replace(recording, time=clock.time if is_even else time).rows(~out), times


def _clock_of(recording: Recording, signals: Array) -> tuple[TimeBase, _EvenClock]:
    """Return the time base of the stamps, and the even clock that they may be late of."""
    time = recording.time
    gap = recording.gap_before
    base = time_base(time, gap)
    if not _are_late_in_bursts(time, signals, gap):
        return base, _even_clock(time, signals, recording.segments(), base)
    reported = np.diff(time, prepend=time[0]) > PAUSE_SECONDS
    if gap is not None:
        reported |= gap
    numbered = replace(recording, time=np.arange(len(time), dtype=np.float64), gap_before=reported)
    segments = numbered.segments()
    base = replace(base, step=_mean_step(time, segments))
    return base, _even_clock(time, signals, segments, base, by_rows=True)


def _are_late_in_bursts(time: Array, signals: Array, reported: Rows | None) -> bool:
    """Return whether pauses of the stamps (m,) are late rows, across which the arm moved one step.

    Stamps of arrival come in bursts after a pause. Where rows are missing the arm has moved on.
    """
    steps = np.diff(time)
    forward = steps[steps > 0.0]
    if len(time) < _MIN_SAMPLES or not forward.size:
        return False
    pause = (steps > GAP_STEPS * float(np.median(forward))) & (steps <= PAUSE_SECONDS)
    if reported is not None:
        pause &= ~reported[1:]
    if not pause.any():
        return False
    moved = np.diff(signals, axis=0)
    before, after = (_run(signals, side) for side in (-1, 1))
    each = (before + after) / (2 * _NEIGHBOUR_STEPS)
    noise = np.maximum(_robust_rms(moved - each), _resolution(signals)[1:])
    unit = each / noise
    clarity = (unit**2).sum(axis=1)
    passed = (unit * moved / noise).sum(axis=1) / np.maximum(clarity, 1.0)
    clear = pause & (clarity > _MIN_CLARITY**2) & _steady(before / noise, after / noise, 0.5)
    if not clear.any():
        return False
    return bool(np.mean(passed[clear] < 1.5) >= _MIN_BURST_SHARE)


def _mean_step(time: Array, segments: Sequence[slice]) -> float:
    """Return the step [s] of the line below the stamps of the longest segment.

    Stamps come late and never early, so that the earliest show the clock.
    """
    longest = max(segments, key=lambda part: part.stop - part.start)
    stamps = time[longest] - time[longest.start]
    rows = np.arange(len(stamps), dtype=np.float64)
    early = np.ones(len(stamps), np.bool_)
    slope = 0.0
    for _ in range(_REFINEMENTS):
        line = np.polynomial.Polynomial.fit(rows[early], stamps[early], 1)
        late = stamps - line(rows)
        early = late <= np.median(late)
        slope = float(line.convert().coef[1])
    return slope


def _line_below(number: Array, stamps: Array, step: float) -> Array:
    """Return even times (m,) [s] of samples with numbers, from the usual lateness of the stamps."""
    return np.asarray(step * number + np.median(stamps - step * number))


class _EvenClock(NamedTuple):
    """Even times that follow the slow drift of the stamps."""

    time: Array  # (m,)
    repeated: Rows  # rows (m,) that repeat the sample before them
    idle: Rows  # other rows (m,) of the number of the one before
    #: of each segment: numbers (k,), even times (k,), signals (k, c), lateness of the stamps (k,)
    evidence: list[tuple[Array, Array, Array, Array]]
    late: Array  # lateness of all stamps in steps, after a zero
    missing: int  # samples


def _even_clock(
    time: Array,
    signals: Array,
    segments: Sequence[slice],
    base: TimeBase,
    *,
    by_rows: bool = False,
) -> _EvenClock:
    """Number the samples of each segment, and place them at even times.

    Args:
        time: stamps (m,) [s].
        signals: positions, and velocities if measured (m, k).
        segments: between gaps.
        base: of the stamps.
        by_rows: each row is the next sample unless positions show otherwise; else the stamps
            count.

    Returns:
        the clock.
    """
    even = time.copy()
    repeated = np.zeros(len(time), dtype=np.bool_)
    idle = np.zeros(len(time), dtype=np.bool_)
    evidence = []
    scatter = []
    missing = 0
    longer = 0.0
    for part in segments:
        even[part] += longer
        repeated[part] = _repeated(time[part], signals[part])
        rows = part.start + np.flatnonzero(~repeated[part])
        if len(rows) < _MIN_SAMPLES:
            continue
        number = _numbers(time[rows], signals[rows], base.step, by_rows=by_rows)
        new = np.diff(number, prepend=-1.0) > 0.0
        idle[rows[~new]] = True
        rows = rows[new]
        number = number[new]
        if len(rows) < _MIN_SAMPLES:
            continue
        lost = int(number[-1]) + 1 - len(rows)
        if base.uniform:  # row counter: missing samples extend the time
            times = time[rows[0]] + base.step * number
            even[rows] = times + longer
            longer += base.step * lost
        elif by_rows:  # drift of the lateness in bursts is none of the clock
            even[rows] = times = _line_below(number, time[rows], base.step)
        else:
            even[rows] = times = _even_times(time[rows], number)
        late = time[rows] - times
        missing += lost
        scatter.append(late / base.step)
        evidence.append((number, times, signals[rows], late))
    return _EvenClock(
        even, repeated, idle, evidence, np.concatenate([np.zeros(1), *scatter]), missing
    )


def _numbers(time: Array, signals: Array, step: float, *, by_rows: bool) -> Array:
    """Return the number of each sample (m,) in an even clock, the first zero."""
    starts = range(0, len(time) - 1, _ROWS_AT_ONCE)
    # Each part begins with the last sample of the one before; a short rest belongs to the last.
    edges = [*starts, len(time) - 1]
    if len(starts) > 1 and edges[-1] - edges[-2] < _MIN_SAMPLES:
        del edges[-2]
    parts = [slice(start, stop + 1) for start, stop in pairwise(edges)]
    steps = []
    for part in parts:
        count = len(time[part]) - 1
        by_clock = np.ones(count) if by_rows else _steps_by_phase(time[part], step)
        steps.append(_steps_by_position(signals[part], by_clock))
    return np.concatenate([[0.0], np.cumsum(np.concatenate(steps))])


def _steps_by_position(signals: Array, phased: Array) -> Array:
    """Return the steps of an even clock between samples (m - 1,), counted, then by positions."""
    moved = np.diff(signals, axis=0)
    resolution = _resolution(signals)[1:]
    before, after = (_run(signals, side) for side in (-1, 1))
    pace = np.add(*(np.abs(_run(signals, side)) for side in (-1, 1))) / (2 * _NEIGHBOUR_STEPS)
    steps = phased
    for _ in range(2):  # speeds by stamps, then by the improved count
        number = np.concatenate([[0.0], np.cumsum(steps)])[:, None]
        passed = [np.maximum(_run(number, side), 0.5) for side in (-1, 1)]
        each = (before + after) / (passed[0] + passed[1])
        noise = np.maximum(_robust_rms(moved - each * steps[:, None]), resolution)
        unit = each / noise
        way = moved / noise
        clarity = (unit**2).sum(axis=1)
        whole_steps = np.rint((unit * way).sum(axis=1) / np.maximum(clarity, 1.0))
        alike = (
            np.abs(way - unit * whole_steps[:, None]) < _OUTLIER_SIGMAS + 0.5 * pace / noise
        ).all(axis=1)
        steady = _steady(before / passed[0] / noise, after / passed[1] / noise, 0.25)
        clear = clarity - (unit**2).max(axis=1) > _MIN_CLARITY**2
        clear &= alike & steady & (whole_steps >= 0.0) & (whole_steps <= GAP_STEPS)
        improved = np.where(clear, whole_steps, phased)
        if np.array_equal(improved, steps):
            break
        steps = improved
    return steps


def _run(values: Array, side: int) -> Array:
    """Return the change of values (m, k) in steps before (-1) or after (1) each (m - 1, k)."""
    at = np.arange(len(values) - 1) + (side > 0)
    there = np.clip(at + side * _NEIGHBOUR_STEPS, 0, len(values) - 1)
    return np.asarray(side * (values[there] - values[at]))


def _even_times(stamps: Array, number: Array) -> Array:
    """Return even times (m,) [s] that follow the slow drift of the stamps (m,) [s]."""
    line = np.polynomial.Polynomial.fit(number, stamps - stamps[0], 1)
    off = stamps - stamps[0] - line(number)
    # Median first: single stamps may be late by many steps.
    usual = scipy.ndimage.median_filter(off, _odd(_DRIFT_SAMPLES / 3, len(off)), mode="nearest")
    drift = _fitted_lines(usual, _odd(_DRIFT_SAMPLES, len(off)))
    return np.asarray(stamps[0] + line(number) + drift)


def _fitted_lines(values: Array, width: int) -> Array:
    """Return the line fitted to a window of an odd width about each of m values, at that value.

    At the ends it is that of the first and last window (Savitzky and Golay 1964). `scipy.signal`
    has it, but takes longer to load than all else of a log.
    """
    half = width // 2
    fitted = scipy.ndimage.convolve1d(values, np.full(width, 1.0 / width))
    offset = np.arange(-half, half + 1)
    for window, beside in (
        (slice(0, width), slice(0, half)),
        (slice(len(values) - width, len(values)), slice(half + 1, width)),
    ):
        section = values[window]
        slope = float(offset @ section) / max(1.0, float(offset @ offset))
        fitted[window][beside] = section.mean() + slope * offset[beside]
    return np.asarray(fitted)


def _odd(wanted: float, samples: int) -> int:
    """Return the largest odd number of samples at or below both."""
    return (int(min(wanted, samples)) - 1) // 2 * 2 + 1


def _repeated(time: Array, signals: Array) -> Rows:
    """Return rows (m,) that repeat the previous one with its stamp or during steady motion."""
    equal = np.concatenate([[False], (np.diff(signals, axis=0) == 0.0).all(axis=1)])
    again = np.diff(time) == 0.0
    samples = signals[~equal]
    if equal.any() and len(samples) >= _MIN_SAMPLES:
        noise = _robust_rms(_off_cubic(np.arange(len(samples), dtype=np.float64), samples))
        noise = np.maximum(noise, _resolution(signals)[1:])
        before, after = (_run(signals, side) / (_NEIGHBOUR_STEPS * noise) for side in (-1, 1))
        moving = (np.abs(before + after) > 2.0 * _MOVING_NOISE_RATIO).any(axis=1)
        again |= moving & _steady(before, after, 0.5)
    return np.asarray(equal & np.concatenate([[False], again]))


def _steady(before: Array, after: Array, most: float) -> Rows:
    """Return where the square of speeds (m, k) changes by at most this share."""
    change = (after - before) ** 2
    mean = (after + before) ** 2 / 4.0
    return np.asarray(change.sum(axis=1) < most * mean.sum(axis=1))


def _resolution(signals: Array) -> Array:
    """Return the least non-zero change of speed nearby (m, k), such as an encoder step."""
    change = np.abs(np.diff(signals, n=2, axis=0))
    # Differences of decimal numbers are rounded.
    change[change <= 1e-10 * np.abs(signals).max()] = np.inf
    change = np.vstack([change[:1], change, change[-1:]])
    starts = np.arange(0, len(change), _DRIFT_SAMPLES // 2)
    least = np.minimum.reduceat(change, starts, axis=0)
    beside = np.vstack([least[:1], least, least[-1:]])
    nearby = np.minimum(np.minimum(beside[:-2], beside[1:-1]), beside[2:])
    return np.repeat(nearby, np.diff(np.append(starts, len(change))), axis=0)


def _off_cubic(number: Array, values: Array) -> Array:
    """Return the distance of samples (m, k) from the cubic through two each side (m - 4, k)."""
    at = np.arange(2, len(number) - 2)
    beside = number[at[:, None] + _CUBIC_OFFSETS] - number[at][:, None]
    self = np.eye(len(_CUBIC_OFFSETS), dtype=np.bool_)
    above = np.where(self, 1.0, -beside[:, None, :])
    below = np.where(self, 1.0, beside[:, :, None] - beside[:, None, :])
    weights = np.prod(above / below, axis=2)
    return np.asarray(
        values[2:-2] - np.einsum("ma,mak->mk", weights, values[at[:, None] + _CUBIC_OFFSETS])
    )


def _residuals(
    number: Array, times: Array, signals: Array, late: Array, step: float
) -> tuple[Array, Array, Array]:
    """Return the residuals of even signals and of correct stamps, and the resolution."""
    half = round(float(np.clip(_SPEED_TIME / step, _DRIFT_SAMPLES // 10, _DRIFT_SAMPLES // 2)))
    at = np.arange(len(number))
    # From other samples than the residual, for independent noise.
    ahead = half // 2 + len(_CUBIC_OFFSETS)
    there = np.minimum(at + ahead, at[-1])
    behind = np.maximum(at - ahead, 0)

    def change(values: Array) -> Array:
        mean = scipy.ndimage.uniform_filter1d(values, half, axis=0, mode="nearest")
        return np.asarray(mean[there] - mean[behind])

    speed = change(signals) / change(times - times[0])[:, None]
    late = _off_cubic(number, late[:, None])
    return _off_cubic(number, signals), speed[2:-2] * late, _resolution(signals)[2:-2]


def _stamp_share(
    measured: Array, late: Array, resolution: Array
) -> tuple[float, float, tuple[float, float]]:
    """Return the share of `late` (m, k) in `measured`, its deviation, and both residuals."""
    level = np.minimum(_robust_rms(measured), _robust_rms(measured - late))
    level = np.maximum(level, _CUBIC_ROUNDING * resolution)
    measured = measured / level
    late = late / level
    inlier = np.minimum(np.abs(measured), np.abs(measured - late)) < _OUTLIER_SIGMAS
    measured = np.where(inlier, measured, 0.0)
    late = np.where(inlier, late, 0.0)
    weight = float((late**2).sum())
    if weight == 0.0:
        return 0.5, np.inf, (1.0, 1.0)
    share = float((measured * late).sum()) / weight
    # Rows are correlated with neighbours, joints by the stamp: blocks of rows are independent.
    score = ((measured - share * late) * late).sum(axis=1)
    score = np.add.reduceat(score, np.arange(0, len(score), 2 * len(_CUBIC_OFFSETS)))
    deviation = float(np.sqrt(max(weight, (score**2).sum()))) / weight
    squares = np.sum((measured - late) ** 2), np.sum(measured**2)
    with_stamps, evenly = np.sqrt(np.array(squares) / np.count_nonzero(inlier))
    return share, deviation, (float(with_stamps), float(evenly))


def _robust_rms(values: Array) -> Array:
    """Return the root mean square (k,) of non-zero values per column, outliers limited."""
    levels = []
    for column in np.abs(values).T:
        some = column[column > 0.0]
        most = _OUTLIER_SIGMAS * MAD_TO_STD * float(np.median(some)) if some.size else np.inf
        levels.append(np.sqrt(np.mean(np.minimum(some, most) ** 2)) if some.size else np.inf)
    return np.array(levels)
