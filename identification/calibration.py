r"""Whether intervals of predicted torque hold what is measured on motion that was not fitted.

A half second's mean of the measured torque of joint j differs from its prediction by

.. math:: \bar e = \bar w_j (\pi - \hat\pi) + \bar r, \qquad
          \operatorname{var} \bar e = \bar w_j C \bar w_j^T + s_j^2

with the mean row :math:`\bar w_j` of the regressor, the covariance C of the estimate and the
residual's own mean :math:`\bar r`. White residuals of variance :math:`\sigma^2` would have
:math:`s^2 = \sigma^2 / m` over m rows. Real ones are coloured and hold the errors of the model, so
that their means hardly shrink. Here s is the root mean square of :math:`\bar e` where the fitted
part is predicted by inner folds: each stretch of time from parameters of the others
(:mod:`identification.inner_prediction`). It is taken about zero, because the prediction is without
bias only as far as the model is right; and it holds the uncertainty of the folds' parameters, so
that intervals are rather too wide than too narrow where the fitted part is short.

Every row counts, at rest and at reversals too. Nothing held out is read to make an interval.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.augmented_rows import augmented_rows
from identification.errors import IdentificationError
from identification.estimation import Estimate
from identification.factor import Factor
from identification.inner_prediction import FOLDS
from identification.model import RobotModel
from identification.phase_factor import FINE_BLOCK, PhaseFactor, block_runs, merged
from identification.preprocessing import Samples
from identification.quantiles import normal_limit, student_limit
from identification.residual_blocks import BLOCK, FEWEST_BLOCKS, block_index

Array = NDArray[np.float64]

Refit = Callable[[Factor], Array]
"""An estimator: a factor to parameters (p,)."""


@dataclass(frozen=True, eq=False)
class TorqueMeans:
    """Means of [W | y] over B blocks of time of `BLOCK` seconds, every row of them.

    Attributes:
        rows: per joint j over its columns and, last, the torque (B, c_j + 1).
        columns: per joint the parameter index of each of its columns (c_j,).
        block: place of each block since the origin of its motion (B,).
        count: time samples (B,).
    """

    rows: tuple[Array, ...]
    columns: tuple[NDArray[np.intp], ...]
    block: NDArray[np.intp]
    count: NDArray[np.intp]

    @classmethod
    def of(cls, model: RobotModel, recordings: Iterable[Samples]) -> TorqueMeans:
        """Blocks of recordings one after the other; without those less than half full."""
        columns = model.plan.columns
        rows: list[list[Array]] = [[np.zeros((0, len(own) + 1))] for own in columns]
        blocks, counts = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
        for samples in recordings:
            index = block_index(samples)
            count = np.bincount(index).astype(np.intp)
            full = np.flatnonzero(count > 0.5 * count.max(initial=0))
            sums = [np.zeros((len(count), len(own) + 1)) for own in columns]
            whole = replace(samples, usable=samples.usable | True)
            for part, chunk in augmented_rows(model, whole):
                for block, at in block_runs(index[part]):
                    for total, own in zip(sums, chunk, strict=True):
                        total[block] += own[:, at].sum(axis=1)
            for all_of_joint, total in zip(rows, sums, strict=True):
                all_of_joint.append(total[full] / count[full, None])
            blocks.append(full)
            counts.append(count[full])
        return cls(
            tuple(np.concatenate(own) for own in rows),
            columns,
            np.concatenate(blocks),
            np.concatenate(counts),
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

    NaN stands for a joint whose intervals are not known: it moved in one stretch of time only.

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
    spread = np.sqrt(np.mean(inner_errors(phase, fitted, refit) ** 2, axis=0))
    # Repetitions of one motion share their blocks: an error that repeats is no new error.
    limit = float(student_limit(0.025, len(np.unique(fitted.block))))
    known = np.where(np.isfinite(estimate.covariance), estimate.covariance, 0.0)
    errors = np.abs(held_out.errors(estimate.values))
    by_parameters = estimate.interval_factor**2 * held_out.variance(known)
    half = np.sqrt(by_parameters + (limit * spread) ** 2)
    white = estimate.noise_std**2 / held_out.count[:, None]
    white_half = np.sqrt(by_parameters + normal_limit(0.025) ** 2 * white)
    judged = np.isfinite(spread) & (len(errors) > 0)

    def share(limits: Array) -> Array:
        return np.where(judged, (errors <= limits).sum(axis=0) / max(1, len(errors)), np.nan)

    return Calibration(
        blocks=np.where(judged, len(errors), 0).astype(np.intp),
        inside=share(half),
        half_width=np.median(half, axis=0) if len(half) else np.full(len(spread), np.nan),
        spread=spread,
        white_inside=share(white_half),
    )


def inner_errors(phase: PhaseFactor, means: TorqueMeans, refit: Refit) -> Array:
    """Errors of mean torques (B, n), each stretch of time predicted from the others.

    Stretches have equally many rows, and are cut at equal times of all recordings. NaN where the
    other stretches have no row of the joint.

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
    fold = np.floor(FOLDS * (np.cumsum(rows) - 0.5 * rows) / rows.sum()).astype(np.intp)
    found = np.full((len(means.block), phase.n_joints), np.nan)
    for k in range(FOLDS):
        others = phase.blocks(np.repeat(fold != k, fine)[: len(phase)]).total
        inside = fold[means.block] == k
        errors = means.errors(refit(others))[inside]
        found[inside] = np.where(others.samples > 0, errors, np.nan)
    return found


def _pooled(shares: Array, blocks: NDArray[np.intp]) -> float:
    total = int(blocks.sum())
    return float(np.nansum(shares * blocks) / total) if total else float("nan")
