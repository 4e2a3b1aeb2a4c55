r"""Whether intervals of predicted torque hold what is measured on motion that was not fitted.

A half second's mean of the measured torque of joint j differs from its prediction by

.. math:: \bar e = \bar w_j (\pi - \hat\pi) + \bar r, \qquad
          \operatorname{var} \bar e = \bar w_j C \bar w_j^T + s_j^2

with the mean row :math:`\bar w_j` of the regressor, the covariance C of the estimate and the
residual's own mean :math:`\bar r`. White residuals of variance :math:`\sigma^2` would have
:math:`s^2 = \sigma^2 / m` over m rows. Real ones are coloured and hold the errors of the model, so
that their means hardly shrink. Here s is the root mean square of :math:`\bar e` where the fitted
part is predicted by inner folds: each stretch of time from parameters of the others
(:mod:`identification.selection.inner_prediction`). It is computed about zero, because the
prediction is without bias only as far as the model is right; and it holds the uncertainty of the
folds' parameters, so that intervals are rather too wide than too narrow where the fitted part is
short.

Rows count at rest and at reversals too, but not where motion or torque are not known: beside gaps
and ends, and saturated. Nothing held out is read to make an interval.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.distributions import normal_limit, student_limit
from identification.errors import IdentificationError
from identification.factor.factor import Estimate, Factor, augmented_rows
from identification.factor.phases import (
    FINE_BLOCK,
    PhaseFactor,
    block_runs,
    merged,
    samples_by_cell,
)
from identification.model.robot import RobotModel
from identification.selection.inner_prediction import FOLDS
from identification.signals.masks import SATURATED, TORN
from identification.signals.samples import Samples
from identification.validation.residuals import BLOCK, FEWEST_BLOCKS, block_index

Array = NDArray[np.float64]

Refit = Callable[[Factor], Array]
"""An estimator: a factor to parameters (p,)."""


@dataclass(frozen=True, eq=False)
class TorqueMeans:
    """Means of [W | y] over B blocks of time of `BLOCK` seconds, rows at rest included.

    Attributes:
        rows: per joint j over its columns and, last, the torque (B, c_j + 1); NaN where less than
            half of the block is known of the joint.
        columns: per joint the parameter index of each of its columns (c_j,).
        block: place of each block since the origin of its motion (B,).
        count: samples that were averaged (B, n).
    """

    rows: tuple[Array, ...]
    columns: tuple[NDArray[np.intp], ...]
    block: NDArray[np.intp]
    count: NDArray[np.intp]

    @classmethod
    def of(cls, model: RobotModel, recordings: Iterable[Samples]) -> TorqueMeans:
        """Blocks of recordings one after the other."""
        parts = [_means(model, samples) for samples in recordings if len(samples.torque)]
        columns = model.plan.columns
        empty = cls(
            tuple(np.zeros((0, len(own) + 1)) for own in columns),
            columns,
            np.zeros(0, dtype=np.intp),
            np.zeros((0, model.n_joints), dtype=np.intp),
        )
        every = [empty, *parts]
        return cls(
            tuple(np.concatenate(own) for own in zip(*(one.rows for one in every), strict=True)),
            columns,
            np.concatenate([one.block for one in every]),
            np.concatenate([one.count for one in every]),
        )

    def errors(self, values: Array) -> Array:
        """Mean torque measured less predicted by parameters (p,), (B, n) [N·m or N]."""
        return np.column_stack(
            [
                own @ np.append(-values[used], 1.0)
                for own, used in zip(self.rows, self.columns, strict=True)
            ]
        )

    def variance(self, covariance: Array) -> Array:
        """What a covariance of the parameters (p, p) does to the predicted means (B, n)."""
        return np.column_stack(
            [
                np.einsum("bi,ik,bk->b", own[:, :-1], covariance[np.ix_(used, used)], own[:, :-1])
                for own, used in zip(self.rows, self.columns, strict=True)
            ]
        )


@dataclass(frozen=True, eq=False)
class Calibration:
    """Held-out means of torque and their 95 % intervals, per joint (n,).

    NaN stands for a joint without any, and for one whose intervals are not known: it moved in one
    stretch of time only.

    Attributes:
        blocks: held-out means that were compared with their interval.
        inside: share of them that lie inside.
        half_width: median of half the interval [N·m or N].
        spread: s, root mean square of the means' errors in inner folds [N·m or N].
        white_inside: share inside the intervals that white residuals would have.
    """

    blocks: NDArray[np.intp]
    inside: Array
    half_width: Array
    spread: Array
    white_inside: Array

    @property
    def overall(self) -> float:
        """Share inside of all joints; NaN where no interval is known."""
        return _pooled(self.inside, self.blocks)

    @property
    def white_overall(self) -> float:
        """Share inside with white residuals, of the same means."""
        return _pooled(self.white_inside, self.blocks)


def calibrate(
    estimate: Estimate,
    phase: PhaseFactor,
    fitted: TorqueMeans,
    held_out: TorqueMeans,
    refit: Refit,
) -> Calibration:
    """Compare held-out means of torque with their 95 % intervals.

    A parameter that the data do not determine adds nothing to an interval.

    Args:
        estimate: what predicts.
        phase: the rows that were fitted.
        fitted: means of the fitted recordings.
        held_out: of those that are predicted.
        refit: the estimator.

    Raises:
        IdentificationError: there are fewer than `FEWEST_BLOCKS` blocks of the fitted motion, or
            a fold cannot be fitted.
    """
    inner = inner_errors(phase, fitted, refit)
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(np.nansum(inner**2, axis=0) / np.count_nonzero(~np.isnan(inner), axis=0))
    # Repetitions of one motion share their blocks: an error that repeats is no new error.
    limit = float(student_limit(0.025, len(np.unique(fitted.block))))
    known = np.where(np.isfinite(estimate.covariance), estimate.covariance, 0.0)
    errors = np.abs(held_out.errors(estimate.values))
    by_parameters = estimate.interval_factor**2 * held_out.variance(known)
    half = np.sqrt(by_parameters + (limit * spread) ** 2)
    white = estimate.noise_std**2 / np.maximum(held_out.count, 1)
    white_half = np.sqrt(by_parameters + normal_limit(0.025) ** 2 * white)
    judged = ~np.isnan(errors) & np.isfinite(spread)
    blocks = np.count_nonzero(judged, axis=0)

    def share(limits: Array) -> Array:
        inside = np.count_nonzero(judged & (errors <= limits), axis=0)
        return np.where(blocks > 0, inside / np.maximum(blocks, 1), np.nan)

    return Calibration(
        blocks=blocks,
        inside=share(half),
        half_width=np.array(
            [
                np.median(own[counts]) if counts.any() else np.nan
                for own, counts in zip(half.T, judged.T, strict=True)
            ]
        ),
        spread=spread,
        white_inside=share(white_half),
    )


def inner_errors(phase: PhaseFactor, means: TorqueMeans, refit: Refit) -> Array:
    """Errors of mean torques (B, n), each stretch of time predicted from the others.

    Stretches have equally many rows, and are cut at equal times of all recordings. NaN where the
    mean is not known, infinite where the other stretches have no row of the joint.

    Args:
        phase: the rows that are fitted.
        means: of the same recordings.
        refit: the estimator.

    Raises:
        IdentificationError: there are fewer than `FEWEST_BLOCKS` blocks, or a fold cannot be
            fitted.
    """
    fine = round(BLOCK / FINE_BLOCK)
    rows = merged(phase.samples, fine).sum(axis=1)
    if np.count_nonzero(rows) < FEWEST_BLOCKS:
        raise IdentificationError(
            f"the fitted motion is too short to be predicted in parts: {BLOCK * len(rows):g} s"
        )
    before = np.cumsum(rows) - 0.5 * rows
    # Blocks at rest behind the last row belong to the last stretch.
    fold = np.minimum(np.floor(FOLDS * before / rows.sum()).astype(np.intp), FOLDS - 1)
    found = np.full((len(means.block), phase.n_joints), np.nan)
    for k in range(FOLDS):
        others = phase.blocks(np.repeat(fold != k, fine)[: len(phase)]).total
        inside = fold[means.block] == k
        errors = means.errors(refit(others))[inside]
        errors[:, others.samples == 0] = np.inf
        found[inside] = errors
    return found


def _means(model: RobotModel, samples: Samples) -> TorqueMeans:
    """Blocks of one recording, which has rows."""
    known = np.ones(samples.torque.shape, dtype=np.bool_)
    if samples.mask is not None:
        for reason in (TORN, SATURATED):
            known &= ~samples.mask.reasons[reason]
    index = block_index(samples)
    present = np.unique(index)
    count = samples_by_cell(index, known)[present]
    sums = [np.zeros((int(index[-1]) + 1, len(own) + 1)) for own in model.plan.columns]
    for part, chunk in augmented_rows(model, replace(samples, usable=known)):
        for block, at in block_runs(index[part]):
            for total, own in zip(sums, chunk, strict=True):
                total[block] += own[:, at].sum(axis=1)
    divisor = np.where(count > 0.5 * np.bincount(index).max(), count, np.nan)
    rows = tuple(total[present] / divisor[:, j, None] for j, total in enumerate(sums))
    return TorqueMeans(rows, model.plan.columns, present, count)


def _pooled(shares: Array, blocks: NDArray[np.intp]) -> float:
    total = int(blocks.sum())
    return float(np.nansum(shares * blocks) / total) if total else float("nan")
