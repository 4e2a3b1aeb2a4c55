r"""Error of the flange in a short simulation, from the error of the acceleration :math:`M^{-1} e`.

An arm that the recorded torque drives departs from its measured motion by x, with

.. math:: M(q)\,\ddot x = e - (F_v + D)\,\dot x - K x,

the residual e, viscous friction and a light feedback D, K, as `hil rollout` has it: a linear
equation along the measured motion, so that no simulator is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.model.flange import flange_motion
from identification.model.friction import VISCOUS
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.rollout.windows import (
    STEP_SECONDS,
    WINDOW_STRIDE,
    Windows,
    stretches_of,
    windows_of,
)
from identification.signals.samples import Samples
from identification.validation.prediction import driving_residual

HORIZON_SECONDS: Final = 0.2
"""Time of a simulation [s]."""
FEEDBACK_BANDWIDTH: Final = 1.0
"""Natural frequency of the feedback that keeps the arm near its motion [Hz]."""
_MAX_SIMULATIONS: Final = 200  # simulations
_STEPS_PER_INERTIA: Final = 8  # steps of one inertia


def flange_error(model: RobotModel, values: Array, recordings: Sequence[Samples]) -> float | None:
    """Return the root mean square distance of the flange from its measured path [m].

    After `HORIZON_SECONDS`, of an arm with parameters (p,); None of too little unseen motion.

    Raises:
        IdentificationError: no bodies have the inertia of the arm.
    """
    stretches = []
    errors = []
    for samples in recordings:
        error = driving_residual(model, samples, values)
        parts = stretches_of(samples, np.zeros_like(samples.torque), STEP_SECONDS)
        stretches += parts
        errors += [stretch.mean_about_instants(error[stretch.part]) for stretch in parts]
    try:
        windows = windows_of(stretches, STEP_SECONDS, HORIZON_SECONDS, WINDOW_STRIDE).some(
            _MAX_SIMULATIONS
        )
    except IdentificationError:
        return None
    departure = departures(model, values, windows, windows.cut(errors))
    jacobian = flange_motion(model.chain, windows.reached[:, -1]).jacobian
    distance = np.einsum("wij,wj->wi", jacobian, departure)
    return float(np.sqrt(np.mean(np.sum(distance**2, axis=1))))


def departures(model: RobotModel, values: Array, windows: Windows, error: Array) -> Array:
    """Return how far joints depart from their motion (w, n) [rad or m] by torque errors.

    Args:
        model: of the arm.
        values: parameters (p,).
        windows: of the motion.
        error: of the torque (w, K, n) [N·m or N].

    Raises:
        IdentificationError: no bodies have the inertia of the arm.
    """
    count, steps, n = error.shape
    # The inertia of an arm hardly changes in so many steps; of many joints it takes long.
    postures = windows.position[:, ::_STEPS_PER_INERTIA]
    inertia = moved_inertia(model, values, postures.reshape(-1, n))
    if np.linalg.eigvalsh(inertia).min() <= 0.0:
        raise IdentificationError("the inertia of the arm is not positive")
    inertia = inertia.reshape(count, -1, n, n)
    alone = np.diagonal(moved_inertia(model, values, np.zeros((1, n)))[0])
    rate = 2.0 * np.pi * FEEDBACK_BANDWIDTH
    stiffness = rate**2 * alone
    damping = 2.0 * rate * alone + viscous_friction(model, values)
    position, velocity = np.zeros((2, count, n))
    for step in range(steps):
        # Damping acts on the velocity after the step: a light joint of much friction stays stable.
        at = inertia[:, step // _STEPS_PER_INERTIA]
        matrix = at + windows.step * np.diag(damping)
        momentum = np.einsum("wij,wj->wi", at, velocity)
        impulse = windows.step * (error[:, step] - stiffness * position)
        velocity = np.linalg.solve(matrix, (momentum + impulse)[..., None])[..., 0]
        position = position + windows.step * velocity
    return position


def moved_inertia(model: RobotModel, values: Array, postures: Array) -> Array:
    """Return the inertia of joints (m, n, n) at postures (m, n), a known payload included."""
    inertia = model.joint_inertia(values, postures)
    if model.payload is None:
        return inertia
    rest = Motion.at_rest(postures)
    weight = model.load_torque(rest)
    columns = [
        model.load_torque(replace(rest, acceleration=rest.acceleration + unit)) - weight
        for unit in np.eye(model.n_joints)
    ]
    return inertia + np.stack(columns, axis=-1)


def viscous_friction(model: RobotModel, values: Array) -> Array:
    """Return the viscous friction of each joint (n,) [N·m·s/rad or N·s/m], at least zero."""
    rows = model.friction.table(values[model.friction_part])[: model.n_joints]
    return np.maximum([row.get(VISCOUS.symbol, 0.0) for row in rows], 0.0)
