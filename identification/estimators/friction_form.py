r"""Uncertainty of the friction law, and its effect on the covariance of an estimate.

A law that lacks a term is fitted wrongly, alike in every block of time, so that the scatter of
blocks does not show the error of its coefficients. Each joint may have one more term than its law
(:data:`FORMS`), with a column e and a coefficient c:

.. math:: y = W \pi + e\,c + \epsilon, \qquad
          \hat c = e^T w (y - W \hat\pi) / D, \qquad D = e^T w\,(e - W m), \qquad
          m = H^{-1} W^T w\,e

with the information H of the estimate. With the term the parameters would be
:math:`\hat\pi - m c`. Beforehand there is one with probability 1 / 11, any of them equally likely,
of some share of the friction; a posterior probability P follows from the estimate of its
coefficient and the scatter of that over blocks of time (Bayes factor of a Gaussian prior, Kass and
Raftery 1995, section 3). The mean square of the shift, :math:`\sum P\,(\hat c^2 + \sigma_c^2)\,m
m^T`, is added to the covariance: of the law itself if the law is right, and if it is wrong of the
coefficients that the right one would have (model averaging, Hoeting et al. 1999).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import normal_limit
from identification.estimators.covariance import block_length, lag_correlation
from identification.factor.blocks import merged
from identification.factor.columns import friction_factor
from identification.factor.estimate import Estimate, inverse_variance
from identification.factor.factor import Factor
from identification.factor.normal_equations import solve
from identification.model.friction import ASYMMETRIC, QUADRATIC, STRIBECK, FrictionTerm
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

# Speeds over which measured Stribeck friction decays, in steps in which terms of neighbours are
# alike (correlation above 0.9).
_STRIBECK_SPEEDS: Final = (0.02, 0.05, 0.1, 0.2, 0.5)  # rad/s or m/s
FORMS: Final[tuple[FrictionTerm, ...]] = (
    *(replace(STRIBECK, speed=speed) for speed in _STRIBECK_SPEEDS),
    QUADRATIC,
    ASYMMETRIC,
)
"""Terms that a friction law may lack."""
_PRIOR_ODDS: Final = 0.1  # of a term that the law lacks, before the data
# Its standard deviation, over the friction of the joint. Dry friction at rest exceeds that in
# motion by 10 to 100 % (Armstrong-Helouvry et al. 1994).
_STATIC_FRICTION_SHARE: Final = 0.3
# Mean square of a Stribeck column, one at rest, from which on it is no friction at low speed: of a
# joint that is slower it cannot be told from viscous friction.
_MAX_SLOW_MEAN_SQUARE: Final = 0.5
_MIN_INDEPENDENT_SHARE: Final = 1e-3  # share of a column that is none of the others
_MAX_LEVERAGE: Final = 0.9  # leverage of a block whose residual still counts
UNCERTAIN_PROBABILITY: Final = 0.99
"""Probability of a further term from which on a law is uncertain."""


@dataclass(frozen=True, eq=False)
class FormUncertainty:
    """Probability of a term that the friction law of each joint lacks, and what it would change."""

    probability: Array  #: (n,)
    forms: tuple[FrictionTerm, ...]  #: the most probable of each joint (n,)
    #: shifts of the parameters by each term, roots of their mean squares (p, n, q)
    shifts: Array
    #: largest change of a coefficient of the joint's friction, as torque over that friction (n,)
    share: Array

    @property
    def covariance(self) -> Array:
        """Sum of the mean squares of all shifts (p, p)."""
        shifts = self.shifts.reshape(len(self.shifts), -1)
        return np.asarray(shifts @ shifts.T)


class _Trials(NamedTuple):
    """Coefficients of q further terms of each joint (n, q)."""

    value: Array
    std: Array
    freedom: Array  # of the variance
    possible: NDArray[np.bool_]
    moved: Array  # change of the parameters by one of each (p, n, q)
    expected: Array  # standard deviation before the data


def form_factor(model: RobotModel, samples: Samples) -> Factor:
    """Reduce a recording to blocks of [W | F | y] with the columns of :data:`FORMS`."""
    return friction_factor(model, samples, FORMS)


def form_uncertainty(
    model: RobotModel,
    estimate: Estimate,
    factor: Factor,
    forms: Factor,
    precision: Array | None = None,
) -> FormUncertainty:
    """Test whether a friction law lacks a term.

    Args:
        model: of the estimate, p parameters and n joints.
        estimate: with this law.
        factor: of the fitted rows.
        forms: :func:`form_factor` of them, or of some repetitions of the same motion.
        precision: information (p, p) of a prior, in addition to the factor.
    """
    trials = _trials(model, estimate, factor, forms, precision)
    # Student's t, as a normal variable that is exceeded as rarely.
    ratio = np.abs(trials.value) / np.where(trials.std > 0.0, trials.std, np.inf)
    tail = scipy.special.stdtr(np.maximum(trials.freedom, 1.0), -ratio)
    surprise = normal_limit(np.clip(tail, np.finfo(np.float64).tiny, 0.5))
    known = trials.expected**2 / np.maximum(trials.expected**2 + trials.std**2, 1e-300)
    log_factor = 0.5 * (surprise**2 * known + np.log1p(-np.minimum(known, 1.0 - 1e-12)))
    log_factor = np.where(trials.possible, log_factor, -np.inf)
    largest = np.maximum(log_factor.max(axis=1, keepdims=True), 0.0)
    count = np.maximum(trials.possible.sum(axis=1, keepdims=True), 1)
    odds = _PRIOR_ODDS * np.exp(log_factor - largest) / count
    probability = odds / (odds.sum(axis=1, keepdims=True) + np.exp(-largest))
    square = probability * ((known * trials.value) ** 2 + known * trials.std**2)
    shifts = trials.moved * np.sqrt(square)
    return FormUncertainty(
        probability=probability.sum(axis=1),
        forms=tuple(FORMS[k] for k in probability.argmax(axis=1).tolist()),
        shifts=shifts,
        share=_share(model, estimate, forms, np.sqrt((shifts**2).sum(axis=2))),
    )


def _share(model: RobotModel, estimate: Estimate, factor: Factor, shift: Array) -> Array:
    """Return the largest torque of shifts (p, n) of own friction over the friction (n,)."""
    rows = np.maximum(factor.samples, 1)
    columns = np.diagonal(factor.gram, axis1=1, axis2=2) / rows[:, None]
    largest = np.zeros(model.n_joints)
    for k, term in enumerate(model.friction.terms, model.base.rank):
        joint = term.owner
        if term.term.is_friction and not term.motor:
            largest[joint] = max(largest[joint], np.sqrt(columns[joint, k]) * shift[k, joint])
    friction = _friction_rms(model, estimate, factor)
    return np.asarray(largest / np.where(friction > 0.0, friction, np.inf))


def _trials(
    model: RobotModel, estimate: Estimate, factor: Factor, forms: Factor, precision: Array | None
) -> _Trials:
    """Fit the coefficient of each further term together with the parameters."""
    n = model.n_joints
    p = model.n_parameters
    q = len(FORMS)
    weights = inverse_variance(estimate.noise_std**2)
    # Repetitions that are not in `forms` have the same columns.
    times = factor.samples.sum() / max(1, int(forms.samples.sum()))
    forms = forms.occupied()
    gram = forms.weighted_gram(weights)
    equations = factor.weighted(weights)
    if precision is not None:
        equations = equations._replace(A=equations.A + precision)
    products = gram[:p, p:-1]
    determined = np.isfinite(np.diag(estimate.covariance))
    moved = np.where(determined[:, None], times * solve(equations).inverse @ products, 0.0)
    squares = gram.diagonal()[p:-1]
    information = squares - np.einsum("pk,pk->k", products, moved)
    possible = (squares > 0.0) & (information > _MIN_INDEPENDENT_SHARE * squares)
    # What remains of each further term after the parameters.
    beside = np.concatenate([-moved, np.eye(n * q)])
    scores = forms.scores(weights, np.append(estimate.values, np.zeros(n * q)))
    # Rows of some repetitions alone need not balance at the parameters of all, as when friction
    # drifts: what their parameters pull is no term of friction.
    excess = scores[:, :p].sum(axis=0) - factor.scores(weights, estimate.values).sum(axis=0) / times
    pull = scores[:, p:].sum(axis=0) - moved.T @ excess
    value = pull / np.where(possible, information, np.inf)
    shares = np.zeros((len(forms), n * q))
    for weight, matrix, used in zip(weights, forms.matrices, forms.columns, strict=True):
        part = beside[used]
        shares += weight * np.einsum("ck,bck->bk", part, matrix[:, :-1, :-1] @ part)
    left = np.where(possible, scores @ beside - shares * value, 0.0)
    length = block_length(left)
    left = merged(left, length)
    shares = merged(shares, length)
    leverage = shares / np.where(possible, np.maximum(shares.sum(axis=0), 1e-300), 1.0)
    left /= np.maximum(1.0 - leverage, 1.0 - _MAX_LEVERAGE)
    correlation = np.array([lag_correlation(left[:, [k]]) for k in range(n * q)])
    variance = (left**2).sum(axis=0) * (1.0 + 2.0 * np.maximum(correlation, 0.0))
    std = np.sqrt(variance) / np.where(possible, information, np.inf)
    freedom = 1.0 / np.maximum((leverage**2).sum(axis=0), 1.0 / max(2, len(left))) - 1.0
    rms = np.sqrt(
        np.diagonal(forms.gram, axis1=1, axis2=2)[:, p:-1].sum(axis=0)
        / np.repeat(np.maximum(forms.samples, 1), q)
    ).reshape(n, q)
    slow = np.array([term.symbol == STRIBECK.symbol for term in FORMS])
    scale = np.where(slow, 1.0, np.where(rms > 0.0, rms, np.inf))
    return _Trials(
        value=value.reshape(n, q),
        std=std.reshape(n, q),
        freedom=freedom.reshape(n, q),
        possible=possible.reshape(n, q) & ~(slow & (rms**2 > _MAX_SLOW_MEAN_SQUARE)),
        moved=moved.reshape(p, n, q),
        expected=_STATIC_FRICTION_SHARE * _friction_rms(model, estimate, forms)[:, None] / scale,
    )


def _friction_rms(model: RobotModel, estimate: Estimate, factor: Factor) -> Array:
    """Return the RMS torque of each joint's friction (n,)."""
    p = model.n_parameters
    friction = np.where(model.friction_columns, estimate.values, 0.0)
    squares = np.einsum("p,npq,q->n", friction, factor.gram[:, :p, :p], friction)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0) / np.maximum(factor.samples, 1)))


def with_uncertain_form(estimate: Estimate, uncertainty: FormUncertainty) -> Estimate:
    """Return the estimate, its covariance widened by the mean square of these shifts."""
    return replace(
        estimate,
        covariance=estimate.covariance + uncertainty.covariance,
        method=estimate.method.widened("friction_form"),
    )
