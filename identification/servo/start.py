"""What is known of servos before a fit: priors of the size of the position errors, and starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array, root_mean_square
from identification.servo.fit import Prior
from identification.servo.parameters import NAMES, PLACE, TERMS
from identification.servo.recorded_motion import SMOOTHING_SECONDS, ServoMotion
from identification.signals.recording import MIN_MOVEMENT

STARTS: Final = ({"delay": 0.01}, {"delay": 0.06, "kd": 0.1})
"""A servo that follows at once, and one that leads a late command: a fit finds the other from
neither, and takes the better of both."""
_SERVO_TIME_CONSTANT: Final = 0.04  # s, square root of armature over kp: a servo of 4 Hz
_TIMES: Final = {"viscous": 0.04, "kd": 0.01}  # s, over kp
_SHARES: Final = {
    "coulomb": 0.2,
    "static": 0.1,
    "dead_band": 0.05,
}  # of the root mean square of the position errors
_RATIOS: Final = {"load": 0.1, "speed": 0.1}
_SATURATION_QUANTILE: Final = 0.99
"""Quantile of position errors and commanded accelerations that a servo is expected to reach."""
_LIMIT_RATIO: Final = 5.0  # of the error at which a servo saturates to what it reaches in a motion
_ACCELERATION: Final = 40.0  # rad/s² or m/s², as of an STS3215 by its register
_MIN_COMPLIANCE: Final = 1e-9  # rad/(N·m) or m/N, of a servo without error


def prior_of(motions: Sequence[ServoMotion], resolution: Array) -> Prior:
    """Return the prior of motions, whose mean is a start as well.

    Args:
        motions: that are fitted.
        resolution: standard deviation of the measured positions (n,).
    """
    errors = np.concatenate([motion.command - motion.position for motion in motions])
    moving = moving_joints(motions)
    size = np.maximum(_of_moving(root_mean_square(errors), moving), resolution)
    mean = np.zeros((len(size), len(TERMS)))
    spread = np.tile([term.spread for term in TERMS], (len(size), 1))
    mean[:, PLACE["kp"]] = np.log(_compliance(motions, errors))
    mean[:, PLACE["armature"]] = 2.0 * np.log(_SERVO_TIME_CONSTANT)
    for name, value in (_TIMES | _RATIOS).items():
        mean[:, PLACE[name]] = np.log(value)
    for name, share in _SHARES.items():
        mean[:, PLACE[name]] = np.log(share * size)
    reached = _of_moving(np.quantile(np.abs(errors), _SATURATION_QUANTILE, axis=0), moving)
    mean[:, PLACE["limit"]] = np.log(_LIMIT_RATIO * np.maximum(reached, resolution))
    acceleration = np.maximum(_commanded_acceleration(motions), _ACCELERATION)
    mean[:, PLACE["acceleration"]] = np.log(acceleration)
    return Prior(mean, spread)


def with_moving_joints(prior: Prior, coordinates: Array, moving: NDArray[np.bool_]) -> Prior:
    """Return a prior in which joints that stood are as the others were found, in the median.

    Args:
        prior: of the joints.
        coordinates: of a fit (n, P).
        moving: joints that moved (n,).
    """
    others = np.median(coordinates[moving], axis=0) if moving.any() else 0.0
    known = np.array([name != "offset" for name in NAMES])
    mean = np.where(known & ~moving[:, None] & moving.any(), others, prior.mean)
    return Prior(mean, prior.spread)


def moving_joints(motions: Sequence[ServoMotion]) -> NDArray[np.bool_]:
    """Return the joints (n,) whose command moves in some motion."""
    commands = [np.ptp(motion.command, axis=0) for motion in motions]
    return np.asarray(np.max(commands, axis=0) > MIN_MOVEMENT)


def _of_moving(values: Array, moving: NDArray[np.bool_]) -> Array:
    """Return values (n,), of joints that stand the median of those that move."""
    return np.where(moving, values, np.median(values[moving])) if moving.any() else values


def _commanded_acceleration(motions: Sequence[ServoMotion]) -> Array:
    """Return the acceleration that the smoothed commands seldom exceed (n,)."""
    accelerations = []
    for motion in motions:
        width = SMOOTHING_SECONDS / motion.step
        smooth = scipy.ndimage.gaussian_filter1d(motion.command, width, axis=0, mode="nearest")
        accelerations.append(np.gradient(np.gradient(smooth, axis=0), axis=0) / motion.step**2)
    size = np.quantile(np.abs(np.concatenate(accelerations)), _SATURATION_QUANTILE, axis=0)
    return np.asarray(size)


def start_of(prior: Prior, start: dict[str, float]) -> Array:
    """Return coordinates (n, P) to start from: the prior's, but for some values."""
    coordinates = prior.mean.copy()
    for name, value in start.items():
        place = PLACE[name]
        coordinates[:, place] = np.log(value) if TERMS[place].positive else value
    return coordinates


def _compliance(motions: Sequence[ServoMotion], errors: Array) -> Array:
    """Return position error per torque of the bodies (n,), alike for all joints of a kind.

    The servos of an arm are of a few types: that of the joint whose errors are smallest for the
    torque that it needs. A softer servo would not have followed.
    """
    torque = root_mean_square(np.concatenate([motion.bodies.bias for motion in motions]))
    softest = root_mean_square(errors) / np.maximum(torque, 1e-9)
    turning = motions[0].turning
    common = [softest[turning == turns].min() for turns in turning]
    return np.asarray(np.maximum(common, _MIN_COMPLIANCE))
