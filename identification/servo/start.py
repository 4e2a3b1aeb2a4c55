"""What is known of servos before a fit: priors of the size of the position errors, and starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import scipy

from identification.arrays import Array
from identification.servo.fit import Prior
from identification.servo.parameters import PLACE, TERMS
from identification.servo.recorded_motion import SMOOTHING_SECONDS, ServoMotion

STARTS: Final = ({"delay": 0.01}, {"delay": 0.06, "kd": 0.1})
"""A servo that follows at once, and one that leads a late command: a fit finds the other from
neither, and takes the better of both."""
_SERVO_TIME_CONSTANT: Final = 0.04  # s, square root of armature over kp: a servo of 4 Hz
_DETERMINED_SIGMAS: Final = 3.0  # deviations from which on a compliance counts
_TIMES: Final = {"viscous": 0.04, "kd": 0.01}  # s, over kp
_SHARES: Final = {
    "coulomb": 0.2,
    "static": 0.1,
    "dead_band": 0.05,
}  # of the root mean square of the position errors
_RATIOS: Final = {"load": 0.1, "speed": 0.1}
_SATURATION_QUANTILE: Final = 0.99
"""Quantile of position errors and commanded accelerations at which a limit is sought."""
_MIN_ACCELERATION: Final = 1e-2  # rad/s² or m/s², of a command that does not move
_SAMPLES_PER_FACT: Final = 20.0  # samples that count as one


def prior_of(motions: Sequence[ServoMotion], resolution: Array) -> Prior:
    """Return the prior of motions, whose mean is a start as well.

    Args:
        motions: that are fitted.
        resolution: standard deviation of the measured positions (n,).
    """
    errors = np.concatenate([motion.command - motion.position for motion in motions])
    size = np.maximum(np.sqrt((errors**2).mean(axis=0)), resolution)
    mean = np.zeros((len(size), len(TERMS)))
    spread = np.tile([term.spread for term in TERMS], (len(size), 1))
    mean[:, PLACE["kp"]] = np.log(_compliance(motions, errors))
    mean[:, PLACE["armature"]] = 2.0 * np.log(_SERVO_TIME_CONSTANT)
    for name, value in (_TIMES | _RATIOS).items():
        mean[:, PLACE[name]] = np.log(value)
    for name, share in _SHARES.items():
        mean[:, PLACE[name]] = np.log(share * size)
    limit = np.quantile(np.abs(errors), _SATURATION_QUANTILE, axis=0)
    mean[:, PLACE["limit"]] = np.log(np.maximum(limit, resolution))
    mean[:, PLACE["acceleration"]] = np.log(_commanded_acceleration(motions))
    return Prior(mean, spread)


def _commanded_acceleration(motions: Sequence[ServoMotion]) -> Array:
    """Return the acceleration that the smoothed commands seldom exceed (n,)."""
    accelerations = []
    for motion in motions:
        width = SMOOTHING_SECONDS / motion.step
        smooth = scipy.ndimage.gaussian_filter1d(motion.command, width, axis=0, mode="nearest")
        accelerations.append(np.gradient(np.gradient(smooth, axis=0), axis=0) / motion.step**2)
    size = np.quantile(np.abs(np.concatenate(accelerations)), _SATURATION_QUANTILE, axis=0)
    return np.asarray(np.maximum(size, _MIN_ACCELERATION))


def start_of(prior: Prior, start: dict[str, float]) -> Array:
    """Return coordinates (n, P) to start from: the prior's, but for some values."""
    coordinates = prior.mean.copy()
    for name, value in start.items():
        place = PLACE[name]
        coordinates[:, place] = np.log(value) if TERMS[place].positive else value
    return coordinates


def _compliance(motions: Sequence[ServoMotion], errors: Array) -> Array:
    """Return position error per torque of the bodies (n,).

    Of the joints whose errors follow that torque with friction and a constant, the median; where
    none does, that at which the bodies alone would make the servo's time constant. At most the size
    of the errors over that of the torque: a softer servo would not have held the arm.
    """
    bodies = [motion.bodies for motion in motions]
    torque = np.concatenate([part.bias for part in bodies])
    speed = np.concatenate([motion.velocity for motion in motions])
    inertia = np.concatenate([part.inertia for part in bodies]).mean(axis=0)
    known = []
    for joint in range(errors.shape[1]):
        columns = np.column_stack(
            [torque[:, joint], speed[:, joint], np.sign(speed[:, joint]), np.ones(len(speed))]
        )
        normal = columns.T @ columns + 1e-12 * np.eye(4)
        solution = np.linalg.solve(normal, columns.T @ errors[:, joint])
        variance = np.mean((errors[:, joint] - columns @ solution) ** 2) * _SAMPLES_PER_FACT
        deviation = np.sqrt(variance * np.linalg.inv(normal)[0, 0])
        if solution[0] > _DETERMINED_SIGMAS * deviation:
            known.append(solution[0])
    alone = _SERVO_TIME_CONSTANT**2 / np.maximum(inertia, 1e-9)
    softest = _rms(errors) / np.maximum(_rms(torque), 1e-9)
    common = float(np.median(known) if known else np.median(alone))
    return np.asarray(np.minimum(common, softest))


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt((values**2).mean(axis=0)))
