r"""The posterior of a Gaussian prior on the bodies, drives and friction of an arm.

.. math:: \hat\pi = \arg\min \; t \sum_j w_j \lVert y_j - W_j \pi \rVert^2
                    + (\pi - \mu)^T C^{-1} (\pi - \mu)

The prior is always there: what the motion determines it does not change, and what the motion
leaves open stays near the maker's bodies instead of being left to chance (Gelman et al. 2013,
section 14.8; for arms without data sheets arXiv 2506.19350). The likelihood is tempered by t, the
share of the rows that are independent: residuals are coloured, and the model is wrong where noise
is not (Gruenwald and van Ommen 2017).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.errors import IdentificationError
from identification.estimators.covariance import block_covariance
from identification.factor.estimate import (
    Estimate,
    estimate_of,
    inverse_variance,
    joint_weights,
    mark_undetermined,
)
from identification.factor.estimation_method import (
    EstimationMethod,
    PriorAndData,
    PriorOrigin,
    TimeBlocks,
)
from identification.factor.factor import Factor, require_rows
from identification.factor.normal_equations import Solution, solve_positive, solve_rows
from identification.model.nominal_masses import MassFault, mass_fault
from identification.model.robot import RobotModel

# Posterior over prior standard deviation of a parameter that is determined by the data, which then
# gave three quarters of its information (inverse variance).
DETERMINED_STD_RATIO: Final = 0.5
_MAX_CONDITION: Final = 1e13  # A weak prior still determines what the data leave open

BODY_STD_SHARE: Final = 0.3
"""Relative standard deviation of a body's mass, of its first moment in units of mass times length
and of its inertia in units of mass times length squared. Makers' descriptions leave out motors,
gears, cables and covers, or smear them over the links; on nine real arms 0.2 to 0.5 predict alike
(``benchmarks.leave_one_out``)."""
NOMINAL_STD_SHARE: Final = 0.1
"""Relative standard deviation of the torque of nominal inertias, which errors of single bodies
partly cancel in. CAD lacks cables, grease and fasteners; assumed."""
# Smallest length of a body, as a share of the mean distance of joints: a wrist's links have next to
# no distance, but a size.
_MIN_BODY_LENGTH_SHARE: Final = 0.25
# A body that the description does not know, for the ratios between bodies; their common scale is
# that of the torque.
_UNKNOWN_MASS: Final = 1.0  # kg
# Ratio of measured to nominal torque from which on the masses of a description have no relation to
# the torque.
_MAX_TORQUE_RATIO: Final = 3.0
_CLEAR_SIGMAS: Final = 3.0  # standard deviations of that ratio
_INDEPENDENT_ROW_SHARE: Final = 0.01  # share of the rows for that deviation
_MIN_EIGENVALUE_RATIO: Final = 1e-12  # over the largest one, of its normal equations
_NOISE_ROUNDS: Final = 20  # of the noise of the joints
_NOISE_TOLERANCE: Final = 1e-3  # relative change of the noise
_SAME_NOISE: Final = 0.01  # relative difference of two noises that are one
_LEAST_VARIANCE: Final = 1e-280  # whose inverse times sums of squares is still a number
_SMALL_NOISE: Final = 3e-3  # share of the torque, smaller than most drives allow
_SAME_ERROR: Final = 0.1  # by which a joint's error may rise and is as good
# Of the scatter of its torque, that a term of friction alone makes. Coulomb and viscous friction
# together are the torque of a light wrist, and a fifth of that of a heavy arm.
_FRICTION_SHARE: Final = 0.5
OFFSET_STD_SHARE: Final = 0.4
"""Deviation of an offset relative to Coulomb friction, for a joint that moves one way. Both are one
column then, and what opposes its motion is friction rather than an offset. In recordings of six
arms of the board the median ratio of the two is 0.31, which is that of a Gaussian of 0.46; from 0.2
to 0.5 the errors of these recordings differ by 0.2 % at most, at 1.0 one is 1.4 % larger
(``benchmarks.leave_one_out``)."""
# RMS of motions that excite an arm: 0.2 to 4.5 rad/s in the recordings of six arms of the board,
# half of the joints above 0.45; at a base frequency of 0.1 to 0.2 Hz the acceleration is as large.
USUAL_SPEED: Final = 0.5  # rad/s or m/s
_MIN_SPEED_SHARE: Final = 0.02  # share of it below which a joint shows the noise of its velocity
_USUAL_ACCELERATION: Final = 0.5  # rad/s² or m/s²
_SPEED_SAMPLES: Final = 20  # up to the usual one
LOAD_FRICTION_STD: Final = 0.1
"""Deviation of the share of the transmitted torque that becomes friction: strain-wave gears lose
some 2 to 15 % (Bittencourt and Gunnarsson 2012)."""
_MIN_ROWS_PER_PARAMETER: Final = 2  # per parameter, to estimate the noise
_MOMENT_SLICE = slice(6, 9)
_MASS_INDEX = 9


class TorqueSums(NamedTuple):
    """Sums over the rows of [W | y] of one torque, or of K along the first axis."""

    gram: Array  #: ([K,] n, p + 1, p + 1)
    samples: Array | Indices  #: rows ([K,] n)

    @classmethod
    def of(cls, factor: Factor) -> TorqueSums:
        """Return the sums of a factor over its blocks."""
        return cls(factor.gram, factor.samples)

    def squared_errors(self, values: Array) -> Array:
        """Return the squared errors of parameters (p,) of one torque, per joint (n,)."""
        augmented = np.ones(len(values) + 1)
        np.negative(values, out=augmented[:-1])
        return np.maximum((self.gram @ augmented) @ augmented, 0.0)

    def each(self) -> Iterator[TorqueSums]:
        """Yield the sums of each of K torques."""
        return map(TorqueSums, self.gram, self.samples)

    def posterior(
        self,
        mean: Array,
        precision: Array,
        smallest_noise: float,
        start: Array | None = None,
        *,
        rounds: int = _NOISE_ROUNDS,
    ) -> tuple[Array, Array]:
        """Return parameters (p,) of one torque and the weights of the joints (n,).

        As :func:`posterior_values`.

        Args:
            mean: of the prior (p,).
            precision: its information times the rows that count as one (p, p).
            smallest_noise: of the factor.
            start: weights from which the iteration starts (n,).
            rounds: at most, of the noise.
        """
        if start is not None:
            return self._settled(mean, precision, smallest_noise, start, rounds)
        whole = self.gram[:, -1, -1] / np.maximum(self.samples, 1)
        weights = np.divide(1.0, whole, where=whole > 0.0, out=np.zeros(len(whole)))
        found = self._settled(mean, precision, smallest_noise, weights, rounds)
        if np.any((self.samples > 0) & (self.samples < 2 * len(mean))):
            return found  # rows that the parameters may fit exactly do not show the noise
        # Where the prior contradicts the rows, two noises may be consistent: as large as the
        # contradiction, which leaves the prior as it is, and as small as the rows allow.
        closer = self._settled(mean, precision, smallest_noise, weights / _SMALL_NOISE**2, rounds)
        return closer if self._is_better(closer, found, mean, precision) else found

    def _is_better(
        self, closer: tuple[Array, Array], found: tuple[Array, Array], mean: Array, precision: Array
    ) -> bool:
        """Return whether parameters and weights are more probable, at no joint's expense.

        If no bodies fit all joints, as with torques of wrong scales, the more probable parameters
        fit one joint and no other. Where both starts settle at one noise, rounding must not choose.
        """
        if np.allclose(closer[1], found[1], rtol=_SAME_NOISE, atol=0.0):
            return False
        theirs, ours = (self.squared_errors(values) for values, _ in (closer, found))
        if np.any(theirs > (1.0 + _SAME_ERROR) ** 2 * ours):
            return False
        more, less = (self._surprise(*each, mean, precision) for each in (found, closer))
        return less < more

    def _settled(
        self, mean: Array, precision: Array, smallest_noise: float, start: Array, rounds: int
    ) -> tuple[Array, Array]:
        """Return parameters and weights that agree, by iteration of the noise from `start`."""
        gram, samples = self
        flat = gram.reshape(len(gram), -1)
        rows = np.maximum(samples, 1)
        whole = gram[:, -1, -1] / rows
        floor = smallest_noise**2 * whole + _LEAST_VARIANCE
        least = np.maximum(precision.diagonal(), np.finfo(np.float64).tiny)
        values = mean
        weights = np.zeros(len(gram))
        variance = np.where(start > 0.0, 1.0 / np.where(start > 0.0, start, 1.0), whole)
        # A torque that is zero throughout was not measured.
        has_rows = (samples > 0) & (gram[:, -1, -1] > 0.0)
        for _ in range(rounds):
            weights = np.where(has_rows, 1.0 / np.maximum(variance, floor), 0.0)
            # One product of flat matrices: a general sum takes several times as long.
            total = (weights @ flat).reshape(gram.shape[1:])
            information = total[:-1, :-1]
            scale = np.sqrt(information.diagonal() + least)
            values = (
                mean
                + solve_positive(
                    (information + precision) / (scale[:, None] * scale),
                    (total[:-1, -1] - information @ mean) / scale,
                )
                / scale
            )
            previous = variance
            variance = self.squared_errors(values) / rows
            if (np.abs(variance - previous) <= _NOISE_TOLERANCE * previous).all():
                break
        return values, weights

    def _surprise(self, values: Array, weights: Array, mean: Array, precision: Array) -> float:
        """Return -2 times the logarithm of rows and prior at these parameters and weights."""
        seen = weights > 0.0
        change = values - mean
        of_rows = weights[seen] @ self.squared_errors(values)[seen]
        of_noise = np.asarray(self.samples)[seen] @ np.log(weights[seen])
        return float(of_rows - of_noise + change @ precision @ change)


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """Gaussian prior: ``root @ (pi - mean)`` is standard normal."""

    mean: Array  #: (p,)
    root: Array  #: (k, p); flat in directions without information
    origin: PriorOrigin | None = None  #: None: given as numbers
    #: what is believed, if this prior is a stronger one; None: this one
    believed: GaussianPrior | None = None

    @classmethod
    def of_combinations(
        cls, combinations: Array, mean: Array, std: Array, origin: PriorOrigin | None = None
    ) -> GaussianPrior:
        """Return the prior on ``combinations @ s`` of independent s.

        With the identity and mean zero this is ridge regression in units of `std`.

        Args:
            combinations: (p, s).
            mean: of s (s,).
            std: of s (s,); an infinite one makes the direction on which its quantity acts flat.
            origin: what the prior is made from; None: from given numbers.
        """
        flat = np.isinf(std)
        spread = combinations[:, ~flat] * std[~flat]
        length = _length(spread, axis=1)
        seen = _null_space(combinations[:, flat] / length[:, None])
        seen_spread = seen.T @ (spread / length[:, None])
        covariance = seen_spread @ seen_spread.T
        scale = np.sqrt(np.diag(covariance))
        lower = np.linalg.cholesky(covariance / np.outer(scale, scale))
        root = scipy.linalg.solve_triangular(lower, seen.T / scale[:, None], lower=True) / length
        return cls(combinations @ mean, np.asarray(root), origin)

    @cached_property
    def information(self) -> Array:
        """Inverse of the covariance (p, p), zero in flat directions."""
        return np.asarray(self.root.T @ self.root)

    @cached_property
    def std(self) -> Array:
        """Standard deviations (p,) of what is believed, infinite where it is flat."""
        believed = self.believed or self
        solution = solve_rows(believed.root, np.zeros(len(believed.root)), _MAX_CONDITION)
        covariance = solution.inverse
        mark_undetermined(covariance, solution.determined)
        return np.sqrt(np.diag(covariance))


@dataclass(frozen=True, eq=False)
class BodyPrior:
    """Independent Gaussian priors of bodies, rotors, friction, springs and balancers."""

    mean: Array  #: of the standard parameters (s,), then of friction and elements (k,)
    std: Array  #: likewise; infinite where nothing is known
    combinations: Array  #: ``pi = combinations @ [standard; others]``, (p, s + k)
    origin: PriorOrigin
    bodies: NDArray[np.intp]  #: where the standard parameters of the links are
    #: whether the description has no masses, or masses without relation to the torque
    placeholder: bool = False
    believed: BodyPrior | None = None  #: what is believed, if this prior is a stronger one

    @property
    def belief(self) -> BodyPrior:
        """What is believed: this prior, or the weaker one it was made from."""
        return self.believed or self

    @cached_property
    def gaussian(self) -> GaussianPrior:
        """The prior of the parameters (p,)."""
        prior = GaussianPrior.of_combinations(self.combinations, self.mean, self.std, self.origin)
        return prior if self.believed is None else replace(prior, believed=self.believed.gaussian)

    def with_weight(self, weight: float) -> BodyPrior:
        """Return the prior with so many times the information on bodies.

        Of friction, rotors and offsets, whose mean of zero says nothing, it stays the same. The
        estimate is closer to the described bodies; its intervals believe them no more.
        """
        if weight == 1.0:
            return self
        std = self.std.copy()
        std[self.bodies] /= np.sqrt(weight)
        origin = replace(self.origin, weight=weight * self.origin.weight)
        return replace(self, std=std, origin=origin, believed=self.belief)

    def most_probable(self, values: Array) -> Array:
        """Return the most probable standard and other parameters (s + k,) of parameters (p,)."""
        variance = np.where(np.isinf(self.std), 0.0, self.std) ** 2
        covariance = (self.combinations * variance) @ self.combinations.T
        scale = np.sqrt(np.diag(covariance))
        change = (values - self.gaussian.mean) / scale
        pull = np.linalg.lstsq(covariance / np.outer(scale, scale), change, rcond=1e-12)[0]
        return np.asarray(self.mean + variance * (self.combinations.T @ (pull / scale)))


@dataclass(frozen=True, eq=False)
class PosteriorEstimate:
    """Estimate from prior and data."""

    estimate: Estimate  #: its covariance is the posterior's
    prior_mean: Array  #: (p,)
    prior_std: Array  #: (p,), infinite where unknown
    origin: PriorOrigin | None  #: of the prior
    design_effect: float  #: rows of data that count as one
    shift: Array  #: way of the parameters (p,) from those by what is believed
    blocks: TimeBlocks | None = None  #: of the covariance; None: of white residuals

    @property
    def ratio(self) -> Array:
        """Posterior over prior standard deviation (p,), 1: all from the prior; without prior 0."""
        flat = np.isinf(self.prior_std)
        ratio = self.estimate.std / np.where(flat, 1.0, self.prior_std)
        return np.where(flat, np.isinf(self.estimate.std).astype(np.float64), ratio)

    @property
    def learned(self) -> NDArray[np.bool_]:
        """Whether the data determine each parameter (p,): ratio below `DETERMINED_STD_RATIO`."""
        return np.asarray(self.ratio < DETERMINED_STD_RATIO)

    @property
    def normalized_change(self) -> Array:
        """Change by the data (p,), standard normal if prior and data agree; NaN without prior."""
        tested = self.learned & np.isfinite(self.prior_std)
        allowed = np.where(tested, self.prior_std**2, 1.0) * (
            1.0 - np.where(tested, self.ratio, 0.0) ** 2
        )
        return np.where(tested, (self.estimate.values - self.prior_mean) / np.sqrt(allowed), np.nan)


def posterior_values(
    factor: Factor,
    prior: GaussianPrior,
    design_effect: float = 1.0,
    start: Array | None = None,
) -> tuple[Array, Array]:
    """Return the posterior's parameters (p,) and the weights of the joints (n,).

    The weights are the inverse variances of the joints' own residuals, by iteration; of two that
    are consistent, the more probable.

    Args:
        factor: of the data.
        prior: of the parameters.
        design_effect: rows of data that count as one.
        start: weights from which the iteration starts (n,).
    """
    sums = TorqueSums.of(factor)
    precision = design_effect * prior.information
    return sums.posterior(prior.mean, precision, factor.smallest_noise, start)


def with_prior(
    model: RobotModel,
    factor: Factor,
    prior: GaussianPrior,
    weights: Array | None = None,
    *,
    design_effect: float = 1.0,
) -> PosteriorEstimate:
    """Estimate from data and prior with white residuals; a flat prior gives least squares.

    Args:
        model: of the arm.
        factor: of the data.
        prior: of the parameters.
        weights: of the joints (n,), by default of an ordinary fit without prior.
        design_effect: by which the information of the data is divided.

    Raises:
        IdentificationError: too few rows to estimate the noise, and no weights.
    """
    if weights is None:
        weights = _weights(factor)
    rows, target = factor.rows(weights)
    data_weight = np.sqrt(1.0 / design_effect)
    # Solved for the change of the prior's mean, which unknown directions keep.
    posterior = solve_rows(
        np.concatenate([data_weight * rows, prior.root]),
        np.concatenate([data_weight * (target - rows @ prior.mean), np.zeros(len(prior.root))]),
        _MAX_CONDITION,
    )
    solution = posterior._replace(
        values=prior.mean + posterior.values,
        condition=solve_rows(rows, target).condition if len(rows) else np.inf,
    )
    method = EstimationMethod(PriorAndData(prior.origin, design_effect))
    estimate = estimate_of(model.units, factor, solution, weights / design_effect, method)
    return PosteriorEstimate(
        estimate, prior.mean, prior.std, prior.origin, design_effect, np.zeros_like(prior.mean)
    )


def fit_posterior(
    model: RobotModel, factor: Factor, prior: GaussianPrior, design_effect: float | None = None
) -> PosteriorEstimate:
    """Estimate from a factor by time and a prior, with coloured residuals.

    The covariance has the scatter of the data, cluster-robust, and the prior's of what they leave
    open. That of a stronger prior is the mean square error by what is believed: the covariance of
    the believed posterior, and the square of the way from its mean as far as its errors do not make
    it.

    Args:
        model: of the arm.
        factor: of the data, by blocks of time.
        prior: of the parameters.
        design_effect: rows that count as one, by default as :func:`design_effect_of` says.

    Raises:
        IdentificationError: the factor has no rows.
    """
    require_rows(model, factor)
    if design_effect is None:
        design_effect = design_effect_of(factor, prior)
    values, weights = posterior_values(factor, prior, design_effect)
    if prior.believed is not None:
        base = fit_posterior(model, factor, prior.believed, design_effect)
        shift = values - base.estimate.values
        bias = _beyond_chance(
            shift,
            base.estimate.covariance,
            factor.weighted(weights).A,
            design_effect * prior.information,
            design_effect * prior.believed.information,
        )
        estimate = replace(
            base.estimate,
            values=values,
            covariance=base.estimate.covariance + np.outer(bias, bias),
            noise_std=factor.residual_rms(values),
            method=EstimationMethod(PriorAndData(prior.origin, design_effect), base.blocks),
        )
        return replace(base, estimate=estimate, origin=prior.origin, shift=shift)
    spread = block_covariance(factor, weights, values, prior.information, design_effect)
    alone = factor.solve(weights)
    solution = Solution(values, spread.root, alone.condition, alone.determined)
    method = EstimationMethod(PriorAndData(prior.origin, design_effect), spread.blocks)
    estimate = estimate_of(model.units, factor, solution, weights, method)
    estimate = replace(
        estimate, covariance=spread.covariance, interval_factor=spread.interval_factor
    )
    unmoved = np.zeros_like(prior.mean)
    return PosteriorEstimate(
        estimate, prior.mean, prior.std, prior.origin, design_effect, unmoved, spread.blocks
    )


def _beyond_chance(
    shift: Array, covariance: Array, data: Array, stronger: Array, believed: Array
) -> Array:
    """Return the part of a shift (p,) by a stronger prior that errors of the estimate do not make.

    Its square is that of the shift less what these errors make of it on average, both in units of
    the information of data and prior; zero where that is more (James and Stein 1961, positive
    part). Its direction is kept, as shifts of single parameters cancel in the torque.

    Args:
        shift: from the estimate by what is believed.
        covariance: of that estimate (p, p), infinite variances of undetermined parameters.
        data: information of the rows (p, p).
        stronger: information of the stronger prior (p, p).
        believed: of the prior of that estimate (p, p).
    """
    information = data + stronger
    scale = 1.0 / np.sqrt(information.diagonal())
    unit = solve_positive(
        information * scale[:, None] * scale, (stronger - believed) * scale[:, None]
    )
    pull = scale[:, None] * unit
    moved = pull @ np.where(np.isfinite(covariance), covariance, 0.0) @ pull.T
    metric = data + believed
    square = float(shift @ metric @ shift)
    by_chance = float(np.einsum("pq,pq->", metric, moved))
    return shift * np.sqrt(max(0.0, 1.0 - by_chance / square)) if square > 0.0 else shift


@dataclass(frozen=True, eq=False)
class ScoreScatter:
    """Cluster-robust scatter of the scores of a factor by time, for estimates from its sum."""

    rows: Array  #: (k, p), ``rows' rows`` is the covariance of the sum of the scores
    interval_factor: float  #: standard deviations in half a 95 % interval
    blocks: TimeBlocks  #: of the covariance

    @classmethod
    def of(cls, factor: Factor, prior: GaussianPrior) -> ScoreScatter:
        """Return the scatter at the posterior of a prior, each row of data counted as one."""
        values, weights = posterior_values(factor, prior)
        spread = block_covariance(factor, weights, values, prior.information)
        size = _length(spread.root, axis=1)
        of_parameters = np.linalg.pinv(spread.root / size[:, None]) / size
        # Not all blocks, of which there may be very many, but rows of the same products.
        triangle = np.linalg.qr(spread.scores, mode="r")
        return cls(triangle @ of_parameters, spread.interval_factor, spread.blocks)

    def covariance(self, root: Array, precision: Array, design_effect: float) -> Array:
        """Return the covariance of a posterior (p, p).

        `root` S (p, k) with S S' the inverse of the information of data and prior, of which
        `precision` (p, p) is the prior's as it counts, see :func:`block_covariance`.
        """
        data = self.rows @ root @ root.T
        prior = root.T @ precision @ root
        return np.asarray(data.T @ data + design_effect * root @ prior @ root.T)


def design_effect_of(factor: Factor, prior: GaussianPrior) -> float:
    """Return how many rows count as one, at least one.

    That is the ratio of the cluster-robust variance of the scores to that of white residuals (Rao
    and Scott 1981; Pauli, Racugno and Ventura 2011).
    """
    effect = 1.0
    for _ in range(2):  # the second time with the residuals of the tempered fit
        values, weights = posterior_values(factor, prior, effect)
        spread = block_covariance(factor, weights, values, prior.information, effect)
        effect = max(1.0, spread.design_effect)
    return effect


def _weights(factor: Factor) -> Array:
    rows = int(factor.samples.sum())
    if 0 < rows < _MIN_ROWS_PER_PARAMETER * factor.n_parameters:
        raise IdentificationError(
            f"{rows} rows are too few to estimate the torque noise with {factor.n_parameters}"
            " parameters; pass the weights"
        )
    return joint_weights(factor) if rows else np.zeros(factor.n_joints)


def _length(columns: Array, axis: int) -> Array:
    """Return lengths to divide by, one for zero."""
    length = np.linalg.norm(columns, axis=axis)
    return np.where(length > 0.0, length, 1.0)


def _null_space(columns: Array) -> Array:
    """Return an orthonormal basis (p, p - r) orthogonal to columns (p, k) of rank r."""
    if columns.shape[1] == 0:
        return np.eye(len(columns))
    left, singular, _ = np.linalg.svd(columns / _length(columns, axis=0), full_matrices=True)
    rank = int(np.count_nonzero(singular > 1e-12 * singular.max(initial=0.0)))
    return np.asarray(left[:, rank:])


# The prior of an arm


def body_prior(
    model: RobotModel,
    factor: Factor,
    share: float = BODY_STD_SHARE,
    stated: Mapping[str, tuple[float, float]] | None = None,
    *,
    wide_rotors: bool = False,
) -> BodyPrior:
    """Return the prior of an arm; its scale without masses, and of friction, is the torque's.

    Bodies: the nominal ones. Without masses in the description, or with masses that have no
    relation to the torque of the factor: zero with bodies that could make all of the torque.
    Rotors: zero, with the inertia of the links outboard or, if larger, what makes half of the
    torque's scatter. Friction and elements: zero, with a coefficient that makes half of it; offsets
    less of a joint that moves one way (`OFFSET_STD_SHARE`).

    Args:
        model: of the arm.
        factor: of the data.
        share: standard deviation of the nominal bodies: of the mass, times the body's length, times
            its square.
        stated: mean and standard deviation by name, in place of these:
            ``{"I3m": (1.2, 0.2), "f0_1": (40.0, 40.0)}``.
        wide_rotors: whether all rotors may be heavier, seen through their gears, than what they
            move.
    """
    layout = model.layout
    names = layout.names + model.parameter_names[model.base.rank :]
    mean, std, placeholder = _mean_and_deviations(
        model, TorqueSums.of(factor), share, wide_rotors=wide_rotors
    )
    origin = PriorOrigin(share, stated=len(stated or {}))
    if placeholder:
        fault = mass_fault(model)
        if fault is None:
            scale, _ = nominal_ratio(model, factor)
            origin = replace(origin, fault=MassFault.UNRELATED, scale=scale)
        else:
            origin = replace(origin, fault=fault)
    for name, (value, spread) in (stated or {}).items():
        mean[names.index(name)] = value
        std[names.index(name)] = spread
    bodies = layout.links.ravel()
    return BodyPrior(mean, std, _of_model(model).combinations, origin, bodies, bool(placeholder))


class Priors(NamedTuple):
    """Gaussian priors of the bodies for K torques."""

    mean: Array  #: (K, p)
    information: Array  #: (K, p, p)


def body_priors(model: RobotModel, sums: TorqueSums) -> Priors:
    """Return the :func:`body_prior` of each of K torques, in much less time than one by one."""
    mean, std, _ = _mean_and_deviations(model, sums, BODY_STD_SHARE)
    combinations = _of_model(model).combinations
    spread = combinations * std[:, None]
    covariance = spread @ spread.transpose(0, 2, 1)
    scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    both = scale[:, :, None] * scale[:, None]
    return Priors(mean @ combinations.T, np.linalg.inv(covariance / both) / both)


class _OfModel(NamedTuple):
    """What the priors of a model's bodies have in common."""

    combinations: Array  # (p, s + k), see BodyPrior
    usual: Array  # columns (p,) of friction, offsets and rotors at usual speed and acceleration
    nominal: Array  # (p + 1, r + 1): nominal torque, rotors, friction and elements; the torque
    sliding: Indices  # joints with Coulomb and viscous friction and an offset
    dry: Indices  # their columns
    viscous: Indices
    offset: Indices
    masses: bool  # whether the description has masses of an arm


@lru_cache(maxsize=16)
def _of_model(model: RobotModel) -> _OfModel:
    layout = model.layout
    b = model.base.rank
    others = model.n_parameters - b
    combinations = np.zeros((model.n_parameters, layout.size + others))
    combinations[:b, : layout.size] = model.base.grouping
    combinations[b:, layout.size :] = np.eye(others)
    # A rotor that is in the mass that it lifts is in the constant torque as well.
    for name, terms in model.base.lumped.items():
        for factor, rotor in terms:
            place = model.parameter_names.index(name), layout.names.index(rotor)
            combinations[place] += factor
    rotors = combinations[:, layout.rotors]
    nominal = np.zeros((model.n_parameters + 1, 2 + rotors.shape[1] + others))
    nominal[:b, 0] = model.base.grouping @ model.nominal
    nominal[:-1, 1 : 1 + rotors.shape[1]] = rotors
    nominal[b:-1, 1 + rotors.shape[1] : -1] = np.eye(others)
    nominal[-1, -1] = 1.0
    columns = dict[int, dict[str, int]]()
    for k, term in enumerate(model.friction.terms, b):
        columns.setdefault(term.owner, {})[term.symbol] = k
    sliding = [joint for joint, has in columns.items() if has.keys() >= {"f0", "f1", "fo"}]
    dry, viscous, offset = (
        np.array([columns[joint][symbol] for joint in sliding], dtype=np.intp)
        for symbol in ("f0", "f1", "fo")
    )
    return _OfModel(
        combinations, _usual_columns(model), nominal, np.array(sliding, dtype=np.intp),
        dry, viscous, offset, mass_fault(model) is None,
    )  # fmt: skip


def _mean_and_deviations(
    model: RobotModel, sums: TorqueSums, share: float, *, wide_rotors: bool = False
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return mean and standard deviations ([K,] s + k), and whether masses say nothing ([K])."""
    layout = model.layout
    size = layout.size
    links = layout.links
    placeholder = _is_placeholder(model, sums)
    whole_torque = _torque_over_columns(model, sums)
    mean = np.zeros((*placeholder.shape, size + model.n_parameters - model.base.rank))
    std = np.zeros_like(mean)
    std[..., size:] = _friction_deviations(model, sums, whole_torque[..., model.base.rank :])
    length = body_lengths(model)
    if not placeholder.all():
        masses = model.nominal[links][:, _MASS_INDEX]
        masses = np.where(masses > 0.0, masses, np.median(masses[masses > 0.0]))
        mean[~placeholder, :size] = model.nominal
        std[~placeholder, :size] = _standard_deviations(model, share, masses, length)
    if placeholder.any():
        alike = _standard_deviations(model, 1.0, np.full(model.n_joints, _UNKNOWN_MASS), length)
        scale = _torque_scale(
            model, TorqueSums(sums.gram[placeholder], sums.samples[placeholder]), alike
        )
        std[placeholder, :size] = scale[..., None] * alike
    # Motors of a wrist are heavier, seen through their gears, than what they move.
    widened = layout.rotors if wide_rotors else np.intersect1d(layout.rotors, model.base.pivots)
    std[..., widened] = np.maximum(std[..., widened], _rotor_torque(model, sums, widened))
    for coupling, (i, j) in zip(layout.couplings, layout.pairs, strict=True):
        std[..., coupling] = np.sqrt(std[..., layout.rotors[i]] * std[..., layout.rotors[j]])
    return mean, std, placeholder


def _standard_deviations(model: RobotModel, share: float, masses: Array, length: Array) -> Array:
    """Return standard deviations of the standard parameters (s,) of bodies and rotors."""
    std = np.zeros(model.layout.size)
    std[model.layout.links] = _body_deviations(share * masses, length)
    std[model.layout.rotors] = _outboard_inertia(model, masses, length)
    return std


def nominal_deviations(model: RobotModel) -> Array:
    """Return deviations of the nominal bodies as inertial parameters (rank, 10 n), one each."""
    links = model.layout.links
    masses = model.nominal[links][:, _MASS_INDEX]
    std = _body_deviations(BODY_STD_SHARE * masses, body_lengths(model))
    return np.asarray(model.base.grouping[:, links.ravel()] * std.ravel())


def _friction_deviations(model: RobotModel, sums: TorqueSums, whole_torque: Array) -> Array:
    """Return standard deviations of friction and elements ([K,] k), each as if it acted alone."""
    std = whole_torque.copy()
    one_way = _one_way(model, sums)
    for k, term in enumerate(model.friction.terms):
        if term.term.of_load:
            std[..., k] = LOAD_FRICTION_STD
        elif term.symbol == "fo":
            std[..., k] *= 1.0 - (1.0 - OFFSET_STD_SHARE) * one_way[..., term.owner]
    return std


def _one_way(model: RobotModel, sums: TorqueSums) -> Array:
    """Return how far Coulomb friction and offset of each joint are one column ([K,] n), 0 to 1.

    Zero for a joint that stands, whose offset holds its torque, and without these three terms.
    """
    parts = _of_model(model)

    def products(first: Indices, second: Indices) -> Array:
        return np.asarray(sums.gram[..., first, second].sum(axis=-2))

    alike = np.zeros(sums.samples.shape)
    offset = products(parts.offset, parts.offset)
    speed = np.sqrt(products(parts.viscous, parts.viscous) / np.maximum(1.0, offset))
    moves = speed > _MIN_SPEED_SHARE * USUAL_SPEED
    product = np.sqrt(products(parts.dry, parts.dry) * offset)
    both = np.abs(products(parts.dry, parts.offset))
    alike[..., parts.sliding] = np.where(moves, both / np.where(moves, product, 1.0), 0.0)
    return alike


def _body_deviations(mass: Array, length: Array) -> Array:
    """Return standard deviations of inertia, moment and mass (n, 10) of bodies of these lengths."""
    sizes = np.column_stack([mass * length**2, mass * length, mass])
    return np.repeat(sizes, [6, 3, 1], axis=1)


def body_lengths(model: RobotModel) -> Array:
    """Return a length of each body (n,) [m]: to its centre, its next joint, or its gyration.

    Where the masses are not an arm's, the inertias may be placeholders as well: they are if a
    gyration exceeds the largest distance of joints, and then say no length.
    """
    inertial = model.nominal[model.layout.links]
    mass = inertial[:, _MASS_INDEX]
    divisor = np.where(mass > 0.0, mass, np.inf)
    centre = np.linalg.norm(inertial[:, _MOMENT_SLICE], axis=1) / divisor
    second_moment = 0.5 * inertial[:, [0, 3, 5]].sum(axis=1)
    gyration = np.sqrt(np.maximum(second_moment, 0.0) / divisor)
    distance = np.linalg.norm(model.chain.translation[1:], axis=1)
    usual = float(distance.mean()) if len(distance) else 0.0
    smallest = _MIN_BODY_LENGTH_SHARE * usual or _MIN_BODY_LENGTH_SHARE
    longest = max(float(distance.max(initial=0.0)), smallest)
    if mass_fault(model) is not None and gyration.max() > longest:
        gyration = np.zeros_like(gyration)
    lengths = [centre, gyration, np.append(distance, 0.0), np.full(model.n_joints, smallest)]
    return np.asarray(np.max(lengths, axis=0))


def _outboard_inertia(model: RobotModel, masses: Array, length: Array) -> Array:
    """Return the inertia of the links outboard of each joint (n,) [kg·m² or kg].

    Mean over all angles between them, where the squares of lengths add; a stretched arm, whose
    inertia is several times as large, is a rare posture.
    """
    if not model.layout.rotor_inertia:
        return np.zeros(0)
    inertia = np.zeros(model.n_joints)
    for joint in range(model.n_joints):
        squares = np.cumsum(length[joint:] ** 2) if model.chain.revolute[joint] else 1.0
        inertia[joint] = float((masses[joint:] * squares).sum())
    return inertia


def _torque_over_columns(model: RobotModel, sums: TorqueSums) -> Array:
    """Return the coefficient ([K,] p) with which a column alone makes its joints' torque vary so.

    A motion slower than usual does not allow more: what it hardly shows would be huge in a faster
    one. A joint without an offset is taken to vary about zero.
    """
    gram, samples = sums
    power = (_FRICTION_SHARE * _scatter(model, sums)) ** 2 * samples
    columns = np.diagonal(gram, axis1=-2, axis2=-1)[..., :-1]
    acting = columns > 0.0
    whole = np.where(acting, power[..., None], 0.0).sum(axis=-2)
    rows = np.where(acting, samples[..., None], 0).sum(axis=-2)
    squares = np.maximum(columns.sum(axis=-2), rows * _of_model(model).usual ** 2)
    ratio = np.sqrt(whole / np.where(squares > 0.0, squares, 1.0))
    # Without a row that shows it, a coefficient of the size of the torque.
    rms = np.sqrt(power.sum(axis=-1) / np.maximum(1, samples.sum(axis=-1)))
    rms = np.where(rms > 0.0, rms, 1.0)
    return np.asarray(np.where(ratio > 0.0, ratio, rms[..., None]))


def _rotor_torque(model: RobotModel, sums: TorqueSums, rotors: NDArray[np.intp]) -> Array:
    """Return inertias ([K,] k) of rotors that alone make half of the scatter of their torque.

    A slow motion does not allow more, as for friction.
    """
    joints = np.flatnonzero(np.isin(model.layout.rotors, rotors))
    columns = _of_model(model).combinations[:, rotors]
    squares = np.zeros((*sums.samples.shape[:-1], len(rotors)))
    for k, joint in enumerate(joints):
        used = np.flatnonzero(columns[:, k])
        share = columns[used, k]
        squares[..., k] = (sums.gram[..., joint, used[:, None], used] @ share) @ share
    rows = np.maximum(sums.samples[..., joints], 1)
    squares = np.maximum(squares, rows * _USUAL_ACCELERATION**2)
    power = (_FRICTION_SHARE * _scatter(model, sums)[..., joints]) ** 2 * rows
    return np.asarray(np.sqrt(power / squares))


def _usual_columns(model: RobotModel) -> Array:
    """Return columns (p,) of friction, offsets and rotors at the usual speed and acceleration.

    Zero for other parameters.
    """
    usual = np.zeros(model.n_parameters)
    speeds = np.linspace(0.0, USUAL_SPEED, _SPEED_SAMPLES)
    for k, term in enumerate(model.friction.terms, model.base.rank):
        usual[k] = np.abs(term.term.column(speeds, np.ones(_SPEED_SAMPLES))).max()
    rotors = np.isin(model.base.pivots, model.layout.rotors)
    usual[: model.base.rank][rotors] = _USUAL_ACCELERATION
    return usual


def torque_scatter(model: RobotModel, factor: Factor) -> Array:
    """Return the standard deviation of each joint's torque (n,), its RMS without an offset."""
    return _scatter(model, TorqueSums.of(factor))


def _scatter(model: RobotModel, sums: TorqueSums) -> Array:
    """Return the :func:`torque_scatter` ([K,] n)."""
    gram = sums.gram
    rows = np.maximum(sums.samples, 1)
    mean = np.zeros(rows.shape)
    for k, term in enumerate(model.friction.terms, model.base.rank):
        if term.symbol == "fo" and not term.motor:
            mean[..., term.owner] = gram[..., term.owner, k, -1] / rows[..., term.owner]
    return np.sqrt(np.maximum(gram[..., -1, -1] / rows - mean**2, 0.0))


def _torque_scale(model: RobotModel, sums: TorqueSums, std: Array) -> Array:
    """Return the factor ([K]) at which bodies of these deviations make as much torque as measured.

    Geometric mean over the joints, which gears and mechanisms make differ.
    """
    links = model.layout.links.ravel()
    spread = _of_model(model).combinations[:, links] * std[links]
    gram = sums.gram[..., :-1, :-1].reshape(-1, *spread.shape[:1] * 2)
    expected = np.einsum("pk,jpq,qk->j", spread, gram, spread, optimize=True)
    expected = expected.reshape(sums.samples.shape)
    measured = sums.gram[..., -1, -1]
    both = (expected > 0.0) & (measured > 0.0)
    ratio = np.where(both, measured, 1.0) / np.where(both, expected, 1.0)
    logarithm = np.log(ratio).sum(axis=-1) / np.maximum(1, both.sum(axis=-1))
    return np.asarray(np.exp(0.5 * logarithm))


def _is_placeholder(model: RobotModel, sums: TorqueSums) -> NDArray[np.bool_]:
    """Return whether the nominal bodies say nothing about the arm ([K])."""
    if not _of_model(model).masses:
        return np.ones(sums.samples.shape[:-1], dtype=np.bool_)
    scale, std = _nominal_ratio(model, sums)
    clear = (std < np.abs(scale) / _CLEAR_SIGMAS) | (
        std < 1.0 / (_CLEAR_SIGMAS * _MAX_TORQUE_RATIO)
    )
    return np.asarray(clear & ~((scale > 1.0 / _MAX_TORQUE_RATIO) & (scale < _MAX_TORQUE_RATIO)))


def nominal_ratio(model: RobotModel, factor: Factor) -> tuple[float, float]:
    """Return the ratio of measured to nominal torque over all joints, and its deviation.

    Friction, offsets and rotors are fitted with it. NaN and infinity without nominal torque.
    """
    ratio, std = _nominal_ratio(model, TorqueSums.of(factor))
    return float(ratio), float(std)


def _nominal_ratio(model: RobotModel, sums: TorqueSums) -> tuple[Array, Array]:
    """Return the :func:`nominal_ratio` and its deviation ([K])."""
    gram, samples = sums
    directions = _of_model(model).nominal
    power = gram[..., -1, -1]
    weights = inverse_variance(np.where(power > 0.0, power, np.nan))
    whole = weights[..., None, :] @ gram.reshape(*samples.shape, -1)
    whole = whole.reshape(*samples.shape[:-1], *gram.shape[-2:])
    total = directions.T @ whole @ directions
    squares = np.diagonal(total, axis1=-2, axis2=-1)[..., :-1]
    moving = squares > 0.0
    scale = np.where(moving, np.sqrt(np.maximum(squares, 0.0)), np.inf)
    # The pseudo-inverse, zero for columns of zeros.
    matrix = total[..., :-1, :-1] / (scale[..., :, None] * scale[..., None, :])
    eigenvalues, vectors = np.linalg.eigh(matrix)
    size = np.abs(eigenvalues)
    significant = size > _MIN_EIGENVALUE_RATIO * size.max(axis=-1, keepdims=True)
    inverse = np.where(significant, 1.0 / np.where(significant, eigenvalues, 1.0), 0.0)
    first = vectors[..., 0, :]
    right = (vectors * (total[..., :-1, -1] / scale)[..., None]).sum(axis=-2)
    residual = total[..., -1, -1] - (inverse * right**2).sum(axis=-1)
    rows = _INDEPENDENT_ROW_SHARE * np.maximum(1.0, samples.sum(axis=-1))
    ratio = (first * inverse * right).sum(axis=-1) / scale[..., 0]
    variance = np.maximum(residual, 0.0) / rows * (first**2 * inverse).sum(axis=-1)
    std = np.sqrt(np.maximum(variance, 0.0)) / scale[..., 0]
    determined = moving[..., 0]
    return np.where(determined, ratio, np.nan), np.where(determined, std, np.inf)
