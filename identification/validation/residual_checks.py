"""What is left over, looked at from all sides: is it noise, and if not, what does it follow?

The samples are read once more, one recording at a time; of each only sums are stored. A check
gives its size as a share of the torque and whether it stands out of noise. Both matter: of a
long recording the smallest error is significant, and of a short one a large one may be chance.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.distributions import student_limit
from identification.errors import IdentificationError
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.validation.prediction import PredictionError
from identification.validation.residual_blocks import BlockMean, BlockSums, block_index
from identification.validation.residual_profile import Profile, equal_edges, profile_sums

Array = NDArray[np.float64]

# A trend through fewer points is none.
FEWEST_PIECES: Final = 4
# Pieces in all: fewer leave the trend's own scatter too uncertain.
_PIECES: Final = 12
# Chance that a trend is seen where none is, per joint.
_CHANCE: Final = 0.001


@dataclass(frozen=True, eq=False)
class FrictionDrift:
    """By how much friction was higher than estimated, piece by piece in the order of recording.

    Attributes:
        share: (P, n), 0.05 for friction 5 % higher; NaN where a joint did not move.
        change: of a straight line through the pieces from the first to the last (n,).
        change_std: its standard error from the scatter about the line (n,).
        freedom: degrees of freedom of that scatter.
    """

    share: Array
    change: Array
    change_std: Array
    freedom: int

    @property
    def pieces(self) -> int:
        """Number P of pieces."""
        return len(self.share)

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Whether the trend stands out of the scatter (n,)."""
        limit = student_limit(0.5 * _CHANCE, self.freedom)
        known = np.isfinite(self.change)
        size = np.abs(np.where(known, self.change, 0.0))
        return np.asarray(size > limit * np.where(known, self.change_std, np.inf))


@dataclass(frozen=True, eq=False)
class DriftSums:
    """Of one recording, per piece and joint: friction times residual and squared, (P, n) each."""

    product: Array
    power: Array


def pieces_per_recording(recordings: int) -> int:
    """Into how many pieces a recording is cut so that a trend can be seen."""
    return max(1, -(-_PIECES // max(recordings, 1)))


def drift_sums(samples: Samples, residual: Array, friction: Array, pieces: int) -> DriftSums:
    """Sums over equal parts of a recording.

    Args:
        samples: the recording.
        residual: torque measured less predicted (m, n).
        friction: the part of the predicted torque that scales with temperature (m, n).
        pieces: number of parts.
    """
    edges = np.linspace(0, len(residual), pieces + 1).astype(np.intp)[:-1]
    rows = samples.usable
    return DriftSums(
        np.add.reduceat(np.where(rows, friction * residual, 0.0), edges, axis=0),
        np.add.reduceat(np.where(rows, friction**2, 0.0), edges, axis=0),
    )


def friction_drift(sums: Sequence[DriftSums]) -> FrictionDrift | None:
    """Trend over all pieces in order; None where they are too few.

    Of several recordings, equal parts are compared with each other: what the friction law gets
    wrong in one part of a motion is no change of friction.
    """
    product = np.concatenate([one.product for one in sums])
    power = np.concatenate([one.power for one in sums])
    if len(product) < FEWEST_PIECES:
        return None
    usual = np.median(power, axis=0)
    moved = power > 0.1 * np.where(usual > 0.0, usual, np.inf)
    share = np.where(moved, product / np.where(moved, power, 1.0), np.nan)
    parts = len(sums[0].power) if len(sums) >= FEWEST_PIECES else 1
    freedom = max(len(share) - parts - 1, 1)
    trends = [
        _trend(column, weight, parts, freedom)
        for column, weight in zip(share.T, power.T, strict=True)
    ]
    change, std = np.array(trends).T
    return FrictionDrift(share, change, std, freedom)


def _trend(share: Array, weight: Array, parts: int, freedom: int) -> tuple[float, float]:
    """Rise of a weighted straight line from the first to the last, and its standard error.

    The line is common to all parts of a motion, its level is each part's own.
    """
    known = np.isfinite(share)
    if np.count_nonzero(known) < FEWEST_PIECES + parts - 1:
        return np.nan, np.nan
    w = np.where(known, weight, 0.0)
    at = _about_means(np.linspace(-0.5, 0.5, len(share)), w, parts)
    y = _about_means(np.where(known, share, 0.0), w, parts)
    spread = float(w @ at**2)
    slope = float(w @ (at * y)) / spread
    left = np.where(known, y - slope * at, 0.0)
    lost = len(share) - int(np.count_nonzero(known))
    scale = np.count_nonzero(known) / max(freedom - lost, 1)
    variance = float(np.sum((w * at * left) ** 2)) / spread**2 * scale
    return slope, float(np.sqrt(variance))


def _about_means(values: Array, weight: Array, parts: int) -> Array:
    """Values (R parts,) less the weighted mean of their part over the R recordings."""
    table, w = values.reshape(-1, parts), weight.reshape(-1, parts)
    total = w.sum(axis=0)
    mean = (w * table).sum(axis=0) / np.where(total > 0.0, total, 1.0)
    return np.asarray((table - mean).ravel())


# Per motor turn: eccentricity 1; strain wave gears 2; pole pairs and slots of servo motors beyond.
HARMONICS: Final = (1, 2, 3, 4, 6)
# Of the worst of five: about one chance in a thousand, with an amplitude of two components.
_SIGMAS: Final = 4.1


@dataclass(frozen=True, eq=False)
class Ripple:
    """Residual of n joints that follows the angle of their motors.

    Attributes:
        parts: mean cosine and sine part of each of `HARMONICS` (n, H, 2) [N·m or N].
    """

    parts: BlockMean

    @property
    def amplitude(self) -> Array:
        """Amplitude per joint and harmonic (n, H) [N·m or N], NaN where not seen."""
        return np.asarray(np.hypot(self.parts.mean[..., 0], self.parts.mean[..., 1]))

    @property
    def rms(self) -> Array:
        """Root mean square of what all harmonics explain (n,) [N·m or N], noise subtracted."""
        squares = 0.5 * (self.parts.mean**2 - self.parts.std**2).sum(axis=-1)
        return np.asarray(np.sqrt(np.maximum(np.nansum(np.nan_to_num(squares), axis=-1), 0.0)))

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Whether some harmonic of a joint stands out (n,)."""
        std = np.sqrt(np.mean(self.parts.std**2, axis=-1))
        return np.asarray((np.nan_to_num(self.amplitude) > _SIGMAS * np.nan_to_num(std)).any(-1))

    def strongest(self, joint: int) -> int:
        """Periods per motor turn of a joint's largest harmonic."""
        return HARMONICS[int(np.nan_to_num(self.amplitude[joint]).argmax())]


def ripple_sums(samples: Samples, residual: Array, motor_from_joint: Array) -> BlockSums:
    """Sums of a recording's residual (m, n) times cosine and sine, by block: (B, n, H, 2).

    The phase is that of the motor's angle about its zero joint angles; the same in every
    recording, as long as nobody takes the gear apart.
    """
    block = block_index(samples)
    count = int(block[-1]) + 1
    n = residual.shape[1]
    values, weights = np.zeros((2, count, n, len(HARMONICS), 2))
    motor = samples.motion.position @ motor_from_joint.T
    for joint in range(n):
        rows = samples.usable[:, joint]
        left, inside = residual[rows, joint], block[rows]
        for h, harmonic in enumerate(HARMONICS):
            angle = harmonic * motor[rows, joint]
            for part, wave in enumerate((np.cos(angle), np.sin(angle))):
                values[:, joint, h, part] = np.bincount(inside, left * wave, count)
                weights[:, joint, h, part] = np.bincount(inside, wave**2, count)
    return BlockSums(values, weights)


Rows = NDArray[np.bool_]

# Median absolute deviations, as standard deviations of a normal distribution: beyond six lies one
# sample of 500 million.
BEYOND: Final = 6.0
_NORMAL: Final = 1.4826


@dataclass(frozen=True, eq=False)
class Outliers:
    """Samples of which the residual is beyond `BEYOND` robust deviations of its joint.

    Attributes:
        share: of the usable samples of each joint (n,).
        power: their share of the squared residual (n,).
        without: prediction error of all other samples.
    """

    share: Array
    power: Array
    without: PredictionError


def find_outliers(runs: Sequence[tuple[Array, Array, Rows]]) -> Outliers:
    """Look for outliers over several recordings together.

    Args:
        runs: of each recording measured torque (m, n), residual (m, n) and which rows count.
    """
    torque, residual = (np.concatenate([run[k] for run in runs]) for k in (0, 1))
    usable = np.concatenate([run[2] for run in runs])
    far = np.zeros_like(usable)
    for joint in range(residual.shape[1]):
        rows = usable[:, joint]
        if rows.any():
            distance = np.abs(residual[:, joint] - np.median(residual[rows, joint]))
            limit = BEYOND * _NORMAL * float(np.median(distance[rows]))
            far[:, joint] = rows & (distance > max(limit, np.finfo(np.float64).tiny))
    squares = np.where(usable, residual, 0.0) ** 2
    total = squares.sum(axis=0)
    return Outliers(
        share=np.count_nonzero(far, axis=0) / np.maximum(np.count_nonzero(usable, axis=0), 1),
        power=np.where(far, squares, 0.0).sum(axis=0) / np.where(total > 0.0, total, 1.0),
        without=PredictionError.between(torque, torque - residual, usable & ~far),
    )


# Longer than any move of an arm takes to forget the one before.
LONGEST_LAG: Final = 0.5  # s
_MOST_LAGS: Final = 1000


@dataclass(frozen=True, eq=False)
class Autocorrelation:
    """Autocorrelation of the residual of n joints at L + 1 lags.

    Attributes:
        lag: (L + 1,) [s], from zero.
        correlation: (L + 1, n), one at lag zero; NaN for a joint without rows.
        rows: samples that were correlated (n,).
    """

    lag: Array
    correlation: Array
    rows: NDArray[np.intp]

    @property
    def time(self) -> Array:
        """Integrated correlation time per joint (n,) [s], half a sampling step for white noise.

        The sum over lags ends where two neighbours together are no longer positive (initial
        positive sequence, Geyer 1992): beyond that an estimated autocorrelation is noise.
        """
        step = self.lag[1] if len(self.lag) > 1 else 0.0
        pairs = self.correlation[: len(self.lag) // 2 * 2].reshape(-1, 2, len(self.rows)).sum(1)
        positive = np.cumprod(pairs > 0.0, axis=0)
        return np.asarray(step * ((pairs * positive).sum(axis=0) - 0.5))

    @property
    def effective_rows(self) -> Array:
        """Independent samples that would say as much about a mean as these do (n,)."""
        step = self.lag[1] if len(self.lag) > 1 else 1.0
        return np.asarray(self.rows / np.maximum(2.0 * self.time / step, 1.0))


def autocorrelation(
    residuals: Iterable[tuple[Array, Rows]], step: float, longest: float = LONGEST_LAG
) -> Autocorrelation:
    """Autocorrelation over several recordings, each with one clock step.

    Pairs of rows count if both do, so that gaps and reversals need not be bridged.

    Args:
        residuals: of each recording torque residual (m, n) and which rows count (m, n).
        step: sampling step [s].
        longest: lag [s].
    """
    lags = max(2, min(_MOST_LAGS, round(longest / step)))
    products: Array | None = None
    pairs: Array | None = None
    for residual, usable in residuals:
        used_residual = np.where(usable, residual, 0.0)
        own = _products(used_residual, lags), _products(usable.astype(np.float64), lags)
        products = own[0] if products is None else products + own[0]
        pairs = own[1] if pairs is None else pairs + own[1]
    if products is None or pairs is None:
        raise ValueError("there is no residual to correlate")
    covariance = products / np.maximum(np.rint(pairs), 1.0)
    power = covariance[0]
    correlation = np.where(power > 0.0, covariance / np.where(power > 0.0, power, 1.0), np.nan)
    return Autocorrelation(
        lag=np.asarray(step * np.arange(lags + 1), dtype=np.float64),
        correlation=correlation,
        rows=np.rint(pairs[0]).astype(np.intp),
    )


def _products(values: Array, lags: int) -> Array:
    """Sums of x(t) x(t + l) for l = 0 .. lags, per column: (lags + 1, n)."""
    m, n = values.shape
    found = np.zeros((lags + 1, n))
    reach = min(lags, m - 1)
    length = scipy.fft.next_fast_len(m + reach, real=True)  # so long that nothing wraps round
    power = np.abs(scipy.fft.rfft(values, length, axis=0)) ** 2
    found[: reach + 1] = scipy.fft.irfft(power, length, axis=0)[: reach + 1]
    return found


def steps_of(times: Sequence[Array]) -> float:
    """Usual sampling step of several clocks [s]."""
    return float(np.median([np.median(np.diff(time)) for time in times if len(time) > 1]))


@dataclass(frozen=True, eq=False)
class ResidualChecks:
    """What the torque residual of all recordings follows.

    Attributes:
        torque_rms: measured torque of the rows that count (n,) [N·m or N].
        rms: residual of those rows (n,) [N·m or N].
        colour: correlation in time, of what was fitted.
        speed: mean residual against the joint's own speed.
        position: against the joint's own position.
        ripple: against the angle of the joint's motor; None where no gear ratio is known.
        drift: change of friction over the fitted recordings; None where they are too few.
        friction_share: friction torque of the fitted recordings over the measured one (n,).
        outliers: of the unseen motion, or of the fitted one where there is no other.
    """

    torque_rms: Array
    rms: Array
    colour: Autocorrelation
    speed: Profile
    position: Profile
    ripple: Ripple | None
    drift: FrictionDrift | None
    friction_share: Array | None = None
    outliers: Outliers | None = None

    def share(self, size: Array) -> Array:
        """A residual (n,) as a share of the joint's torque; zero for a joint without rows."""
        torque = self.torque_rms
        return np.where(torque > 0.0, size / np.where(torque > 0.0, torque, 1.0), 0.0)


def check_residuals(
    model: RobotModel,
    values: Array,
    training: Sequence[Samples],
    held_out: Sequence[Samples] = (),
    *,
    same_motion: bool = False,
    motor_from_joint: Array | None = None,
) -> ResidualChecks:
    """Look at the residuals of parameters (p,) on all recordings.

    Args:
        model: the robot.
        values: parameters (p,).
        training: recordings in the order in which they were made; drift is looked for in these.
        held_out: recordings of other motions.
        same_motion: whether the training recordings repeat one motion.
        motor_from_joint: motor angle per joint angle (n, n); None where unknown.

    Raises:
        IdentificationError: no recording.
    """
    runs = [*training, *held_out]
    if not runs:
        raise IdentificationError("there is no residual to check: no recording is given")
    usable = [run.usable for run in runs]
    speeds = equal_edges([run.motion.velocity for run in runs], usable)
    positions = equal_edges([run.motion.position for run in runs], usable)
    pieces = pieces_per_recording(len(training))
    heat = np.where(model.friction_columns, values, 0.0)
    squares, fitted_torque = np.zeros((3, model.n_joints)), np.zeros(model.n_joints)
    speed, position, ripple, drift, left = [], [], [], [], []
    for index, run in enumerate(runs):
        residual = run.torque - run.predicted_torque(model, values)
        residual = np.where(run.usable, residual, 0.0)
        left.append((residual, run.usable))
        squares += [
            (np.where(run.usable, run.torque, 0.0) ** 2).sum(axis=0),
            (residual**2).sum(axis=0),
            np.count_nonzero(run.usable, axis=0),
        ]
        speed.append(profile_sums(run, residual, run.motion.velocity, speeds))
        position.append(profile_sums(run, residual, run.motion.position, positions))
        if motor_from_joint is not None:
            ripple.append(ripple_sums(run, residual, motor_from_joint))
        if index < len(training):
            drift.append(drift_sums(run, residual, run.predicted_torque(model, heat), pieces))
            fitted_torque += (np.where(run.usable, run.torque, 0.0) ** 2).sum(axis=0)
    repeated = len(training) if same_motion else 1
    rows = np.maximum(squares[2], 1.0)
    judged = runs[len(training) :] or runs
    friction = sum((one.power.sum(axis=0) for one in drift), np.zeros(model.n_joints))
    return ResidualChecks(
        torque_rms=np.sqrt(squares[0] / rows),
        rms=np.sqrt(squares[1] / rows),
        colour=autocorrelation(
            left[: len(training)] or left,
            steps_of([run.motion.time for run in training or runs]),
        ),
        speed=Profile(speeds, _joined(speed, repeated).mean()),
        position=Profile(positions, _joined(position, repeated).mean()),
        ripple=Ripple(_joined(ripple, repeated).mean()) if ripple else None,
        drift=friction_drift(drift),
        friction_share=np.sqrt(friction / np.where(fitted_torque > 0.0, fitted_torque, 1.0)),
        outliers=find_outliers(
            [(run.torque, *of) for run, of in zip(judged, left[-len(judged) :], strict=True)]
        ),
    )


def _joined(parts: Sequence[BlockSums], repeated: int) -> BlockSums:
    """All blocks; the first `repeated` recordings are of one motion and share theirs."""
    first = reduce(lambda a, b: a.plus(b, same_motion=True), parts[:repeated])
    return reduce(lambda a, b: a.plus(b, same_motion=False), parts[repeated:], first)
