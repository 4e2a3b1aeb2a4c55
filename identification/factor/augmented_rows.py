"""The rows [W | y] of a recording, chunk by chunk, for whatever has to see the samples again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.model.regressor import CHUNK, joint_arrays
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]


class Rows(NamedTuple):
    """Rows of k consecutive samples, joint by joint.

    Attributes:
        part: which samples of the recording these are.
        blocks: per joint j the columns of its row and, last, its torque (c_j + 1, k). Columns of
            samples that do not count are zero. Valid until the next chunk is asked for.
    """

    part: slice
    blocks: list[Array]


def augmented_rows(model: RobotModel, samples: Samples) -> Iterator[Rows]:
    """Yield [W | y] of a recording in chunks, with zeros for what is not usable.

    ``model.plan.columns[j]`` says which parameters the columns of joint j belong to. Where the
    torque has come through a low-pass the columns have too, and then the regressor of the whole
    recording is made at once: a filter without phase needs what comes later.

    Raises:
        ShapeError: an array does not have the shape the model asks for.
    """
    q, qd, qdd, torque = joint_arrays(
        model.n_joints,
        position=samples.motion.position,
        velocity=samples.motion.velocity,
        acceleration=samples.motion.acceleration,
        torque=samples.torque,
    )
    if samples.usable.shape != q.shape:
        raise ShapeError("usable", samples.usable.shape, str(q.shape))
    chunks: Iterable[tuple[slice, list[Array]]]
    if samples.torque_bandwidth is None:
        chunks = model.plan.chunks(q, qd, qdd, samples.motion.direction, response=torque)
    else:
        chunks = _filtered(model, samples)
    return masked_rows(chunks, samples.usable)


def masked_rows(
    chunks: Iterable[tuple[slice, list[Array]]], usable: NDArray[np.bool_]
) -> Iterator[Rows]:
    """Yield rows in chunks, with zeros, in place, for what is not usable (m, n)."""
    for part, blocks in chunks:
        for block, lost in zip(blocks, ~usable[part].T, strict=True):
            if lost.any():
                # Assigned, not multiplied: a row left out may hold NaN.
                block[:, np.flatnonzero(lost)] = 0.0
        yield Rows(part, blocks)


def _filtered(model: RobotModel, samples: Samples) -> Iterator[Rows]:
    blocks, _ = samples.regressor(model)
    for start in range(0, len(samples.torque), CHUNK):
        part = slice(start, min(start + CHUNK, len(samples.torque)))
        yield Rows(
            part,
            [
                np.concatenate([block[part].T, samples.torque[None, part, joint]])
                for joint, block in enumerate(blocks)
            ],
        )
