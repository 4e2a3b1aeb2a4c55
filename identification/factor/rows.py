"""Rows [W | y] of a recording, in chunks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.model.motion import joint_arrays
from identification.model.regressor import SAMPLES_PER_CHUNK
from identification.model.robot import RobotModel
from identification.signals.samples import Samples


class FactorRows(NamedTuple):
    """Rows of k consecutive samples, joint by joint."""

    part: slice  # of the recording
    # per joint j its columns and, last, its torque (c_j + 1, k), zero for unusable rows; valid
    # until the next chunk
    blocks: list[Array]


def augmented_rows(model: RobotModel, samples: Samples) -> Iterator[FactorRows]:
    """Yield [W | y] of a recording in chunks, zero for unusable rows.

    ``model.plan.columns[j]`` are the parameters of the columns of joint j.

    Raises:
        ShapeError: wrong shape of an array.
    """
    _, torque = joint_arrays(
        model.n_joints, position=samples.motion.position, torque=samples.torque
    )
    chunks: Iterable[tuple[slice, list[Array]]]
    if samples.torque_bandwidth is None:
        chunks = model.chunks(samples.motion, response=torque)
    else:
        chunks = _filtered(model, samples)
    for part, blocks in chunks:
        for block, lost in zip(blocks, ~samples.usable[part].T, strict=True):
            if lost.any():
                # Unusable rows may be NaN.
                block[:, np.flatnonzero(lost)] = 0.0
        yield FactorRows(part, blocks)


def _filtered(model: RobotModel, samples: Samples) -> Iterator[tuple[slice, list[Array]]]:
    blocks, _ = samples.regressor(model)
    tables = [
        np.concatenate([block.T, torque[None]])
        for block, torque in zip(blocks, samples.torque.T, strict=True)
    ]
    for start in range(0, len(samples.torque), SAMPLES_PER_CHUNK):
        part = slice(start, min(start + SAMPLES_PER_CHUNK, len(samples.torque)))
        yield part, [table[:, part] for table in tables]
