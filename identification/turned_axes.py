"""Whether turning an axis of a recording round makes it fit better, beyond chance.

A gear ratio with the wrong sign turns an axis' measured position and torque at once. Its own
friction and inertia keep their signs, and only what couples it to the other axes is wrong: too
little to stand out for the first axis of an arm, which is nearly its own mirror image. But the
right hypothesis then fits better than the wrong one, and that can be tried.

A single ratio of errors can fall below
any threshold on a weak motion; here it is taken block by block of time, which gives it a standard
error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.estimation import estimate, joint_weights, total
from identification.model import RobotModel
from identification.motion import Motion
from identification.preprocessing import Samples
from identification.residual_blocks import block_index
from identification.validation import residual

Array = NDArray[np.float64]

# A few recordings of each kind decide as well as all.
MOST_RECORDINGS: Final = 3
# Standard errors that make a difference between two hypotheses one.
SIGMAS: Final = 3.0
# Blocks of time that a comparison needs, and samples of a joint that a block needs.
_FEWEST_BLOCKS: Final = 6
_FEWEST_ROWS: Final = 10


def turned(samples: Samples, joint: int) -> Samples:
    """Return samples as they would be if one joint counted the other way round."""
    sign = np.ones(samples.torque.shape[1])
    sign[joint] = -1.0
    motion = samples.motion
    return replace(
        samples,
        motion=Motion(motion.time, *(part * sign for part in motion[1:4])),
        torque=samples.torque * sign,
    )


@dataclass(frozen=True, eq=False)
class Turned:
    """Error on unseen motion if an axis counted the other way, over that as it is.

    Attributes:
        ratio: squared slow error, turned over as it is, per axis turned (n,); the geometric mean
            over blocks of time and over the joints whose torque tells the two apart. One where
            none does.
        highest: the same, `SIGMAS` standard errors up (n,): below one, the axis is better turned
            beyond chance.
    """

    ratio: Array
    highest: Array

    @property
    def lowest(self) -> Array:
        """The ratio as many standard errors down (n,): above one, the axis is right as it is."""
        return np.asarray(self.ratio**2 / self.highest)


def compare_turned(
    model: RobotModel,
    training: Sequence[Samples],
    held_out: Sequence[Samples],
    bandwidth: float,
) -> Turned:
    """Fit and predict with each axis turned in its place.

    Errors are compared block by block of time, joint by joint. A joint whose torque is predicted
    alike under both, within the scatter over the blocks, has nothing to say: on a weak motion, or
    on an arm that is its own mirror image, that may be all of them.

    Args:
        model: the robot.
        training: recordings to fit.
        held_out: recordings to predict.
        bandwidth: of a low-pass on the error [Hz].
    """
    training, held_out = training[:MOST_RECORDINGS], held_out[:MOST_RECORDINGS]
    as_is = _block_errors(model, training, held_out, bandwidth)
    ratio, highest = np.ones((2, model.n_joints))
    for joint in range(model.n_joints):
        other = _block_errors(
            model,
            [turned(samples, joint) for samples in training],
            [turned(samples, joint) for samples in held_out],
            bandwidth,
        )
        ratio[joint], highest[joint] = _mean_ratio(as_is, other)
    return Turned(ratio, highest)


def _mean_ratio(as_is: Array, other: Array) -> tuple[float, float]:
    """Geometric mean of other over as_is (B, n each), and that with its standard errors on top."""
    change = np.log(other) - np.log(as_is)
    blocks = np.count_nonzero(np.isfinite(change), axis=0)
    means, errors = [], []
    for column in change[:, blocks >= _FEWEST_BLOCKS].T:
        known = column[np.isfinite(column)]
        mean, error = (
            float(known.mean()),
            float(known.std(ddof=1) / np.sqrt(len(known))),
        )
        if abs(mean) > SIGMAS * error:
            means.append(mean)
            errors.append(error)
    if not means:
        return 1.0, np.inf
    # Joints share their moves, and so their luck: their errors are not averaged down.
    mean, error = float(np.mean(means)), float(np.mean(errors))
    return float(np.exp(mean)), float(np.exp(mean + SIGMAS * error))


def _block_errors(
    model: RobotModel,
    training: Sequence[Samples],
    held_out: Sequence[Samples],
    bandwidth: float,
) -> Array:
    """Mean squared slow error of each block of unseen motion (B, n), NaN with too few rows."""
    factor = total([samples.factor(model) for samples in training])
    values = estimate(model, factor, joint_weights(factor)).values
    found = []
    for samples in held_out:
        squared = residual(model, values, samples, bandwidth) ** 2
        block = block_index(samples)
        edges = np.searchsorted(block, np.arange(int(block[-1]) + 1))
        rows = np.add.reduceat(samples.usable.astype(np.float64), edges, axis=0)
        sums = np.add.reduceat(np.where(samples.usable, squared, 0.0), edges, axis=0)
        # What an exact model leaves over is rounding, and its logarithm would be chance.
        floor = 1e-12 * np.mean(samples.torque**2, axis=0) + np.finfo(np.float64).tiny
        known = rows >= _FEWEST_ROWS
        found.append(np.where(known, np.maximum(sums / np.maximum(rows, 1.0), floor), np.nan))
    return np.concatenate(found)
