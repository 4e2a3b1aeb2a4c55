"""Samples that lie far outside of everything else: spikes in a log, collisions, torn packets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.validation import PredictionError

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

# Median absolute deviations, as standard deviations of a normal distribution: beyond six lies one
# sample of 500 million.
BEYOND: Final = 6.0
_NORMAL: Final = 1.4826


@dataclass(frozen=True, eq=False)
class Outliers:
    """Samples of which the residual is beyond `BEYOND` robust deviations of its joint.

    Attributes:
        share: of the usable samples of each joint (n,).
        power: their share of the squared residual (n,).
        without: prediction error of all other samples.
    """

    share: Array
    power: Array
    without: PredictionError


def find_outliers(runs: Sequence[tuple[Array, Array, Rows]]) -> Outliers:
    """Look for outliers over several recordings together.

    Args:
        runs: of each recording measured torque (m, n), residual (m, n) and which rows count.
    """
    torque, residual = (np.concatenate([run[k] for run in runs]) for k in (0, 1))
    usable = np.concatenate([run[2] for run in runs])
    far = np.zeros_like(usable)
    for joint in range(residual.shape[1]):
        rows = usable[:, joint]
        if rows.any():
            distance = np.abs(residual[:, joint] - np.median(residual[rows, joint]))
            limit = BEYOND * _NORMAL * float(np.median(distance[rows]))
            far[:, joint] = rows & (distance > max(limit, np.finfo(np.float64).tiny))
    squares = np.where(usable, residual, 0.0) ** 2
    total = squares.sum(axis=0)
    return Outliers(
        share=np.count_nonzero(far, axis=0) / np.maximum(np.count_nonzero(usable, axis=0), 1),
        power=np.where(far, squares, 0.0).sum(axis=0) / np.where(total > 0.0, total, 1.0),
        without=PredictionError.between(torque, torque - residual, usable & ~far),
    )
