"""From a recording to what a fit reads: smoothed motion, torque, and which rows count."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from identification.model.motion import Motion
from identification.model.regressor import Regressor
from identification.model.robot import RobotModel
from identification.signals.masks import (
    SHORTEST_STRETCH,
    LeftOut,
    RowMask,
    mask_rows,
)
from identification.signals.noise import difference_variance
from identification.signals.recording import Recording, RecordingError
from identification.signals.smoothing import (
    SMOOTHER,
    LowPassShape,
    SmoothingSpline,
    fit_smoothing_spline,
    low_passed,
)

Array = NDArray[np.float64]

# Widest where nobody chose (see :mod:`identification.selection.inner_prediction`): planned motion
# has next to nothing above 10 Hz, and the first resonance of a large arm lies at 10 to 30 Hz. On
# the simulated NS 16 everything from 20 to 60 Hz is as good as noise allows.
RIGID_BANDWIDTH: Final = 40.0  # Hz
_SHORTEST_SEGMENT: Final = 12  # samples: twice what a quintic spline needs

VelocitySource = Literal["position", "measured"]


@dataclass(frozen=True)
class Preprocessing:
    """How a recording is turned into samples."""

    #: widest bandwidth of the smoothed positions [Hz], however little noise they have. A rigid
    #: model has nothing to say above the first resonance of the arm, where motors accelerate
    #: without their links; and a wide one lets ripple that has found a resonance pass for inertia
    rigid_bandwidth: float = RIGID_BANDWIDTH
    #: where the velocity comes from: the slope of the smoothed position, or the measured
    #: velocity, smoothed alike, whose slope is then the acceleration. Recordings without a
    #: measured velocity take the position's
    velocity: VelocitySource = "position"
    #: which rows do not count for being slow, see :func:`identification.signals.masks.mask_rows`.
    #: By default "rests" where dry friction has a presliding state in every joint, "slow" where
    #: it jumps: no sgn(v) is right there
    left_out: LeftOut | None = None
    #: the paper's way. The torque is smoothed, and the regressor goes through the same linear
    #: smoother. By default the torque is left as measured: least squares averages it better
    smooth_torque: bool = False
    #: with `smooth_torque` the bandwidth of that smoother [Hz]; None smooths until the mean
    #: squared residual is the torque's noise variance. Without, the bandwidth of a low-pass that
    #: the torque has come through before it was logged, as many controllers do it: the regressor
    #: then goes through the same low-pass and the torque is left alone. None: it has come through
    #: none
    torque_bandwidth: float | None = None
    #: how that low-pass falls off; `smooth_torque` is always by the spline's
    torque_shape: LowPassShape = SMOOTHER
    #: time by which the recorded torque lags the recorded position [s], beside the lag of a
    #: causal low-pass
    torque_delay: float = 0.0

    def __post_init__(self) -> None:
        for name in ("rigid_bandwidth", "torque_bandwidth"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"{name} is {value} Hz, must be positive")


@dataclass(frozen=True, eq=False)
class Samples:
    """m samples of n joints, ready for a fit, in the rows of the recording they come from."""

    #: smoothed positions and their derivatives, at the instants the torque belongs to
    motion: Motion
    torque: Array  #: (m, n) [N·m or N]
    #: (m, n) rows that count: moving, and away from gaps, ends and reversals
    usable: NDArray[np.bool_]
    segments: tuple[slice, ...]  #: stretches without a gap
    #: time at which the planned motion begins [s]; repetitions are compared at equal times since
    #: then
    origin: float
    position_bandwidth: Array  #: of the smoothing, per joint (n,) [Hz]
    #: of the low-pass the torque has come through, per joint (n,) [Hz]; the regressor has to go
    #: through it as well. None: it has come through none
    torque_bandwidth: Array | None = None
    torque_shape: LowPassShape = SMOOTHER  #: of that low-pass
    mask: RowMask | None = None  #: why rows do not count; None where nobody asked
    #: the samples that these are part of, and which part: a low-pass reads what comes before and
    #: after. None where they are all there is
    whole: tuple[Samples, slice] | None = None

    def between(self, start: int, stop: int) -> Samples:
        """Return samples start to stop (exclusive), still filtered as part of these."""
        part = slice(start, stop)
        segments = [
            slice(max(one.start, start) - start, min(one.stop, stop) - start)
            for one in self.segments
            if one.start < stop and one.stop > start
        ]
        return replace(
            self,
            motion=self.motion.rows(part),
            torque=self.torque[part],
            usable=self.usable[part],
            segments=tuple(segments),
            mask=None if self.mask is None else self.mask.rows(part),
            whole=None if self.torque_bandwidth is None else (self, part),
        )

    def moving(self) -> Samples:
        """Return samples of which only rows count in which the joint moves."""
        return self if self.mask is None else replace(self, usable=self.mask.moving)

    def directed(self, model: RobotModel) -> Samples:
        """Return samples whose dry friction has the direction that a model's law gives it."""
        if self.whole is not None:
            whole, part = self.whole
            whole = whole.directed(model)
            return replace(self, motion=whole.motion.rows(part), whole=(whole, part))
        direction = None
        if any(law.presliding > 0.0 for law in model.friction.laws):
            direction = model.friction.direction(*self.motion[:3])
        return replace(self, motion=self.motion._replace(direction=direction))

    def as_measured(self, joint: int, columns: Array) -> Array:
        """Columns (m, c) of a joint's row as the torque channel would have recorded them."""
        if self.torque_bandwidth is None:
            return columns
        bandwidth = np.full(columns.shape[1], self.torque_bandwidth[joint])
        return _low_passed(self.motion.time, columns, bandwidth, self.segments, self.torque_shape)

    def regressor(self, model: RobotModel) -> Regressor:
        """Regressor of every row, usable or not, as the torque channel would record it."""
        if self.whole is not None:
            samples, part = self.whole
            blocks, columns = samples.regressor(model)
            return Regressor(tuple(block[part] for block in blocks), columns)
        blocks, columns = model.regressor(*self.motion[1:])
        return Regressor(
            tuple(self.as_measured(joint, block) for joint, block in enumerate(blocks)), columns
        )

    def predicted_torque(self, model: RobotModel, values: Array) -> Array:
        """Torque (m, n) that parameters (p,) predict, as the torque channel would record it."""
        if self.whole is not None:
            samples, part = self.whole
            return samples.predicted_torque(model, values)[part]
        return self._through_channel(model.torque(values, *self.motion[1:]))

    def known_torque(self, model: RobotModel) -> Array:
        """Torque (m, n) of payload and elements that is known, as it would be recorded."""
        torque = model.load_torque(*self.motion[1:4])
        return self._through_channel(torque) if model.has_load else torque

    def _through_channel(self, torque: Array) -> Array:
        if self.torque_bandwidth is None:
            return torque
        return _low_passed(
            self.motion.time, torque, self.torque_bandwidth, self.segments, self.torque_shape
        )


def smooth(
    recording: Recording,
    noise_variance: Array | None = None,
    options: Preprocessing = Preprocessing(),
) -> tuple[Motion, Array]:
    """Smoothed motion at each instant less the delay, and the bandwidth of the longest stretch.

    Rows of a stretch too short to smooth keep their position, at rest; see :func:`prepare` for
    which rows count.

    Args:
        recording: checked.
        noise_variance: of the measured positions (n,) [rad² or m²], from standstill and at least
            resolution²/12. None: estimated from the differences of the positions.
        options: its bandwidth, velocity and delay.

    Returns:
        Motion in the rows of the recording, and the bandwidth per joint (n,) [Hz].
    """
    position = recording.position.copy()
    velocity, acceleration = np.zeros_like(position), np.zeros_like(position)
    bandwidth, longest = np.full(recording.n_joints, np.inf), 0
    speed = recording.velocity if options.velocity == "measured" else None

    def spline_of(time: Array, measured: Array, variance: Array | None) -> SmoothingSpline:
        tolerance = _attainable(time, measured, variance)
        return fit_smoothing_spline(time, measured, tolerance, widest=options.rigid_bandwidth)

    for segment in recording.segments():
        time = recording.time[segment]
        if len(time) < SHORTEST_STRETCH:
            continue
        spline, at = spline_of(time, position[segment], noise_variance), time - options.torque_delay
        position[segment] = spline(at)
        if speed is None:
            velocity[segment], acceleration[segment] = spline(at, 1), spline(at, 2)
        else:
            slope = spline_of(time, speed[segment], None)
            velocity[segment], acceleration[segment] = slope(at), slope(at, 1)
        if len(time) > longest:
            longest, bandwidth = len(time), spline.bandwidth
    return Motion(recording.time, position, velocity, acceleration), bandwidth


def prepare(
    recording: Recording,
    model: RobotModel,
    *,
    noise_variance: Array | None = None,
    torque_variance: Array | None = None,
    options: Preprocessing = Preprocessing(),
    origin: float | None = None,
    current_limit: Array | None = None,
) -> Samples:
    """Samples of a recording for a model; of its torque, that of a known payload is subtracted.

    Args:
        recording: with torque; joints in the model's order.
        model: says below which speed a joint stands, and what the arm carried.
        noise_variance: of the positions (n,), see :func:`smooth`.
        torque_variance: of the torques (n,), for `options.smooth_torque` only; None: estimated.
        options: what to do with the torque.
        origin: time at which the planned motion begins [s]; by default where the command begins
            to move.
        current_limit: largest current a motor is given (n,) [A]; rows at it do not
            count.

    Raises:
        RecordingError: the recording does not pass its checks, or has no torque.
    """
    recording.checked(model.joint_names)
    if recording.torque is None:
        raise RecordingError("the recording has no joint torque to fit")
    motion, bandwidth = smooth(recording, noise_variance, options)
    segments = tuple(recording.segments())
    torque, torque_bandwidth = recording.torque, None
    if options.torque_bandwidth is not None:
        torque_bandwidth = np.full(recording.n_joints, options.torque_bandwidth)
    if options.smooth_torque:
        if torque_bandwidth is None:
            torque_bandwidth = _noise_bandwidth(recording, torque_variance, segments)
        torque = _low_passed(recording.time, torque, torque_bandwidth, segments)
    presliding = all(law.presliding > 0.0 for law in model.friction.laws)
    mask = mask_rows(
        recording,
        model,
        motion,
        bandwidth,
        current_limit=current_limit,
        torque_bandwidth=torque_bandwidth,
        delay=options.torque_delay,
        left_out=options.left_out or ("rests" if presliding else "slow"),
    )
    samples = Samples(
        motion=motion,
        torque=torque,
        usable=mask.usable,
        segments=segments,
        origin=recording.motion_start if origin is None else origin,
        position_bandwidth=bandwidth,
        torque_bandwidth=torque_bandwidth,
        torque_shape=SMOOTHER if options.smooth_torque else options.torque_shape,
        mask=mask,
    ).directed(model)
    if not model.has_load:
        return samples
    return replace(samples, torque=samples.torque - samples.known_torque(model))


def _noise_bandwidth(
    recording: Recording, variance: Array | None, segments: tuple[slice, ...]
) -> Array:
    """Bandwidth per joint (n,) [Hz] that takes the noise variance (n,) out of the torque."""
    assert recording.torque is not None
    longest = max(segments, key=lambda segment: int(segment.stop - segment.start))
    time, measured = recording.time[longest], recording.torque[longest]
    return fit_smoothing_spline(time, measured, _attainable(time, measured, variance)).bandwidth


def _attainable(time: Array, measured: Array, variance: Array | None) -> Array:
    """Noise variance (c,), by default from differences; at least that of rounding."""
    if variance is None:
        variance = difference_variance(time, measured)
    rounding = (np.finfo(np.float64).eps * np.abs(measured).max(axis=0)) ** 2
    return np.asarray(np.maximum(variance, np.maximum(rounding, 1e-40)))


def _low_passed(
    time: Array,
    columns: Array,
    bandwidth: Array,
    segments: tuple[slice, ...],
    shape: LowPassShape = SMOOTHER,
) -> Array:
    """Columns (m, c), each through a low-pass of its own (c,), segment by segment."""
    filtered = np.zeros_like(columns)
    for segment in segments:
        if segment.stop - segment.start < _SHORTEST_SEGMENT:
            continue
        for value in np.unique(bandwidth):
            alike = bandwidth == value
            filtered[segment, alike] = low_passed(
                time[segment], columns[segment][:, alike], float(value), shape
            )
    return filtered
