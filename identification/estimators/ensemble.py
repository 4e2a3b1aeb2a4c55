r"""Variants of a physically consistent estimate, as far apart as its covariance says.

Least squares knows the parameters up to :math:`\delta \sim N(0, C)`. Each draw is carried to the
standard parameters by the smallest change of the consistent ones that makes it,

.. math:: \Delta\pi_s = H^{-1} G^T (G H^{-1} G^T)^{-1} \delta

with the grouping G and the Hessian H of :math:`-\log\det` of the pseudo-inertias and of the rotors'
inertia matrix, which measures a change by what a body has, the same in all frames and units. What
the data say nothing about stays where it is. The draws are those of the normal distribution on the
side of the boundary where machines are possible, by elliptical slice sampling (Murray, Adams and
MacKay 2010); a coefficient of friction that may not be negative is reflected at zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.consistent import ConsistentEstimate
from identification.model.friction import dissipation
from identification.model.pseudo_inertia import margin, pseudo_inertia, pseudo_inertia_map
from identification.model.robot import RobotModel

Array = NDArray[np.float64]

MOST: Final = 10_000
"""Variants; more would fill memories before they say more."""
# Steps of the sampler between two variants: where nothing is cut off, two leave no correlation.
_STEPS: Final = 20
# Of the consistent estimate's smallest eigenvalues: nearer to the edge, rounding decides.
_CLEAR: Final = 1e-3
# Of the largest rotor.
_ROUNDING: Final = 1e-12


@dataclass(frozen=True, eq=False)
class Ensemble:
    """N variants of an arm.

    Attributes:
        standard: standard parameters (N, s), every body and every rotor possible.
        values: the parameters (N, p) that follow from them, with friction, springs and balancers.
    """

    standard: Array
    values: Array


def sample_ensemble(
    model: RobotModel, consistent: ConsistentEstimate, covariance: Array, count: int, seed: int
) -> Ensemble:
    """Draw variants around a consistent estimate.

    Args:
        model: the robot.
        consistent: the estimate.
        covariance: of the parameters (p, p); one of infinite variance stays as it is.
        count: number N of variants.
        seed: of the draws; the same one gives the same variants.

    Raises:
        IdentificationError: the count is not between 1 and `MOST`.
    """
    if not 1 <= count <= MOST:
        raise IdentificationError(f"{count} variants were asked for; ask for 1 to {MOST}")
    centre, values = consistent.standard, consistent.estimate.values
    root = _root(covariance)
    lift = _lift(model, centre) @ root[: model.base.rank]
    possible = _possible(model, centre)
    random = np.random.default_rng(seed)
    state = np.zeros(root.shape[1])
    standard, variants = [], []
    for _ in range(count):
        for _ in range(_STEPS):
            state = _next_state(state, random, lambda x: possible(centre + lift @ x))
        standard.append(centre + lift @ state)
        variants.append(values + root @ state)
    found, rest = np.array(standard), np.array(variants)[:, model.base.rank :]
    friction = len(model.friction.terms)
    rest[:, :friction] = _dissipating(model, rest[:, :friction])
    return Ensemble(found, np.hstack([found @ model.base.grouping.T, rest]))


def _possible(model: RobotModel, centre: Array) -> Callable[[Array], bool]:
    """Return what says whether standard parameters (s,) are those of a machine."""
    layout = model.layout
    least = _CLEAR * margin(centre[layout.links])
    rounding = -_ROUNDING * float(np.abs(layout.rotor_matrix(centre)).max(initial=0.0))

    def possible(standard: Array) -> bool:
        bodies = np.all(margin(standard[layout.links]) > least)
        return bool(bodies and np.linalg.eigvalsh(layout.rotor_matrix(standard))[0] >= rounding)

    return possible


def _next_state(
    state: Array, random: np.random.Generator, inside: Callable[[Array], bool]
) -> Array:
    """Return the next state (d,) of a standard normal distribution that is cut off."""
    other = random.standard_normal(len(state))
    angle = random.uniform(0.0, 2.0 * np.pi)
    low, high = angle - 2.0 * np.pi, angle
    while not inside(moved := np.asarray(state * np.cos(angle) + other * np.sin(angle))):
        low, high = (angle, high) if angle < 0.0 else (low, angle)
        angle = random.uniform(low, high)
    return moved


def _root(covariance: Array) -> Array:
    """Return L (p, d) with L L' the covariance; rows of infinite variance are zero."""
    known = np.isfinite(np.diag(covariance))
    own = covariance[np.ix_(known, known)]
    scale = _units(own)
    eigenvalues, vectors = np.linalg.eigh(own / np.outer(scale, scale))
    root = np.zeros((len(covariance), len(own)))
    root[known] = scale[:, None] * vectors * np.sqrt(np.maximum(eigenvalues, 0.0))
    return root


def _lift(model: RobotModel, centre: Array) -> Array:
    """Return the smallest change of standard parameters per change of base parameters (s, b)."""
    layout = model.layout
    metric = np.zeros((layout.size, layout.size))
    for places in layout.links:
        curvature = _curvature(pseudo_inertia(centre[places]), pseudo_inertia_map())
        metric[np.ix_(places, places)] = np.linalg.inv(curvature)
    rotors = layout.rotor_matrix(centre)
    turning = np.diag(rotors) > _ROUNDING * np.abs(rotors).max(initial=0.0)
    if turning.any():
        places = np.concatenate([layout.rotors, layout.couplings])
        entries = np.array([layout.rotor_matrix(one) for one in np.eye(layout.size)[places]])
        free = ~entries[:, ~turning].any(axis=(1, 2))  # a rotor of zero is on its bound
        own = np.ix_(turning, turning)
        curvature = _curvature(rotors[own], entries[free][:, *own])
        metric[np.ix_(places[free], places[free])] = np.linalg.inv(curvature)
    grouping = model.base.grouping
    spread = metric @ grouping.T
    scale = _units(grouping @ spread)
    gain = np.linalg.pinv(grouping @ spread / np.outer(scale, scale), hermitian=True)
    return np.asarray(spread @ (gain / np.outer(scale, scale)))


def _curvature(matrix: Array, entries: Array) -> Array:
    """Return the Hessian of -log det (d, d) at a matrix (k, k), for its entries (d, k, k)."""
    turned = np.linalg.solve(matrix, entries)
    return np.asarray(np.einsum("kab,lba->kl", turned, turned))


def _units(matrix: Array) -> Array:
    """Return the roots of a diagonal (d,), one for zero."""
    diagonal = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    return np.where(diagonal > 0.0, diagonal, 1.0)


def _dissipating(model: RobotModel, coefficients: Array) -> Array:
    """Return friction coefficients (N, k), those that would give energy reflected at zero."""
    combine, not_negative = dissipation(model.friction)
    free = np.linalg.solve(combine, coefficients.T)
    return np.asarray((combine @ np.where(not_negative[:, None], np.abs(free), free)).T)
