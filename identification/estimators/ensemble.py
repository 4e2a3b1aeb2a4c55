r"""Physically consistent arms drawn from the posterior of the parameters.

A draw :math:`\pi \sim N(\hat\pi, C)` of the base parameters, friction and elements is completed to
bodies by the conditional distribution of the prior (Matheron's rule), which leaves the torque as
drawn,

.. math:: x = x_0 + S A^T (A S A^T)^{-1} (\pi - A x_0), \qquad x_0 \sim N(\mu, S)

with parameters :math:`A x`. A draw that no arm can have is moved to the nearest that can be built,
by the precision of the posterior (Everink, Dong and Andersen, Bayesian inference with projected
densities, 2023).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.estimators.consistent import Program, is_consistent, without_rounding
from identification.estimators.prior import BodyPrior
from identification.factor.estimate import Estimate
from identification.factor.factor import Factor
from identification.factor.normal_equations import or_one
from identification.model.robot import RobotModel

MIN_ARMS = 10
"""Number of arms from which a spread is estimated."""
# deviations of a quantity without prior, in the largest deviation of the others
_UNKNOWN_STD_FACTOR = 1e3
_MIN_EIGENVALUE = 1e-14  # eigenvalue of a correlation matrix
_RANK_TOLERANCE = 1e-12  # smallest singular value that counts, relative to the largest
_WIDENING_ROUNDS = 6  # of widening
_SPREAD_TOLERANCE = 0.01
_MAX_WIDENING = 5.0  # factor of the deviations


class UndeterminedError(IdentificationError):
    """The covariance of the parameters is not finite."""


@dataclass(frozen=True, eq=False)
class Ensemble:
    """N physically consistent arms."""

    standard: Array  #: standard parameters (N, s)
    values: Array  #: the corresponding parameters (N, p)
    moved: NDArray[np.bool_]  #: whether the draw was moved to the nearest consistent arm (N,)
    #: root mean square of the spread of the predicted torque of each joint (n,), over that of the
    #: covariance of the estimate; NaN for a joint without rows
    spread: Array
    widened: float  #: factor of the deviations of the draws

    def __len__(self) -> int:
        return len(self.standard)


def draw_ensemble(
    model: RobotModel,
    prior: BodyPrior,
    estimate: Estimate,
    factor: Factor,
    count: int,
    seed: int,
) -> Ensemble:
    """Draw arms from the posterior with mean and covariance of an estimate.

    The nearest consistent arms of draws vary less than the draws. So these are widened until the
    torque of the arms, on the motion of the factor, varies as the covariance says.

    Args:
        model: of the arm.
        prior: of the bodies.
        estimate: mean and covariance.
        factor: of the data.
        count: of the arms.
        seed: of the random numbers.

    Raises:
        UndeterminedError: the covariance is not finite.
        SolverError: no consistent arm was found for a draw.
    """
    if not np.isfinite(estimate.covariance).all():
        names = ", ".join(estimate.undetermined) or "some parameters"
        raise UndeterminedError(f"the uncertainty of {names} is not known")
    draws = _Draws(model, prior, estimate, np.random.default_rng(seed), count)
    scale = 1.0
    ensemble = draws.consistent(factor, 1.0)
    for _ in range(_WIDENING_ROUNDS):
        ratio = float(np.sqrt(np.nanmean(ensemble.spread**2)))
        if count < MIN_ARMS or abs(ratio - 1.0) < _SPREAD_TOLERANCE:
            break
        scale = min(scale / ratio, _MAX_WIDENING)
        ensemble = draws.consistent(factor, scale)
    return ensemble


class _Draws:
    """The same N standard normal draws, at any scale of their deviations."""

    def __init__(
        self,
        model: RobotModel,
        prior: BodyPrior,
        estimate: Estimate,
        random: np.random.Generator,
        count: int,
    ) -> None:
        self.model = model
        self.prior = prior
        self.estimate = estimate
        self._deviations = _finite_deviations(prior.std)
        root, self._inverse_root = _roots(estimate.covariance)
        self._change = _balanced(random.standard_normal((count, len(root)))) @ root.T
        self._start = random.standard_normal((count, len(prior.std))) * self._deviations

    def consistent(self, factor: Factor, scale: float) -> Ensemble:
        """Return the nearest consistent arms of the draws."""
        model = self.model
        combinations = self.prior.combinations
        combined = combinations * self._deviations
        length = np.linalg.norm(combined, axis=1)
        pull = np.linalg.pinv(combined / length[:, None], rcond=_RANK_TOLERANCE)
        start = self.prior.mean + self._start
        change = self.estimate.values + scale * self._change - start @ combinations.T
        arms = start + (change / length @ pull.T) * self._deviations
        unseen = _not_combined(combined / length[:, None]) / or_one(self._deviations)
        rows = np.concatenate([self._inverse_root @ combinations, unseen])
        program = Program.of(model, self.prior)
        moved = np.zeros(len(arms), dtype=np.bool_)
        for k, arm in enumerate(arms):
            if not is_consistent(model, arm):
                moved[k] = True
                arms[k] = without_rounding(model, program.solve(rows, rows @ arm))
        values = arms @ combinations.T
        spread = _spread(factor, values, self.estimate.covariance)
        return Ensemble(arms[:, : model.layout.size], values, moved, spread, scale)


def _spread(factor: Factor, values: Array, covariance: Array) -> Array:
    """Return the spread of each joint's torque (n,) over the spread of a covariance (p, p)."""
    change = values - values.mean(axis=0)
    grams = factor.gram[:, :-1, :-1]
    scatter = np.einsum("ka,jab,kb->j", change, grams, change) / max(len(values) - 1, 1)
    stated = np.einsum("jab,ab->j", grams, covariance)
    return np.where(stated > 0.0, np.sqrt(scatter / np.where(stated > 0.0, stated, 1.0)), np.nan)


def _balanced(normal: Array) -> Array:
    """Return standard normal draws (N, p) with the mean zero and each variance one."""
    if len(normal) < MIN_ARMS:
        return normal
    return np.asarray((normal - normal.mean(axis=0)) / normal.std(axis=0, ddof=1))


def _finite_deviations(std: Array) -> Array:
    finite = np.isfinite(std)
    return np.where(finite, std, _UNKNOWN_STD_FACTOR * np.max(std, initial=1.0, where=finite))


def _roots(covariance: Array) -> tuple[Array, Array]:
    """Return R (p, p) with R R' the covariance, and its inverse."""
    scale = or_one(np.sqrt(np.diag(covariance)))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    size = np.sqrt(np.maximum(values, _MIN_EIGENVALUE))
    return scale[:, None] * vectors * size, (vectors / size).T / scale


def _not_combined(combined: Array) -> Array:
    """Return an orthonormal basis (k, s) of the directions that no row (p, s) has."""
    _, singular, right = np.linalg.svd(combined)
    rank = int(np.count_nonzero(singular > _RANK_TOLERANCE * singular.max()))
    return np.asarray(right[rank:])
