"""Whole motions simulated from their commands alone, from the first sample to the last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import scipy

from identification.arrays import Array
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.servo.parameters import in_errors
from identification.servo.recorded_motion import (
    SMOOTHING_SECONDS,
    Bodies,
    ServoMotion,
    side_by_side,
)
from identification.servo.servo_simulation import simulate

_MAX_PASSES: Final = 4
_PASS_TOLERANCE: Final = 1e-4  # rad or m between passes


def predicted(
    model: RobotModel, bodies: Array, motion: ServoMotion, parameters: Sequence[Array]
) -> Array:
    """Return positions (S, g, n) of a motion for S sets of parameters (n, P) in SI units.

    Measured positions are used for the first instant alone. The bodies are computed along the
    commanded motion, and then again along the simulated one until both agree.

    Args:
        model: of the arm.
        bodies: its parameters (p,) without friction and rotors.
        motion: whose commands are followed.
        parameters: sets of them.
    """
    values = np.concatenate([in_errors(each) for each in parameters])[None]
    references = [motion.command for _ in parameters]
    still = True
    positions = np.stack(references)
    for _ in range(_MAX_PASSES):
        inputs = [
            replace(
                motion.along(_along(model, bodies, reference, motion.step, still=still)),
                velocity=np.zeros_like(motion.velocity),
            ).inputs(0, len(motion.position))
            for reference in references
        ]
        simulated = simulate(side_by_side(inputs), values)[:, 0]
        new = np.moveaxis(simulated.reshape(len(simulated), len(references), -1), 1, 0)
        change = float(np.abs(new - positions).max())
        positions = new
        references = list(new)
        still = False
        if change < _PASS_TOLERANCE:
            break
    return positions


def _along(
    model: RobotModel, bodies: Array, reference: Array, step: float, *, still: bool
) -> Bodies:
    """Return the bodies along a reference (g, n), at rest or as it moves."""
    if still:
        return Bodies.every(model, bodies, Motion.at_rest(reference))
    smooth = scipy.ndimage.gaussian_filter1d(
        reference, SMOOTHING_SECONDS / step, axis=0, mode="nearest"
    )
    velocity = np.gradient(smooth, step, axis=0)
    states = Motion.of_states(reference, velocity, np.gradient(velocity, step, axis=0))
    return Bodies.every(model, bodies, states)
