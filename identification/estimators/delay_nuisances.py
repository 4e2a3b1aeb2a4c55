r"""Columns that resemble a delay of the torque, and are estimated together with it.

A delay adds :math:`-d\,\dot\tau` to the torque. So do, in part, the error of a torque's scale, that
of an encoder's zero, friction that changes in time, and friction that the model's law does not
have. Each of these is linear with a size that is known beforehand within a standard deviation, by
which its column is multiplied, so that all coefficients have unit variance. What they explain as
well as a delay remains uncertain, in its interval; what they explain better is no delay.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimators.prior import LOAD_FRICTION_STD
from identification.estimators.torque_scale import TORQUE_CONSTANT_STD
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

JOINT_ZERO_STD: Final = 0.03
"""Standard deviation of the error of an encoder's zero [rad, m]: marks that are aligned by eye, or
a mechanical stop, are good to a degree or two."""
FRICTION_DRIFT_STD: Final = 0.2
"""Relative standard deviation of friction over the recording, of its slowest change: friction of
gears falls by some tens of per cent while they warm (Bittencourt and Gunnarsson 2012)."""
STATIC_FRICTION_STD: Final = 0.5
"""Standard deviation of static friction beyond that in motion, over the RMS of friction."""
QUADRATIC_FRICTION_STD: Final = 0.3
"""Likewise of a quadratic term at the largest speed."""
_DRIFT_HALF_PERIODS: Final = 4  # half periods in the recording, of changing friction
# Speeds [rad/s or m/s] at which static friction has fallen to a third: Stribeck speeds of gears are
# 0.01 to 0.2 rad/s.
_STATIC_SPEEDS: Final = (0.03, 0.1, 0.3)
_DERIVATIVE_STEP: Final = 1e-4  # rad or m, of a numerical derivative
_TINY: Final = np.finfo(np.float64).tiny


@dataclass(frozen=True, eq=False)
class Nuisances:
    """Columns of each joint (m, r_j), and their places among all r coefficients."""

    columns: tuple[Array, ...]
    places: tuple[NDArray[np.intp], ...]
    names: tuple[str, ...]  # of the r coefficients


def nuisances(model: RobotModel, samples: Samples, values: Array) -> Nuisances:
    """Return columns that resemble a delay, for an arm with parameters near these (p,)."""
    n = model.n_joints
    # Of torques before a low-pass, which all columns pass at the end.
    samples_before = replace(samples, torque_bandwidth=None, parent=None)
    torque = samples_before.predicted_torque(model, values)
    zeros = _of_zeros(model, samples_before, values, torque)
    torque = torque + samples_before.known_torque(model)
    friction = samples_before.predicted_torque(model, values, model.friction_columns)
    load = None if model.friction.has_load else model.gear_torque(values, samples.motion)
    columns = []
    places = []
    names = [f"zero {name}" for name in model.joint_names]
    for joint, name in enumerate(model.joint_names):
        own = {"scale": TORQUE_CONSTANT_STD * torque[:, joint]}
        transmitted = None if load is None else load[:, joint]
        own |= dict(_of_friction(samples.motion, joint, friction[:, joint], transmitted))
        table = np.column_stack([JOINT_ZERO_STD * zeros[:, :, joint].T, *own.values()])
        columns.append(samples.as_measured(joint, table))
        places.append(np.concatenate([np.arange(n), len(names) + np.arange(len(own))]))
        names += [f"{what} {name}" for what in own]
    return Nuisances(tuple(columns), tuple(places), tuple(names))


def _of_zeros(model: RobotModel, samples: Samples, values: Array, torque: Array) -> Array:
    """Return the derivatives of the torques (m, n) by the position of each joint (n, m, n)."""
    motion = samples.motion
    derivatives = []
    for joint in range(model.n_joints):
        position = motion.position.copy()
        position[:, joint] += _DERIVATIVE_STEP
        moved = replace(samples, motion=replace(motion, position=position))
        derivatives.append((moved.predicted_torque(model, values) - torque) / _DERIVATIVE_STEP)
    return np.array(derivatives)


def _of_friction(
    motion: Motion, joint: int, friction: Array, load: Array | None
) -> Iterator[tuple[str, Array]]:
    """Yield names and columns (m,) of changing and unmodelled friction of a joint.

    By its friction (m,) and, if the law of friction has none, the load of its gears (m,).
    """
    speed = np.abs(motion.velocity[:, joint])
    sign = np.sign(motion.velocity[:, joint])
    rms = float(np.sqrt(np.mean(friction**2)))
    phase = np.pi * (motion.time - motion.time[0]) / max(np.ptp(motion.time), _TINY)
    for k in range(1, _DRIFT_HALF_PERIODS + 1):
        yield f"change {k} of friction", FRICTION_DRIFT_STD / k * np.cos(k * phase) * friction
    for slow in _STATIC_SPEEDS:
        yield (
            f"friction below {slow:g}",
            STATIC_FRICTION_STD * rms * sign * np.exp(-((speed / slow) ** 2)),
        )
    relative = speed / max(float(speed.max(initial=0.0)), _TINY)
    yield "quadratic friction", QUADRATIC_FRICTION_STD * rms * sign * relative**2
    if load is not None:
        yield "friction over load", LOAD_FRICTION_STD * np.abs(load) * sign
