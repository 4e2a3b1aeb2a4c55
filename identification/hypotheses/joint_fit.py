r"""Zeros and scales of all joints together, by one nonlinear least-squares fit.

.. math:: y_j = (1 + g_j)\,\tau_j(\pi, q + z) + e_j

Bodies, drives and friction have the prior of :mod:`identification.estimators.prior`, except that
the scale of all torques together is left open; zeros and scales have zero mean. Fitted by
Gauss-Newton steps (Nocedal and Wright 2006, section 10.3) with joints weighted by their residuals.
Few joints differ from what is stated: those that cost least are fixed one by one, by the sums of
the last step (backward elimination), and the rest is fitted again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimators.prior import GaussianPrior, body_prior
from identification.factor.factor import MIN_NOISE, Factor
from identification.factor.normal_equations import solve_positive
from identification.hypotheses.error_ratios import geometric_mean
from identification.model.motion import Motion
from identification.model.regressor import Regressor
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Mask = NDArray[np.bool_]

ROWS_PER_FACT: Final = 10.0
"""Rows that count as one against the prior: residuals are coloured, and friction deviates from its
law."""
ZERO_SPREAD: Final = np.radians(45.0)
"""Standard deviation of the zero of a joint that is off [rad]."""
GAIN_SPREAD: Final = 0.5
"""Standard deviation of the relative error of a torque scale that is off."""
_PRIOR_SPREADS: Final = (ZERO_SPREAD, GAIN_SPREAD)
# of the information on bodies, where a fit is free of their masses
_FREE_BODY_INFORMATION: Final = 1e-2
_COMMON_SCALE_SPREAD: Final = 3.0  # relative deviation of a scale that all torques have in common
# twice the loss of log posterior of what is kept: 3.5 deviations
_MIN_LIKELIHOOD_LOSS: Final = 12.0
MIN_ZERO: Final = np.radians(1.0)
"""Errors of zeros that assembly leaves [rad]: smaller ones are not named."""
MIN_GAIN: Final = 0.15
"""Relative errors of torque constants: smaller ones are not named."""
_DERIVATIVE_STEP: Final = 1e-5  # rad, of a numerical derivative
_MAX_STEP: Final = (0.5, 0.3)  # rad, and share, of one iteration
_MAX_ROUNDS: Final = 12
_COST_TOLERANCE: Final = 1e-2  # change of twice the log posterior
_MAX_SCALE_DEVIATION: Final = 0.1  # relative deviation of a scale that the motion shows
_SAME_ZERO_TOLERANCE: Final = np.radians(3.0)  # difference of two fits that agree
_SAME_ZERO_SIGMAS: Final = 3.0  # the same, in standard deviations
# Relative deviation of the positions' scale: model errors of real arms look like up to 0.17.
_MIN_POSITION_SCALE: Final = 0.2
_MAX_HALVINGS: Final = 4
_WEIGHTING_ROUNDS: Final = 6
_GAIN_LOWER_BOUND: Final = -0.95


@dataclass(frozen=True, eq=False)
class JointFit:
    """Zeros and scales that explain a recording best.

    Attributes:
        zero: to add to the recorded positions (n,) [rad].
        gain: factor of each measured torque over that of the arm, less one (n,).
        zero_std: standard deviations (n,) [rad].
        values: parameters (p,) of the model.
        error: of each joint as a share of its torque (n,), of the fitted rows.
        cost: twice the negative log posterior, to compare fits of the same rows.
        free: which zeros, then scales, were fitted (2 n,).
        tied: joints whose torques the motion compares with each other, through their coupling.
    """

    zero: Array
    gain: Array
    zero_std: Array
    values: Array
    error: Array
    cost: float
    free: Mask
    tied: tuple[int, ...] = ()

    @property
    def moved(self) -> tuple[int, ...]:
        """The joints whose zero is other than stated."""
        return tuple(np.flatnonzero(np.abs(self.zero) > MIN_ZERO).tolist())

    @property
    def scaled(self) -> tuple[int, ...]:
        """The joints whose torque has another scale."""
        return tuple(np.flatnonzero(np.abs(self.gain) > MIN_GAIN).tolist())

    def fixed(self, free: Mask) -> JointFit:
        """Return it with the zeros and scales as stated that are not `free` (2 n,)."""
        zero, gain = np.split(np.where(free, np.concatenate([self.zero, self.gain]), 0.0), 2)
        return replace(self, zero=zero, gain=gain, free=free)

    @property
    def is_scale_known(self) -> bool:
        """Whether most torques that the motion compares agree: the others are off, not these."""
        off = [joint for joint in self.scaled if joint in self.tied]
        return 2 * len(off) < len(self.tied)

    def is_zero_at(self, joints: Sequence[int]) -> bool:
        """Return whether the zeros of joints are as stated, within their uncertainty."""
        tolerance = np.maximum(_SAME_ZERO_TOLERANCE, _SAME_ZERO_SIGMAS * self.zero_std)
        return bool((np.abs(self.zero) < tolerance)[list(joints)].all())

    def ratio_to(self, other: JointFit) -> float:
        """Return the error over another fit's of the same torques: mean over the joints."""
        return geometric_mean(self.ratios_to(other))

    def ratios_to(self, other: JointFit) -> Array:
        """Return the error over the error of another fit, for each joint with a torque."""
        both = (self.error > 0.0) & (other.error > 0.0)
        return np.asarray(self.error[both] / other.error[both])


def candidates(model: RobotModel, samples: Samples, *, gains: bool = True) -> Mask:
    """Return which zeros and scales (2 n,) a recording can show: of joints that turn, and move."""
    moves = samples.usable.any(axis=0) & (np.ptp(samples.motion.position, axis=0) > 0.0)
    loaded = np.square(samples.torque).sum(axis=0) > 0.0
    turns = np.asarray(model.chain.revolute, dtype=np.bool_)
    return np.concatenate([turns, moves & loaded & gains])


def starting_at(model: RobotModel, samples: Samples, zero: Array, gain: Array) -> JointFit:
    """Return zeros and scales with the parameters that fit best with them.

    Args:
        model: of the arm.
        samples: of the recording.
        zero: of the joints (n,) [rad].
        gain: of the torques (n,).
    """
    problem = _Problem.of(model, samples, 1.0)
    none = np.zeros(2 * problem.n, dtype=np.bool_)
    return _fitted(problem, none, problem.settled(zero, gain, problem.of_torque()))


def fit_joints(
    model: RobotModel,
    samples: Samples,
    free: Mask,
    start: JointFit | None = None,
    *,
    free_bodies: bool = False,
) -> JointFit:
    """Fit the zeros and scales of `free` (2 n,) with all parameters.

    Args:
        model: of the arm.
        samples: some hundred rows, as recorded.
        free: which zeros, then scales.
        start: from which the iteration starts; the others are fixed at its values.
        free_bodies: hardly believe the masses of the description.
    """
    problem = _Problem.of(model, samples, _FREE_BODY_INFORMATION if free_bodies else 1.0)
    return _fitted(problem, free, problem.start(start))


def find_joints(
    model: RobotModel, samples: Samples, free: Mask, start: JointFit | None = None
) -> JointFit:
    """Find the few zeros and scales that are other than stated.

    Args:
        model: of the arm.
        samples: of the recording.
        free: zeros and scales that may be (2 n,).
        start: of the search.
    """
    problem = _Problem.of(model, samples, 1.0)
    point = problem.start(start)
    fit = _fitted(problem, free, point)
    # The scale that all torques have in common is that of the masses.
    tied = _tied(problem, fit)
    fit = replace(fit, gain=(1.0 + fit.gain) / _common_scale(1.0 + fit.gain, tied) - 1.0)
    while fit.free.any():
        needed = _significant(problem, fit)
        if np.array_equal(needed, fit.free):
            break
        fit = _fitted(problem, needed, problem.start(fit.fixed(needed)))
    return replace(fit, tied=tied)


class PositionScales(NamedTuple):
    """By how much the positions of each joint may be multiplied, with its zero free.

    Attributes:
        factor: that explains the rows best, by one step from the positions as read (n,).
        std: standard deviation of it (n,); infinite for joints that slide or do not move.
    """

    factor: Array
    std: Array

    @property
    def shown(self) -> Mask:
        """Which scales the rows show (n,)."""
        return np.asarray(self.std < _MAX_SCALE_DEVIATION)

    @property
    def other(self) -> tuple[int, ...]:
        """The joints with another scale than read."""
        off = np.abs(self.factor - 1.0)
        least = np.maximum(_MIN_POSITION_SCALE, _SAME_ZERO_SIGMAS * self.std)
        return tuple(np.flatnonzero(self.shown & (off > least)).tolist())

    @property
    def agrees(self) -> bool:
        """Whether the rows show that half of the moving joints have the scale as read."""
        moves = np.isfinite(self.std)
        is_most = 2 * np.count_nonzero(self.shown) >= np.count_nonzero(moves)
        return bool(is_most) and not self.other


def position_scales(model: RobotModel, samples: Samples) -> PositionScales:
    """Estimate a scale and a zero of the positions of each joint with all parameters.

    Args:
        model: of the arm.
        samples: some hundred rows, as read.
    """
    problem = _Problem.of(model, samples, 1.0)
    point = problem.start(None)
    n, p = problem.n, model.n_parameters
    turns = candidates(model, samples)
    free = np.concatenate([turns[:n], np.zeros(n, dtype=np.bool_)])
    moving = np.flatnonzero(turns[:n] & (np.ptp(samples.motion.position, axis=0) > 0.0))
    sums = problem.linearised(point, free)
    stretched = problem.stretched(point, moving)
    _, turned = problem.turned(point, free)
    weights = problem.weights(point.squares)
    zeros = np.flatnonzero(free[:n])
    added = p + n + np.arange(len(moving))
    matrix = np.zeros((p + n + len(moving), p + n + len(moving)))
    matrix[: p + n, : p + n] = sums.matrix[: p + n, : p + n]
    matrix[added, added] = ROWS_PER_FACT / GAIN_SPREAD**2
    gradient = np.concatenate([sums.gradient[: p + n], np.zeros(len(moving))])
    for joint, (block, places) in enumerate(zip(*point.regressor, strict=True)):
        usable = samples.usable[:, joint]
        known = np.concatenate([places, p + zeros])
        table = np.hstack([block, turned[:, :, joint].T])[usable]
        own = stretched[:, usable, joint]
        cross = weights[joint] * (own @ table)
        matrix[np.ix_(added, known)] += cross
        matrix[np.ix_(known, added)] += cross.T
        matrix[np.ix_(added, added)] += weights[joint] * (own @ own.T)
        gradient[added] += weights[joint] * (own @ point.residuals[usable, joint])
    factor, std = np.ones(n), np.full(n, np.inf)
    factor[moving] += _solved(matrix, gradient)[p + n :]
    std[moving] = np.sqrt(ROWS_PER_FACT * _inverse(matrix).diagonal()[p + n :])
    return PositionScales(factor, std)


class _Point(NamedTuple):
    """Zeros and scales, the parameters that fit with them, and the errors then."""

    values: Array  # (p,)
    zero: Array  # (n,)
    gain: Array  # (n,)
    residuals: Array  # of the usable rows (m, n)
    squares: Array  # their sums (n,)
    cost: float  # twice the negative log posterior
    regressor: Regressor  # of the positions with these zeros

    @property
    def joints(self) -> Array:
        """Zeros, then gains (2 n,)."""
        return np.concatenate([self.zero, self.gain])


class _Sums(NamedTuple):
    """The problem linearised at a point."""

    matrix: Array  # information of rows and prior (p + 2 n, p + 2 n)
    gradient: Array  # of half the cost, downhill (p + 2 n,)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Rows and prior of a joint fit."""

    model: RobotModel
    samples: Samples
    prior: GaussianPrior
    information: Array  # of the prior (p, p), in rows
    power: Array  # squared torque of the usable rows (n,)

    @classmethod
    def of(cls, model: RobotModel, samples: Samples, share: float) -> _Problem:
        prior = body_prior(model, Factor.of(model, samples)).gaussian
        power = np.where(samples.usable, samples.torque, 0.0)
        information = ROWS_PER_FACT * share * _of_any_scale(prior)
        return cls(model, samples, prior, information, np.square(power).sum(axis=0))

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.model.n_joints

    @property
    def rows(self) -> Array:
        """Usable rows of each joint (n,)."""
        return np.asarray(self.samples.usable.sum(axis=0), dtype=np.float64)

    def start(self, fit: JointFit | None) -> _Point:
        """Return the point of another fit, or the unchanged one."""
        weights = self.of_torque()
        zeros = np.zeros(self.n)
        if fit is not None:
            return self.settled(fit.zero, fit.gain, weights)
        return self.settled(zeros, zeros, weights)

    def moved(self, zero: Array) -> Motion:
        """Return the motion with zeros (n,) added to its positions."""
        motion = self.samples.motion
        return replace(motion, position=motion.position + zero)

    def at(self, zero: Array, gain: Array, weights: Array) -> _Point:
        """Return the point of these zeros and scales, with the parameters fitted to them."""
        return self._at(self.model.regressor(self.moved(zero)), zero, gain, weights)

    def _at(self, regressor: Regressor, zero: Array, gain: Array, weights: Array) -> _Point:
        blocks, columns = regressor
        matrix = self.information.copy()
        right = self.information @ self.prior.mean
        tables = []
        for joint, (block, places) in enumerate(zip(blocks, columns, strict=True)):
            usable = self.samples.usable[:, joint]
            table = (1.0 + gain[joint]) * block[usable]
            tables.append(table)
            matrix[np.ix_(places, places)] += weights[joint] * (table.T @ table)
            right[places] += weights[joint] * (table.T @ self.samples.torque[usable, joint])
        values = _solved(matrix, right)
        residuals = np.zeros_like(self.samples.torque)
        for joint, (table, places) in enumerate(zip(tables, columns, strict=True)):
            usable = self.samples.usable[:, joint]
            residuals[usable, joint] = self.samples.torque[usable, joint] - table @ values[places]
        squares = np.square(residuals).sum(axis=0)
        least = MIN_NOISE**2 * self.power + np.finfo(np.float64).tiny
        squares = np.maximum(squares, least)
        away = values - self.prior.mean
        joints = np.concatenate([zero, gain]) / np.repeat(_PRIOR_SPREADS, self.n)
        log = float((self.rows * np.log(squares)).sum()) / ROWS_PER_FACT
        cost = log + float(away @ self.information @ away) / ROWS_PER_FACT + float(joints @ joints)
        return _Point(values, zero, gain, residuals, squares, cost, regressor)

    def weights(self, squares: Array) -> Array:
        """Return the weights of the joints (n,) by their squared residuals."""
        loaded = self.power > 0.0
        return np.asarray(np.where(loaded, self.rows / np.where(loaded, squares, 1.0), 0.0))

    def of_torque(self) -> Array:
        """Return the weights of the joints (n,) by their torque."""
        return self.weights(np.maximum(self.power, np.finfo(np.float64).tiny))

    def settled(self, zero: Array, gain: Array, weights: Array) -> _Point:
        """Return the point with weights from its own residuals."""
        point = self.at(zero, gain, weights)
        for _ in range(_WEIGHTING_ROUNDS):
            before = point.cost
            point = self._at(point.regressor, zero, gain, self.weights(point.squares))
            if before - point.cost < _COST_TOLERANCE:
                break
        return point

    def linearised(self, point: _Point, free: Mask) -> _Sums:
        """Return the sums at a point, with columns of zero for what is fixed."""
        p = self.model.n_parameters
        n = self.n
        torque, turned = self.turned(point, free)
        factor = 1.0 + point.gain
        weights = self.weights(point.squares)
        matrix = np.zeros((p + 2 * n, p + 2 * n))
        matrix[:p, :p] = self.information
        own = ROWS_PER_FACT / np.repeat(_PRIOR_SPREADS, n) ** 2
        matrix[range(p, p + 2 * n), range(p, p + 2 * n)] = own
        gradient = np.zeros(p + 2 * n)
        gradient[:p] = -self.information @ (point.values - self.prior.mean)
        gradient[p:] = -own * point.joints
        zeros = np.flatnonzero(free[:n])
        for joint, (block, places) in enumerate(zip(*point.regressor, strict=True)):
            usable = self.samples.usable[:, joint]
            gains = np.flatnonzero(free[n:] & (np.arange(n) == joint))
            at = np.concatenate([places, p + zeros, p + n + gains])
            moved = np.hstack([block, turned[:, :, joint].T])[usable]
            scaled = torque[usable][:, gains]
            table = np.hstack([factor[joint] * moved, scaled])
            matrix[np.ix_(at, at)] += weights[joint] * (table.T @ table)
            gradient[at] += weights[joint] * (table.T @ point.residuals[usable, joint])
        gradient[p:][~free] = 0.0
        return _Sums(matrix, gradient)

    def turned(self, point: _Point, free: Mask) -> tuple[Array, Array]:
        """Return the torque (m, n), and its derivative by each free zero (k, m, n)."""
        joints = np.flatnonzero(free[: self.n])
        motion = self.moved(point.zero)
        moved = Motion.joined([motion] * (1 + len(joints)))  # one call for all
        position = moved.position.reshape(-1, *motion.position.shape)
        position[range(1, len(position)), :, joints] += _DERIVATIVE_STEP
        torque, *turned = self.model.torque(point.values, moved).reshape(position.shape)
        return torque, (np.reshape(turned, (-1, *torque.shape)) - torque) / _DERIVATIVE_STEP

    def stretched(self, point: _Point, joints: NDArray[np.intp]) -> Array:
        """Return the derivative of the torque by the scale of each joint's positions (k, m, n)."""
        motion = self.moved(point.zero)
        torque = self.model.torque(point.values, motion)
        parts = []
        for joint in joints:
            scale = np.ones(self.n)
            scale[joint] += _DERIVATIVE_STEP
            other = motion.converted(partial(np.multiply, scale))
            parts.append((self.model.torque(point.values, other) - torque) / _DERIVATIVE_STEP)
        return np.reshape(parts, (-1, *torque.shape))


def _of_any_scale(prior: GaussianPrior) -> Array:
    """Return the information of a prior (p, p) whose bodies have an open common scale."""
    information = prior.information
    along = information @ prior.mean
    known = 1.0 / _COMMON_SCALE_SPREAD**2 + float(prior.mean @ along)
    return np.asarray(information - np.outer(along, along) / known)


def _fitted(problem: _Problem, free: Mask, point: _Point) -> JointFit:
    p = problem.model.n_parameters
    n = problem.n
    most = np.repeat(_MAX_STEP, n)
    sums = problem.linearised(point, free)
    for _ in range(_MAX_ROUNDS if free.any() else 0):
        step = np.where(free, _solved(sums.matrix, sums.gradient)[p:], 0.0)
        step /= max(1.0, float((np.abs(step) / most).max()))
        for _ in range(_MAX_HALVINGS):
            zero = point.zero + step[:n]
            gain = np.maximum(point.gain + step[n:], _GAIN_LOWER_BOUND)
            moved = problem.at(zero, gain, problem.weights(point.squares))
            if moved.cost < point.cost:
                break
            step *= 0.25
        else:
            break
        before = point.cost
        point = moved
        sums = problem.linearised(point, free)
        if before - point.cost < _COST_TOLERANCE:
            break
    zero_std = np.sqrt(ROWS_PER_FACT * _inverse(sums.matrix).diagonal()[p : p + n])
    power = np.where(problem.power > 0.0, problem.power, np.inf)
    error = np.sqrt(point.squares / power)
    return JointFit(point.zero, point.gain, zero_std, point.values, error, point.cost, free)


def _tied(problem: _Problem, fit: JointFit) -> tuple[int, ...]:
    """Return the largest set of joints whose scales are known relative to one of them.

    The scale that all torques have in common is open.
    """
    n = problem.n
    gains = problem.model.n_parameters + n
    point = problem.settled(fit.zero, fit.gain, problem.weights(problem.power * fit.error**2))
    covariance = (
        ROWS_PER_FACT * _inverse(problem.linearised(point, fit.free).matrix)[gains:, gains:]
    )
    free = np.flatnonzero(fit.free[n:])
    best: tuple[int, ...] = ()
    for joint in free.tolist():
        column = covariance[joint]
        beside = covariance.diagonal() - column**2 / covariance[joint, joint]
        known = np.sqrt(np.maximum(beside, 0.0)) < _MAX_SCALE_DEVIATION * (1.0 + fit.gain)
        tied = tuple(k for k in free.tolist() if known[k] or k == joint)
        best = max(best, tied, key=len)
    return best


def _common_scale(scales: Array, tied: Sequence[int]) -> float:
    """Return the scale (n,) that most of the joints have which the motion compares.

    Of several that as many have, the one nearest to the masses of the description.
    """
    if len(tied) < 2:
        return float(np.median(scales))
    compared = scales[list(tied)]
    others = (np.abs(compared / compared[:, None] - 1.0) > MIN_GAIN).sum(axis=1)
    return float(compared[np.lexsort((np.abs(np.log(compared)), others))[0]])


def _significant(problem: _Problem, fit: JointFit) -> Mask:
    """Return which of the fitted zeros and scales are needed (2 n,), by the sums at the fit."""
    p = problem.model.n_parameters
    joints = np.concatenate([fit.zero, fit.gain])
    point = problem.settled(fit.zero, fit.gain, problem.weights(problem.power * fit.error**2))
    covariance = ROWS_PER_FACT * _inverse(problem.linearised(point, fit.free).matrix)[p:, p:]
    needed = fit.free.copy()
    while needed.any():
        # What fixing one of them at zero costs, and where the others are then.
        cost = np.where(needed, joints**2 / covariance.diagonal(), np.inf)
        worst = int(cost.argmin())
        if cost[worst] > _MIN_LIKELIHOOD_LOSS:
            break
        column = covariance[:, worst].copy()
        pivot = column[worst]
        joints = joints - column * (joints[worst] / pivot)
        covariance = covariance - np.outer(column, column) / pivot
        covariance[worst, worst] = 1.0
        needed[worst] = False
    return needed


def _solved(matrix: Array, right: Array) -> Array:
    scale = np.sqrt(matrix.diagonal())
    return solve_positive(matrix / np.outer(scale, scale), right / scale) / scale


def _inverse(matrix: Array) -> Array:
    scale = np.sqrt(matrix.diagonal())
    both = np.outer(scale, scale)
    return np.asarray(np.linalg.inv(matrix / both) / both)
