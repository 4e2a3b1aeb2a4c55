"""Torque ripple: a residual that repeats with the angle of the motors, else of the joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.distributions import student_limit
from identification.model.robot import RobotModel
from identification.signals.block_mean import BLOCK_SECONDS, BlockMean, block_mean
from identification.signals.samples import Samples

# Per motor turn: eccentricity 1; strain wave gears 2; pole pairs and slots of servo motors above.
HARMONICS: Final = (1, 2, 3, 4, 6)
_HARMONIC_SIGMAS: Final = 4.1  # largest of five harmonics: probability of about 0.001
# Per turn of the joint. Below, bodies, springs and cables repeat; above, hardly any motor has one.
_LEAST_PERIODS: Final = 12.0
_MOST_PERIODS: Final = 1000.0
_LEAST_IN_RANGE: Final = 6.0  # periods in the range that the joint moves through
_CELLS_PER_PERIOD: Final = 8.0  # of the table of the angle, at the most periods
_OVERSAMPLING: Final = 4  # frequencies per resolved one
_BAND: Final = 1.5  # ratio of the frequencies whose median power a peak is compared with
# probability of a false finding per joint and half
_FALSE_FINDING_PROBABILITY: Final = 0.001


class Ripple(NamedTuple):
    """Residual of n joints that repeats with an angle.

    Attributes:
        turn: whose turns the periods count.
        periods: of the strongest wave, per turn (n,).
        rms: (n,) [N·m or N], with noise subtracted.
        significant: whether a joint has a ripple (n,).
    """

    turn: Literal["motor", "joint"]
    periods: Array
    rms: Array
    significant: NDArray[np.bool_]


def motor_ripple(
    runs: Sequence[Samples], residuals: Sequence[Array], motor_from_joint: Array, repeated: int
) -> Ripple:
    """Find what repeats with the angle of each motor, at its `HARMONICS`.

    Args:
        runs: recordings.
        residuals: of their torque (m, n), zero in rows that do not count.
        motor_from_joint: motor angles per joint angle (n, n).
        repeated: number of the first recordings that repeat one motion.
    """
    waves = [
        _harmonic_sums(run, residual, motor_from_joint)
        for run, residual in zip(runs, residuals, strict=True)
    ]
    mean, std, *_ = block_mean(waves, repeated)
    amplitude = np.nan_to_num(np.hypot(mean[..., 0], mean[..., 1]))
    noise = np.nan_to_num(np.sqrt(np.mean(std**2, axis=-1)))
    squares = np.nan_to_num(0.5 * (mean**2 - std**2).sum(axis=-1))
    return Ripple(
        "motor",
        np.array(HARMONICS, dtype=np.float64)[amplitude.argmax(axis=-1)],
        np.sqrt(np.maximum(squares.sum(axis=-1), 0.0)),
        (amplitude > _HARMONIC_SIGMAS * noise).any(axis=-1),
    )


def _harmonic_sums(samples: Samples, residual: Array, motor_from_joint: Array) -> Array:
    """Sum a residual (m, n) times each wave, and its squares (2, B, n, H, 2)."""
    block = samples.blocks(BLOCK_SECONDS)
    motor = samples.motion.position @ motor_from_joint.T
    count = int(block[-1]) + 1
    sums = np.zeros((2, count, residual.shape[1], len(HARMONICS), 2))
    for joint, rows in enumerate(samples.usable.T):
        for h, harmonic in enumerate(HARMONICS):
            phase = harmonic * motor[rows, joint]
            sums[:, :, joint, h] = _wave_sums(block[rows], residual[rows, joint], phase, count)
    return sums


def _wave_sums(block: Indices, residual: Array, phase: Array, count: int) -> Array:
    """Sum a residual times cosine and sine of a phase, and their squares, by block (2, B, 2)."""
    sums = np.zeros((2, count, 2))
    for part, wave in enumerate((np.cos(phase), np.sin(phase))):
        for table, factor in zip(sums, (residual, wave), strict=True):
            table[:, part] = np.bincount(block, factor * wave, count)
    return sums


class _Rows(NamedTuple):
    """Usable rows of a joint in all recordings."""

    angle: Array  # (m,) [rad]
    residual: Array  # (m,) [N·m]
    block: Indices  # (m,), numbered through all recordings

    def half(self, parity: int) -> _Rows:
        """Return the rows of every second block."""
        chosen = self.block % 2 == parity
        return _Rows(*(values[chosen] for values in self))

    def wave(self, periods: float) -> BlockMean:
        """Return cosine and sine part of a number of periods per turn (2,)."""
        count = int(self.block[-1]) + 1
        return block_mean([_wave_sums(self.block, self.residual, periods * self.angle, count)])


def joint_ripple(model: RobotModel, runs: Sequence[Samples], residuals: Sequence[Array]) -> Ripple:
    """Find what repeats many times in a turn of each joint, without knowing its gears.

    Eccentricity, poles and gear teeth repeat at their order times the gear ratio. The period is
    searched in every second block of time and tested in the other blocks, and vice versa: both
    halves must show the same one.

    Args:
        model: of the arm.
        runs: recordings.
        residuals: of their torque (m, n), zero in rows that do not count.
    """
    periods = np.full(model.n_joints, np.nan)
    rms = np.zeros(model.n_joints)
    for joint, turns in enumerate(model.chain.revolute):
        if turns and (rows := _rows_of(joint, runs, residuals)) is not None:
            found = _ripple_of(rows)
            if found is not None:
                periods[joint], rms[joint] = found
    return Ripple("joint", periods, rms, np.isfinite(periods))


def _rows_of(joint: int, runs: Sequence[Samples], residuals: Sequence[Array]) -> _Rows | None:
    parts = []
    first = 0
    for run, residual in zip(runs, residuals, strict=True):
        usable = run.usable[:, joint]
        block = run.blocks(BLOCK_SECONDS)
        parts.append(
            (run.motion.position[usable, joint], residual[usable, joint], first + block[usable])
        )
        first += int(block[-1]) + 1
    rows = _Rows(*(np.concatenate(values) for values in zip(*parts, strict=True)))
    return rows if len(rows.angle) else None


def _ripple_of(rows: _Rows) -> tuple[float, float] | None:
    """Return periods per turn and RMS of a joint; None if it has none."""
    reach = float(np.ptp(rows.angle))
    least = max(_LEAST_PERIODS, _LEAST_IN_RANGE * 2.0 * np.pi / max(reach, 1e-9))
    if least >= _MOST_PERIODS:
        return None
    halves = [rows.half(parity) for parity in range(2)]
    if not all(len(half.angle) for half in halves):
        return None
    spectra = [_spectrum(half, reach, float(rows.angle.min())) for half in halves]
    step = spectra[0][1]
    number = np.arange(len(spectra[0][0])) * step
    inside = np.flatnonzero((number >= least) & (number <= _MOST_PERIODS))
    if len(inside) < 2 * _OVERSAMPLING:
        return None
    powers = [np.asarray(np.abs(spectrum[inside]) ** 2) for spectrum, _ in spectra]
    numbers = np.asarray(number[inside], dtype=np.float64)
    peaks = [int(np.argmax(_whitened(power, numbers))) for power in powers]
    if abs(peaks[0] - peaks[1]) > _OVERSAMPLING:
        return None
    both = np.abs(spectra[0][0][inside] + spectra[1][0][inside]) ** 2
    near = np.arange(
        max(min(peaks) - _OVERSAMPLING, 0), min(max(peaks) + _OVERSAMPLING + 1, len(both))
    )
    for half, peak in zip(halves, reversed(peaks), strict=True):
        if not _is_significant(half.wave(float(numbers[peak]))):
            return None
    best = float(numbers[near[np.argmax(both[near])]])
    wave = rows.wave(best)
    squares = 0.5 * float(np.sum(wave.mean**2 - wave.std**2))
    return best, float(np.sqrt(max(squares, 0.0)))


def _is_significant(wave: BlockMean) -> bool:
    """Return whether cosine or sine part differ from zero; not with too few blocks."""
    if not np.isfinite(wave.mean).all():
        return False
    limit = student_limit(0.25 * _FALSE_FINDING_PROBABILITY, np.maximum(wave.blocks - 1, 1))
    return bool(np.any(np.abs(wave.mean) > limit * wave.std))


def _spectrum(rows: _Rows, reach: float, first: float) -> tuple[NDArray[np.complex128], float]:
    """Return the transform of the residual over the angle, and the step of its periods per turn."""
    width = 2.0 * np.pi / (_CELLS_PER_PERIOD * _MOST_PERIODS)
    cell = ((rows.angle - first) / width).astype(np.intp)
    count = int(reach / width) + 2
    length = 1 << (_OVERSAMPLING * count - 1).bit_length()
    table = np.bincount(cell, rows.residual, count)
    return np.fft.rfft(table, length), 2.0 * np.pi / (length * width)


def _whitened(power: Array, number: Array) -> Array:
    """Return the power over its median at frequencies nearby."""
    band = np.floor(np.log(number / number[0]) / np.log(_BAND)).astype(np.intp)
    median = np.array([np.median(power[band == each]) for each in range(int(band[-1]) + 1)])
    return np.asarray(power / np.maximum(median[band], np.finfo(np.float64).tiny))
