"""Springs of joints: torques of a joint's own angle, a rival of what is concluded from gravity.

A spring, a balancer or a cable adds a torque to one joint that repeats with that joint's angle, as
the weight of its body nearly does: as if its zero, the scale of its torque or the weight of the arm
were other than stated. Cosine and sine of the angle are free, so that a spring carries any weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.hypotheses.scores import Score, score_of
from identification.model.elements import ElementError, PositionTorque
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.recording import MIN_MOVEMENT
from identification.signals.samples import Samples

_ORDER: Final = 1  # periods per turn, as of a weight
_SPREAD: Final = 3.0  # standard deviation of a coefficient, of torque and weight of its joint


def may_have_springs(model: RobotModel, samples: Samples) -> tuple[int, ...]:
    """Return the joints whose motion shows a spring: those that turn, and move."""
    moves = np.ptp(samples.motion.position, axis=0) > MIN_MOVEMENT
    return tuple(np.flatnonzero(moves & np.array(model.chain.revolute, dtype=np.bool_)).tolist())


def score_with_springs(
    model: RobotModel,
    samples: Samples,
    joints: Sequence[int],
    columns: NDArray[np.intp] | None = None,
) -> Score | None:
    """Return the score of samples of an arm with springs; None where they are weights of bodies.

    Args:
        model: of the arm.
        samples: of the recording, as read.
        joints: that have one.
        columns: as for :func:`~identification.hypotheses.scores.score_of`.
    """
    names = model.joint_names
    elements = [PositionTorque(names[joint], orders=(_ORDER,)) for joint in joints]
    try:
        sprung = model.with_elements(elements)
    except ElementError:
        return None
    spread = _SPREAD * _largest(model, samples)
    stated = {
        name: (0.0, float(spread[placed.joint]))
        for placed in sprung.elements.placed[len(model.elements.placed) :]
        for name in sprung.elements.names[placed.part]
    }
    return score_of(sprung, samples, columns, stated=stated)


def _largest(model: RobotModel, samples: Samples) -> Array:
    """Return the largest torque of each joint, measured or of the described weight (n,)."""
    weight = model.torque(model.nominal_values, Motion.at_rest(samples.motion.position))
    torque = np.where(samples.usable, samples.torque, 0.0)
    return np.asarray(np.abs(torque).max(axis=0) + np.abs(weight).max(axis=0))
