"""What a motion that was not run yet will leave uncertain, by the contributions of an interval.

`hil identify` counts the same (`hil.pipeline.estimating`): the error of the torque, an uncertain
delay, and elastic gears, each by the function that counts it of recordings. The scale of the
torques, which only absolute intervals have, is added by :mod:`hil.precision.forecast`. Only
recordings show that a friction law lacks a term, or that friction drifts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np

from hil.base.arrays import Array
from hil.cell import Cell
from hil.pipeline.prepared import stated_delay, with_stated_delay
from identification.distributions import student_limit
from identification.estimators.covariance import MIN_FINE_BLOCKS
from identification.estimators.delay import DelayEstimate, UndeterminedDelay, predicted_rate
from identification.estimators.elasticity import (
    KnownGears,
    elastic_torque,
    expected_compliance,
    expected_square,
    open_compliance,
)
from identification.factor.blocks import FINE_BLOCK
from identification.model.motion import Motion
from identification.signals.samples import Preprocessing, Samples

_MIN_BLOCKS: Final = 2


class Variances(NamedTuple):
    """Variances of k quantities, by contribution."""

    rows: Array  #: of the torque's error, with prior and earlier recordings (k,)
    delay: Array  #: of the torque's uncertain delay (k,)
    gears: Array  #: of elastic gears (k,)

    @property
    def total(self) -> Array:
        """Their sum (k,)."""
        return np.asarray(self.rows + self.delay + self.gears)


@dataclass(frozen=True, eq=False)
class PredictedRows:
    """Sums over a motion of an arm with parameters (p,): of regressor, rate and elastic torque."""

    cell: Cell
    grams: Array  #: integrals of the products of the columns of each joint (n, q, q), q = p + 1 + n
    duration: float  #: of the motion [s]
    gears: KnownGears
    rigid: bool  #: whether the gears are known to be rigid, as on a simulated arm

    @classmethod
    def of(
        cls,
        cell: Cell,
        motion: Motion,
        values: Array,
        *,
        gears: KnownGears | None = None,
        rigid: bool,
    ) -> Self:
        """Return the sums over a sampled motion.

        Args:
            cell: of the arm.
            motion: sampled.
            values: parameters (p,).
            gears: what recordings have shown of them, if any.
            rigid: whether the gears are known to be rigid.
        """
        model = cell.model
        n = model.n_joints
        torque = model.torque(values, motion)
        samples = Samples(
            motion=motion,
            torque=torque,
            usable=np.asarray(model.moving(motion.velocity)),
            segments=(slice(0, len(motion.time)),),
            origin=0.0,
            position_bandwidth=np.full(n, Preprocessing().rigid_bandwidth),
        ).with_friction_direction(model)
        rate = predicted_rate(samples, torque)
        elastic = np.zeros((*torque.shape, n))
        if gears is None:
            gears = KnownGears.unknown(expected_compliance(model, samples, values))
        if cell.file.drive_train is not None:
            elastic = elastic_torque(model, samples, values, gears.size)
        p = model.n_parameters
        step = float(motion.time[1] - motion.time[0])
        grams = np.zeros((n, p + 1 + n, p + 1 + n))
        for joint, (block, used) in enumerate(zip(*samples.regressor(model), strict=True)):
            table = np.zeros((len(torque), p + 1 + n))
            table[:, used] = block
            table[:, p] = rate[:, joint]
            table[:, p + 1 :] = elastic[:, joint]
            some = table[samples.usable[:, joint]]
            grams[joint] = step * some.T @ some
        return cls(cell, grams, step * len(torque), gears, rigid)

    def variances(
        self, directions: Array, prior: Array, density: Array, motions: float = 1.0
    ) -> Variances:
        """Return the variances of functions (k, p) after a number of such motions.

        Args:
            directions: linear functions of the parameters (k, p).
            prior: information of prior and earlier recordings (p, p).
            density: of the torque error of each joint at low frequencies (n,) [(N m)² s].
            motions: number of different motions of this kind.
        """
        p = directions.shape[1]
        total = motions * np.tensordot(1.0 / density, self.grams, axes=1)
        information = prior + total[:p, :p]
        scale = 1.0 / np.sqrt(np.diag(information))
        inverse = np.linalg.inv(information * scale[:, None] * scale) * scale[:, None] * scale
        rows = np.einsum("kp,pq,kq->k", directions, inverse, directions)
        moved = inverse @ total[:p, p]
        variance = float(total[p, p] - total[:p, p] @ moved)
        delay = self._delay_variance(1.0 / np.sqrt(variance) if variance > 0.0 else np.inf)
        before = self.gears.covariance
        moved_by_gears, covariance = open_compliance(
            inverse, total[:p, p + 1 :], total[p + 1 :, p + 1 :], known=before
        )
        gears = directions @ moved_by_gears
        # Estimates of rigid gears scatter by noise; others come nearer to what the gears have.
        change = covariance - covariance @ covariance if self.rigid else before - covariance
        scatter = np.sqrt(np.maximum(np.diag(change), 0.0))
        square = expected_square(covariance, self.gears.mean, scatter)
        return Variances(
            rows,
            delay * (directions @ moved) ** 2,
            np.einsum("kn,nm,km->k", gears, square, gears),
        )

    def interval_factor(self, motions: float = 1.0) -> float:
        """Return the standard deviations in half a 95 % interval, by the blocks of time."""
        count = motions * self.duration / (MIN_FINE_BLOCKS * FINE_BLOCK)
        return float(student_limit(0.025, max(_MIN_BLOCKS, count) - 1.0))

    def _delay_variance(self, std: float) -> float:
        """Return the variance of the delay [s²], estimated with a standard deviation [s]."""
        stated = stated_delay(self.cell)
        cycle = self.cell.period if self.cell.file.controller is not None else 0.0
        estimate = DelayEstimate(
            delay=stated,
            std=std,
            assumed=stated,
            cycle=cycle,
            interval_factor=self.interval_factor(),
            reason=None if np.isfinite(std) else UndeterminedDelay.INSEPARABLE,
            significant=False,
        )
        if self.cell.file.controller is None:
            return estimate.variance
        return with_stated_delay(estimate, stated).variance
