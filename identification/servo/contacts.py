r"""Stretches in which something held a joint: it stands though its servo exceeds all friction.

Where a joint stands, dry friction holds the rest of its servo's torque and that of the bodies,

.. math:: |\mathrm{sat}(k_p\,\mathrm{dz}(q_c + o - q)) - \tau_{bodies}|
    \le f_0 + f_s + \mu |\tau_{bodies}|,

and what is beyond is the torque of something else: a table, an object in a gripper, an end stop.
Friction itself changes with place and time, by up to a factor of two in motions unlike the fitted
ones (an SO-101 with nothing near it: by 1.97). So something held the arm where a joint is beyond
twice its friction; joints that are beyond their friction at that time were held as well. Weaker
contacts cannot be distinguished from friction.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array, root_mean_square, runs_of
from identification.servo.fit import ROBUST
from identification.servo.intervals import reach_of, widened_covariance
from identification.servo.parameters import PLACE, POSITIVE, natural, without_absent
from identification.servo.recorded_motion import ServoMotion
from identification.servo.servo_fit import ServoFit

_OVER: Final = 1.0  # s that a joint stands, longer than any answer to a command takes
_PERIOD: Final = 0.05  # s between rows that are judged
_RESTING: Final = 2.0  # steps of the encoder that a joint at rest may move
_TIMES_FRICTION: Final = 2.0  # that no friction of one joint reaches
_DIFFERENCE: Final = np.where(POSITIVE, 1e-3, 1e-5)  # of the coordinates, for derivatives


class Contact(NamedTuple):
    """A joint that something held.

    Attributes:
        joint: index.
        start, end: from the start of the motion [s].
        torque: of what held it, beyond the friction, in the middle of its rows [N·m or N].
    """

    joint: int
    start: float
    end: float
    torque: float


def contacts_of(motion: ServoMotion, fit: ServoFit, resolution: Array) -> list[Contact]:
    """Return the contacts of a motion, by joint and time.

    Friction is exceeded for a second, in one direction, by more than the 95 % interval of the
    servo's parameters and three times the scatter of the positions that they were fitted to; that
    of one joint is by then exceeded twofold.

    Args:
        motion: as it was measured.
        fit: of the servos.
        resolution: standard deviation of the measured positions (n,).
    """
    every = max(1, round(_PERIOD / motion.step))
    period = every * motion.step
    over = max(1, round(_OVER / period))
    position = motion.position[::every]
    if len(position) <= over:
        return []
    still = _at_rest(position, _RESTING * np.sqrt(12.0) * resolution, over)
    scatter = root_mean_square(fit.estimate.scatter)
    least = ROBUST * np.maximum(scatter, resolution)
    compliance = fit.estimate.values[:, PLACE["kp"]]
    beyond, deviation, friction = _beyond(motion, every, fit)
    surely = [sign * beyond - reach_of(fit) * deviation - least for sign in (1.0, -1.0)]

    def held(excess: Array) -> NDArray[np.bool_]:
        """Return the rows (m, n) of stretches in which joints stand beyond something."""
        marked = np.zeros(excess.shape, np.bool_)
        resting = still & (scipy.ndimage.minimum_filter(excess, (over, 1)) > 0.0)
        for joint in np.flatnonzero(resting.any(axis=0)).tolist():
            for first, end in runs_of(excess[:, joint] > 0.0):
                marked[first:end, joint] = resting[first:end, joint].any()
        return marked

    twofold = [held(excess - (_TIMES_FRICTION - 1.0) * friction) for excess in surely]
    arm = np.any(twofold, axis=(0, 2))
    contacts = []
    for excess in surely:
        rows = held(excess) & arm[:, None]
        for joint in np.flatnonzero(rows.any(axis=0)).tolist():
            for first, end in runs_of(rows[:, joint]):
                torque = float(np.median(beyond[first:end, joint])) / compliance[joint]
                contacts.append(Contact(joint, first * period, (end - 1) * period, -torque))
    return sorted(contacts, key=lambda each: (each.joint, each.start))


def _beyond(motion: ServoMotion, every: int, fit: ServoFit) -> tuple[Array, Array, Array]:
    """Return the unexplained position error of the servo, its deviation, and friction (m, n) each.

    At every `every`-th sample, beyond what motion and static friction, the largest, explain.
    """
    estimate = fit.estimate
    n, count = estimate.coordinates.shape
    shifted = np.repeat(estimate.coordinates[None], 1 + count, axis=0)
    terms = np.arange(count)
    shifted[1 + terms, :, terms] += _DIFFERENCE[:, None]
    values = without_absent(natural(shifted), estimate.present)

    def of(name: str) -> Array:
        return values[:, None, :, PLACE[name]]

    instants = motion.step * np.arange(len(motion.command))
    late = instants[::every, None] - estimate.values[:, PLACE["delay"]]
    command = np.column_stack(
        [np.interp(late[:, joint], instants, motion.command[:, joint]) for joint in range(n)]
    )
    velocity = motion.velocity[::every]
    acceleration = np.gradient(motion.velocity, motion.step, axis=0)
    pace = np.gradient(command, every * motion.step, axis=0)
    error = command - motion.position[::every] + of("offset")
    error = error - np.clip(error, -of("dead_band"), of("dead_band"))
    error = error + of("kd") * (pace - velocity)
    torque = motion.bodies.bias + motion.bodies.inertia * acceleration
    bodies = of("kp") * torque[::every]
    moving = of("armature") * acceleration[::every] + of("viscous") * velocity
    rest = np.clip(error, -of("limit"), of("limit")) - bodies - moving
    friction = of("coulomb") + of("static") + of("load") * np.abs(bodies)
    direction = np.sign(rest[0])
    over = direction * rest - friction
    slopes = (over[1:] - over[0]) / _DIFFERENCE[:, None, None]
    covariance = widened_covariance(fit)
    variance = np.empty_like(over[0])
    for joint in range(n):
        part = slice(joint * count, (joint + 1) * count)
        own = slopes[..., joint]
        variance[:, joint] = np.einsum("pm,pq,qm->m", own, covariance[part, part], own)
    beyond = direction * np.maximum(over[0], 0.0)
    return beyond, np.sqrt(np.maximum(variance, 0.0)), friction[0]


def _at_rest(position: Array, most: Array, over: int) -> NDArray[np.bool_]:
    """Return where each joint moves by `most` (n,) at most in the rows about each (m, n)."""
    size = (over, 1)
    highest = scipy.ndimage.maximum_filter(position, size)
    return np.asarray(highest - scipy.ndimage.minimum_filter(position, size) <= most)
