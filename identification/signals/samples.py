"""Preparation of a recording for a fit: smoothed motion, torque, and usable rows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.model.motion import Motion
from identification.model.regressor import Regressor
from identification.model.robot import RobotModel
from identification.signals.masks import (
    END_PERIODS,
    MAX_END_SECONDS,
    MIN_STRETCH_SAMPLES,
    ExcludedRows,
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

# Default (see :mod:`identification.selection.questions`). Planned motion is below 10 Hz, the
# first resonance of large arms at 10 to 30 Hz; on the simulated NS 16 20 to 60 Hz are equal.
RIGID_BANDWIDTH: Final = 40.0  # Hz
_FITTED_SHARE: Final = 0.7  # of the rows of one recording
_MAX_PREDICTIONS: Final = 2  # in memory: predictions of the result and of the nominal model
# Of a velocity or acceleration near an end over the largest elsewhere: a motion may begin abruptly.
_MAX_AT_ENDS: Final = 2.0
_MIN_SEGMENT_SAMPLES: Final = 12  # samples, twice the minimum of a quintic spline

VelocitySource = Literal["position", "measured"]
Smoothed = tuple[Motion, Array]
"""Motion and bandwidth of :func:`smooth`."""


@dataclass(frozen=True)
class Preprocessing:
    """Settings of the preparation."""

    #: largest bandwidth of the smoothed positions [Hz]; a rigid model is wrong above the first
    #: resonance
    rigid_bandwidth: float = RIGID_BANDWIDTH
    #: velocity and acceleration from the smoothed position, or from the smoothed measured velocity
    #: if recorded
    velocity: VelocitySource = "position"
    #: excluded slow rows, see :func:`identification.signals.masks.mask_rows`; by default "halts" if
    #: all joints have presliding friction, else "slow"
    exclude_rows: ExcludedRows | None = None
    #: as in the paper: torque and regressor are smoothed alike. Without it least squares averages
    #: noise better
    smooth_torque: bool = False
    #: bandwidth [Hz] of the torque smoother with `smooth_torque` (None: by noise variance),
    #: otherwise of a low-pass in the recorded torque, also applied to the regressor (None: no
    #: low-pass)
    torque_bandwidth: float | None = None
    torque_shape: LowPassShape = SMOOTHER  #: of that low-pass; ignored with `smooth_torque`
    #: lag of the recorded torque behind the position [s], without that of a causal low-pass
    torque_delay: float = 0.0

    @property
    def of_motion(self) -> Preprocessing:
        """The settings that change the smoothed motion, the others by default."""
        return Preprocessing(
            self.rigid_bandwidth, velocity=self.velocity, torque_delay=self.torque_delay
        )

    def __post_init__(self) -> None:
        for name in ("rigid_bandwidth", "torque_bandwidth"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"{name} is {value} Hz, must be positive")


@dataclass(frozen=True, eq=False)
class Samples:
    """m samples of n joints, prepared for a fit, in the rows of their recording."""

    motion: Motion  #: smoothed positions and derivatives, at the times of the torque
    torque: Array  #: (m, n) [N·m or N]
    usable: NDArray[np.bool_]  #: (m, n) moving, and away from gaps, ends and reversals
    segments: tuple[slice, ...]  #: stretches without a gap
    origin: float  #: start time of the planned motion [s], common to repetitions
    position_bandwidth: Array  #: of the smoothing (n,) [Hz]
    #: of the low-pass of torque and regressor (n,) [Hz]; None: no low-pass
    torque_bandwidth: Array | None = None
    torque_shape: LowPassShape = SMOOTHER  #: of that low-pass
    mask: RowMask | None = None  #: reasons against rows; None if unknown
    #: samples that these are part of, and which part, for a low-pass
    parent: tuple[Samples, slice] | None = None
    _predictions: dict[bytes, tuple[RobotModel, Array]] = field(
        default_factory=dict, init=False, repr=False
    )

    def between(self, start: int, stop: int) -> Samples:
        """Return samples start to stop (exclusive), filtered as part of these."""
        part = slice(start, stop)
        motion = self.motion.rows(part)
        if motion.direction is not None:  # a view would hold the whole recording's
            motion = replace(motion, direction=motion.direction.copy())
        segments = [
            slice(max(segment.start, start) - start, min(segment.stop, stop) - start)
            for segment in self.segments
            if segment.start < stop and segment.stop > start
        ]
        return replace(
            self,
            motion=motion,
            torque=self.torque[part],
            usable=self.usable[part],
            segments=tuple(segments),
            mask=None if self.mask is None else self.mask.rows(part),
            parent=None if self.torque_bandwidth is None else (self, part),
        )

    def to_fit_and_predict(self) -> tuple[Samples, Samples]:
        """Return the first 70 %, to be fitted, and the rest, to be predicted."""
        cut = round(_FITTED_SHARE * len(self.torque))
        return self.between(0, cut), self.between(cut, len(self.torque))

    def thinned(self, step: int) -> Samples:
        """Return every `step`-th row, as of a torque without a low-pass."""
        rows = slice(step // 2, None, step)
        return replace(
            self,
            motion=self.motion.rows(rows),
            torque=self.torque[rows],
            usable=self.usable[rows],
            segments=(),
            mask=None if self.mask is None else self.mask.rows(rows),
            torque_bandwidth=None,
            parent=None,
        )

    def thinned_to(self, rows: int) -> Samples:
        """Return at least this many rows where there are, evenly spaced."""
        return self.thinned(max(1, len(self.torque) // rows))

    def blocks(self, duration: float) -> Indices:
        """Return the block of time [s] of each row (m,), rising, counted from the origin.

        Rows before the origin belong to the first block.
        """
        since = self.motion.time - self.origin
        return np.maximum(np.floor(since / duration + 1e-9).astype(np.intp), 0)

    def moving(self) -> Samples:
        """Return samples with the rows in sliding motion only."""
        return self if self.mask is None else replace(self, usable=self.mask.moving)

    def with_friction_direction(self, model: RobotModel) -> Samples:
        """Return samples with the direction of dry friction by a model's law."""
        direction = None
        if any(law.presliding > 0.0 for law in model.friction.laws):
            direction = model.friction.direction(self.whole.motion)
        return self._with_direction(direction)

    def sliding(self, model: RobotModel, sign: float) -> Samples:
        """Return samples whose dry friction has the direction +1 or -1 throughout."""
        motion = self.whole.motion
        return self._with_direction(np.full_like(model.friction.direction(motion), np.sign(sign)))

    def _with_direction(self, direction: Array | None) -> Samples:
        """Return samples with the direction of dry friction of all rows of their recording."""
        if self.parent is not None:
            parent, part = self.parent
            parent = parent._with_direction(direction)
            return replace(self, motion=parent.motion.rows(part), parent=(parent, part))
        return replace(self, motion=replace(self.motion, direction=direction))

    def with_load(self, model: RobotModel, values: Array) -> Samples:
        """Return samples with the torque that the gears transmit, of parameters (p,)."""
        return self.with_given_load(model.gear_torque(values, self.whole.motion))

    def with_given_load(self, load: Array | None) -> Samples:
        """Return samples with a transmitted torque [N·m, N] of all rows of their recording."""
        if self.parent is not None:
            parent, part = self.parent
            parent = parent.with_given_load(load)
            return replace(self, motion=parent.motion.rows(part), parent=(parent, part))
        return replace(self, motion=replace(self.motion, load=load))

    @property
    def whole(self) -> Samples:
        """The samples of the recording that these are part of."""
        return self if self.parent is None else self.parent[0].whole

    def as_measured(self, joint: int, columns: Array) -> Array:
        """Filter columns (m, c) of a joint's row by the torque's low-pass."""
        if self.torque_bandwidth is None:
            return columns
        bandwidth = np.full(columns.shape[1], self.torque_bandwidth[joint])
        return _low_passed(self.motion.time, columns, bandwidth, self.segments, self.torque_shape)

    def regressor(self, model: RobotModel) -> Regressor:
        """Return the regressor of every row, filtered by the torque's low-pass."""
        if self.parent is not None:
            samples, part = self.parent
            blocks, columns = samples.regressor(model)
            return Regressor(tuple(block[part] for block in blocks), columns)
        blocks, columns = model.regressor(self.motion)
        return Regressor(
            tuple(self.as_measured(joint, block) for joint, block in enumerate(blocks)), columns
        )

    def predicted_torque(
        self, model: RobotModel, values: Array, chosen: NDArray[np.bool_] | None = None
    ) -> Array:
        """Return the torque (m, n) of parameters (p,), filtered by the torque's low-pass.

        Friction has the load of these values, not of the motion. With `chosen` (p,) only the part
        of some parameters, whose friction has the load of all.
        """
        if self.parent is not None:
            samples, part = self.parent
            return samples.predicted_torque(model, values, chosen)[part]
        if chosen is not None:
            return self._torque_of(model, values, np.where(chosen, values, 0.0))
        of_model, torque = self._predictions.get(values.tobytes(), (None, np.empty(0)))
        if of_model is not model:
            torque = self._torque_of(model, values, values)
            torque.flags.writeable = False
            # The tests of a verdict request the predictions of few estimates repeatedly.
            if len(self._predictions) >= _MAX_PREDICTIONS:
                del self._predictions[next(iter(self._predictions))]
            self._predictions[values.tobytes()] = model, torque
        return torque

    def _torque_of(self, model: RobotModel, values: Array, part: Array) -> Array:
        """Return the torque (m, n) of a part of the values (p,), with the load of all."""
        load = None
        if model.friction.has_load:
            load = model.gear_torque(values, self.motion)
        return self._filtered(model.torque(part, replace(self.motion, load=load)))

    def known_torque(self, model: RobotModel) -> Array:
        """Return the torque (m, n) of known payload and elements, filtered in the same way."""
        torque = model.load_torque(self.motion)
        return self._filtered(torque) if model.has_load else torque

    def _filtered(self, torque: Array) -> Array:
        if self.torque_bandwidth is None:
            return torque
        return _low_passed(
            self.motion.time, torque, self.torque_bandwidth, self.segments, self.torque_shape
        )


def smooth(
    recording: Recording,
    noise_variance: Array | None = None,
    options: Preprocessing = Preprocessing(),
) -> Smoothed:
    """Return the smoothed motion at each time minus the delay, and the bandwidth (n,) [Hz].

    `noise_variance` of the measured positions (n,) [rad² or m²] is from standstill and at least
    resolution²/12; None: estimated from differences of positions. Rows of segments too short to
    smooth keep their position, at rest. Near the ends of a segment, where a smoother is inaccurate
    and drives begin to filter, velocity and acceleration are at most twice those elsewhere in it.
    """
    position = recording.position.copy()
    velocity = np.zeros_like(position)
    acceleration = np.zeros_like(position)
    bandwidth = np.full(recording.n_joints, np.inf)
    longest = 0
    speed = recording.velocity if options.velocity == "measured" else None

    def spline_of(time: Array, measured: Array, variance: Array | None) -> SmoothingSpline:
        tolerance = _attainable(time, measured, variance)
        return fit_smoothing_spline(time, measured, tolerance, widest=options.rigid_bandwidth)

    for segment in recording.segments():
        time = recording.time[segment]
        if len(time) < MIN_STRETCH_SAMPLES:
            continue
        spline = spline_of(time, position[segment], noise_variance)
        at = time - options.torque_delay
        position[segment] = spline(at)
        if speed is None:
            velocity[segment] = spline(at, 1)
            acceleration[segment] = spline(at, 2)
        else:
            slope = spline_of(time, speed[segment], None)
            velocity[segment] = slope(at)
            acceleration[segment] = slope(at, 1)
        for derivative in (velocity, acceleration):
            derivative[segment] = _bounded_at_ends(at, derivative[segment], spline.bandwidth)
        if len(time) > longest:
            longest = len(time)
            bandwidth = spline.bandwidth
    return Motion(recording.time, position, velocity, acceleration), bandwidth


def _bounded_at_ends(time: Array, values: Array, bandwidth: Array) -> Array:
    """Return values (m, n) that near the ends of a segment are no outliers of its other rows.

    Args:
        time: of the rows (m,) [s].
        values: of derivatives of the position (m, n).
        bandwidth: of the smoother (n,) [Hz].
    """
    end = np.minimum(MAX_END_SECONDS, END_PERIODS / bandwidth)
    inside = (time[:, None] >= time[0] + end) & (time[:, None] <= time[-1] - end)
    largest = _MAX_AT_ENDS * np.where(inside, np.abs(values), 0.0).max(axis=0)
    largest[inside.sum(axis=0) < MIN_STRETCH_SAMPLES] = np.inf
    return np.clip(values, -largest, largest)


def prepare(
    recording: Recording,
    model: RobotModel,
    *,
    noise_variance: Array | None = None,
    torque_variance: Array | None = None,
    options: Preprocessing = Preprocessing(),
    origin: float | None = None,
    current_limit: Array | None = None,
    motions: dict[Preprocessing, Smoothed] | None = None,
) -> Samples:
    """Prepare a recording for a model; the torque of a known payload is subtracted.

    Args:
        recording: with torque.
        model: of the arm.
        noise_variance: of the positions (n,); estimated if None, see :func:`smooth`.
        torque_variance: of the torques (n,), for `options.smooth_torque`; likewise.
        options: of the preparation.
        origin: start of the planned motion [s], by default of the command.
        current_limit: of the motors (n,) [A]; rows at it are excluded.
        motions: of the recording by their settings, kept for several preparations.

    Raises:
        RecordingError: the recording is invalid or has no torque.
    """
    recording.checked(model.joint_names)
    if recording.torque is None:
        raise RecordingError("the recording has no joint torque to fit")
    motion, bandwidth = _smoothed(recording, noise_variance, options, motions)
    segments = tuple(recording.segments())
    torque = recording.torque
    torque_bandwidth = None
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
        exclude_rows=options.exclude_rows or ("halts" if presliding else "slow"),
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
    ).with_friction_direction(model)
    if not model.has_load:
        return samples
    return replace(samples, torque=samples.torque - samples.known_torque(model))


def _smoothed(
    recording: Recording,
    noise_variance: Array | None,
    options: Preprocessing,
    motions: dict[Preprocessing, Smoothed] | None,
) -> Smoothed:
    """Return the smoothed motion, by `motions` if it is there."""
    motions = {} if motions is None else motions
    if options.of_motion not in motions:
        motions[options.of_motion] = smooth(recording, noise_variance, options)
    return motions[options.of_motion]


def _noise_bandwidth(
    recording: Recording, variance: Array | None, segments: tuple[slice, ...]
) -> Array:
    """Return the bandwidth per joint (n,) [Hz] that removes the torque noise variance (n,)."""
    assert recording.torque is not None
    longest = max(segments, key=lambda segment: int(segment.stop - segment.start))
    time = recording.time[longest]
    measured = recording.torque[longest]
    return fit_smoothing_spline(time, measured, _attainable(time, measured, variance)).bandwidth


def _attainable(time: Array, measured: Array, variance: Array | None) -> Array:
    """Return the noise variance (c,), by default from differences, at least of rounding."""
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
    """Filter columns (m, c) by own low-passes (c,), segment by segment."""
    filtered = np.zeros_like(columns)
    for segment in segments:
        if segment.stop - segment.start < _MIN_SEGMENT_SAMPLES:
            continue
        widths = np.unique(bandwidth)
        if len(widths) == 1:
            filtered[segment] = low_passed(time[segment], columns[segment], float(widths[0]), shape)
            continue
        for value in widths:
            alike = bandwidth == value
            filtered[segment, alike] = low_passed(
                time[segment], columns[segment][:, alike], float(value), shape
            )
    return filtered
