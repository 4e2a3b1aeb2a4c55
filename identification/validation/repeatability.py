"""What of a residual repeats when a motion is repeated, and what does not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.validation.prediction import residual

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Repeatability:
    """Residual of R repetitions of one motion, split in two.

    Attributes:
        noise: standard deviation between repetitions at equal times (n,) [N·m or N]: no model
            can predict it. NaN for a joint that never moves twice at the same time.
        systematic: root mean square of what all repetitions have in common (n,) [N·m or N]: what
            the model gets wrong. Zero where noise can explain it.
        repetitions: R.
    """

    noise: Array
    systematic: Array
    repetitions: int


def repeatability(
    model: RobotModel,
    values: Array,
    recordings: Iterable[Samples],
    bandwidth: float | None = None,
) -> Repeatability:
    """Split the residual of repetitions of one motion; samples are read once, one at a time.

    Times are compared to the nearest sampling interval since each recording's origin; on a
    controller's clock that is exact.

    Args:
        model: the robot.
        values: parameters (p,).
        recordings: two repetitions or more.
        bandwidth: of a low-pass on the residual [Hz]; None for none.

    Raises:
        IdentificationError: fewer than two repetitions, or no row that two of them share.
    """
    moments = _Moments(model.n_joints)
    step = 0.0
    for samples in recordings:
        if step == 0.0:
            step = float(np.median(np.diff(samples.motion.time)))
        index = np.rint((samples.motion.time - samples.origin) / step).astype(np.int64)
        usable = samples.usable & (index >= 0)[:, None]
        moments.add(index, usable, residual(model, values, samples, bandwidth))
    return moments.split()


class _Moments:
    """Mean and spread over repetitions at each time and joint (Welford's updates)."""

    def __init__(self, n_joints: int) -> None:
        self.count = np.zeros((0, n_joints))
        self.mean = np.zeros((0, n_joints))
        self.spread = np.zeros((0, n_joints))
        self.repetitions = 0

    def add(self, index: NDArray[np.int64], usable: NDArray[np.bool_], values: Array) -> None:
        missing = max(0, int(index[-1]) + 1 - len(self.count))
        for name in ("count", "mean", "spread"):
            setattr(self, name, np.pad(getattr(self, name), ((0, missing), (0, 0))))
        rows, joints = np.nonzero(usable)
        at = index[rows], joints
        self.count[at] += 1.0
        change = values[rows, joints] - self.mean[at]
        self.mean[at] += change / self.count[at]
        self.spread[at] += change * (values[rows, joints] - self.mean[at])
        self.repetitions += 1

    def split(self) -> Repeatability:
        shared = self.count >= 2.0
        rows = np.count_nonzero(shared, axis=0)
        if self.repetitions < 2 or not rows.any():
            raise IdentificationError(
                "what repeats cannot be distinguished from noise: it takes two repetitions in which"
                f" joints move at the same times, here are {self.repetitions} with"
                f" {rows.tolist()} common rows per joint"
            )
        freedom = np.where(shared, self.count - 1.0, 0.0).sum(axis=0)
        freedom[rows == 0], rows = np.nan, np.where(rows == 0, np.nan, rows)
        noise = np.where(shared, self.spread, 0.0).sum(axis=0) / freedom
        # The mean over repetitions still holds its share of the noise.
        common = self.mean**2 - noise / np.maximum(self.count, 1.0)
        systematic = np.where(shared, common, 0.0).sum(axis=0) / rows
        return Repeatability(
            noise=np.sqrt(noise),
            systematic=np.sqrt(np.maximum(systematic, 0.0)),
            repetitions=self.repetitions,
        )
