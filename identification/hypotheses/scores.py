"""Errors of a reading on blocks predicted from the others, and a comparison of two readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimators.prior import (
    BODY_STD_SHARE,
    body_lengths,
    body_prior,
    posterior_values,
)
from identification.factor.blocks import FOLDS
from identification.factor.factor import Factor
from identification.hypotheses.error_ratios import (
    ErrorRatios,
    geometric_mean,
    mean_and_error,
)
from identification.hypotheses.little_torque import little_torque
from identification.model.link_wrenches import MASS_INDEX, N_INERTIA
from identification.model.motion import Motion
from identification.model.nominal_masses import mass_fault
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

SURE_SIGMAS: Final = 4.5
"""Standard errors over the blocks of a reading that is sure, whatever the number tried: with 19
degrees of freedom one of 4 000 exceeds it by chance."""
SEPARATE_SIGMAS: Final = 3.0
"""Standard errors by which the second best reading is worse."""
EXPLAINED_ERROR: Final = 0.15
"""Error of the torque above which no reading is sure: the arm does not explain the torque."""
LARGE_REDUCTION: Final = 0.15
"""Relative reduction of the error that chance alone does not make."""
ALIKE_REDUCTION: Final = 0.05
"""Relative reduction of the error between readings that fit alike."""
MIN_REDUCTION: Final = 0.02
"""Relative reduction of the error by a reading that is adopted."""
DRIVING_FRICTION_SIGMAS: Final = 4.0  # standard errors of a friction that drives a joint
_MIN_FRICTION_SHARE: Final = 0.02  # of the torque of a joint
_BLOCKS: Final = 20
# Rows that count as one against the prior. Where other parts are predicted they are seven in all: a
# wrong reading needs bodies that no arm has, which a weak prior would allow. Of few rows, all of
# which are fitted, that would be too few to tell orders of a wrist apart.
ROWS_PER_FACT: Final = 10.0
_ROWS_PER_FACT_LEFT_OUT: Final = 100.0
_POSTURES: Final = 35  # at which the inertia about each axis is evaluated
_SPEED_QUANTILE: Final = 0.9  # quantile of the speed at which friction is judged


@dataclass(frozen=True, eq=False)
class Score:
    """Errors of predicted blocks under one reading.

    Attributes:
        squares: squared errors (B, n).
        torque: squared torque (n,).
        friction: at a usual speed, over its standard error (n,); negative drives the joint.
        share: that friction over the RMS torque (n,).
        columns: of the recorded torque, the one that is read as that of each joint (n,).
    """

    squares: Array
    torque: Array
    friction: Array
    share: Array
    columns: NDArray[np.intp]

    @property
    def relative(self) -> Array:
        """Errors as shares of the torque (n,)."""
        torque = np.where(self.torque > 0.0, self.torque, 1.0)
        return np.asarray(np.sqrt(self.squares.sum(axis=0) / torque))

    @property
    def overall(self) -> float:
        """Error over all joints as a share of the torque."""
        return float(np.sqrt(self.squares.sum() / max(self.torque.sum(), 1e-300)))

    @property
    def driven(self) -> NDArray[np.bool_]:
        """Whether friction would drive each joint (n,)."""
        return (self.friction < -DRIVING_FRICTION_SIGMAS) & (self.share < -_MIN_FRICTION_SHARE)

    @property
    def is_all_driven(self) -> bool:
        """Whether friction would drive every joint with a clear sign, at least two."""
        clear = self.friction[np.abs(self.friction) > DRIVING_FRICTION_SIGMAS]
        return len(clear) > 1 and bool(np.all(clear < 0.0))

    @property
    def joints(self) -> NDArray[np.intp]:
        """The joint that each recorded column of the torque is read as (n,)."""
        return np.argsort(self.columns)

    def of_torque(self, scale: Array) -> Score:
        """Return the errors in units of a torque that is so many times (n,) the one scored."""
        return replace(self, squares=self.squares * scale**2, torque=self.torque * scale**2)


class Comparison(NamedTuple):
    """Errors of one hypothesis over another's: mean over the recorded torques, and each."""

    ratio: float
    sigmas: float  # negative if the first is better
    joints: Array  # (n,) by column of the recorded torque

    @property
    def is_much_better(self) -> bool:
        """Whether the first reduces the error by more than chance ever does."""
        return self.ratio < 1.0 - LARGE_REDUCTION and self.sigmas < -SEPARATE_SIGMAS

    @property
    def is_better(self) -> bool:
        """Whether the first is better, and that is no chance, as the best of many hypotheses."""
        is_certain = self.ratio < 1.0 - MIN_REDUCTION and self.sigmas < -SURE_SIGMAS
        return self.is_much_better or is_certain


def _factor(model: RobotModel, samples: Samples) -> Factor:
    index = np.arange(len(samples.torque)) * _BLOCKS // max(1, len(samples.torque))
    return Factor.of(model, samples, index=index)


def score_of(
    model: RobotModel,
    samples: Samples,
    columns: NDArray[np.intp] | None = None,
    *,
    wide_rotors: bool = False,
    share: float = BODY_STD_SHARE,
    stated: Mapping[str, tuple[float, float]] | None = None,
) -> Score:
    """Predict every fifth of `_BLOCKS` blocks of samples from the others.

    Args:
        model: of the arm.
        samples: of the recording.
        columns: of the recorded torque that the joints are read from, by default in order.
        wide_rotors: as for :func:`~identification.estimators.prior.body_prior`.
        share: likewise, of the bodies.
        stated: likewise, of single parameters.
    """
    columns = np.arange(model.n_joints) if columns is None else columns
    factor = _factor(model, samples)
    prior = body_prior(model, factor, share, stated, wide_rotors=wide_rotors).gaussian
    squares = np.zeros((len(factor), factor.n_joints))
    weights: Array | None = None
    estimates: list[Array] = []
    for fold in range(FOLDS):
        left_out = np.arange(len(factor)) % FOLDS == fold
        values, weights = posterior_values(
            factor.without(left_out), prior, _ROWS_PER_FACT_LEFT_OUT, weights
        )
        estimates.append(values)
        squares[left_out] = _squares(factor, values, left_out)
    friction = np.array(estimates) @ friction_columns(model, samples).T
    deviation = np.sqrt((FOLDS - 1) * friction.var(axis=0))
    torque = factor.gram[:, -1, -1]
    rms = np.maximum(np.sqrt(torque / np.maximum(factor.samples, 1)), 1e-300)
    mean = friction.mean(axis=0)
    return Score(squares, torque, mean / np.maximum(deviation, 1e-300), mean / rms, columns)


def any_load(model: RobotModel) -> dict[str, tuple[float, float]]:
    """Return mean and standard deviation of the last body under a load as heavy as the arm.

    By the names of its parameters, as :func:`~identification.estimators.prior.body_prior` has them
    stated. The load may be as far from the axis as the longest body reaches. Empty where the
    description has no masses: then the prior allows any.
    """
    if mass_fault(model) is not None:
        return {}
    last = model.layout.links[model.chain.last_joint]
    mass = float(model.nominal[model.layout.links][:, MASS_INDEX].sum())
    reach = float(body_lengths(model).max())
    inertias, moments = [mass * reach**2] * N_INERTIA, [mass * reach] * 3
    return {
        model.layout.names[place]: (float(model.nominal[place]), std)
        for place, std in zip(last, [*inertias, *moments, mass], strict=True)
    }


def inertial_torque(model: RobotModel, samples: Samples) -> Array:
    """Return the torque of each joint's own RMS acceleration (n,) [N·m or N], by a fit.

    It is negative where the fit has a negative inertia about the axis.
    """
    factor = Factor.of(model, samples)
    prior = body_prior(model, factor).gaussian
    values = posterior_values(factor, prior, ROWS_PER_FACT)[0]
    motion = samples.motion
    position = motion.position[:: max(1, len(motion.position) // _POSTURES)]
    rest = Motion.at_rest(position)
    weight = model.torque(values, rest)
    units = np.eye(model.n_joints)
    inertia = np.array(
        [
            np.mean(
                model.torque(values, replace(rest, acceleration=rest.acceleration + unit))[:, joint]
                - weight[:, joint]
            )
            for joint, unit in enumerate(units)
        ]
    )
    acceleration = np.sqrt(np.mean(motion.acceleration**2, axis=0))
    return np.asarray(inertia * acceleration)


def is_backwards(model: RobotModel, samples: Samples, score: Score) -> bool:
    """Return whether the rows run backwards in time, by a score of them.

    Then friction drives every joint, and inertia is as it should be: a torque with the opposite
    sign has a negative one as well.
    """
    return score.is_all_driven and bool(inertial_torque(model, samples).sum() > 0.0)


def _squares(factor: Factor, values: Array, blocks: slice | NDArray[np.bool_]) -> Array:
    """Return the squared errors of parameters in some blocks (B, n)."""
    squares = []
    for gram, columns in zip(factor.matrices, factor.columns, strict=True):
        residual = np.append(-values[columns], 1.0)
        squares.append((gram[blocks] @ residual) @ residual)
    return np.asarray(np.maximum(np.column_stack(squares), 0.0))


def friction_columns(model: RobotModel, samples: Samples) -> Array:
    """Return the friction of each joint at a usual speed as a sum of the parameters (n, p)."""
    speed = np.quantile(np.abs(samples.motion.velocity), _SPEED_QUANTILE, axis=0)
    columns = np.zeros((model.n_joints, model.n_parameters))
    for place, (_, term, joint, motor, _) in enumerate(model.friction.terms, model.base.rank):
        if not motor and term.is_friction and not term.of_load:
            law = model.friction.laws[joint]
            here = speed[joint : joint + 1]
            columns[joint, place] = term.column(here, law.sign(here))[0]
    return columns


def compare(score: Score, other: Score, model: RobotModel) -> Comparison:
    """Compare two readings, torque by torque and block by block; small torques aside.

    A torque is compared with itself, whichever joint it is read as.
    """
    at = other.joints
    torque = np.sqrt(other.torque)[at]
    counts = (torque > 0.0) & ~little_torque(torque, ~np.array(model.chain.revolute)[at])
    mine = score.squares[:, score.joints[counts]]
    its = other.squares[:, at[counts]]
    ratios = ErrorRatios.of(mine, its)
    joints = np.ones(len(counts))
    joints[counts] = ratios.joints
    if not ratios.tested.any():
        return Comparison(1.0, 0.0, joints)
    changes = ratios.changes[ratios.some_blocks].mean(axis=1)
    return Comparison(geometric_mean(joints[counts]), sigmas_of(changes), joints)


def fits_alike(score: Score, other: Score, model: RobotModel) -> bool:
    """Return whether a reading predicts about as well as another, or better."""
    is_near = score.overall < (1.0 + ALIKE_REDUCTION) * other.overall
    return is_near and compare(score, other, model).sigmas < SEPARATE_SIGMAS


def sigmas_of(changes: Array) -> float:
    """Return the mean of changes by block over its standard error."""
    mean, error = mean_and_error(changes)
    return mean / error if error > 0.0 else 0.0
