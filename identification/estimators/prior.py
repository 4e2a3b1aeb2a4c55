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

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.estimators.covariance import block_covariance
from identification.factor.estimate import (
    Estimate,
    estimate_of,
    inverse_variance,
    joint_weights,
    mark_undetermined,
)
from identification.factor.factor import Factor, require_rows
from identification.factor.normal_equations import Solution, solve_positive, solve_rows
from identification.model.nominal_masses import without_masses
from identification.model.robot import RobotModel

# Posterior over prior standard deviation of a parameter that is determined by the data, which then
# gave three quarters of its information (inverse variance).
LEARNED: Final = 0.5
_WORST_CONDITION: Final = 1e13  # A weak prior still determines what the data leave open

BODY_SHARE: Final = 0.3
"""Relative standard deviation of a body's mass, of its first moment in units of mass times length
and of its inertia in units of mass times length squared. Makers' descriptions leave out motors,
gears, cables and covers, or smear them over the links; on nine real arms 0.2 to 0.5 predict alike
(``benchmarks.leave_one_out``)."""
NOMINAL_SHARE: Final = 0.1
"""Relative standard deviation of the torque of nominal inertias, which errors of single bodies
partly cancel in. CAD lacks cables, grease and fasteners; assumed."""
# Smallest length of a body, as a share of the mean distance of joints: a wrist's links have next to
# no distance, but a size.
_SMALLEST_BODY: Final = 0.25
# A body that the description does not know, for the ratios between bodies; their common scale is
# that of the torque.
_UNKNOWN_MASS: Final = 1.0  # kg
# Ratio of measured to nominal torque from which on the masses of a description have no relation to
# the torque.
_NO_RELATION: Final = 3.0
_CLEAR: Final = 3.0  # standard deviations of that ratio
_INDEPENDENT: Final = 0.01  # share of the rows for that deviation
_ROUNDS: Final = 20  # of the noise of the joints
_SETTLED: Final = 1e-3  # relative change of the noise
# Of the scatter of its torque, that a term of friction alone makes. Coulomb and viscous friction
# together are the torque of a light wrist, and a fifth of that of a heavy arm.
_FRICTION_SHARE: Final = 0.5
OFFSET_SHARE: Final = 0.4
"""Deviation of an offset over that of Coulomb friction of a joint that moves one way. Both are one
column then, and what opposes its motion is friction rather than an offset. In recordings of six
arms of the board the median ratio of the two is 0.31, which is that of a Gaussian of 0.46; from 0.2
to 0.5 the errors of these recordings differ by 0.2 % at most, at 1.0 one is 1.4 % larger
(``benchmarks.leave_one_out``)."""
# RMS of motions that excite an arm: 0.2 to 4.5 rad/s in the recordings of six arms of the board,
# half of the joints above 0.45; at a base frequency of 0.1 to 0.2 Hz the acceleration is as large.
USUAL_SPEED: Final = 0.5  # rad/s or m/s
_STANDS: Final = 0.02  # share of it below which a joint shows the noise of its velocity
_USUAL_ACCELERATION: Final = 0.5  # rad/s² or m/s²
_SPEEDS: Final = 20  # up to the usual one
LOAD_SHARE: Final = 0.1
"""Deviation of the share of the transmitted torque that becomes friction: strain-wave gears lose
some 2 to 15 % (Bittencourt and Gunnarsson 2012)."""
_FEWEST_ROWS: Final = 2  # per parameter, to estimate the noise
_INERTIA = slice(0, 6)
_MOMENT = slice(6, 9)
_MASS = 9


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """Gaussian prior: ``root @ (pi - mean)`` is standard normal."""

    mean: Array  #: (p,)
    root: Array  #: (k, p); flat in directions without information
    origin: str
    #: what is believed, if this prior is a stronger one; None: this one
    believed: GaussianPrior | None = None

    @classmethod
    def of_combinations(
        cls, combinations: Array, mean: Array, std: Array, origin: str = "given"
    ) -> GaussianPrior:
        """Return the prior on ``combinations @ s`` of independent s with mean and std (s,).

        An infinite standard deviation makes the direction on which its quantity acts flat. With the
        identity (p, s) and mean zero this is ridge regression in units of `std`.
        """
        flat = np.isinf(std)
        spread = combinations[:, ~flat] * std[~flat]
        size = _length(spread, axis=1)
        seen = _null_space(combinations[:, flat] / size[:, None])
        seen_spread = seen.T @ (spread / size[:, None])
        covariance = seen_spread @ seen_spread.T
        scale = np.sqrt(np.diag(covariance))
        lower = np.linalg.cholesky(covariance / np.outer(scale, scale))
        root = scipy.linalg.solve_triangular(lower, seen.T / scale[:, None], lower=True) / size
        return cls(combinations @ mean, np.asarray(root), origin)

    @cached_property
    def information(self) -> Array:
        """Inverse of the covariance (p, p), zero in flat directions."""
        return np.asarray(self.root.T @ self.root)

    @cached_property
    def std(self) -> Array:
        """Standard deviations (p,) of what is believed, infinite where it is flat."""
        believed = self.believed or self
        solution = solve_rows(believed.root, np.zeros(len(believed.root)), _WORST_CONDITION)
        covariance = solution.inverse
        mark_undetermined(covariance, solution.determined)
        return np.sqrt(np.diag(covariance))


@dataclass(frozen=True, eq=False)
class BodyPrior:
    """Independent Gaussian priors of bodies, rotors, friction, springs and balancers."""

    mean: Array  #: of the standard parameters (s,), then of friction and elements (k,)
    std: Array  #: likewise; infinite where nothing is known
    combinations: Array  #: ``pi = combinations @ [standard; others]``, (p, s + k)
    origin: str
    bodies: NDArray[np.intp]  #: where the standard parameters of the links are
    #: whether the description has no masses, or masses without relation to the torque
    placeholder: bool = False
    believed: BodyPrior | None = None  #: what is believed, if this prior is a stronger one

    @property
    def belief(self) -> BodyPrior:
        """What is believed: this prior, or that of which it is a stronger one."""
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
        origin = f"{self.origin}, which weigh {weight:g} times"
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
    origin: str  #: of the prior
    design_effect: float  #: rows of data that count as one
    shift: Array  #: way of the parameters (p,) from those by what is believed
    scatter: str = ""  #: how the scatter of the data entered the covariance

    @property
    def ratio(self) -> Array:
        """Posterior over prior standard deviation (p,), 1: all from the prior; without prior 0."""
        flat = np.isinf(self.prior_std)
        ratio = self.estimate.std / np.where(flat, 1.0, self.prior_std)
        return np.where(flat, np.isinf(self.estimate.std).astype(np.float64), ratio)

    @property
    def learned(self) -> NDArray[np.bool_]:
        """Whether each parameter is determined by the data (p,): ratio below `LEARNED`."""
        return np.asarray(self.ratio < LEARNED)

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

    The weights are the inverse variances of the joints' own residuals, iterated from `start` (n,)
    if given.
    """
    gram = factor.gram
    rows = np.maximum(factor.samples, 1)
    variance = gram[:, -1, -1] / rows
    floor = factor.smallest_noise**2 * variance + np.finfo(np.float64).tiny
    precision = design_effect * prior.information
    least = np.maximum(precision.diagonal(), np.finfo(np.float64).tiny)
    values = prior.mean
    weights = np.zeros(factor.n_joints)
    if start is not None:
        variance = np.where(start > 0.0, 1.0 / np.where(start > 0.0, start, 1.0), variance)
    for _ in range(_ROUNDS):
        weights = np.where(factor.samples > 0, 1.0 / np.maximum(variance, floor), 0.0)
        equations = factor.weighted(weights)
        scale = np.sqrt(equations.A.diagonal() + least)
        values = (
            prior.mean
            + solve_positive(
                (equations.A + precision) / (scale[:, None] * scale),
                (equations.b - equations.A @ prior.mean) / scale,
            )
            / scale
        )
        before = variance
        variance = factor.squared_errors(values) / rows
        if np.all(np.abs(variance - before) <= _SETTLED * before):
            break
    return values, weights


def with_prior(
    model: RobotModel,
    factor: Factor,
    prior: GaussianPrior,
    weights: Array | None = None,
    *,
    design_effect: float = 1.0,
) -> PosteriorEstimate:
    """Estimate from data and prior with white residuals; a flat prior gives least squares.

    Weights (n,) are by default those of an ordinary fit without prior. The information of the data
    is divided by `design_effect`.

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
        _WORST_CONDITION,
    )
    solution = posterior._replace(
        values=prior.mean + posterior.values,
        condition=solve_rows(rows, target).condition if len(rows) else np.inf,
    )
    method = f"weighted least squares with a Gaussian prior ({prior.origin}), posterior covariance"
    if design_effect > 1.0:
        method += f", design effect {design_effect:.3g}"
    estimate = estimate_of(model.units, factor, solution, weights / design_effect, method)
    return PosteriorEstimate(
        estimate, prior.mean, prior.std, prior.origin, design_effect, np.zeros_like(prior.mean)
    )


def fit_posterior(
    model: RobotModel, factor: Factor, prior: GaussianPrior, design_effect: float | None = None
) -> PosteriorEstimate:
    """Estimate from a factor by time and a prior, with coloured residuals.

    `design_effect` rows count as one, by default as many as :func:`design_effect_of` says. The
    covariance has the scatter of the data, cluster-robust, and the prior's of what they leave open.
    That of a stronger prior is the mean square error by what is believed: the covariance of the
    believed posterior, and the square of the way from its mean.

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
        estimate = replace(
            base.estimate,
            values=values,
            covariance=base.estimate.covariance + np.outer(shift, shift),
            noise_std=factor.residual_rms(values),
            method=posterior_method(prior.origin, design_effect, base.scatter),
        )
        return replace(base, estimate=estimate, origin=prior.origin, shift=shift)
    spread = block_covariance(factor, weights, values, prior.information, design_effect)
    alone = factor.solve(weights)
    solution = Solution(values, spread.root, alone.condition, alone.determined)
    scatter = spread.description
    method = posterior_method(prior.origin, design_effect, scatter)
    estimate = estimate_of(model.units, factor, solution, weights, method)
    estimate = replace(
        estimate, covariance=spread.covariance, interval_factor=spread.interval_factor
    )
    unmoved = np.zeros_like(prior.mean)
    return PosteriorEstimate(
        estimate, prior.mean, prior.std, prior.origin, design_effect, unmoved, scatter
    )


def posterior_method(origin: str, design_effect: float, scatter: str) -> str:
    """Return the description of an estimate from a prior; `scatter` is that of its covariance."""
    return f"posterior of the prior ({origin}), {design_effect:.3g} rows count as one; {scatter}"


@dataclass(frozen=True, eq=False)
class ScoreScatter:
    """Cluster-robust scatter of the scores of a factor by time, for estimates from its sum."""

    rows: Array  #: (k, p), ``rows' rows`` is the covariance of the sum of the scores
    interval_factor: float  #: standard deviations in half a 95 % interval
    description: str  #: of the covariance

    @classmethod
    def of(cls, factor: Factor, prior: GaussianPrior) -> ScoreScatter:
        """Return the scatter at the posterior of a prior, each row of data counted as one."""
        values, weights = posterior_values(factor, prior)
        spread = block_covariance(factor, weights, values, prior.information)
        size = _length(spread.root, axis=1)
        of_parameters = np.linalg.pinv(spread.root / size[:, None]) / size
        # Not all blocks, of which there may be very many, but rows of the same products.
        triangle = np.linalg.qr(spread.scores, mode="r")
        return cls(triangle @ of_parameters, spread.interval_factor, spread.description)

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
    if 0 < rows < _FEWEST_ROWS * factor.n_parameters:
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
    share: float = BODY_SHARE,
    stated: Mapping[str, tuple[float, float]] | None = None,
    *,
    wide_rotors: bool = False,
) -> BodyPrior:
    """Return the prior of an arm; its scale without masses, and of friction, is the torque's.

    Bodies: the nominal ones with a deviation of `share` of the mass, times the body's length, times
    its square. Without masses in the description, or with masses that have no relation to the
    torque of the factor: zero with bodies that could make all of the torque. Rotors: zero, with the
    inertia of the links outboard or, if larger, what makes half of the torque's scatter. Friction
    and elements: zero, with a coefficient that makes half of it; offsets less of a joint that moves
    one way (`OFFSET_SHARE`). `stated` replaces mean and standard deviation by name:
    ``{"I3m": (1.2, 0.2), "f0_1": (40.0, 40.0)}``.
    """
    layout = model.layout
    b = model.base.rank
    others = model.parameter_names[b:]
    names = layout.names + others
    combinations = np.zeros((model.n_parameters, len(names)))
    combinations[:b, : layout.size] = model.base.grouping
    combinations[b:, layout.size :] = np.eye(len(others))
    mean = np.zeros(len(names))
    std = np.zeros(len(names))
    whole_torque = _torque_over_columns(model, factor)
    std[layout.size :] = _friction_deviations(model, factor, whole_torque[b:])
    reason = _placeholder(model, factor)
    length = body_lengths(model)
    masses = np.full(model.n_joints, _UNKNOWN_MASS)
    if not reason:
        mean[: layout.size] = model.nominal
        masses = model.nominal[layout.links][:, _MASS]
        masses = np.where(masses > 0.0, masses, np.median(masses[masses > 0.0]))
    else:
        share = 1.0
    std[layout.links] = _body_deviations(share * masses, length)
    std[layout.rotors] = _outboard_inertia(model, masses, length)
    origin = f"nominal bodies to {100.0 * share:g} %"
    if reason:
        std[: layout.size] *= _torque_scale(model, factor, combinations[:, : layout.size], std)
        origin = f"bodies of the size of the torque, as {reason}"
    # Motors of a wrist are heavier, seen through their gears, than what they move.
    widened = layout.rotors if wide_rotors else np.intersect1d(layout.rotors, model.base.pivots)
    std[widened] = np.maximum(std[widened], _rotor_torque(model, factor, widened))
    pairs = [np.sqrt(std[layout.rotors][i] * std[layout.rotors][j]) for i, j in layout.pairs]
    std[layout.couplings] = pairs
    for name, (value, spread) in (stated or {}).items():
        mean[names.index(name)] = value
        std[names.index(name)] = spread
    if stated:
        origin += f", {len(stated)} given"
    bodies = layout.links.ravel()
    return BodyPrior(mean, std, combinations, origin, bodies, bool(reason))


def nominal_deviations(model: RobotModel, share: float = BODY_SHARE) -> Array:
    """Return deviations of the nominal bodies as inertial parameters (rank, 10 n), one each."""
    links = model.layout.links
    std = _body_deviations(share * model.nominal[links][:, _MASS], body_lengths(model))
    return np.asarray(model.base.grouping[:, links.ravel()] * std.ravel())


def _friction_deviations(model: RobotModel, factor: Factor, whole_torque: Array) -> Array:
    """Return those of friction and elements (k,), of the coefficients that each may have alone."""
    std = whole_torque.copy()
    one_way = _one_way(model, factor)
    for k, term in enumerate(model.friction.terms):
        if term.term.of_load:
            std[k] = LOAD_SHARE
        elif term.symbol == "fo":
            std[k] *= 1.0 - (1.0 - OFFSET_SHARE) * one_way[term.owner]
    return std


def _one_way(model: RobotModel, factor: Factor) -> Array:
    """Return how far Coulomb friction and offset of each joint are one column (n,), 0 to 1.

    Zero for a joint that stands, whose offset holds its torque, and without these three terms.
    """
    columns = dict[int, dict[str, int]]()
    for k, term in enumerate(model.friction.terms, model.base.rank):
        columns.setdefault(term.owner, {})[term.symbol] = k
    gram = factor.gram.sum(axis=0)
    alike = np.zeros(model.n_joints)
    for joint, column in columns.items():
        if not column.keys() >= {"f0", "f1", "fo"}:
            continue
        dry, viscous, offset = (column[symbol] for symbol in ("f0", "f1", "fo"))
        speed = np.sqrt(gram[viscous, viscous] / max(1.0, gram[offset, offset]))
        if speed > _STANDS * USUAL_SPEED:
            product = np.sqrt(gram[dry, dry] * gram[offset, offset])
            alike[joint] = abs(gram[dry, offset]) / product
    return alike


def _body_deviations(mass: Array, length: Array) -> Array:
    """Return those of inertia, moment and mass (n, 10) of deviating masses of these lengths."""
    sizes = np.column_stack([mass * length**2, mass * length, mass])
    return np.repeat(sizes, [6, 3, 1], axis=1)


def body_lengths(model: RobotModel) -> Array:
    """Return a length of each body (n,) [m]: to its centre, its next joint, or its gyration."""
    inertial = model.nominal[model.layout.links]
    mass = inertial[:, _MASS]
    divisor = np.where(mass > 0.0, mass, np.inf)
    centre = np.linalg.norm(inertial[:, _MOMENT], axis=1) / divisor
    second_moment = 0.5 * inertial[:, [0, 3, 5]].sum(axis=1)
    gyration = np.sqrt(np.maximum(second_moment, 0.0) / divisor)
    distance = np.linalg.norm(model.chain.translation[1:], axis=1)
    usual = float(distance.mean()) if len(distance) else 0.0
    smallest = _SMALLEST_BODY * usual or _SMALLEST_BODY
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


def _torque_over_columns(model: RobotModel, factor: Factor) -> Array:
    """Return the coefficient (p,) with which a column alone makes its joints' torque vary so.

    A motion slower than usual does not allow more: what it hardly shows would be huge in a faster
    one. A joint without an offset is taken to vary about zero.
    """
    power = (_FRICTION_SHARE * torque_scatter(model, factor)) ** 2 * factor.samples
    columns = np.diagonal(factor.gram, axis1=1, axis2=2)[:, :-1]
    acting = columns > 0.0
    whole = np.where(acting, power[:, None], 0.0).sum(axis=0)
    rows = np.where(acting, factor.samples[:, None], 0).sum(axis=0)
    squares = np.maximum(columns.sum(axis=0), rows * _usual_columns(model) ** 2)
    size = np.sqrt(whole / np.where(squares > 0.0, squares, 1.0))
    # Without a row that shows it, a coefficient of the size of the torque.
    rms = np.sqrt(power.sum() / max(1, int(factor.samples.sum()))) or 1.0
    return np.asarray(np.where(size > 0.0, size, rms))


def _rotor_torque(model: RobotModel, factor: Factor, rotors: NDArray[np.intp]) -> Array:
    """Return inertias of rotors (k,) that alone make half of the scatter of their joint's torque.

    A slow motion does not allow more, as for friction.
    """
    joints = np.flatnonzero(np.isin(model.layout.rotors, rotors))
    columns = model.base.grouping[:, rotors]
    squares = np.zeros(len(rotors))
    for k, joint in enumerate(joints):
        gram = factor.gram[joint, : model.base.rank, : model.base.rank]
        squares[k] = columns[:, k] @ gram @ columns[:, k]
    rows = np.maximum(factor.samples[joints], 1)
    squares = np.maximum(squares, rows * _USUAL_ACCELERATION**2)
    power = (_FRICTION_SHARE * torque_scatter(model, factor)[joints]) ** 2 * rows
    return np.asarray(np.sqrt(power / squares))


def _usual_columns(model: RobotModel) -> Array:
    """Return columns (p,) of friction, offsets and rotors at the usual speed and acceleration.

    Zero for other parameters.
    """
    usual = np.zeros(model.n_parameters)
    speeds = np.linspace(0.0, USUAL_SPEED, _SPEEDS)
    for k, term in enumerate(model.friction.terms, model.base.rank):
        usual[k] = np.abs(term.term.column(speeds, np.ones(_SPEEDS))).max()
    rotors = np.isin(model.base.pivots, model.layout.rotors)
    usual[: model.base.rank][rotors] = _USUAL_ACCELERATION
    return usual


def torque_scatter(model: RobotModel, factor: Factor) -> Array:
    """Return the standard deviation of each joint's torque (n,), its RMS without an offset."""
    rows = np.maximum(factor.samples, 1)
    mean = np.zeros(model.n_joints)
    for k, term in enumerate(model.friction.terms, model.base.rank):
        if term.symbol == "fo" and not term.motor:
            mean[term.owner] = factor.gram[term.owner, k, -1] / rows[term.owner]
    return np.sqrt(np.maximum(factor.gram[:, -1, -1] / rows - mean**2, 0.0))


def _torque_scale(model: RobotModel, factor: Factor, combinations: Array, std: Array) -> float:
    """Return the factor at which bodies of these deviations make a torque of the measured size.

    Geometric mean over the joints, which gears and mechanisms make differ.
    """
    links = model.layout.links.ravel()
    spread = combinations[:, links] * std[links]
    expected = np.einsum("pk,jpq,qk->j", spread, factor.gram[:, :-1, :-1], spread, optimize=True)
    measured = factor.gram[:, -1, -1]
    both = (expected > 0.0) & (measured > 0.0)
    if not both.any():
        return 1.0
    return float(np.exp(0.5 * np.mean(np.log(measured[both] / expected[both]))))


def _placeholder(model: RobotModel, factor: Factor) -> str:
    """Return why the nominal bodies say nothing about the arm, or nothing."""
    if reason := without_masses(model):
        return reason
    scale, std = nominal_ratio(model, factor)
    clear = std < abs(scale) / _CLEAR or std < 1.0 / (_CLEAR * _NO_RELATION)
    if clear and not 1.0 / _NO_RELATION < scale < _NO_RELATION:
        return f"the torque is {scale:.2g} times that of the bodies of the description"
    return ""


def nominal_ratio(model: RobotModel, factor: Factor) -> tuple[float, float]:
    """Return the ratio of measured to nominal torque over all joints, and its deviation.

    Friction, offsets and rotors are fitted beside it. NaN and infinity without nominal torque.
    """
    b = model.base.rank
    nominal = model.base.grouping @ model.nominal
    rotors = model.base.grouping[:, model.layout.rotors]
    size = 1 + rotors.shape[1] + model.n_parameters - b
    directions = np.zeros((model.n_parameters + 1, size + 1))
    directions[:b, 0] = nominal
    directions[:b, 1 : 1 + rotors.shape[1]] = rotors
    directions[b:-1, 1 + rotors.shape[1] : -1] = np.eye(model.n_parameters - b)
    directions[-1, -1] = 1.0
    power = factor.gram[:, -1, -1]
    weights = inverse_variance(np.where(power > 0.0, power, np.nan))
    total = directions.T @ factor.weighted_gram(weights) @ directions
    moving = np.diag(total)[:-1] > 0.0
    if not moving[0]:
        return np.nan, np.inf
    used = np.flatnonzero(moving)
    scale = np.sqrt(np.diag(total)[used])
    matrix = total[np.ix_(used, used)] / np.outer(scale, scale)
    inverse = np.linalg.pinv(matrix, rcond=1e-12, hermitian=True)
    ratio = float(inverse[0] @ (total[used, -1] / scale) / scale[0])
    left = total[-1, -1] - (total[used, -1] / scale) @ inverse @ (total[used, -1] / scale)
    rows = _INDEPENDENT * max(1.0, float(factor.samples.sum()))
    return ratio, float(np.sqrt(max(left, 0.0) / rows * inverse[0, 0]) / scale[0])
