r"""Difference of unseen from fitted motion, joint by joint: gain of the torque, or friction.

On each part the measured torque of a joint is compared with its prediction,

.. math:: \tau = (1 + g)\,\hat\tau + e \qquad \text{or} \qquad \tau = \hat\tau + h\,\hat\tau_f + e

with the predicted torque and its friction part. A joint has changed if one of the two factors
brings its error on unseen motion down to what is usual: the error of the fitted motion, and that of
parameters which the fitted motion leaves uncertain.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import SIGNIFICANT_SIGMAS
from identification.factor.estimate import Estimate
from identification.factor.factor import Factor
from identification.hypotheses.explanation import Explanation
from identification.model.robot import RobotModel
from identification.signals.block_mean import BLOCK_SECONDS, BlockMean, block_mean
from identification.signals.samples import Samples

ChangeKind = Literal["gain", "friction"]

_KINDS: Final[tuple[ChangeKind, ...]] = ("gain", "friction")
# Smallest change that is named; a torque constant drifts by some per cent with the temperature of
# its magnets.
_MIN_CHANGE: Final = 0.03
# Error on unseen motion over the usual one of a joint that may have changed: half of its square
# again, so that there is an additional error to explain. A change that other axes contradict is an
# error of the fit as well, and grows it by little.
_MIN_ERROR_GROWTH: Final = 1.25
# Error that remains with the change, of a joint that is then predicted as well as usual: twice that
# of the fitted motion, or that of published fits.
_MAX_REMAINING_ERROR: Final = (2.0, 0.1)
# Share of the additional squared error that the change has to explain: twice what is left. Planted
# changes: at least 0.72, of a friction that is a twentieth of the torque; another motion that the
# fitted one does not cover: below 0.6.
_MIN_EXPLAINED_SHARE: Final = 2.0 / 3.0
# Ratio of remaining errors up to which the two kinds are alike, as for a joint that has little more
# than friction: friction varies, a gain is set once. More where neither leaves more than is usual.
_ALIKE_ERROR_RATIO: Final = 1.1
# Share of a torque constant's logarithm that a ratio exceeds where the constant changed: nearer to
# all of it than to none.
_MIN_CONSTANT_SHARE: Final = 0.5


class UnseenChange(NamedTuple):
    """Ratio of a joint's torque or friction on unseen motion to the fitted one."""

    kind: ChangeKind
    joint: int
    ratio: float  # unseen over fitted
    std: float  # standard deviation over blocks of time, and by the uncertainty of the parameters
    relative: float  # remaining relative error of the joint on unseen motion
    alike: bool = False  # whether the other kind explains it as well


def beyond_constants(
    changes: Sequence[UnseenChange], explanations: Sequence[Explanation]
) -> tuple[UnseenChange, ...]:
    """Return the changes without gains that a torque constant of the fitted motion explains.

    Where a constant is wrong in all motions, the parameters are between its value and that of the
    other joints, and another motion has an error of a part of it. Where it is wrong in the fitted
    motion only, the ratio is all of it.

    Args:
        changes: of unseen motion.
        explanations: of the errors of the fit.
    """
    constants = {
        joint: abs(np.log1p(found.size))
        for found in explanations
        if found.change.is_constant and found.size is not None and found.size > -1.0
        for joint in found.change.joints
    }
    return tuple(
        change
        for change in changes
        if change.kind != "gain"
        or abs(np.log(change.ratio)) > _MIN_CONSTANT_SHARE * constants.get(change.joint, 0.0)
    )


class _Part(NamedTuple):
    """Sums over one part of the motions, joint by joint (n,)."""

    torque: Array  # of squared measured torque
    error: Array  # of squared error
    shares: tuple[BlockMean, BlockMean]  # g and h
    explained: Array  # squared error that each of them explains (2, n)

    @property
    def relative(self) -> Array:
        """Error over torque (n,), zero without torque."""
        return _relative(self.error, self.torque)

    @classmethod
    def of(cls, model: RobotModel, values: Array, recordings: Sequence[Samples]) -> _Part:
        """Compare measured with predicted torque in the usable rows of recordings."""
        torque, error = np.zeros((2, model.n_joints))
        sums: tuple[list[Array], list[Array]] = ([], [])
        for samples in recordings:
            usable = samples.usable
            block = samples.blocks(BLOCK_SECONDS)
            predicted = samples.predicted_torque(model, values)
            left = np.where(usable, samples.torque - predicted, 0.0)
            torque += np.einsum("mj,mj,mj->j", samples.torque, samples.torque, usable)
            error += np.einsum("mj,mj->j", left, left)
            columns = predicted, samples.predicted_torque(model, values, model.friction_columns)
            for table, column in zip(sums, columns, strict=True):
                column = np.where(usable, column, 0.0)
                table.append(
                    np.array([_by_block(block, column, factor) for factor in (left, column)])
                )
        products = np.array([sum(part.sum(axis=1) for part in table) for table in sums])
        power = np.where(products[:, 1] > 0.0, products[:, 1], np.inf)
        gain, friction = (block_mean(table) for table in sums)
        return cls(torque, error, (gain, friction), products[:, 0] ** 2 / power)


class _Doubt(NamedTuple):
    """What the uncertainty of the parameters alone makes of unseen motion (n,)."""

    relative: Array  # error over torque
    shares: tuple[Array, Array]  # standard deviations of g and h

    @classmethod
    def of(cls, model: RobotModel, estimate: Estimate, unseen: Factor) -> _Doubt:
        """Propagate the covariance; an undetermined parameter has none."""
        determined = np.isfinite(np.diag(estimate.covariance))
        covariance = np.where(np.outer(determined, determined), estimate.covariance, 0.0)
        gram = unseen.gram
        regressor = gram[:, :-1, :-1]
        squares = np.einsum("ik,jki->j", covariance, regressor)
        values = estimate.values
        parts = values, np.where(model.friction_columns, values, 0.0)
        shares = []
        for part in parts:
            mixed = regressor @ part
            power = mixed @ part
            spread = np.sqrt(np.maximum(np.einsum("ji,ik,jk->j", mixed, covariance, mixed), 0.0))
            shares.append(spread / np.where(power > 0.0, power, np.inf))
        return cls(_relative(squares, gram[:, -1, -1]), (shares[0], shares[1]))


def find_changes(
    model: RobotModel,
    estimate: Estimate,
    training: Sequence[Samples],
    held_out: Sequence[Samples],
    held_out_factor: Factor,
    moved: NDArray[np.bool_],
) -> tuple[UnseenChange, ...]:
    """Compare unseen with fitted motion under an estimate; return the joints that changed.

    Args:
        model: of the arm.
        estimate: from the training.
        training: recordings that were fitted.
        held_out: recordings of unseen motion.
        held_out_factor: of their usable rows.
        moved: joints that the fitted motion has moved (n,); others have no torque or friction that
            could have changed.
    """
    values = estimate.values
    fitted, unseen = (_Part.of(model, values, runs) for runs in (training, held_out))
    doubt = _Doubt.of(model, estimate, held_out_factor)
    usual = np.maximum(np.hypot(fitted.relative, doubt.relative), 1e-9)
    changes = []
    for joint in np.flatnonzero(moved & (unseen.relative > _MIN_ERROR_GROWTH * usual)).tolist():
        beyond = unseen.relative[joint] ** 2 - usual[joint] ** 2
        trials = []
        for k, kind in enumerate(_KINDS):
            unseen_share = unseen.shares[k]
            reference = fitted.shares[k]
            base = 1.0 + float(np.nan_to_num(reference.mean[joint]))
            share = float(unseen_share.mean[joint])
            std = float(np.hypot(unseen_share.std[joint], doubt.shares[k][joint]))
            if not np.isfinite(share) or base <= 0.0:
                continue
            ratio = (1.0 + share) / base
            deviation = std / base
            error = unseen.error[joint] - unseen.explained[k, joint]
            left = float(_relative(error, unseen.torque[joint]))
            explains = unseen.relative[joint] ** 2 - left**2 > _MIN_EXPLAINED_SHARE * beyond
            # A factor near zero removes a prediction that is wrong, and explains nothing.
            explains &= left < max(_MAX_REMAINING_ERROR[0] * usual[joint], _MAX_REMAINING_ERROR[1])
            size = abs(ratio - 1.0)
            # A factor below zero is no change of one quantity.
            if ratio > 0.0 and explains and size > max(_MIN_CHANGE, SIGNIFICANT_SIGMAS * deviation):
                trials.append(UnseenChange(kind, joint, ratio, deviation, left))
        if trials:
            least = min(trial.relative for trial in trials)
            most = max(
                _ALIKE_ERROR_RATIO * least, min(_MIN_ERROR_GROWTH * least, float(usual[joint]))
            )
            alike = [trial for trial in trials if trial.relative <= most]
            changes.append(alike[-1]._replace(alike=len(alike) > 1))
    return tuple(changes)


def _by_block(block: NDArray[np.intp], first: Array, second: Array) -> Array:
    """Sum products of two tables (m, n) by block (B, n)."""
    joints = zip(first.T, second.T, strict=True)
    return np.column_stack([np.bincount(block, column * other) for column, other in joints])


def _relative(squares: Array, torque: Array) -> Array:
    """Return the root of squares over squared torque, zero without torque."""
    loaded = torque > 0.0
    share = np.where(loaded, np.maximum(squares, 0.0) / np.where(loaded, torque, 1.0), 0.0)
    return np.asarray(np.sqrt(share))
