"""Errors of blocks that are predicted from the others, with columns of changes and without."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import SIGNIFICANT_SIGMAS
from identification.factor.blocks import FOLDS
from identification.factor.normal_equations import solve_with_ridge
from identification.hypotheses.error_ratios import (
    ErrorRatios,
    error_ratio,
    geometric_mean,
    mean_and_error,
)
from identification.hypotheses.joint_changes import Change
from identification.hypotheses.torque_columns import (
    ColumnSums,
    folded,
)
from identification.model.link_wrenches import MASS_INDEX

# Ratio of the fit's error on the affected joints, with the correction over that without: 0.55 is
# 70 % of the squared error. True faults of simulated and real arms, without noise known: at most
# 0.5, a payload in half of a recording 0.66; false ones: at least 0.9.
_EXPLAINED_ERROR_RATIO: Final = 0.55
_LONE_JOINT_ERROR_RATIO: Final = 0.7  # the same, if the joint then is as good as the others
_SAME_PART_ERROR_RATIO: Final = 0.85  # the same, if separate parameters for the part do no better
# noise floors; a floor of coloured noise is estimated a third too low
_NEAR_NOISE_FLOORS: Final = 2.0
_MIN_POWER_SHARE: Final = 1e-20  # squared torque of an axis that counts, as a share of the largest
SEPARATE_ERROR_RATIO: Final = 1.1
"""Error ratio to separate parameters up to which a change explains a part as well."""
_MIN_ROWS: Final = 10
MIN_BLOCKS: Final = 2
# Ridge as a share of each column's information, for columns that the motion hardly determines.
_RIDGE: Final = 1e-6
ALIKE_ERROR_RATIO: Final = 1.05
"""Ratio of errors up to which two changes explain as much."""


class ColumnScore(NamedTuple):
    """Squared errors of predicted blocks, and parameters and added coefficients by fold."""

    squares: Array  # (B, n)
    fitted: Array  # squared errors of the fit to all blocks (n,)
    torque: Array  # squared torque (n,)
    values: Array
    added: Array

    def shares(self, squares: Array) -> Array:
        """Return squared errors (n,) as shares of the squared torque, zero without torque."""
        loaded = self.torque > _MIN_POWER_SHARE * self.torque.max(initial=0.0)
        return np.where(loaded, squares / np.where(loaded, self.torque, 1.0), 0.0)

    def explains(
        self, joints: Sequence[int], usual: ColumnScore, noise: Array, separate: ColumnScore | None
    ) -> bool:
        """Return whether the error of the fit on some joints is explained.

        Args:
            joints: that count; all if none.
            usual: fit without this correction.
            noise: sums of squared noise (n,).
            separate: fit with separate parameters for the part, if any.
        """
        before = usual.shares(usual.fitted)
        after = self.shares(self.fitted)
        every = np.flatnonzero(before > 0.0)
        affected = np.array(joints, dtype=np.intp) if len(joints) else every
        affected = affected[np.isin(affected, every)]
        if not affected.size:
            return False
        if self.is_near_noise(noise, affected):
            return True
        ratio = geometric_mean(np.sqrt(after[affected] / before[affected]))
        if ratio <= _EXPLAINED_ERROR_RATIO:
            return True
        others = np.setdiff1d(every, affected)
        if others.size and ratio <= _LONE_JOINT_ERROR_RATIO:
            level = float(np.median(after[others]))
            if np.all(after[affected] <= level) and np.all(before[affected] > level):
                return True
        if separate is None or ratio > _SAME_PART_ERROR_RATIO:
            return False
        least = separate.squares.sum(axis=0)[affected]
        mine = self.squares.sum(axis=0)[affected]
        positive = (least > 0.0) & (mine > 0.0)
        return bool(positive.any()) and geometric_mean(
            np.sqrt(mine[positive] / least[positive])
        ) <= (SEPARATE_ERROR_RATIO)

    def is_near_noise(self, noise: Array, joints: NDArray[np.intp] | None = None) -> bool:
        """Return whether the errors of a fit are little above its sums of squared noise (n,).

        The errors of some `joints`, by default of all that have torque.
        """
        loaded = self.shares(self.fitted) > 0.0
        near = (self.fitted <= _NEAR_NOISE_FLOORS**2 * noise) | ~loaded
        return bool(np.all(near if joints is None else near[joints]))

    def ratio_to(self, other: ColumnScore) -> tuple[float, float]:
        """Return the error ratio, geometric mean over the joints, and its upper limit by blocks."""
        ratios = ErrorRatios.of(self.squares, other.squares)
        if not ratios.tested.any():
            return 1.0, np.inf
        ratio = geometric_mean(ratios.joints[ratios.some_joints])
        some = ratios.some_blocks
        counts = np.count_nonzero(ratios.tested[some], axis=1)
        mean, error = mean_and_error(ratios.changes[some].sum(axis=1) / counts)
        return ratio, float(np.exp(mean + SIGNIFICANT_SIGMAS * error))


def fit_ratio(fitted: Array, other: Array) -> float:
    """Return the ratio of the errors of two fits by their squares (n,), a mean over the joints."""
    positive = (fitted > 0.0) & (other > 0.0)
    return geometric_mean(error_ratio(fitted, other)[positive])


def separate_errors(tables: ColumnSums, target: Array, part: Array) -> Array:
    """Return the squared errors (n,) of a fit with separate parameters in some of the blocks.

    The errors of `column_score` with the parameters as added columns, without predicted blocks.

    Args:
        tables: of the blocks.
        target: of each joint (n, q).
        part: 1 for the blocks with parameters of their own, 0 for the others (B,).
    """
    count = tables.n_parameters + 1
    ends = tables.gram @ target[:, :, None]
    torque = np.swapaxes(ends, 2, 3) @ target[:, :, None]
    total = np.zeros((2, len(target), count, count))
    for blocks, side in zip((part, 1.0 - part), total, strict=True):
        side[:, :-1, :-1] = np.tensordot(blocks, tables.of_parameters, 1)
        side[:, :-1, -1] = np.tensordot(blocks, ends[..., : count - 1, 0], 1)
        side[:, -1, :-1] = side[:, :-1, -1]
        side[:, -1, -1] = np.tensordot(blocks, torque[..., 0, 0], 1)
    floor = 1e-12 * total[:, :, -1, -1].sum(axis=0) + np.finfo(np.float64).tiny

    def errors(weights: Array) -> Array:
        squares = np.zeros(len(target))
        for side in total:
            values = np.append(-_solved(np.tensordot(weights, side, 1)), 1.0)
            squares += (side @ values) @ values
        return np.asarray(np.maximum(squares, floor))

    usual = errors(np.ones(len(target)))
    return errors(np.maximum(tables.rows.sum(axis=0), 1) / usual)


def column_score(tables: ColumnSums, added: Array, target: Array) -> ColumnScore:
    """Predict every fifth block from the others.

    Columns and target are combinations of the columns of the tables.

    Args:
        tables: of the blocks.
        added: columns of further parameters (B, n, q, r).
        target: of each joint (n, q).
    """
    blocks, n = tables.rows.shape
    p = tables.n_parameters
    column = np.broadcast_to(target[:, :, None], (blocks, n, target.shape[1], 1))
    wide = np.concatenate([added, column], axis=3)
    moved = tables.gram @ wide
    sums = _Sums(tables.of_parameters, moved[..., :p, :], np.swapaxes(wide, 2, 3) @ moved)
    folds = _Sums(tables.by_fold, folded(sums.mixed), folded(sums.beside))
    whole = _Sums(*(part.sum(axis=0) for part in folds))
    # Weighted by the inverse variances of an ordinary fit, limited by rounding.
    torque = whole.beside[:, -1, -1]
    floor = 1e-12 * torque + np.finfo(np.float64).tiny
    usual = np.maximum(whole.squares(_solved(whole.weighted(np.ones(n)))), floor)
    weights = np.maximum(tables.rows.sum(axis=0), 1) / usual
    total = whole.weighted(weights)
    of_folds = total - folds.weighted(weights)
    squares = np.zeros((blocks, n))
    coefficients = []
    for k in range(FOLDS):
        fold_blocks = slice(k, None, FOLDS)
        values = _solved(of_folds[k])
        coefficients.append(values)
        squares[fold_blocks] = _Sums(*(part[fold_blocks] for part in sums)).squares(values)
    squares = np.where(tables.rows >= _MIN_ROWS, np.maximum(squares, floor / blocks), 0.0)
    fitted = np.maximum(whole.squares(_solved(total)), floor)
    fold_values = np.array(coefficients)
    return ColumnScore(squares, fitted, torque, fold_values[:, :p], fold_values[:, p:])


class _Sums(NamedTuple):
    """Sums of products of p parameters, r added columns and the torque, for each joint."""

    parameters: Array  # (..., n, p, p)
    mixed: Array  # parameters times the others (..., n, p, r + 1)
    beside: Array  # the others, torque last (..., n, r + 1, r + 1)

    def weighted(self, weights: Array) -> Array:
        """Return the sum (..., p + r + 1, p + r + 1) over the joints with weights (n,)."""
        p, count = self.mixed.shape[-2:]
        total = np.empty((*self.mixed.shape[:-3], p + count, p + count))
        parameters, mixed, beside = (
            (weights @ part.reshape(*part.shape[:-2], -1)).reshape(
                *part.shape[:-3], *part.shape[-2:]
            )
            for part in self
        )
        total[..., :p, :p] = parameters
        total[..., :p, p:] = mixed
        total[..., p:, :p] = np.swapaxes(mixed, -1, -2)
        total[..., p:, p:] = beside
        return total

    def squares(self, values: Array) -> Array:
        """Return the sum of squared errors (..., n) of coefficients (p + r,)."""
        p = self.parameters.shape[-1]
        first = values[:p]
        second = np.append(-values[p:], 1.0)
        of_parameters = (self.parameters @ first - 2.0 * (self.mixed @ second)) @ first
        return np.asarray(of_parameters + (self.beside @ second) @ second)


def _solved(gram: Array) -> Array:
    """Solve a Gram matrix of [W | y] (k + 1, k + 1) for (k,), slightly regularised."""
    return solve_with_ridge(gram[:-1, :-1], gram[:-1, -1], _RIDGE)


def rough_size(
    change: Change, score: ColumnScore, tables: ColumnSums
) -> tuple[float | None, float]:
    """Return about the size of a change that adds a torque, and its jackknife deviation.

    None of others; :mod:`~identification.hypotheses.sizes` has the size to be stated.
    """
    if change.meaning not in ("delay", "drift", "payload", "load friction"):
        return None, 0.0
    sizes = score.added[:, MASS_INDEX if change.meaning == "payload" else 0]
    if change.meaning == "load friction":
        loaded = np.median(score.added[:, : tables.gram.shape[1]], axis=1)
        return float(loaded.mean()), float(np.sqrt((FOLDS - 1) * loaded.var()))
    return float(sizes.mean()), float(np.sqrt((FOLDS - 1) * sizes.var()))
