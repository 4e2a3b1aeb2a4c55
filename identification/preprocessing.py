"""From a recording to what a fit reads: smoothed motion, torque, and which rows count."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.factor import Factor
from identification.model import RobotModel
from identification.motion import Motion
from identification.recording import Recording, RecordingError
from identification.regressor import Regressor
from identification.smoothing_spline import fit_smoothing_spline, low_pass

Array = NDArray[np.float64]

# Planned motion has next to nothing above 10 Hz, and the first resonance of a large arm lies at
# 10 to 30 Hz. On the simulated NS 16 everything from 20 to 60 Hz is as good as noise allows.
RIGID_BANDWIDTH: Final = 40.0  # Hz
# A smoothed signal is worse near the ends of its segment, where it is known from one side only.
# Measured on sines with noise: the error of the acceleration has come down to its usual size two
# periods of the smoother's bandwidth from the end. A joint that hardly moves is smoothed to
# almost nothing and must not take the whole segment with it, hence the limit.
END_PERIODS: Final = 2.0
LONGEST_END: Final = 0.25  # s
# When a joint turns round, Coulomb friction jumps, and until its servo has followed so does its
# acceleration. The smoother cannot follow that within half a period of its bandwidth: on the
# simulated NS 16 such rows, 0.5 % of all, made three quarters of the systematic error.
REVERSAL_PERIODS: Final = 0.5
_SHORTEST_SEGMENT: Final = 12  # samples: twice what a quintic spline needs
_HIGHEST_DIFFERENCE: Final = 8
STANDSTILL_WINDOW: Final = 0.1  # s
_SHORTEST_WINDOW: Final = 20  # samples


@dataclass(frozen=True)
class Preprocessing:
    """How a recording is turned into samples.

    Attributes:
        rigid_bandwidth: widest bandwidth of the smoothed positions [Hz], however little noise
            they have. A rigid model has nothing to say above the first resonance of the arm,
            where motors accelerate without their links; and a wide one lets ripple that has
            found a resonance pass for inertia.
        smooth_torque: the paper's way. The torque is smoothed, and the regressor goes through the
            same linear smoother. By default the torque is left as measured: least squares
            averages it better.
        torque_bandwidth: with `smooth_torque` the bandwidth of that smoother [Hz]; None smooths
            until the mean squared residual is the torque's noise variance. Without, the bandwidth
            of a low-pass that the torque has come through before it was logged, as many
            controllers do it: the regressor then goes through the same low-pass and the torque
            is left alone. None: it has come through none.
        torque_delay: time by which the recorded torque lags the recorded position [s].
    """

    rigid_bandwidth: float = RIGID_BANDWIDTH
    smooth_torque: bool = False
    torque_bandwidth: float | None = None
    torque_delay: float = 0.0

    def __post_init__(self) -> None:
        for name in ("rigid_bandwidth", "torque_bandwidth"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"{name} is {value} Hz, must be positive")


@dataclass(frozen=True, eq=False)
class Samples:
    """m samples of n joints, ready for a fit, in the rows of the recording they come from.

    Attributes:
        motion: smoothed positions and their derivatives, at the instants the torque belongs to.
        torque: (m, n) [N·m or N].
        usable: (m, n) rows that count: moving, and away from gaps, ends and reversals.
        segments: stretches without a gap.
        origin: time at which the planned motion begins [s]; repetitions are compared at equal
            times since then.
        position_bandwidth: of the smoothing, per joint (n,) [Hz].
        torque_bandwidth: of the low-pass the torque has come through, per joint (n,) [Hz]; the
            regressor has to go through it as well. None: it has come through none.
    """

    motion: Motion
    torque: Array
    usable: NDArray[np.bool_]
    segments: tuple[slice, ...]
    origin: float
    position_bandwidth: Array
    torque_bandwidth: Array | None = None

    def as_measured(self, joint: int, columns: Array) -> Array:
        """Columns (m, c) of a joint's row as the torque channel would have recorded them."""
        if self.torque_bandwidth is None:
            return columns
        bandwidth = np.full(columns.shape[1], self.torque_bandwidth[joint])
        return _low_passed(self.motion.time, columns, bandwidth, self.segments)

    def regressor(self, model: RobotModel) -> Regressor:
        """Regressor of every row, usable or not, as the torque channel would record it."""
        blocks, columns = model.regressor(*self.motion[1:])
        return Regressor(
            tuple(self.as_measured(joint, block) for joint, block in enumerate(blocks)), columns
        )

    def predicted_torque(self, model: RobotModel, values: Array) -> Array:
        """Torque (m, n) that parameters (p,) predict, as the torque channel would record it."""
        torque = model.torque(values, *self.motion[1:])
        for joint in range(model.n_joints):
            torque[:, joint] = self.as_measured(joint, torque[:, joint : joint + 1])[:, 0]
        return torque

    def factor(self, model: RobotModel) -> Factor:
        """All a fit needs of the usable rows."""
        if self.torque_bandwidth is None:
            return Factor.from_samples(model, self.motion, self.torque, self.usable)
        blocks, columns = self.regressor(model)
        factor = Factor.zero(model)
        for joint, (block, used) in enumerate(zip(blocks, columns, strict=True)):
            rows = self.usable[:, joint]
            table = np.column_stack([block, self.torque[:, joint]])[rows]
            index = np.append(used, model.n_parameters)
            factor.gram[joint][np.ix_(index, index)] = table.T @ table
            factor.samples[joint] = np.count_nonzero(rows)
        return factor


def standstill_variance(time: Array, values: Array) -> Array:
    """Noise variance per channel (c,) of a recording at standstill (m, c).

    The variance about a straight line in windows of a tenth of a second, and of these the
    median: an arm at rest creeps, and now and then dry friction lets go of an axis whose servo
    has been winding up, which is motion and no noise. A reading that hardly ever changes gives
    zero; its resolution is then what is known about it.

    Raises:
        RecordingError: fewer samples than one window needs.
    """
    if len(time) < _SHORTEST_WINDOW:
        raise RecordingError(
            "shape",
            f"a variance at standstill needs {_SHORTEST_WINDOW} samples, the recording has"
            f" {len(time)}",
        )
    width = max(_SHORTEST_WINDOW, round(STANDSTILL_WINDOW / float(np.median(np.diff(time)))))
    width = min(width, len(time))
    count = len(time) // width
    line = np.linspace(-1.0, 1.0, width)
    basis = np.column_stack([np.ones(width), line])
    basis /= np.linalg.norm(basis, axis=0)
    windows = values[: count * width].reshape(count, width, -1)
    windows = windows - windows.mean(axis=1, keepdims=True)
    residual = windows - np.einsum("wk,vk,nvc->nwc", basis, basis, windows)
    freedom = width - 2
    variance = (residual**2).sum(axis=1) / freedom
    # The median of a chi-squared variable lies a little below its mean (Wilson and Hilferty).
    return np.asarray(np.median(variance, axis=0) / (1.0 - 2.0 / (9.0 * freedom)) ** 3)


def difference_variance(time: Array, values: Array) -> Array:
    """Variance of the white noise on smooth channels (m, c), from the channels themselves.

    Divided differences of rising order, scaled to unit noise gain, remove ever more of the
    smooth part and keep the noise (Gasser, Sroka and Jennen-Steinmetz 1986). Taken is the first
    order at which the next one changes the estimate by less than 5 %; a channel without white
    noise (filtered before it was logged) gives the highest order's, next to nothing.

    Raises:
        RecordingError: fewer samples than the highest order needs.
    """
    if len(time) < 2 * _HIGHEST_DIFFERENCE:
        raise RecordingError(
            "shape",
            f"a noise variance needs {2 * _HIGHEST_DIFFERENCE} samples, got {len(time)}",
        )
    estimates = np.array(
        [_difference_variance(time, values, order) for order in range(1, _HIGHEST_DIFFERENCE + 1)]
    )
    settled = estimates[1:] > 0.95 * estimates[:-1]
    first = np.where(settled.any(axis=0), settled.argmax(axis=0), _HIGHEST_DIFFERENCE - 1)
    return np.asarray(np.take_along_axis(estimates, first[None, :], axis=0)[0])


def _difference_variance(time: Array, values: Array, order: int) -> Array:
    windows = np.lib.stride_tricks.sliding_window_view(time, order + 1)
    scale = windows[:, -1:] - windows[:, :1]
    apart = (windows[:, :, None] - windows[:, None, :]) / scale[:, :, None]
    apart[:, np.arange(order + 1), np.arange(order + 1)] = 1.0
    weights = 1.0 / apart.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    stacked = np.lib.stride_tricks.sliding_window_view(values, order + 1, axis=0)
    return np.asarray(np.mean(np.einsum("mck,mk->mc", stacked, weights) ** 2, axis=0))


def smooth(
    recording: Recording,
    noise_variance: Array | None = None,
    *,
    delay: float = 0.0,
    widest: float = RIGID_BANDWIDTH,
) -> Motion:
    """Smoothed motion in the rows of the recording, at each instant less the delay.

    Rows of a segment too short to smooth keep their position, at rest; see :func:`prepare` for
    which rows count.

    Args:
        recording: checked.
        noise_variance: of the measured positions (n,) [rad² or m²], from standstill and at least
            resolution²/12. None: estimated from the differences of the positions.
        delay: time by which what the motion is to be compared with lags it [s].
        widest: see `Preprocessing.rigid_bandwidth` [Hz].
    """
    return _smooth(recording, noise_variance, delay, widest)[0]


def prepare(
    recording: Recording,
    model: RobotModel,
    *,
    noise_variance: Array | None = None,
    torque_variance: Array | None = None,
    options: Preprocessing = Preprocessing(),
    origin: float | None = None,
) -> Samples:
    """Samples of a recording for a model.

    Args:
        recording: with torque; joints in the model's order.
        model: says below which speed a joint stands.
        noise_variance: of the positions (n,), see :func:`smooth`.
        torque_variance: of the torques (n,), for `options.smooth_torque` only; None: estimated.
        options: what to do with the torque.
        origin: time at which the planned motion begins [s]; by default where the command begins
            to move.

    Raises:
        RecordingError: the recording does not pass its checks, or has no torque.
    """
    recording.checked(model.joint_names)
    if recording.torque is None:
        raise RecordingError("torque", "the recording has no joint torque to fit")
    motion, bandwidth, clear = _smooth(
        recording, noise_variance, options.torque_delay, options.rigid_bandwidth
    )
    segments = tuple(recording.segments())
    torque, torque_bandwidth = recording.torque, None
    if options.torque_bandwidth is not None:
        torque_bandwidth = np.full(recording.n_joints, options.torque_bandwidth)
    if options.smooth_torque:
        if torque_bandwidth is None:
            torque_bandwidth = _noise_bandwidth(recording, torque_variance, segments)
        torque = _low_passed(recording.time, torque, torque_bandwidth, segments)
    if torque_bandwidth is not None:
        ends = min(LONGEST_END, END_PERIODS / float(torque_bandwidth.min()))
        clear &= _away_from_ends(recording.time, segments, ends)
    moving = model.moving(motion.velocity) & ~_near_reversal(motion, bandwidth)
    return Samples(
        motion=motion,
        torque=torque,
        usable=clear[:, None] & moving,
        segments=segments,
        origin=recording.motion_start if origin is None else origin,
        position_bandwidth=bandwidth,
        torque_bandwidth=torque_bandwidth,
    )


def _smooth(
    recording: Recording, noise_variance: Array | None, delay: float, widest: float
) -> tuple[Motion, Array, NDArray[np.bool_]]:
    """Motion, bandwidth (n,) of the longest segment, and rows (m,) that are away from ends."""
    position = recording.position.copy()
    velocity, acceleration = np.zeros_like(position), np.zeros_like(position)
    bandwidth = np.full(recording.n_joints, np.inf)
    clear = np.zeros(recording.n_samples, dtype=np.bool_)
    longest = 0
    for segment in recording.segments():
        time, measured = recording.time[segment], recording.position[segment]
        if len(time) < 2 * _SHORTEST_SEGMENT:
            continue
        variance = difference_variance(time, measured) if noise_variance is None else noise_variance
        spline = fit_smoothing_spline(
            time, measured, _attainable(variance, measured), widest=widest
        )
        at = time - delay
        position[segment], velocity[segment] = spline(at), spline(at, 1)
        acceleration[segment] = spline(at, 2)
        moving = np.ptp(measured, axis=0) > 0.0
        slowest = float(spline.bandwidth[moving].min()) if moving.any() else np.inf
        end = min(LONGEST_END, END_PERIODS / slowest)
        clear[segment] = (at >= time[0] + end) & (at <= time[-1] - end)
        if len(time) > longest:
            longest, bandwidth = len(time), spline.bandwidth
    return Motion(recording.time, position, velocity, acceleration), bandwidth, clear


def _noise_bandwidth(
    recording: Recording, variance: Array | None, segments: tuple[slice, ...]
) -> Array:
    """Bandwidth per joint (n,) [Hz] that takes the noise variance (n,) out of the torque.

    One bandwidth per joint, from the longest segment, so that the smoother is one and the same
    linear filter everywhere.
    """
    assert recording.torque is not None
    longest = max(segments, key=lambda segment: int(segment.stop - segment.start))
    time, measured = recording.time[longest], recording.torque[longest]
    if variance is None:
        variance = difference_variance(time, measured)
    return fit_smoothing_spline(time, measured, _attainable(variance, measured)).bandwidth


def _attainable(variance: Array, measured: Array) -> Array:
    """Noise variance (c,), at least that of rounding: closer a spline cannot follow (m, c)."""
    rounding = (np.finfo(np.float64).eps * np.abs(measured).max(axis=0)) ** 2
    return np.asarray(np.maximum(variance, np.maximum(rounding, 1e-40)))


def _low_passed(
    time: Array, columns: Array, bandwidth: Array, segments: tuple[slice, ...]
) -> Array:
    """Columns (m, c), each through a low-pass of its own (c,), segment by segment."""
    filtered = np.zeros_like(columns)
    for segment in segments:
        if segment.stop - segment.start < _SHORTEST_SEGMENT:
            continue
        for value in np.unique(bandwidth):
            alike = bandwidth == value
            filtered[segment, alike] = low_pass(
                time[segment], columns[segment][:, alike], float(value)
            )
    return filtered


def _near_reversal(motion: Motion, bandwidth: Array) -> NDArray[np.bool_]:
    """Rows (m, n) within half a period of a joint's smoothing bandwidth from its reversals."""
    near = np.zeros(motion.velocity.shape, dtype=np.bool_)
    for joint, velocity in enumerate(motion.velocity.T):
        reach = min(LONGEST_END, REVERSAL_PERIODS / float(bandwidth[joint]))
        last = np.flatnonzero(velocity[1:] * velocity[:-1] < 0.0)
        starts = np.searchsorted(motion.time, motion.time[last] - reach)
        stops = np.searchsorted(motion.time, motion.time[last + 1] + reach, side="right")
        for start, stop in zip(starts, stops, strict=True):
            near[start:stop, joint] = True
    return near


def _away_from_ends(time: Array, segments: tuple[slice, ...], end: float) -> NDArray[np.bool_]:
    clear = np.zeros(len(time), dtype=np.bool_)
    for segment in segments:
        inside = time[segment]
        clear[segment] = (inside >= inside[0] + end) & (inside <= inside[-1] - end)
    return clear
