r"""Coverage of intervals of predicted torque on held-out motion.

The mean torque of joint j over half a second differs from its prediction with variance :math:`\bar
w_j C \bar w_j^T + s_j^2`: mean row of the regressor, covariance C of the estimate, and mean square
s² of the same error between inner folds of the fitted part
(:mod:`identification.selection.questions`), which includes coloured residuals and model
errors. Rows at rest and at reversals are included.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import normal_limit, student_limit
from identification.errors import IdentificationError
from identification.factor.blocks import block_slices, count_by_block, merged
from identification.factor.estimate import Estimate
from identification.factor.factor import Factor
from identification.factor.rows import augmented_rows
from identification.model.robot import RobotModel
from identification.selection.folds import FOLDS
from identification.signals.block_mean import BLOCK_SECONDS, MIN_BLOCKS
from identification.signals.masks import RowReason
from identification.signals.samples import Samples

Refit = Callable[[Factor], Array]
"""Estimator: factor to parameters (p,)."""


@dataclass(frozen=True, eq=False)
class TorqueMeans:
    """Means of [W | y] over B blocks of `BLOCK_SECONDS` seconds, rows at rest included."""

    rows: Array  # (B, n, p + 1), torque last; NaN where less than half of the block is known
    block: NDArray[np.intp]  # index since the origin of the motion (B,)
    count: NDArray[np.intp]  # averaged samples (B, n)

    @classmethod
    def of(cls, model: RobotModel, recordings: Iterable[Samples]) -> TorqueMeans:
        """Average recordings in blocks, one after the other."""
        n = model.n_joints
        p = model.n_parameters
        empty = (
            np.zeros((0, n, p + 1)),
            np.zeros(0, dtype=np.intp),
            np.zeros((0, n), dtype=np.intp),
        )
        parts = [_means(model, samples) for samples in recordings if len(samples.torque)]
        return cls(*map(np.concatenate, zip(empty, *parts, strict=True)))

    def errors(self, values: Array) -> Array:
        """Return measured minus predicted mean torque of parameters (p,), (B, n) [N·m or N]."""
        return np.asarray(self.rows @ np.append(-values, 1.0))

    def variance(self, covariance: Array) -> Array:
        """Return the variance of predicted means (B, n) by a covariance of parameters (p, p)."""
        rows = self.rows[:, :, :-1]
        return np.asarray(((rows @ covariance) * rows).sum(axis=2))


@dataclass(frozen=True, eq=False)
class Calibration:
    """Coverage of 95 % intervals by held-out mean torques, per joint (n,); NaN without one."""

    joint_means: NDArray[np.intp]  #: number of held-out means
    joint_inside: Array  #: share inside the interval
    half_width: Array  #: median of half the interval [N·m or N]
    joint_white_inside: Array  #: share inside the intervals of white residuals
    block: float = BLOCK_SECONDS  #: time of a mean [s]

    @property
    def means(self) -> int:
        """Number of held-out means of all joints."""
        return int(self.joint_means.sum())

    @property
    def inside(self) -> float:
        """Share inside over all joints; NaN without intervals."""
        return self._pooled(self.joint_inside)

    @property
    def white_inside(self) -> float:
        """Share inside with white residuals."""
        return self._pooled(self.joint_white_inside)

    def _pooled(self, shares: Array) -> float:
        means = self.means
        return float(np.nansum(shares * self.joint_means) / means) if means else float("nan")


def calibrate(
    estimate: Estimate, factor: Factor, fitted: TorqueMeans, held_out: TorqueMeans, refit: Refit
) -> Calibration:
    """Compare held-out mean torques with their 95 % intervals.

    Undetermined parameters are ignored.

    Args:
        estimate: whose intervals are tested.
        factor: that it is from.
        fitted: mean torques of the fitted motion.
        held_out: mean torques of unseen motion.
        refit: of a part of the factor.

    Raises:
        IdentificationError: fewer than `MIN_BLOCKS` blocks, or a fold cannot be fitted.
    """
    inner = inner_errors(factor, fitted, refit)
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(np.nansum(inner**2, axis=0) / np.count_nonzero(~np.isnan(inner), axis=0))
    # Repetitions share blocks: repeated errors are not independent.
    limit = float(student_limit(0.025, len(np.unique(fitted.block))))
    covariance = np.where(np.isfinite(estimate.covariance), estimate.covariance, 0.0)
    errors = np.abs(held_out.errors(estimate.values))
    by_parameters = estimate.interval_factor**2 * held_out.variance(covariance)
    half = np.sqrt(by_parameters + (limit * spread) ** 2)
    white = estimate.noise_std**2 / np.maximum(held_out.count, 1)
    white_half = np.sqrt(by_parameters + normal_limit(0.025) ** 2 * white)
    judged = ~np.isnan(errors) & np.isfinite(spread)
    blocks = np.count_nonzero(judged, axis=0)
    inside, white_inside = (
        np.where(
            blocks > 0,
            np.count_nonzero(judged & (errors <= limits), axis=0) / np.maximum(blocks, 1),
            np.nan,
        )
        for limits in (half, white_half)
    )
    widths = [joint_widths[rows] for joint_widths, rows in zip(half.T, judged.T, strict=True)]
    half_width = np.array(
        [np.median(joint_widths) if joint_widths.size else np.nan for joint_widths in widths]
    )
    return Calibration(blocks, inside, half_width, white_inside)


def inner_errors(factor: Factor, means: TorqueMeans, refit: Refit) -> Array:
    """Return errors of mean torques (B, n), each fold predicted from the others.

    Folds have equally many rows and are cut at equal times of all recordings. NaN where a mean is
    unknown, infinite where the other folds have no row of the joint.
    """
    fine = round(BLOCK_SECONDS / factor.block)
    rows = merged(factor.counts, fine).sum(axis=1)
    if np.count_nonzero(rows) < MIN_BLOCKS:
        raise IdentificationError(
            f"the fitted motion of {BLOCK_SECONDS * len(rows):g} s is too short for inner"
            " prediction"
        )
    before = np.cumsum(rows) - 0.5 * rows
    # Blocks at rest after the last row belong to the last fold.
    fold = np.minimum(np.floor(FOLDS * before / rows.sum()).astype(np.intp), FOLDS - 1)
    fold_errors = np.full((len(means.block), factor.n_joints), np.nan)
    for k in range(FOLDS):
        others = factor.without(np.repeat(fold == k, fine)[: len(factor)])
        inside = fold[means.block] == k
        errors = means.errors(refit(others))[inside]
        errors[:, others.samples == 0] = np.inf
        fold_errors[inside] = errors
    return fold_errors


def _means(model: RobotModel, samples: Samples) -> tuple[Array, NDArray[np.intp], NDArray[np.intp]]:
    """Return the fields of :class:`TorqueMeans` of one recording with rows."""
    usable = np.ones(samples.torque.shape, dtype=np.bool_)
    if samples.mask is not None:
        for reason in (RowReason.EDGE, RowReason.SATURATED, RowReason.UNMEASURED):
            usable &= ~samples.mask.reasons[reason]
    index = samples.blocks(BLOCK_SECONDS)
    p = model.n_parameters
    present = np.unique(index)
    count = count_by_block(index, usable)[present]
    places = [np.append(joint_columns, p) for joint_columns in model.plan.columns]
    sums = np.zeros((int(index[-1]) + 1, model.n_joints, p + 1))
    for rows, chunk in augmented_rows(model, replace(samples, usable=usable)):
        for block, at in block_slices(index[rows]):
            for joint, joint_rows in enumerate(chunk):
                sums[block, joint, places[joint]] += joint_rows[:, at].sum(axis=1)
    divisor = np.where(count > 0.5 * np.bincount(index).max(), count, np.nan)
    return sums[present] / divisor[:, :, None], present, count
