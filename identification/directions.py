"""Whether a recording would make more sense if one of its axes turned the other way.

A gear ratio with the wrong sign turns an axis' measured position and torque at once. Its own
friction and inertia keep their signs, and only what couples it to the other axes is wrong: too
little to stand out for the first axis of an arm, which is nearly its own mirror image. But the
right hypothesis then fits better than the wrong one, and that can be tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.estimation import estimate, joint_weights, total
from identification.model import RobotModel
from identification.motion import Motion
from identification.preprocessing import Samples
from identification.validation import over_all, prediction_error

Array = NDArray[np.float64]

# A few recordings of each kind decide as well as all.
MOST_RECORDINGS: Final = 3


def turned(samples: Samples, joint: int) -> Samples:
    """Return samples as they would be if one joint counted the other way round."""
    sign = np.ones(samples.torque.shape[1])
    sign[joint] = -1.0
    motion = samples.motion
    return replace(
        samples,
        motion=Motion(motion.time, *(part * sign for part in motion[1:])),
        torque=samples.torque * sign,
    )


def gain_if_turned(
    model: RobotModel,
    training: Sequence[Samples],
    held_out: Sequence[Samples],
    bandwidth: float,
) -> Array:
    """Squared slow error on unseen motion if a joint is turned, over that if it is not (n,).

    The geometric mean over all joints' errors, each fitted anew on the training recordings. Far
    below one: that joint has its direction wrong. One: its direction makes no difference.

    Args:
        model: the robot.
        training: recordings to fit.
        held_out: recordings to predict.
        bandwidth: of a low-pass on the error [Hz].
    """
    training, held_out = training[:MOST_RECORDINGS], held_out[:MOST_RECORDINGS]
    as_is = _squared_error(model, training, held_out, bandwidth)
    ratios = [
        _squared_error(
            model,
            [turned(samples, joint) for samples in training],
            [turned(samples, joint) for samples in held_out],
            bandwidth,
        )
        / as_is
        for joint in range(model.n_joints)
    ]
    return np.asarray(np.exp(np.mean(np.log(ratios), axis=1)))


def _squared_error(
    model: RobotModel, training: Sequence[Samples], held_out: Sequence[Samples], bandwidth: float
) -> Array:
    factor = total([samples.factor(model) for samples in training])
    values = estimate(model, factor, joint_weights(factor)).values
    error = over_all(prediction_error(model, values, held_out, bandwidth=bandwidth))
    # A joint that does not move has no error either way.
    return np.maximum(error.squared, np.finfo(np.float64).tiny)
